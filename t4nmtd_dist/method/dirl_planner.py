"""The planner of DIRL: Dijkstra's search over the automaton, which trains edges as it goes (Jothimurugan et al., 2021).

The cost of an edge is -log p, where p is the success rate of its policy, so the cheapest path is the one that most
probably succeeds.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from t4nmtd_dist.automata.reduction import Transition
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.edge_attempts import Attempt, EvenShares, on_path

ESTIMATE_ATTEMPTS = 50
SUCCESSES_IN_A_ROW = 20
NOT_PLANNED = -1.0

Phase = Literal["training", "estimating"]


class Candidate(NamedTuple):
    """A vertex that an edge reaches: what the search has in its queue.

    Attributes:
        cost: of the path to the vertex.
        number: earlier candidates of equal cost come first.
        vertex: not explored yet.
        edge: the last of the path.
    """

    cost: float
    number: int
    vertex: int
    edge: str


class Planner:
    """Explores vertices in the order of their cost, and trains the edges out of each.

    An edge trains for so many interactions, or until so many attempts in a row succeeded; then attempts of the policy
    as it is estimate p. Its attempts start in states that the policy of its source's parent reached in such attempts.
    Once the search is over, the path's edges share further training evenly; without a path those that were tried do,
    and nobody acts in evaluations.

    Args:
        edges: transitions by name.
        initial: vertex that the environment's reset starts from.
        accepting: F.
        interactions: K, after which the training of an edge ends.
        in_a_row: successes in a row that end it earlier.
        estimate_attempts: attempts from which p is estimated; the report that completes them counts as a whole.

    Attributes:
        explored: vertices in the order of their exploration.
        p: estimated success rates.
        current: the edge in training; None before ``advance`` begins.
        phase: of the current edge.
        path: the most probable path to F that is known, from the initial vertex.
        is_over: whether the search is.
    """

    def __init__(
        self,
        edges: Mapping[str, Transition],
        initial: int,
        accepting: Collection[int],
        *,
        interactions: int,
        in_a_row: int = SUCCESSES_IN_A_ROW,
        estimate_attempts: int = ESTIMATE_ATTEMPTS,
    ) -> None:
        self._edges, self._accepting = edges, frozenset(accepting)
        self._interactions, self._in_a_row, self._estimate_attempts = interactions, in_a_row, estimate_attempts
        self._cost, self._parent = {initial: 0.0}, dict[int, str]()
        self._queue: list[Candidate] = []
        self._pushed = 0
        self._waiting: list[str] = []
        self._shares: EvenShares | None = None
        self.explored: list[int] = []
        self.p: dict[str, float] = {}
        self.current: str | None = None
        self.phase: Phase = "training"
        self._steps = self._row = self._tries = self._successes = 0
        self._explore(initial)

    @property
    def is_over(self) -> bool:
        """Whether F is explored, or nothing is left to be explored."""
        return self._shares is not None

    @property
    def path(self) -> tuple[str, ...]:
        """The edges of the cheapest path to F so far; empty if there is none."""
        known = [Candidate(self._cost[v], -1, v, self._parent[v]) for v in self.explored if v in self._accepting]
        best = min([*known, *(each for each in self._queue if each.vertex in self._accepting)], default=None)
        return () if best is None else on_path(self._edges, self._parent | {best.vertex: best.edge}, best.vertex)

    def keeps(self, edge: str) -> bool:
        """Whether states that the edge reaches now may become start states: not those of its training."""
        return edge in self.p or (edge == self.current and self.phase == "estimating")

    def origin(self, vertex: int) -> str | None:
        """The edge whose states start the attempts of edges out of a vertex: the one by which it was explored."""
        return self._parent.get(vertex)

    def attempted(self, edge: str, attempts: Sequence[Attempt]) -> None:
        """Take in the attempts of an edge; late ones, of an edge that is not in training, do not count."""
        if self._shares is not None:
            self._shares.spend(edge, attempts)
        elif edge == self.current and self.phase == "training":
            self._train(attempts)
        elif edge == self.current:
            self._estimate(edge, attempts)

    def _train(self, attempts: Sequence[Attempt]) -> None:
        for attempt in attempts:
            self._steps += attempt.steps
            self._row = self._row + 1 if attempt.success else 0
            if self._row >= self._in_a_row or self._steps >= self._interactions:
                self._begin_phase("estimating")
                return

    def _estimate(self, edge: str, attempts: Sequence[Attempt]) -> None:
        self._tries += len(attempts)
        self._successes += sum(attempt.success for attempt in attempts)
        if self._tries >= self._estimate_attempts:
            self.estimated(edge, self._successes / self._tries)

    def _begin_phase(self, phase: Phase) -> None:
        self.phase = phase
        self._steps = self._row = self._tries = self._successes = 0

    def estimated(self, edge: str, p: float) -> None:
        """Take in the success rate of the current edge, and go on to the next."""
        source, target = self._edges[edge]
        self.p[edge] = p
        self.current = None
        if p > 0.0:
            self._queue.append(Candidate(self._cost[source] - math.log(p), self._pushed, target, edge))
            self._pushed += 1
        self._begin_phase("training")

    def advance(self, rng: np.random.Generator | None = None) -> None:
        """Choose the edge to train, if none is in training: the next out of the vertex that is being explored."""
        while self.current is None and not self.is_over:
            if self._waiting:
                self.current = self._waiting.pop(0)
            elif self._queue:
                self._explore_nearest()
            else:
                self._shares = EvenShares(sorted(self.p))
        if self._shares is not None and self._shares.spent:
            self.current = self._shares.next()

    def _explore_nearest(self) -> None:
        nearest = min(self._queue)
        self._queue.remove(nearest)
        if nearest.vertex in self.explored:
            return
        self._cost[nearest.vertex], self._parent[nearest.vertex] = nearest.cost, nearest.edge
        self._explore(nearest.vertex)
        if nearest.vertex in self._accepting:
            self._shares = EvenShares(self.path)

    def _explore(self, vertex: int) -> None:
        """Put the edges from a vertex to unexplored ones in line."""
        self.explored.append(vertex)
        self._waiting = sorted(
            (e for e, (source, target) in self._edges.items() if source == vertex and target not in self.explored),
            key=lambda edge: self._edges[edge],
        )

    def working(self) -> dict[str, bool]:
        """The edge in training, and whether it learns."""
        return {} if self.current is None else {self.current: self.phase == "training"}

    def worth(self) -> dict[str, float]:
        """What decides who acts: the path alone does."""
        path = self.path
        return {edge: self.p[edge] if edge in path else NOT_PLANNED for edge in self._edges}

    def state_dict(self) -> State:
        """Everything, for a checkpoint."""
        return {
            "cost": {str(vertex): cost for vertex, cost in self._cost.items()},
            "parent": {str(vertex): edge for vertex, edge in self._parent.items()},
            "queue": [list(each) for each in self._queue],
            "pushed": self._pushed,
            "waiting": list(self._waiting),
            "explored": list(self.explored),
            "p": dict(self.p),
            "current": self.current,
            "phase": self.phase,
            "counts": [self._steps, self._row, self._tries, self._successes],
            "spent": None if self._shares is None else dict(self._shares.spent),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state`` of a planner of the same edges."""
        self._cost = {int(vertex): cost for vertex, cost in state["cost"].items()}
        self._parent = {int(vertex): edge for vertex, edge in state["parent"].items()}
        self._queue = [Candidate(*each) for each in state["queue"]]
        self._pushed, self._waiting = state["pushed"], list(state["waiting"])
        self.explored, self.p = list(state["explored"]), dict(state["p"])
        self.current, self.phase = state["current"], state["phase"]
        self._steps, self._row, self._tries, self._successes = state["counts"]
        self._shares = None if state["spent"] is None else EvenShares([], state["spent"])
