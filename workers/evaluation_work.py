"""The evaluator's work under its lease: polls, evaluates in slices, reports."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING

import msgspec

from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import EvaluationJob, EvaluationPoll, EvaluationReport, Message, Release

if TYPE_CHECKING:
    from workers.evaluation_session import EvaluationSession

POLL_S = 0.2
PATIENCE_S = 3.0
BUSY_S = 0.5
SLICE_S = 0.2


class EvaluationWork:
    """Work under one lease on the evaluator role.

    Evaluating in slices keeps the process responsive to the coordinator and signals.

    Args:
        session: plays the episodes.
        clock: seconds.
    """

    def __init__(
        self,
        session: EvaluationSession,
        send: Callable[[Message], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._session, self._send, self._clock = session, send, clock
        self._steps: Generator[None, None, EvaluationReport] | None = None
        self._processor_s = 0.0
        self._poll_due = -float("inf")

    @property
    def busy(self) -> bool:
        """Whether an evaluation is running."""
        return self._steps is not None

    def take(self, envelope: Envelope) -> None:
        """Process a reply to a poll: begin its job or poll again later."""
        message = envelope.message
        if not isinstance(message, EvaluationJob) or (self.busy and not message.job):
            return
        if message.job:
            self._steps, self._processor_s = self._session.steps(envelope), 0.0
        self._poll_due = self._clock() + (BUSY_S if message.job else POLL_S)

    def tell(self) -> None:
        """Send a due poll; while busy it is only a heartbeat."""
        now = self._clock()
        if now >= self._poll_due:
            self._poll_due = now + (BUSY_S if self.busy else PATIENCE_S)
            self._send(EvaluationPoll(epoch=self._session.epoch, busy=self.busy))

    def advance(self) -> bool:
        """Run one slice of the evaluation; whether this finished and reported it."""
        if self._steps is None:
            return False
        began, until = time.process_time(), self._clock() + SLICE_S
        report = _advance(self._steps, lambda: self._clock() < until)
        self._processor_s += time.process_time() - began
        if report is None:
            return False
        self._send(msgspec.structs.replace(report, processor_s=self._processor_s))
        self._steps, self._poll_due = None, -float("inf")
        return True

    def give_back(self) -> None:
        """Release the lease."""
        self._send(Release(pid=self._session.place, epoch=self._session.epoch))


def _advance(steps: Generator[None, None, EvaluationReport], keep_going: Callable[[], bool]) -> EvaluationReport | None:
    """Run steps while ``keep_going``; returns the report once finished."""
    try:
        while keep_going():
            next(steps)
    except StopIteration as end:
        report: EvaluationReport = end.value
        return report
    return None
