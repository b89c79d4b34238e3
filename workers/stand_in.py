"""Lets learners' workers evaluate between turns, using at most a tenth of their time."""

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

STAND_IN = 1  # number of all of a stand-in's messages, to recognise replies
TIME_SHARE = 0.1
ANSWER_S = 1.0


@dataclass
class SpareTime:
    """Time budget for evaluations: the first is free, later ones wait for their share.

    Attributes:
        began: start of the worker, in seconds of its clock.
        spent: seconds spent on evaluations.
    """

    began: float
    spent: float = 0.0

    def allows(self, now: float) -> bool:
        """Whether another evaluation may begin."""
        return self.spent <= TIME_SHARE * (now - self.began)


def open_session(granted: Granted) -> EvaluationSession:
    """An evaluation session with other starts than those of other stand-ins."""
    from t4nmtd_dist.agents.registry import subtask_seed
    from workers.evaluation_session import EvaluationSession

    return EvaluationSession(granted, seed=subtask_seed(granted.seed, granted.pid, granted.epoch))


class StandIn:
    """Takes the evaluator role for one evaluation at a time, when invited.

    Args:
        send: sends a message to the coordinator, numbered ``STAND_IN``.
        say: called with a line for the user.
        clock: seconds.
        sessions: creates a session for a lease.
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
        """Whether to await a reply: a long turn might outlast the lease."""
        return self._clock() < self._answer_until

    def invited(self) -> None:
        """Claim the evaluator role when invited, if there is time to spare."""
        now = self._clock()
        if self._work is None and now >= self._ask_again and self._spare.allows(now):
            self._ask_again, self._answer_until = now + PATIENCE_S, now + ANSWER_S
            self._asked = True
            self._send(Claim(role="evaluator", instance=self._instance, stand_in=True))

    def take(self, envelope: Envelope) -> None:
        """Process a reply to one of its messages; ignores leases that it did not request."""
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
        """Run a slice of the evaluation; False if there is none."""
        work = self._work
        if work is None or not work.busy:
            return False
        began = self._clock()
        self._try(self._advance)
        self._spare.spent += self._clock() - began
        return True

    def tell(self) -> None:
        """Send a due poll or heartbeat."""
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
        """Survive a policy that cannot be evaluated here."""
        try:
            do()
        except T4NMTDError as error:
            self._give_up(str(error))

    def _give_up(self, reason: str) -> None:
        self._say(f"does not evaluate any more: {reason}")
        self._end()
        self._ask_again = float("inf")

    def close(self) -> None:
        """Release the lease, if held."""
        self._end()
