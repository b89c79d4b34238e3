"""Methods whose policies are the edges of the automaton, trained one at a time: what LSTS and DIRL have in common.

An edge's attempts start where its source is: at the environment's reset, or in states that another edge reached. They
end at any change of the DFA state. Nothing is bootstrapped beyond it, and only the edge's own target is rewarded.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.reduction import Transition
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.decomposition import decompose as decompose_automaton
from t4nmtd_dist.method.edge_attempts import Attempt
from t4nmtd_dist.method.high_level import QEntries
from t4nmtd_dist.method.protocol import Change, Delivery, Ending, Mask, Reading, Start, States
from t4nmtd_dist.method.rewards import ACCEPTANCE_REWARD
from t4nmtd_dist.method.roles import Role, role_of
from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState, sample_starts


def decompose(config: TaskConfig, dfa: DFA, *, seed: int, deadline: Deadline | None) -> Decomposition:
    """One role ``e0-1`` for every transition that T4NMTD's sub-tasks have; see ``MethodModule.decompose``."""
    transitions = decompose_automaton(
        dfa, exclusive=config.exclusive, prune=config.decomposition.prune, deadline=deadline
    ).transitions
    return Decomposition({f"e{source}-{target}": ((source, target),) for source, target in transitions})


def edges_of(decomposition: Decomposition) -> dict[str, Transition]:
    """The transition of every edge by name."""
    return {edge: transitions[0] for edge, transitions in decomposition.subtasks.items()}


class UpperLevel(Protocol):
    """Decides which edge trains, from what attempts come to; without I/O.

    The loop it is meant for::

        upper.advance(rng)
        while True:
            attempts = train(upper.working())
            upper.attempted(edge, attempts)
            upper.advance(rng)
    """

    def attempted(self, edge: str, attempts: Sequence[Attempt]) -> None:
        """Take in attempts of an edge, in the order in which they ended."""

    def advance(self, rng: np.random.Generator) -> None:
        """Choose the edge to train, if none is in training."""

    def working(self) -> Mapping[str, bool]:
        """The edges in training, and whether they learn; their greedy policy makes attempts otherwise."""

    def worth(self) -> Mapping[str, float]:
        """Of the edges out of a DFA state the one of the highest worth acts; none of negative worth does."""

    def keeps(self, edge: str) -> bool:
        """Whether states that an edge reaches now may become start states."""

    def origin(self, vertex: int) -> str | None:
        """The edge whose states start the attempts of edges out of a vertex; None while that is open."""

    def state_dict(self) -> State:
        """Everything, for a checkpoint."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state``."""


@dataclass(frozen=True)
class EdgePlan:
    """What learners and evaluator know of the upper level.

    Attributes:
        worth: see ``UpperLevel.worth``.
        working: see ``UpperLevel.working``.
    """

    worth: Mapping[str, float] = field(default_factory=dict)
    working: Mapping[str, bool] = field(default_factory=dict)

    def entries(self, edges: Mapping[str, Transition]) -> QEntries:
        """As (q, edge, value): an edge's worth at its source; at its target 1 if it learns now, 0 if it only acts."""
        worth = [(edges[edge][0], edge, value) for edge, value in self.worth.items()]
        return sorted([*worth, *((edges[edge][1], edge, float(learns)) for edge, learns in self.working.items())])

    @classmethod
    def of(cls, entries: Iterable[tuple[int, str, float]], edges: Mapping[str, Transition]) -> EdgePlan:
        """The plan that was written as ``entries``."""
        worth: dict[str, float] = {}
        working: dict[str, bool] = {}
        for q, edge, value in entries:
            if q == edges[edge][0]:
                worth[edge] = value
            else:
                working[edge] = value > 0.0
        return cls(worth, working)


class EdgeMethod:
    """Edges as roles; see ``Method`` for what each rule means.

    The coordinator's object holds back the states that each edge reached until the upper level says whose states are
    the starts of the edges out of a vertex.

    Attributes:
        upper: the upper level; only the coordinator's is told anything.
        shares_env: every edge acts in an environment of its own.
    """

    shares_env = False

    def __init__(
        self,
        config: TaskConfig,
        dfa: DFA,
        decomposition: Decomposition,
        rho: NDArray[np.float64],
        upper: UpperLevel,
    ) -> None:
        self._config, self._dfa, self._decomposition, self._rho = config, dfa, decomposition, rho
        self._edges = edges_of(decomposition)
        self._roles: dict[str, Role] = {}
        self._plan = EdgePlan()
        self._reached = {edge: InitialStateBuffer() for edge in self._edges}
        self._delivered = dict.fromkeys(self._edges, 0)
        self._keeps = False
        self.upper = upper

    @property
    def roles(self) -> tuple[str, ...]:
        """The edges."""
        return self._decomposition.pids

    def role(self, name: str) -> Role:
        """The edge; see ``Method.role``."""
        if name not in self._roles:
            self._roles[name] = edge_role(self._config, self._dfa, self._decomposition, self._rho, name)
        return self._roles[name]

    def starts(
        self, role: str, buffer: InitialStateBuffer, count: int, rng: np.random.Generator
    ) -> Sequence[StartState]:
        """The reset for edges out of the initial state, else uniform over the start states."""
        return sample_starts(buffer, self.role(role).reset_q, count, rng)

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        """An attempt ends at any change, and when its steps are spent."""
        over = (q != q_next) | (steps >= self.role(role).attempt_steps)
        return np.where(over, Ending.RESTART, Ending.KEEP).astype(np.int8)

    def hands_over(self, role: str, q: States, q_next: States) -> Mask:
        """The target is handed over."""
        reached: Mask = self.role(role).tables.target[q, q_next]
        return reached

    def receivers(self, role: str, q: int, rng: np.random.Generator) -> Collection[str]:
        """Nobody at once; ``advance`` delivers."""
        return ()

    def reads(self, role: str) -> Reading:
        """Own rows."""
        return Reading(np.array([self._edges[role][0]], np.int32), "own")

    def successors(self, role: str, q_next: States, rng: np.random.Generator) -> list[str | None]:
        """Nobody: the attempt is over."""
        return [None] * len(q_next)

    def choose(
        self,
        q: Sequence[int],
        rng: np.random.Generator | None = None,
        *,
        observations: NDArray[np.float32] | None = None,
        among: Collection[str] | None = None,
    ) -> list[str | None]:
        """The edge of the highest worth, 0 where none is known, the first by name of several."""
        return [self._best(each, among) for each in q]

    def _best(self, q: int, among: Collection[str] | None) -> str | None:
        worth = {
            edge: self._plan.worth.get(edge, 0.0)
            for edge in self._decomposition.available(q)
            if among is None or edge in among
        }
        best = max(worth, key=lambda edge: worth[edge], default=None)
        return None if best is None or worth[best] < 0.0 else best

    def told(self, role: str, changes: Iterable[Change]) -> None:
        """Every attempt ends with one change or failure."""
        self._keeps = self.upper.keeps(role)  # before the attempts that came with these states
        target = self._edges[role][1]
        self.upper.attempted(role, [Attempt(change.q_next == target, change.steps) for change in changes])

    def advance(self, role: str, starts: Sequence[Start], rng: np.random.Generator) -> list[Delivery]:
        """Choose the next edge; deliver the states of a vertex's chosen incoming edge to the edges out of it."""
        if self._keeps:
            for q, state in starts:
                self._reached[role].add(q, state)
        self.upper.advance(rng)
        self._plan = EdgePlan(self.upper.worth(), self.upper.working())
        return [delivery for vertex in range(self._dfa.states) for delivery in self._due(vertex)]

    def _due(self, vertex: int) -> list[Delivery]:
        origin = self.upper.origin(vertex)
        if origin is None:
            return []
        fresh = self._reached[origin].since(self._delivered[origin], len(self._reached[origin]))
        self._delivered[origin] = self._reached[origin].cursor
        return [(edge, q, state) for edge in self._decomposition.available(vertex) for _, q, state in fresh]

    def schedule(self) -> Collection[str]:
        """The edge in training."""
        return self._plan.working.keys()

    def learns(self, role: str) -> bool:
        """False while the success rate of an edge's policy is estimated."""
        return self._plan.working.get(role, True)

    def entries(self) -> QEntries:
        """See ``EdgePlan.entries``."""
        return self._plan.entries(self._edges)

    def load(self, entries: Iterable[tuple[int, str, float]]) -> None:
        """Replace what is known of the upper level."""
        self._plan = EdgePlan.of(entries, self._edges)

    def state_dict(self) -> State:
        """The upper level, and the states that are held back."""
        return {
            "upper": self.upper.state_dict(),
            "reached": {edge: buffer.state_dict() for edge, buffer in self._reached.items()},
            "delivered": dict(self._delivered),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state``."""
        self.upper.load_state_dict(state["upper"])
        for edge, buffer in self._reached.items():
            buffer.load_state_dict(state["reached"][edge])
        self._delivered = dict(state["delivered"])


def edge_role(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64], name: str) -> Role:
    """Tabulate an edge (u, v): T4NMTD's shaping for the target set {v}.

    Under ``potential`` every other vertex has the potential 0, as where an episode ends, and acceptance pays only where
    v accepts. So leaving u elsewhere is worth as much as never leaving it.
    """
    ((source, target),) = decomposition.subtasks[name]
    own = np.zeros_like(rho)
    own[[source, target]] = rho[[source, target]]
    role = role_of(config, dfa, decomposition, own, name)
    tables = role.tables
    if config.learner.shaping != "potential":
        return role
    elsewhere = tables.accepting[None, :] & ~tables.accepting[:, None] & ~tables.target
    reward = np.where(elsewhere, tables.reward - ACCEPTANCE_REWARD, tables.reward)
    return dataclasses.replace(role, tables=dataclasses.replace(tables, reward=reward))
