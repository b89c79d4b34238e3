"""Methods whose roles share one environment: a copy passes from role to role within an episode.

One learner holds all networks, so the decomposition has one pid with all transitions.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.reduction import Transition, reduce_automaton
from t4nmtd_dist.core.agent_settings import suits
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import AGENTS
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.decomposition import decompose as decompose_automaton
from t4nmtd_dist.method.high_level import QEntries
from t4nmtd_dist.method.protocol import Change, Ending, Mask, Reading, States, Unstaged
from t4nmtd_dist.method.roles import Role
from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState

LEARNER = "policies"


def edges(config: TaskConfig, dfa: DFA, deadline: Deadline | None) -> tuple[Transition, ...]:
    """The transitions that T4NMTD assigns to sub-tasks: no self-loops, none into E, pruned if the task says so.

    Raises:
        ConfigError: if acceptance cannot be reached, or the deadline passes.
    """
    exclusive, prune = config.exclusive, config.decomposition.prune
    return decompose_automaton(dfa, exclusive=exclusive, prune=prune, deadline=deadline).transitions


def decompose(config: TaskConfig, dfa: DFA, *, seed: int, deadline: Deadline | None) -> Decomposition:
    """One learner with all transitions; see ``MethodModule.decompose``.

    Raises:
        ConfigError: see ``edges``; also if ``decomposition.mode`` is ``random``, since no sub-tasks are formed, or if
            the agent is on-policy.
    """
    agent, method = config.learner.algorithm, config.learner.method
    if agent in AGENTS.modules and not suits(agent, method):
        able = [name for name in AGENTS.names() if suits(name, method)]
        raise ConfigError(
            f"learner.algorithm = {agent!r}: learner.method = {method!r} learns from a replay buffer; expected one of "
            f"{', '.join(able)}; --method {method} chooses one"
        )
    if config.decomposition.mode == "random":
        raise ConfigError(f'decomposition.mode = "random" has no effect on learner.method = "{method}"; leave it out')
    return Decomposition({LEARNER: edges(config, dfa, deadline)})


def live_states(config: TaskConfig, dfa: DFA) -> States:
    """DFA states outside F and E that symbols without excluded combinations reach, sorted, int32 [k]."""
    reduced = reduce_automaton(dfa, config.exclusive)
    return np.array(sorted(reduced.states - reduced.accepting - reduced.error), np.int32)


class SharedRows(Unstaged):
    """The rules that such methods have in common: episodes begin at the environment's reset, no state is handed over.

    Args:
        roles: all of them, in the order of their goals.

    Attributes:
        shares_env: see ``Method``.
    """

    shares_env = True

    def __init__(self, roles: Iterable[Role]) -> None:
        self._roles = {role.name: role for role in roles}

    @property
    def roles(self) -> tuple[str, ...]:
        """Names of all roles."""
        return tuple(self._roles)

    def role(self, name: str) -> Role:
        """See ``Method.role``."""
        if name not in self._roles:
            raise ConfigError(f"unknown role {name!r}; expected one of {', '.join(self._roles)}")
        return self._roles[name]

    def starts(
        self, role: str, buffer: InitialStateBuffer, count: int, rng: np.random.Generator
    ) -> Sequence[StartState]:
        """The environment's reset, for roles that are available there."""
        reset_q = self.role(role).reset_q
        return [] if reset_q is None else [StartState(reset_q, None)] * count

    def hands_over(self, role: str, q: States, q_next: States) -> Mask:
        """No state is stored."""
        return np.zeros(len(q), np.bool_)

    def receivers(self, role: str, q: int, rng: np.random.Generator) -> Collection[str]:
        """None."""
        return ()

    def told(self, role: str, changes: Iterable[Change]) -> None:
        """No Q table learns from changes."""

    def schedule(self) -> None:
        """All roles learn at once."""

    def entries(self) -> QEntries:
        """No Q table."""
        return []

    def load(self, entries: Iterable[tuple[int, str, float]]) -> None:
        """No Q table."""


class PolicyPerState(SharedRows):
    """The DFA state alone determines which role acts, and whose value the others bootstrap from.

    Args:
        roles: all of them.
        acting: the role of every DFA state; None where there is none.
        rows: whether a role learns from the rows that it recorded, or from all rows, read in each of its states.
    """

    def __init__(self, roles: Iterable[Role], acting: Sequence[str | None], rows: Literal["own", "all"]) -> None:
        super().__init__(roles)
        self._acting, self._rows = tuple(acting), rows
        numbers = {name: number for number, name in enumerate(self._roles)}
        self._number = np.array([-1 if name is None else numbers[name] for name in acting], np.int32)

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        """A copy passes to the role of q'; where there is none, another episode begins."""
        before, after = self._number[q], self._number[q_next]
        moved = np.where(after < 0, Ending.RESTART, Ending.CHOOSE)
        return np.where(before == after, Ending.KEEP, moved).astype(np.int8)

    def reads(self, role: str) -> Reading:
        """Rows in the DFA states in which the role acts."""
        own = [q for q, name in enumerate(self._acting) if name == role]
        return Reading(np.array(own, np.int32), self._rows)

    def successors(self, role: str, q_next: States, rng: np.random.Generator) -> list[str | None]:
        """The role of q'; no value where there is none."""
        return self.choose(q_next.tolist())

    def choose(
        self,
        q: Sequence[int],
        rng: np.random.Generator | None = None,
        *,
        observations: NDArray[np.float32] | None = None,
        among: Collection[str] | None = None,
    ) -> list[str | None]:
        """The role of each DFA state."""
        named = [self._acting[each] for each in q]
        return named if among is None else [name if name in among else None for name in named]
