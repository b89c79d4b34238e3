"""A learner's worker that evaluates between its turns while there is no evaluator, for a tenth of its time at most."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from t4nmtd_dist.core.errors import T4NMTDError
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Claim, EvaluationJob, Failure, Granted, Message, Refused
from workers.evaluation_work import PATIENCE_S, EvaluationWork

if TYPE_CHECKING:
    from workers.evaluation_session import EvaluationSession

STAND_IN = 1  # the number of all messages of a stand-in, by which answers to it are known
TIME_SHARE = 0.1
ANSWER_S = 1.0


@dataclass
class SpareTime:
    """What a worker may spend on evaluations: the first is free, a later one waits until all are within the share.

    Attributes:
        began: when the worker began, in seconds of its clock.
        spent: seconds that evaluations took.
    """

    began: float
    spent: float = 0.0

    def allows(self, now: float) -> bool:
        """Whether another evaluation may begin."""
        return self.spent <= TIME_SHARE * (now - self.began)


def open_session(granted: Granted) -> EvaluationSession:
    """An evaluation session whose starts differ from those of other stand-ins."""
    from t4nmtd_dist.agents.registry import subtask_seed
    from workers.evaluation_session import EvaluationSession

    return EvaluationSession(granted, seed=subtask_seed(granted.seed, granted.pid, granted.epoch))


class StandIn:
    """Takes the evaluator's place for one evaluation at a time, on invitation.

    Args:
        instance: name of the worker.
        send: sends a message to the coordinator, to be numbered ``STAND_IN``.
        say: called with a line for people.
        clock: seconds.
        sessions: makes a session for a lease.
    """

    def __init__(
        self,
        instance: str,
        send: Callable[[Message], object],
        say: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
        sessions: Callable[[Granted], EvaluationSession] = open_session,
    ) -> None:
        self._instance, self._send, self._say = instance, send, say
        self._clock, self._sessions = clock, sessions
        self._spare = SpareTime(clock())
        self._session: EvaluationSession | None = None
        self._work: EvaluationWork | None = None
        self._asked = False
        self._ask_again = self._answer_until = -float("inf")

    @property
    def waiting(self) -> bool:
        """Whether an answer is due any moment: a long turn now might outlast the lease."""
        return self._clock() < self._answer_until

    def invited(self) -> None:
        """The coordinator wants an evaluation: claim the place if there is time to spare."""
        now = self._clock()
        if self._work is None and now >= self._ask_again and self._spare.allows(now):
            self._ask_again, self._answer_until = now + PATIENCE_S, now + ANSWER_S
            self._asked = True
            self._send(Claim(role="evaluator", instance=self._instance, stand_in=True))

    def take(self, envelope: Envelope) -> None:
        """An answer to one of its own messages; a lease that it has not asked for is ignored."""
        message = envelope.message
        if isinstance(message, Granted):
            if self._asked:
                self._try(lambda: self._begin(message))
        elif isinstance(message, Failure):
            self._give_up(f"the coordinator refused a message: {message.text}")
        elif isinstance(message, Refused):
            self._asked, self._work, self._answer_until = False, None, -float("inf")
        elif isinstance(message, EvaluationJob) and self._work is not None:
            if message.job:
                self._answer_until = -float("inf")
                self._work.take(envelope)
            elif not self._work.busy:
                self._end()

    def turn(self) -> bool:
        """A slice of the evaluation under way; False if there is none."""
        work = self._work
        if work is None or not work.busy:
            return False
        began = self._clock()
        self._try(self._advance)
        self._spare.spent += self._clock() - began
        return True

    def tell(self) -> None:
        """Send what is due: a poll, or a sign of life."""
        if self._work is not None:
            self._work.tell()

    def _begin(self, granted: Granted) -> None:
        self._asked = False
        if self._session is None or not self._session.renew(granted):
            self._session = self._sessions(granted)
        self._work = EvaluationWork(self._session, self._send, self._clock)
        self._answer_until = self._clock() + ANSWER_S

    def _advance(self) -> None:
        if self._work is not None and self._work.advance():
            self._end()

    def _end(self) -> None:
        if self._work is not None:
            self._work.give_back()
        self._work = None
        self._ask_again = self._answer_until = -float("inf")

    def _try(self, do: Callable[[], None]) -> None:
        """A policy that cannot be evaluated here must not end the learners."""
        try:
            do()
        except T4NMTDError as error:
            self._give_up(str(error))

    def _give_up(self, reason: str) -> None:
        self._say(f"does not evaluate any more: {reason}")
        self._end()
        self._ask_again = float("inf")

    def close(self) -> None:
        """Give the place back, if it is held."""
        self._end()
