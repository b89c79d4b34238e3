"""Settings of a run that are not part of its task."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run that are not part of its task.

    Attributes:
        run_id: identifies the run across resumes, so that workers recognise its checkpoints.
        lease_s: seconds of silence until a worker is lost.
        transfer_from: folder of the policy whose networks sub-tasks of the same name begin with; "" for none.
    """

    seed: int
    max_interactions: int
    run_dir: str = ""
    lease_s: float = 10.0
    run_id: str = ""
    transfer_from: str = ""
