"""Every message of the protocol as a typed Struct; docs/protocol.md says who sends which and when.

Arrays never travel inside these bodies: they follow as raw frames, by name (see ``wire.codec``). The comment
"arrays:" in a docstring names them. What clients and peers send is bounded field by field (``wire.fields``).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.wire.fields import Address, Amount, Count, Finite, Name, OptionalName, Share, StateNumber, Version

PROTOCOL_VERSION = 3
LONGEST_PATH = 4000  # below the longest list that a header may hold

Role = Literal["learner", "evaluator"]
LearnerPhase = Literal["free", "waiting", "training", "lost"]
RunPhase = Literal["starting", "training", "solved", "budget spent", "stopped"]


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What all messages share: nothing but strictness."""


class Claim(Message, frozen=True, tag="claim"):
    """Worker -> coordinator: asks for a lease on a sub-task, or for the evaluator's place.

    ``pid`` None means the next free sub-task. ``instance`` names the worker process, so that a repeated claim
    of the same process renews its lease instead of colliding with it. ``stand_in``: a learner's worker claims the
    evaluator's place for one evaluation between its turns.
    """

    role: Role
    instance: Name
    pid: Name | None = None
    critic_endpoint: Address = ""
    stand_in: bool = False


class Granted(Message, frozen=True, tag="granted"):
    """Coordinator -> worker: a lease. arrays: the newest weights of the sub-task, if any (``weights.*``).

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
    """Coordinator -> worker: no lease. ``final`` says that asking again cannot help."""

    reason: Literal["unknown pid", "lease is live", "nothing free", "stale epoch", "finished"]
    text: str
    final: bool
    pid: str | None = None


class Intervention(Message, frozen=True):
    """Counts of critic values asked from peers, in rows, since the lease began (learners.peers says what of)."""

    asked: Count = 0
    answered: Count = 0
    late: Count = 0
    own_used: Count = 0
    lag_total: Count = 0


class LearnerStats(Message, frozen=True):
    """Cumulative counts of one learner since its lease began; the coordinator adds earlier epochs.

    ``peer_rows``: experiences of peers that it can learn from now. ``processor_s``: what acting and learning took.
    ``errors``, ``timeouts`` and ``terminated``: attempts without success that ended in an error state, by lack of
    time, and with the environment.
    """

    phase: LearnerPhase = "waiting"
    interactions: Count = 0
    gradient_steps: Count = 0
    attempts: Count = 0
    successes: Count = 0
    recent_success: float | None = None
    episode_steps: float | None = None
    entropy: float | None = None
    value_loss: float | None = None
    peer_rows: Count = 0
    processor_s: Amount = 0.0
    intervention: Intervention = Intervention()
    errors: Count = 0
    timeouts: Count = 0
    terminated: Count = 0


class Sync(Message, frozen=True, tag="sync"):
    """Learner -> coordinator, several times a second: heartbeat, progress, weights.

    ``sequence`` numbers the batch of progress; a repeat of a number changes nothing, and 0 is a heartbeat without
    progress. ``start_cursor`` is the newest start state the learner holds. arrays: ``progress.q`` int32 [n, 3]
    (q, q' or -1, steps), ``progress.reward`` float64 [n], ``starts.q`` int32 [m], ``starts.state`` [m, s], and
    ``weights.*`` when ``version`` is newer than what was sent before.
    """

    pid: Name
    epoch: Count
    sequence: Count
    version: Count
    start_cursor: Count
    stats: LearnerStats


class Peer(Message, frozen=True):
    """Where a peer's critic answers, and the newest version of its weights that the coordinator knows.

    ``key`` is the public key by which the peer is known; empty where the coordinator has no keys.
    """

    endpoint: str
    version: int
    epoch: int
    key: str = ""


class SyncReply(Message, frozen=True, tag="sync_reply"):
    """Coordinator -> learner. arrays: ``starts.q`` int32 [m] and ``starts.state`` [m, s], the new start states.

    ``evaluate``: there is no evaluator and an evaluation is due, so this learner's worker may stand in for one.
    """

    pid: str
    epoch: int
    accepted_sequence: int
    start_cursor: int
    q_table: list[tuple[int, str, float]]
    peers: dict[str, Peer]
    evaluate: bool = False


class Release(Message, frozen=True, tag="release"):
    """Worker -> coordinator: gives a lease back."""

    pid: Name
    epoch: Count


class EvaluationPoll(Message, frozen=True, tag="evaluation_poll"):
    """Evaluator -> coordinator, every second while idle: heartbeat, and answered by a job once one is due.

    ``busy``: only a heartbeat in the midst of an evaluation, which is answered by job 0.
    """

    epoch: Count
    busy: bool = False


class EvaluationJob(Message, frozen=True, tag="evaluation_job"):
    """Coordinator -> evaluator. ``job`` 0: nothing to do yet. arrays: ``<pid>/weights.actor.*`` of every sub-task.

    ``actions``: the modes to play. The first is played, another only where those before it fall short of
    ``evaluation.success``.
    """

    job: int
    interactions: int = 0
    q_table: list[tuple[int, str, float]] = []
    versions: dict[str, int] = {}
    actions: tuple[ActionMode, ...] = ("greedy",)


class EvaluationReport(Message, frozen=True, tag="evaluation_report"):
    """Evaluator -> coordinator: what the episodes of one job came to.

    All figures are of the mode ``actions``; ``other_success_rate`` is that of the other one where both were played.
    """

    epoch: Count
    job: Count
    success_rate: Share
    mean_length: Amount
    std_length: Amount
    mean_return: Finite
    episodes: Count
    dfa_path: Annotated[list[StateNumber], Meta(max_length=LONGEST_PATH)]
    processor_s: Amount = 0.0
    actions: ActionMode = "greedy"
    other_success_rate: Share | None = None


class Goodbye(Message, frozen=True, tag="goodbye"):
    """Coordinator -> worker: the run is over; end."""

    reason: str


class StatusRequest(Message, frozen=True, tag="status_request"):
    """Anyone -> coordinator: how is the run? Changes nothing."""


class Notice(Message, frozen=True, tag="notice"):
    """Launcher -> coordinator: something that belongs into the event log, such as how a worker ended. Not answered."""

    text: str


class Failure(Message, frozen=True, tag="failure"):
    """Answer to a message that could not be understood."""

    text: str


class ValueRequest(Message, frozen=True, tag="value_request"):
    """Learner -> peer. arrays: ``observation`` float32 [k, d] and ``q`` int32 [k], the states after the change."""

    pid: Name


class ValueReply(Message, frozen=True, tag="value_reply"):
    """Peer -> learner. arrays: ``value`` float32 [k]."""

    version: Count


class WeightsRequest(Message, frozen=True, tag="weights_request"):
    """Learner -> peer: the networks that value requests are answered from, if newer than ``newer_than``; -1: any."""

    pid: Name
    newer_than: Version


class WeightsReply(Message, frozen=True, tag="weights_reply"):
    """Peer -> learner. arrays: ``weights.*`` of that version; none if it is not newer than what was named."""

    version: Count


class ExperienceRequest(Message, frozen=True, tag="experience_request"):
    """Learner -> peer: what the learner of ``pid`` has lived through, from its step number ``step`` on."""

    pid: Name
    step: Count


class ExperienceReply(Message, frozen=True, tag="experience_reply"):
    """Peer -> learner. arrays: ``experience.*`` [T, N, ...], T steps of N copies of the environment from ``first`` on.

    ``first`` is above what was asked for where the peer does not keep the steps before it any more, and below if it
    has not made as many; ``written`` is the number of steps that it has made. ``origin`` names the record that the
    numbers count in: after a peer has begun anew, be it from a checkpoint, there is another.
    """

    first: Count
    written: Count
    origin: OptionalName = ""


class LearnerRow(Message, frozen=True):
    """One learner on the dashboard; ``heartbeat_age_s`` None: never heard of; ``hint``: lines if it is stuck."""

    pid: str
    phase: LearnerPhase
    worker: str
    epoch: int
    version: int
    interactions: int
    steps_per_s: float
    updates: int
    updates_per_s: float
    attempts: int
    recent_success: float | None
    starts_waiting: int
    heartbeat_age_s: float | None
    intervention: Intervention
    successes: int = 0
    hint: str = ""


class QCell(Message, frozen=True):
    """One known entry of the high-level Q table."""

    q: int
    pid: str
    value: float
    greedy: bool


class EvaluationRow(Message, frozen=True):
    """One evaluation; ``dfa_path`` is the sequence of DFA states of its first episode.

    ``actions`` is the mode that it was played in; ``other_success_rate`` is of the other one, where both were played.
    """

    job: int
    interactions: int
    elapsed_s: float
    success_rate: float
    mean_length: float
    std_length: float
    mean_return: float
    dfa_path: list[int]
    actions: ActionMode = "greedy"
    other_success_rate: float | None = None


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
    missing: list[Missing] = []


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
    missing: list[Missing] = []


KINDS: dict[str, type[Message]] = {
    str(kind.__struct_config__.tag): kind
    for kind in (
        Claim,
        Granted,
        Refused,
        Sync,
        SyncReply,
        Release,
        EvaluationPoll,
        EvaluationJob,
        EvaluationReport,
        Goodbye,
        StatusRequest,
        Status,
        Notice,
        Failure,
        ValueRequest,
        ValueReply,
        WeightsRequest,
        WeightsReply,
        ExperienceRequest,
        ExperienceReply,
        DashboardState,
    )
}
