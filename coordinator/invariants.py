"""Invariants of the coordinator's parts between events, whatever workers send."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise

from coordinator.evaluations import EvaluationSchedule, rank
from coordinator.learner_registry import LearnerRecord
from coordinator.leases import LeaseTable
from coordinator.stand_ins import StandIns
from t4nmtd_dist.core.invariants import require
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.high_level import QEntries
from t4nmtd_dist.method.start_states import CAPACITY
from t4nmtd_dist.wire.messages import EventLine, LearnerStats
from t4nmtd_dist.wire.statistics import by_name, declared


def check_leases(table: LeaseTable, now: float) -> None:
    """Leases are on known places, have the newest epochs, and expire in time."""
    epochs = table.epochs()
    for lease in table.all():
        where = ("lease on", lease.place)
        require(lease.place in table.places, "{} is on no known place", where)
        require(
            1 <= lease.epoch == epochs[lease.place], "{}: epoch {}, newest {}", where, lease.epoch, epochs[lease.place]
        )
        require(lease.heard <= now, "{} was heard in the future", where)
        require(lease.heard <= lease.expires <= lease.heard + table.duration, "{} expires out of turn", where)
        require(not lease.released or lease.expires == lease.heard, "{} is released and lasts", where)
    held = [lease.place for lease in table.holders(now)]
    require(len(set(held)) == len(held), "a place is held twice: {}", held)


def check_stand_ins(stand_ins: StandIns, table: LeaseTable) -> None:
    """A stand-in's lease was granted by the table."""
    newest = max(table.epochs().values())
    require(stand_ins.epoch <= newest, "a stand-in holds epoch {}, newest {}", stand_ins.epoch, newest)


def check_records(records: Mapping[str, LearnerRecord], leases: LeaseTable, task: CompiledTask, now: float) -> None:
    """There is one record per sub-task, consistent in itself and with its lease."""
    pids = task.decomposition.pids
    require(tuple(records) == tuple(pids) == leases.places, "records and leases are not those of {}", pids)
    for pid, record in records.items():
        check_statistics(pid, record.earlier)
        check_statistics(pid, record.current)
        require(record.sequence >= 0, "{}: sequence {}", pid, record.sequence)
        require(record.version >= 0, "{}: version {}", pid, record.version)
        require(bool(record.weights) == (record.version > 0), "{}: version {} with other weights", pid, record.version)
        lost = record.lost and leases.live(pid, now)
        require(not lost, "{} counts as lost under a live lease", pid)
        check_buffer(pid, record, task)


def check_statistics(pid: str, stats: LearnerStats) -> None:
    """Counters are within bounds; other statistics are finite."""
    wrong = _out_of_bounds(stats)
    require(not wrong, "{}: {}", pid, wrong)


@lru_cache(maxsize=1000)  # an event changes the statistics of one learner only
def _out_of_bounds(stats: LearnerStats) -> str:
    """The invalid statistics; empty if there are none."""
    values, wrong = by_name(stats), []
    for name, found in declared(LearnerStats).items():
        value = values[name]
        counted = value is not None and 0 <= value <= found.most
        if (found.statistic.counter and not counted) or (value is not None and not math.isfinite(value)):
            wrong.append(f"{name} = {value}")
    return ", ".join(wrong)


def check_buffer(pid: str, record: LearnerRecord, task: CompiledTask) -> None:
    """An initial-state buffer is bounded and holds only its sub-task's start states."""
    buffer = record.buffer
    require(len(buffer) <= buffer.cursor, "{}: {} start states numbered up to {}", pid, len(buffer), buffer.cursor)
    for q in buffer.states_present():
        where, count = (pid, q), buffer.count(q)
        require(q in range(task.dfa.states), "start states {}: no such DFA state", where)
        require(q not in task.terminal, "start states {}: the DFA state is terminal", where)
        require(pid in task.decomposition.available(q), "start states {}: the sub-task is not available there", where)
        require(count <= CAPACITY, "start states {}: {}, at most {} are kept", where, count, CAPACITY)


def check_q_table(entries: QEntries, task: CompiledTask) -> None:
    """Q entries are finite and belong to known DFA states and sub-tasks."""
    pids = set(task.decomposition.pids)
    for q, pid, value in entries:
        require(math.isfinite(value), "Q({}, {}) = {}", q, pid, value)
        require(q in range(task.dfa.states) and pid in pids, "Q({}, {}): no such DFA state or sub-task", q, pid)


def check_evaluations(evaluations: EvaluationSchedule, records: Mapping[str, LearnerRecord]) -> None:
    """Evaluations are in order, use received weights, and are not better than the best."""
    jobs = [row.job for row in evaluations.history]
    require(all(a < b for a, b in pairwise([0, *jobs])), "evaluations are out of order: {}", jobs)
    require(0 <= evaluations.processor_s < math.inf, "evaluations took {} s", evaluations.processor_s)
    pending = evaluations.pending
    if pending is not None:
        require(pending.job > max(jobs, default=0), "evaluation {} is under way after {}", pending.job, jobs)
        ahead = {pid: version for pid, version in pending.versions.items() if version > records[pid].version}
        require(not ahead, "an evaluation is of versions that are not known: {}", ahead)
        require(set(pending.weights) == set(pending.versions), "an evaluation's weights are not those of its versions")
    best = None if evaluations.best is None else rank(evaluations.best.row)
    better = [row.job for row in evaluations.history if best is None or rank(row) > best]
    require(not better, "the policies of evaluations {} were better than the best", better)


def check_events(lines: Sequence[EventLine], most: int) -> None:
    """The event log is bounded and in order."""
    require(len(lines) <= most, "{} lines are kept of the event log", len(lines))
    times = [line.elapsed_s for line in lines]
    require(times == sorted(times), "the event log is out of order")
