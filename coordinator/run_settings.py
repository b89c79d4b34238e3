"""Settings of a run, beside its task."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run, beside its task.

    Attributes:
        run_id: identifies the run across resumes, so that workers recognise its checkpoints.
        lease_s: seconds of silence after which a worker counts as lost.
    """

    seed: int
    max_interactions: int
    run_dir: str = ""
    lease_s: float = 10.0
    run_id: str = ""
