"""Refused claims: the reason and what to do."""

from __future__ import annotations

from collections.abc import Sequence

from coordinator.leases import Lease
from coordinator.numbering import names_with_numbers
from t4nmtd_dist.wire.messages import Claim, Refused, Sync


def unknown_pid(task: str, pid: str, pids: Sequence[str]) -> Refused:
    """The task has no sub-task with this name or number."""
    text = f"unknown pid {pid!r}; the sub-tasks of {task} are {names_with_numbers(pids)}"
    return Refused(reason="unknown pid", text=text, final=True, pid=pid)


def live_lease(claim: Claim, place: str, lease: Lease | None, now: float) -> Refused:
    """Another worker holds the place. A learner may give up; an evaluator stands by."""
    holder = lease.instance if lease else "another worker"
    remaining = lease.expires - now if lease else 0.0
    number = f"{claim.pid} is {place}; " if claim.role == "learner" and claim.pid not in (None, place) else ""
    text = f"{number}{place} is held by {holder}, whose lease is live for {remaining:.0f} s more; "
    learner = claim.role == "learner"
    text += "stop that worker first, or start this one without --pid to stand by" if learner else "standing by"
    return Refused(reason="lease is live", text=text, final=learner, pid=place)


def stale_learner(sync: Sync, lease: Lease | None) -> Refused:
    """A learner's epoch is over, or another connection holds it; ``lease`` is the newest."""
    if lease is None:
        text = f"no lease on {sync.pid!r} is known here (the coordinator was started again); claim it again"
    else:
        text = f"epoch {sync.epoch} of {sync.pid} is over: {lease.instance} holds epoch {lease.epoch}"
    final = lease is not None and sync.epoch != lease.epoch  # same epoch: the same learner, reconnected
    return Refused(reason="stale epoch", text=text, final=final, pid=sync.pid)


def stale_evaluator(place: str) -> Refused:
    """An evaluator's lease is over."""
    text = "this evaluator's place was taken by another, or the coordinator was started again"
    return Refused(reason="stale epoch", text=text, final=False, pid=place)
