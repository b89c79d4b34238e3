"""The coordinator's checkpointed state, and its more often saved counts."""

from __future__ import annotations

import msgspec

from coordinator.state import CoordinatorState
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.wire.messages import EventLine, LearnerStats


def saved_state(state: CoordinatorState) -> State:
    """Everything but leases and the pending evaluation, which a resumed run creates again.

    Weights are not copied: their arrays are replaced, never modified.
    """
    return {
        "high_level": state.method.entries(),
        "method": state.method.state_dict(),
        "rng": state.rng.bit_generator.state,
        "records": {pid: record.state_dict() for pid, record in state.records.items()},
        "evaluations": state.evaluations.state_dict(),
        "events": msgspec.to_builtins(list(state.events)),
        "snapshot": state.snapshot,
        "solved": state.outcome == "solved",
        "counts": saved_counts(state),
    }


def load_saved_state(state: CoordinatorState, saved: State) -> None:
    """Restore a ``saved_state`` into a fresh coordinator of the same run."""
    state.method.load((q, pid, value) for q, pid, value in saved["high_level"])
    if "method" in saved:
        state.method.load_state_dict(saved["method"])
    state.rng.bit_generator.state = saved["rng"]
    for pid, record in state.records.items():
        record.load_state_dict(saved["records"][pid])
    state.evaluations.load_state_dict(saved["evaluations"])
    state.events.clear()  # a serial run claims leases before it loads the state
    state.events.extend(msgspec.convert(saved["events"], list[EventLine]))
    state.snapshot = saved["snapshot"]
    _raise_clock(state, saved["counts"])
    if saved.get("solved", False):
        state.outcome = "solved"


def saved_counts(state: CoordinatorState) -> State:
    """What must survive between checkpoints: time, epochs, and learners' counts."""
    return {
        "elapsed_s": state.elapsed_s,
        "epochs": state.leases.epochs() | state.evaluator_lease.epochs(),
        "evaluated": len(state.evaluations.history),
        "outcome": state.outcome,
        "totals": {pid: msgspec.to_builtins(record.total) for pid, record in state.records.items()},
    }


def raise_counts(state: CoordinatorState, counts: State) -> None:
    """Include counts made since the loaded checkpoint, if there was one.

    Later evaluations are lost, so the count of consecutive successes restarts.
    """
    for pid, total in counts["totals"].items():
        if pid in state.records:
            state.records[pid].raise_counts(msgspec.convert(total, LearnerStats))
    if counts["evaluated"] > len(state.evaluations.history):
        state.evaluations.begin_row()
    _raise_clock(state, counts)


def _raise_clock(state: CoordinatorState, counts: State) -> None:
    state.clock.earlier_s = max(state.clock.earlier_s, counts["elapsed_s"])
    state.leases.raise_epochs(counts["epochs"])
    state.evaluator_lease.raise_epochs(counts["epochs"])
