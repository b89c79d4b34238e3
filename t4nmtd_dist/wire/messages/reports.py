"""The coordinator's reports on a run, and notices for its event log."""

from __future__ import annotations

from typing import Literal

from msgspec import field

from t4nmtd_dist.wire.messages.base import Message
from t4nmtd_dist.wire.messages.evaluations import EvaluationRow
from t4nmtd_dist.wire.messages.statistics import LearnerPhase, LearnerStats

RunPhase = Literal["starting", "training", "solved", "budget spent", "stopped"]


class LearnerRow(Message, frozen=True):
    """One learner on the dashboard.

    ``phase`` is the coordinator's view; the one in ``total`` is the learner's. ``total`` covers all epochs. ``rates``
    are counters per second over the last ten seconds, by name. ``heartbeat_age_s`` None: no heartbeat yet. ``hint``:
    why it is stuck and what to try; empty if it is not.
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
    """One known entry of the high-level Q-table."""

    q: int
    pid: str
    value: float
    greedy: bool


class EventLine(Message, frozen=True):
    """A line of the event log and its time in seconds since the start."""

    elapsed_s: float
    text: str


class Missing(Message, frozen=True):
    """A process that a manually started run lacks, and the command to start it; ``needed`` False: optional."""

    what: str
    command: str
    needed: bool = True

    @property
    def text(self) -> str:
        """A line for display."""
        if self.needed:
            return f"missing {self.what}: {self.command}"
        return f"no {self.what}: {self.command} (until then workers evaluate between their turns)"


class StatusRequest(Message, frozen=True, tag="status_request"):
    """Any client -> coordinator: requests the run's status; read-only."""


class Status(Message, frozen=True, tag="status"):
    """Coordinator -> client. ``clock`` is Unix time in seconds, ``policy`` the best evaluation so far."""

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
    """Coordinator -> dashboards: the full state; any single message suffices to draw everything."""

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
    """Launcher -> coordinator: a line for the event log, such as how a worker ended. Not answered."""

    text: str


class Failure(Message, frozen=True, tag="failure"):
    """Reply to a message that could not be understood."""

    text: str
