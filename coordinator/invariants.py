"""What must hold of the coordinator's parts between any two events, whatever workers send."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

from coordinator.evaluations import EvaluationSchedule, rank
from coordinator.learner_registry import LearnerRecord
from coordinator.leases import LeaseTable
from coordinator.stand_ins import StandIns
from t4nmtd_dist.core.invariants import require
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.high_level import QEntries
from t4nmtd_dist.wire.messages import EventLine, LearnerStats
from t4nmtd_dist.wire.statistics import by_name, declared


def check_leases(table: LeaseTable, now: float) -> None:
    """Leases are on known places, under their newest epochs, and last no longer than they may."""
    epochs = table.epochs()
    for lease in table.all():
        where = f"the lease on {lease.place}"
        require(lease.place in table.places, f"{where} is on no known place")
        require(1 <= lease.epoch == epochs[lease.place], f"{where}: epoch {lease.epoch}, newest {epochs[lease.place]}")
        require(lease.heard <= now, f"{where} was heard in the future")
        require(lease.heard <= lease.expires <= lease.heard + table.duration, f"{where} expires out of turn")
        require(not lease.released or lease.expires == lease.heard, f"{where} is released and lasts")
    held = [lease.place for lease in table.holders(now)]
    require(len(set(held)) == len(held), f"a place is held twice: {held}")


def check_stand_ins(stand_ins: StandIns, table: LeaseTable) -> None:
    """A stand-in's lease is one that the table gave."""
    newest = max(table.epochs().values())
    require(stand_ins.epoch <= newest, f"a stand-in holds epoch {stand_ins.epoch}, newest {newest}")


def check_records(records: Mapping[str, LearnerRecord], leases: LeaseTable, task: CompiledTask, now: float) -> None:
    """There is one record for each sub-task; its counts, weights and marks fit together and its lease."""
    pids = task.decomposition.pids
    require(tuple(records) == tuple(pids) == leases.places, f"records and leases are not those of {pids}")
    for pid, record in records.items():
        check_statistics(pid, record.earlier)
        check_statistics(pid, record.current)
        require(record.sequence >= 0, f"{pid}: sequence {record.sequence}")
        require(record.version >= 0, f"{pid}: version {record.version}")
        require(bool(record.weights) == (record.version > 0), f"{pid}: version {record.version} with other weights")
        lost = record.lost and leases.live(pid, now)
        require(not lost, f"{pid} counts as lost under a live lease")
        check_buffer(pid, record, task)


def check_statistics(pid: str, stats: LearnerStats) -> None:
    """Counters are within their bounds, and all other statistics are finite."""
    values = by_name(stats)
    for name, found in declared(LearnerStats).items():
        value = values[name]
        require(value is None or math.isfinite(value), f"{pid}: {name} = {value}")
        if found.statistic.counter:
            require(value is not None and 0 <= value <= found.most, f"{pid}: {name} = {value}")


def check_buffer(pid: str, record: LearnerRecord, task: CompiledTask) -> None:
    """An initial-state buffer is bounded and holds states only from which its sub-task can go on."""
    buffer, capacity = record.buffer, task.config.learner.start_capacity
    require(len(buffer) <= buffer.cursor, f"{pid}: {len(buffer)} start states numbered up to {buffer.cursor}")
    for q in buffer.states_present():
        where = f"the start states of {pid} in {q}"
        require(q in range(task.dfa.states), f"{where}: no such DFA state")
        require(q not in task.terminal, f"{where}: the DFA state is terminal")
        require(pid in task.decomposition.available(q), f"{where}: the sub-task is not available there")
        require(buffer.count(q) <= capacity, f"{where}: {buffer.count(q)}, at most {capacity} are kept")


def check_q_table(entries: QEntries, task: CompiledTask) -> None:
    """Q entries are finite numbers of known DFA states and sub-tasks."""
    pids = set(task.decomposition.pids)
    for q, pid, value in entries:
        require(math.isfinite(value), f"Q({q}, {pid}) = {value}")
        require(q in range(task.dfa.states) and pid in pids, f"Q({q}, {pid}): no such DFA state or sub-task")


def check_evaluations(evaluations: EvaluationSchedule, records: Mapping[str, LearnerRecord]) -> None:
    """Evaluations are in order; one that is under way is of weights that were received; the best is the best."""
    jobs = [row.job for row in evaluations.history]
    require(all(a < b for a, b in pairwise([0, *jobs])), f"evaluations are out of order: {jobs}")
    require(0 <= evaluations.processor_s < math.inf, f"evaluations took {evaluations.processor_s} s")
    pending = evaluations.pending
    if pending is not None:
        require(pending.job > max(jobs, default=0), f"evaluation {pending.job} is under way after {jobs}")
        ahead = {pid: version for pid, version in pending.versions.items() if version > records[pid].version}
        require(not ahead, f"an evaluation is of versions that are not known: {ahead}")
        require(set(pending.weights) == set(pending.versions), "an evaluation's weights are not those of its versions")
    best = None if evaluations.best is None else rank(evaluations.best.row)
    better = [row.job for row in evaluations.history if best is None or rank(row) > best]
    require(not better, f"the policies of evaluations {better} were better than the best")


def check_events(lines: Sequence[EventLine], most: int) -> None:
    """The event log is bounded and in order."""
    require(len(lines) <= most, f"{len(lines)} lines are kept of the event log")
    times = [line.elapsed_s for line in lines]
    require(times == sorted(times), "the event log is out of order")
