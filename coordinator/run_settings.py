"""What a run adds to its task."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RunSettings:
    """What a run adds to its task.

    Attributes:
        run_id: names the run, however often it is resumed, so that workers know which checkpoints are of it.
        lease_s: seconds of silence after which a worker counts as lost.
    """

    seed: int
    max_interactions: int
    run_dir: str = ""
    lease_s: float = 10.0
    run_id: str = ""
