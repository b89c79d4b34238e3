"""Diagnoses learners that reach no target: likely causes and settings to try."""

from __future__ import annotations

from collections.abc import Mapping

from coordinator.learner_registry import LearnerRecord
from t4nmtd_dist.core.agent_settings import agent_settings
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.wire.messages import LearnerStats

MANY_ATTEMPTS = 2000
MANY_INTERACTIONS = 20_000
RARE = 0.01  # of all attempts
RARE_LATELY = 0.05  # of the recent ones
LOOK_EVERY_S, REPORT_EVERY_S = 2.0, 600.0
PREDECESSORS_NAMED = 4

Records = Mapping[str, LearnerRecord]


def stuck_lines(pid: str, records: Records, task: CompiledTask) -> list[str]:
    """Symptoms, likely causes and settings to try for a stuck learner, else nothing."""
    stats = records[pid].total
    if _waits(pid, stats, records, task):
        return [f"{pid}: {line}" for line in _waiting(pid, records, task)]
    many = stats.attempts >= MANY_ATTEMPTS or (stats.interactions >= MANY_INTERACTIONS and stats.attempts > 0)
    lately = stats.recent_success is not None and stats.recent_success >= RARE_LATELY
    if not many or lately or stats.successes > RARE * stats.attempts:
        return []
    return [f"{pid}: {line}" for line in (_counts(stats), *_advice(stats, task))]


def _waits(pid: str, stats: LearnerStats, records: Records, task: CompiledTask) -> bool:
    """Whether it never had a start state, long into the run."""
    if stats.interactions or len(records[pid].buffer) or pid in task.decomposition.available(task.dfa.initial):
        return False
    return _interactions(records) >= MANY_INTERACTIONS


def _interactions(records: Records) -> int:
    return sum(record.total.interactions for record in records.values())


def _waiting(pid: str, records: Records, task: CompiledTask) -> list[str]:
    subtasks, available = task.decomposition.subtasks, task.decomposition.available
    predecessors = [
        each for each, taus in subtasks.items() if each != pid and any(pid in available(to) for _, to in taus)
    ]
    named = [_successes(each, records[each].total) for each in predecessors[:PREDECESSORS_NAMED]]
    more = f" and {len(predecessors) - PREDECESSORS_NAMED} more" if len(predecessors) > PREDECESSORS_NAMED else ""
    spent = f"{_interactions(records):,} interactions of all learners"
    return [
        f"no start state has come in {spent}, so it has made no attempt",
        f"one of these must reach its target first: {', '.join(named) or 'none'}{more}; see what holds them up",
    ]


def _successes(pid: str, stats: LearnerStats) -> str:
    return f"{pid} ({stats.successes:,} of {stats.attempts:,} attempts)"


def _counts(stats: LearnerStats) -> str:
    ways = [
        (stats.timeouts, "ran out of time"),
        (stats.errors, "ended in an error state"),
        (stats.terminated, "were ended by the environment"),
        (_strayed(stats), "ended in another DFA state"),
    ]
    least = max(1.0, 0.01 * stats.attempts)
    shares = [f"{count / stats.attempts:.0%} {what}" for count, what in ways if count >= least]
    reached = f"{stats.successes:,} of {stats.attempts:,} attempts reached a target"
    return f"{reached}; {', '.join(shares)}" if shares else reached


def _strayed(stats: LearnerStats) -> int:
    return max(0, stats.attempts - stats.successes - stats.timeouts - stats.errors - stats.terminated)


def _advice(stats: LearnerStats, task: CompiledTask) -> list[str]:
    """Likely causes and settings to try, by most attempts' ending."""
    learner = task.config.learner
    explore = " or ".join(agent_settings(learner.algorithm).exploration)
    ends = {
        "timeouts": (
            f"the target is further away than learner.attempt_steps = {learner.attempt_steps}, or too rare to be "
            "found by chance",
            f"learner.attempt_steps, more exploration ({explore}), an intermediate goal in the formula",
        ),
        "errors": (
            "the error state is easier to come by than the target, or a label holds where it should not",
            f"learner.error_penalty (now {learner.error_penalty:g}), more exploration ({explore}), `t4nmtd check`",
        ),
        "terminated": (
            "the environment reports terminated before the target can be reached",
            "`t4nmtd check`, the environment's own ends, a smaller learner.gamma",
        ),
        "strayed": (
            "other sub-tasks' goals come first, after which this one has no transition",
            "`t4nmtd inspect` to see the transitions, another decomposition.mode, the formula",
        ),
    }
    counts = {
        "timeouts": stats.timeouts,
        "errors": stats.errors,
        "terminated": stats.terminated,
        "strayed": _strayed(stats),
    }
    cause, cure = ends[max(counts, key=lambda way: counts[way])]
    rare = " (a hard target may take 100,000 interactions before its first success)" if not stats.successes else ""
    return [f"likely causes: {cause}{rare}", f"try: {cure}"]


class StuckDetector:
    """Reports each stuck learner to the event log at once, then every ten minutes."""

    def __init__(self) -> None:
        self._look_at: dict[str, float] = {}

    def due_lines(self, pid: str, records: Records, task: CompiledTask, elapsed_s: float) -> list[str]:
        """Lines that are due about a learner.

        Args:
            pid: the sub-task.
            records: of all learners.
            task: the compiled task.
            elapsed_s: seconds since the start of the run.
        """
        if elapsed_s < self._look_at.get(pid, 0.0):
            return []
        lines = stuck_lines(pid, records, task)
        self._look_at[pid] = elapsed_s + (REPORT_EVERY_S if lines else LOOK_EVERY_S)
        return lines
