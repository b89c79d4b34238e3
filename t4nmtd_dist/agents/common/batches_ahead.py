"""Draws batches ahead of their updates, so that peers have time to answer value queries."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from t4nmtd_dist.agents.common.batches import DrawnBatch
from t4nmtd_dist.agents.common.peer_values import PeerCritics, PeerValues

BATCHES_AHEAD = 16  # twice the batches per request: the other half gives peers time to answer


class BatchesAhead:
    """A queue of drawn batches and the peer queries about them.

    Intended loop::

        batch, answers = ahead.next(source.draw, peers)
        train_on(batch, answers)

    Args:
        observation_size: d, the part of a product state sent to peers.

    Attributes:
        drawn: batches in training order.
    """

    def __init__(self, observation_size: int) -> None:
        self._observation_size = observation_size
        self.drawn: deque[DrawnBatch] = deque()
        self._first = 0  # number of the next batch
        self._asked = 0  # peers were queried about batches with smaller numbers

    def next(self, draw: Callable[[int], DrawnBatch], peers: PeerCritics) -> tuple[DrawnBatch, PeerValues]:
        """Pop the oldest batch and its answers, after refilling the queue with ``draw(number)`` and querying peers."""
        while len(self.drawn) < BATCHES_AHEAD:
            self.drawn.append(draw(self._first + len(self.drawn)))
        self._ask(peers)
        batch = self.drawn.popleft()
        self._first += 1
        return batch, peers.gather(batch.number)

    def _ask(self, peers: PeerCritics) -> None:
        """Query peers about all batches not queried yet."""
        for batch in self.drawn:
            if batch.number >= self._asked:
                self._asked = batch.number + 1
                if len(batch.asked_rows):
                    peers.ask(batch.number, batch.questions(self._observation_size))

    def state_dict(self) -> list[dict[str, Any]]:
        """The batches, for a checkpoint."""
        return [dict(vars(batch)) for batch in self.drawn]

    def load_state_dict(self, batches: Iterable[Mapping[str, Any]], first: int) -> None:
        """Restore the batches, beginning with number ``first``; peers will be queried again."""
        self.drawn = deque(DrawnBatch(**{**batch, "asked_pids": tuple(batch["asked_pids"])}) for batch in batches)
        self._first = self._asked = first
