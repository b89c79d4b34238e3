"""What the coordinator reports about a run, and what it is told for its event log."""

from __future__ import annotations

from typing import Literal

from msgspec import field

from t4nmtd_dist.wire.messages.base import Message
from t4nmtd_dist.wire.messages.evaluations import EvaluationRow
from t4nmtd_dist.wire.messages.statistics import LearnerPhase, LearnerStats

RunPhase = Literal["starting", "training", "solved", "budget spent", "stopped"]


class LearnerRow(Message, frozen=True):
    """One learner on the dashboard.

    ``phase`` is the coordinator's word, that in ``total`` the learner's. ``total`` is over all epochs. ``rates`` are of
    counters, per second over the last ten, by name. ``heartbeat_age_s`` None: never heard of. ``hint``: lines on why
    it is stuck and what to try; empty if it is not.
    """

    pid: str
    phase: LearnerPhase
    worker: str
    epoch: int
    version: int
    starts_waiting: int
    heartbeat_age_s: float | None
    total: LearnerStats = LearnerStats()
    rates: dict[str, float] = field(default_factory=dict)
    hint: str = ""


class QCell(Message, frozen=True):
    """One known entry of the high-level Q table."""

    q: int
    pid: str
    value: float
    greedy: bool


class EventLine(Message, frozen=True):
    """Something worth telling: when (seconds since the start) and what."""

    elapsed_s: float
    text: str


class Missing(Message, frozen=True):
    """What a training started by hand lacks, and the command that brings it; ``needed`` False: it can do without."""

    what: str
    command: str
    needed: bool = True

    @property
    def text(self) -> str:
        """The same for people."""
        if self.needed:
            return f"missing {self.what}: {self.command}"
        return f"no {self.what}: {self.command} (until then workers evaluate between their turns)"


class StatusRequest(Message, frozen=True, tag="status_request"):
    """Anyone -> coordinator: how is the run? Changes nothing."""


class Status(Message, frozen=True, tag="status"):
    """Coordinator -> who asked. ``clock`` is in seconds of Unix time, ``policy`` the best evaluation so far."""

    program: str
    clock: float
    task: str
    seed: int
    run_dir: str
    phase: RunPhase
    elapsed_s: float
    interactions: int
    max_interactions: int
    success_rate: float | None
    solved_in_a_row: int
    solved_needed: int
    evaluator: str
    learners: list[LearnerRow]
    critics: dict[str, str]
    success_needed: float = 1.0
    solved_at: int | None = None
    policy: EvaluationRow | None = None
    missing: list[Missing] = field(default_factory=list)


class DashboardState(Message, frozen=True, tag="dashboard_state"):
    """Coordinator -> dashboards: the full state, so that any one message is enough to draw all."""

    task: str
    title: str
    formula: str
    run_dir: str
    seed: int
    phase: RunPhase
    elapsed_s: float
    interactions: int
    max_interactions: int
    dfa_states: int
    accepting: list[int]
    error: list[int]
    dist: list[float | None]
    solved_in_a_row: int
    solved_needed: int
    learners: list[LearnerRow]
    q_table: list[QCell]
    evaluations: list[EvaluationRow]
    events: list[EventLine]
    acceptance: Literal["first", "end"] = "first"
    success_needed: float = 1.0
    solved_at: int | None = None
    policy: EvaluationRow | None = None
    missing: list[Missing] = field(default_factory=list)


class Notice(Message, frozen=True, tag="notice"):
    """Launcher -> coordinator: something that belongs into the event log, such as how a worker ended. Not answered."""

    text: str


class Failure(Message, frozen=True, tag="failure"):
    """Answer to a message that could not be understood."""

    text: str
