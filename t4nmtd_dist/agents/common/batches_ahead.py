"""Batches drawn before they are trained on, so that peers have time to answer what they are asked about them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from t4nmtd_dist.agents.common.batches import DrawnBatch
from t4nmtd_dist.agents.common.peer_values import PeerCritics, PeerValues

BATCHES_AHEAD = 16  # twice what shares a request: the other half is the time that peers have to answer


class BatchesAhead:
    """A queue of drawn batches, and which of them peers have been asked about.

    The loop it is meant for::

        batch, answers = ahead.next(source.draw, peers)
        train_on(batch, answers)

    Args:
        observation_size: d, how many numbers of a product state peers are told.

    Attributes:
        drawn: the batches, in the order in which they will be trained on.
    """

    def __init__(self, observation_size: int) -> None:
        self._observation_size = observation_size
        self.drawn: deque[DrawnBatch] = deque()
        self._first = 0  # number of the next batch
        self._asked = 0  # batches of smaller numbers have been asked about

    def next(self, draw: Callable[[int], DrawnBatch], peers: PeerCritics) -> tuple[DrawnBatch, PeerValues]:
        """The batch drawn longest ago and its answers; draws further batches and asks peers about them.

        Args:
            draw: draws the batch of a number.
            peers: are asked.
        """
        while len(self.drawn) < BATCHES_AHEAD:
            self.drawn.append(draw(self._first + len(self.drawn)))
        self._ask(peers)
        batch = self.drawn.popleft()
        self._first += 1
        return batch, peers.gather(batch.number)

    def _ask(self, peers: PeerCritics) -> None:
        """Ask peers about the batches that they have not been asked about: after a resume about all of them."""
        for batch in self.drawn:
            if batch.number >= self._asked:
                self._asked = batch.number + 1
                if len(batch.asked_rows):
                    peers.ask(batch.number, batch.questions(self._observation_size))

    def state_dict(self) -> list[dict[str, Any]]:
        """The batches, for a checkpoint."""
        return [dict(vars(batch)) for batch in self.drawn]

    def load_state_dict(self, batches: Iterable[Mapping[str, Any]], first: int) -> None:
        """Go on with the batches of a ``state``; peers will be asked about them again.

        Args:
            batches: of the state.
            first: number of the next one.
        """
        self.drawn = deque(DrawnBatch(**{**batch, "asked_pids": tuple(batch["asked_pids"])}) for batch in batches)
        self._first = self._asked = first
