"""Messages about evaluations of the global policy."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, field

from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.wire.fields import Amount, Count, Finite, Share, StateNumber
from t4nmtd_dist.wire.messages.base import Message

LONGEST_PATH = 4000  # below the longest list that a header may hold


class EvaluationPoll(Message, frozen=True, tag="evaluation_poll"):
    """Evaluator -> coordinator, 0.2 s after each answer while idle: heartbeat; the reply is a job if one is due.

    ``busy``: heartbeat during an evaluation, answered by job 0.
    """

    epoch: Count
    busy: bool = False


class EvaluationJob(Message, frozen=True, tag="evaluation_job"):
    """Coordinator -> evaluator. ``job`` 0: nothing to do. arrays: ``<pid>/weights.actor.*`` of every sub-task.

    ``actions``: modes to play in order; each is played only if those before it miss ``evaluation.success``.
    """

    job: int
    interactions: int = 0
    q_table: list[tuple[int, str, float]] = field(default_factory=list)
    versions: dict[str, int] = field(default_factory=dict)
    actions: tuple[ActionMode, ...] = ("greedy",)


class EvaluationReport(Message, frozen=True, tag="evaluation_report"):
    """Evaluator -> coordinator: results of one job's episodes.

    All figures belong to mode ``actions``; ``other_success_rate`` belongs to the other mode if both were played.
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


class EvaluationRow(Message, frozen=True):
    """One evaluation; ``dfa_path`` lists the DFA states of its first episode.

    ``actions`` is the mode played; ``other_success_rate`` belongs to the other mode if both were played.
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
