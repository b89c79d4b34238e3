"""The teacher of LSTS: which edge of the automaton the student trains next (Shukla et al., 2024, Algorithm 1)."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from t4nmtd_dist.automata.reduction import Transition, closure, predecessors
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.edge_attempts import Attempt, EvenShares, on_path

SLICE_ATTEMPTS = 50
WINDOW = 50
THRESHOLD = 0.95
EPSILON = 0.5
STEP_SIZE = 0.1
LEARNED_BONUS, PLANNED_BONUS = 1.0, 2.0  # a learned edge acts before others, one of the path before all


class Teacher:
    """A bandit over the active edges, rewarded with the progress of the student.

    An edge is active once its source is the initial vertex or the target of a learned edge. A learned edge discards all
    others into its target, and then those that no longer lead to acceptance. Once an edge into F is learned, the
    learned edges that lead there are the path, and share further training evenly.

    Args:
        edges: transitions by name.
        initial: vertex that the environment's reset starts from; no edge may lead back to it.
        accepting: F.
        slice_attempts: attempts that an edge trains for before the teacher chooses again. A slice ends with the
            report that completes it.
        window: attempts over which an edge's success is measured.
        threshold: share of successes that a learned edge exceeds.
        epsilon: share of uniform choices.
        step_size: of the update of Q.

    Attributes:
        q: Q(e) of the active edges.
        learned: learned edges, in order.
        discarded: edges that will not be scheduled any more.
        current: the edge in training; None before ``advance`` chooses one.
        path: edges from the initial vertex to F, once they are learned.
    """

    def __init__(
        self,
        edges: Mapping[str, Transition],
        initial: int,
        accepting: Collection[int],
        *,
        slice_attempts: int = SLICE_ATTEMPTS,
        window: int = WINDOW,
        threshold: float = THRESHOLD,
        epsilon: float = EPSILON,
        step_size: float = STEP_SIZE,
    ) -> None:
        self._edges, self._initial, self._accepting = edges, initial, frozenset(accepting)
        self._slice_attempts, self._threshold = slice_attempts, threshold
        self._epsilon, self._step_size = epsilon, step_size
        self._recent: dict[str, deque[bool]] = {edge: deque(maxlen=window) for edge in edges}
        self._last_mean: dict[str, float] = {}
        self._slice: list[bool] = []
        self._shares: EvenShares | None = None
        self.q: dict[str, float] = {}
        self.learned: list[str] = []
        self.discarded: set[str] = set()
        self.current: str | None = None
        self.path: tuple[str, ...] = ()
        self._discard_into(initial)
        self._activate(initial)

    def keeps(self, edge: str) -> bool:
        """Whether states that the edge reaches now may become start states: always."""
        return True

    def origin(self, vertex: int) -> str | None:
        """The edge whose states start the attempts of edges out of a vertex: its learned incoming edge."""
        return next((edge for edge in self.learned if self._edges[edge][1] == vertex), None)

    def attempted(self, edge: str, attempts: Sequence[Attempt]) -> None:
        """Take in the attempts of an edge; the current edge's slice ends once it is full."""
        self._recent[edge].extend(attempt.success for attempt in attempts)
        if self._shares is not None:
            self._shares.spend(edge, attempts)
        elif edge == self.current:
            self._slice += [attempt.success for attempt in attempts]
            if len(self._slice) >= self._slice_attempts:
                self._end_slice(edge)

    def _end_slice(self, edge: str) -> None:
        """Q(e) <- 0.1 (change of mean success) + 0.9 Q(e); then look whether e is learned."""
        mean = float(np.mean(self._slice))
        progress = mean - self._last_mean.get(edge, 0.0)
        self.q[edge] = self._step_size * progress + (1.0 - self._step_size) * self.q[edge]
        self._last_mean[edge], self._slice, self.current = mean, [], None
        recent = self._recent[edge]
        if len(recent) == recent.maxlen and float(np.mean(recent)) > self._threshold:
            self.learn(edge)

    def learn(self, edge: str) -> None:
        """Count an active edge as learned."""
        target = self._edges[edge][1]
        del self.q[edge]
        self.learned.append(edge)
        self._discard_into(target)
        if target in self._accepting:
            self.path = on_path(self._edges, {self._edges[each][1]: each for each in self.learned}, target)
            self._shares = EvenShares(self.path)
        else:
            self._activate(target)

    def _discard_into(self, vertex: int) -> None:
        """Discard the edges into a reached vertex, and those whose target then leads to acceptance no more."""
        self.discarded |= {e for e, (_, target) in self._edges.items() if target == vertex} - set(self.learned)
        left = [tau for edge, tau in self._edges.items() if edge not in self.discarded]
        alive = closure(self._accepting, predecessors(left))
        self.discarded |= {e for e, (_, target) in self._edges.items() if target not in alive} - set(self.learned)
        self.q = {edge: value for edge, value in self.q.items() if edge not in self.discarded}

    def _activate(self, vertex: int) -> None:
        taken = self.discarded.union(self.learned)
        self.q |= {edge: 0.0 for edge, (source, _) in self._edges.items() if source == vertex and edge not in taken}

    def advance(self, rng: np.random.Generator) -> None:
        """Choose the edge to train, if none is in training."""
        if self._shares is not None:
            self.current = self._shares.next()
        elif self.current is None and self.q:
            self.current = self._choose(rng)

    def _choose(self, rng: np.random.Generator) -> str:
        active = sorted(self.q)
        if rng.random() >= self._epsilon:
            best = max(self.q.values())
            active = [edge for edge in active if self.q[edge] == best]
        return active[int(rng.integers(len(active)))]

    def working(self) -> dict[str, bool]:
        """The edge in training, which learns."""
        return {} if self.current is None else {self.current: True}

    def worth(self) -> dict[str, float]:
        """What decides who acts, of all edges that were tried: recent success, and more if learned or on the path."""
        return {
            edge: float(np.mean(recent)) + LEARNED_BONUS * (edge in self.learned) + PLANNED_BONUS * (edge in self.path)
            for edge, recent in self._recent.items()
            if recent
        }

    def state_dict(self) -> State:
        """Everything, for a checkpoint."""
        return {
            "recent": {edge: list(recent) for edge, recent in self._recent.items()},
            "last_mean": dict(self._last_mean),
            "slice": list(self._slice),
            "q": dict(self.q),
            "learned": list(self.learned),
            "discarded": sorted(self.discarded),
            "current": self.current,
            "path": list(self.path),
            "spent": None if self._shares is None else dict(self._shares.spent),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state`` of a teacher of the same edges."""
        for edge, recent in self._recent.items():
            recent.clear()
            recent.extend(state["recent"][edge])
        self._last_mean, self._slice = dict(state["last_mean"]), list(state["slice"])
        self.q, self.current = dict(state["q"]), state["current"]
        self.learned, self.discarded = list(state["learned"]), set(state["discarded"])
        self.path = tuple(state["path"])
        self._shares = None if state["spent"] is None else EvenShares(self.path, state["spent"])
