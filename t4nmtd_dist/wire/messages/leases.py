"""Messages about leases: the right to train a sub-task, or to evaluate."""

from __future__ import annotations

from typing import Any, Literal

from t4nmtd_dist.wire.fields import Address, Count, Name
from t4nmtd_dist.wire.messages.base import Message

Role = Literal["learner", "evaluator"]


class Claim(Message, frozen=True, tag="claim"):
    """Worker -> coordinator: requests a lease on a sub-task, or the evaluator role.

    ``pid`` None means the next free sub-task. ``instance`` names the worker process, which may claim again its own
    lease, under a new epoch. ``stand_in``: a learner's worker claims the evaluator role for one evaluation.
    """

    role: Role
    instance: Name
    pid: Name | None = None
    critic_endpoint: Address = ""
    stand_in: bool = False


class Granted(Message, frozen=True, tag="granted"):
    """Coordinator -> worker: a lease. arrays: the sub-task's newest weights, if any (``weights.*``).

    ``asked`` repeats the claim's ``pid``, which may be a number such as p1; "" if it named none.
    """

    role: Role
    pid: str
    epoch: int
    lease_s: float
    seed: int
    task: dict[str, Any]
    dfa: dict[str, Any]
    decomposition: dict[str, Any]
    rho: list[float]
    version: int = 0
    run_id: str = ""
    asked: str = ""


class Refused(Message, frozen=True, tag="refused"):
    """Coordinator -> worker: no lease. ``final``: retrying cannot help."""

    reason: Literal["unknown pid", "lease is live", "nothing free", "stale epoch"]
    text: str
    final: bool
    pid: str | None = None


class Release(Message, frozen=True, tag="release"):
    """Worker -> coordinator: returns a lease."""

    pid: Name
    epoch: Count


class Goodbye(Message, frozen=True, tag="goodbye"):
    """Coordinator -> worker: the run is over; exit."""

    reason: str
