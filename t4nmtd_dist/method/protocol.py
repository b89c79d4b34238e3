"""What a method is: which policies a task is solved by, where they start and end, and whose value they bootstrap from.

A method is one module, listed in ``t4nmtd_dist.core.registry.METHODS`` and chosen by ``learner.method``. The module has
the functions of ``MethodModule``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.registry import METHODS
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.high_level import QEntries
from t4nmtd_dist.method.roles import Role
from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState

NO_TARGET = -1
"""The q' of a change that led nowhere: the attempt ended in the DFA state in which it was."""

States = NDArray[np.int32]
Mask = NDArray[np.bool_]

Start = tuple[int, NDArray[Any]]
"""A start state <s, q> as (q, snapshot)."""

Delivery = tuple[str, int, NDArray[Any]]
"""A start state for a role's buffer, as (role, q, snapshot)."""


class Ending(IntEnum):
    """What a role does after a step: act on, leave the row to whom ``choose`` names, or begin a new attempt."""

    KEEP = 0
    CHOOSE = 1
    RESTART = 2


class Change(NamedTuple):
    """A change of the DFA state that a role saw, or the end of its attempt without one.

    Attributes:
        q: the DFA state before.
        q_next: the DFA state after; ``NO_TARGET`` if the attempt failed.
        steps: steps since q was entered.
        reward: shaped reward of the last of them, unscaled; 0 if the attempt failed.
    """

    q: int
    q_next: int
    steps: int
    reward: float


@dataclass(frozen=True)
class Reading:
    """Which replay rows a role learns from.

    Attributes:
        q: DFA states in which rows may be read, whatever state they were recorded in, int32 [k].
        rows: its ``own``, or those of ``all`` roles. The agent's settings say in which shares.
    """

    q: States
    rows: Literal["own", "all"]


class Method(Protocol):
    """The rules of one method for one compiled task.

    Coordinator, learners and evaluator hold an object each, and each runs its part of the loop it is meant for::

        starts = method.starts(role, buffer, n, rng)                    # learner: act
        while True:
            q_next, reward = ...                                        # step with the role's actor
            ending = method.ends(role, q, q_next, steps)
            stored = method.hands_over(role, q, q_next)

        rows = method.reads(role)                                       # learner: train
        bootstrap = method.successors(role, q_next, rng)

        method.told(role, changes)                                      # coordinator
        for q, state in stored:
            for receiver in method.receivers(role, q, rng):
                buffers[receiver].add(q, state)
        for receiver, q, state in method.advance(role, stored, rng):
            buffers[receiver].add(q, state)
        entries = method.entries()                                      # to the others, who call load(entries)

        roles = method.choose(q)                                        # evaluator: who acts

    Roles are named as in the task's ``Decomposition``, so that a role's targets are its transitions there.
    """

    def role(self, name: str) -> Role:
        """One role with its tables.

        Raises:
            ConfigError: if there is none of that name.
        """

    def starts(
        self, role: str, buffer: InitialStateBuffer, count: int, rng: np.random.Generator
    ) -> Sequence[StartState]:
        """Where ``count`` attempts of a role begin: at the environment's reset or in stored states.

        Returns:
            The starts; empty while there is nowhere to begin.
        """

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        """``Ending`` values int8 [N] after a step from q to q' [N], the ``steps``-th of the attempt.

        F, E and an environment that ends start a new attempt whatever this says.
        """

    def hands_over(self, role: str, q: States, q_next: States) -> Mask:
        """Bool [N]: which steps lead to a state that the coordinator is to store as a start; terminals never are."""

    def receivers(self, role: str, q: int, rng: np.random.Generator) -> Collection[str]:
        """The roles whose buffers take a state <s, q> that ``role`` handed over."""

    def reads(self, role: str) -> Reading:
        """Which replay rows a role learns from."""

    def successors(self, role: str, q_next: States, rng: np.random.Generator) -> list[str | None]:
        """Whose value ``role`` bootstraps from after a change to each of q' [N], outside F and E.

        Its own name stands for its own critic, None for the value 0.
        """

    def choose(
        self,
        q: Sequence[int],
        rng: np.random.Generator | None = None,
        *,
        observations: NDArray[np.float32] | None = None,
        among: Collection[str] | None = None,
    ) -> list[str | None]:
        """The role that acts in each of these DFA states.

        Args:
            q: DFA states [N].
            rng: draws exploring choices; without it the choice is greedy.
            observations: float32 [N, d], where they are known.
            among: roles to choose from; None for all.

        Returns:
            Names [N]; None where no role is available.
        """

    def told(self, role: str, changes: Iterable[Change]) -> None:
        """Learn the upper level from what a role reports, in order."""

    def advance(self, role: str, starts: Sequence[Start], rng: np.random.Generator) -> Iterable[Delivery]:
        """Decide what comes next, once all of a report is in.

        Args:
            role: whose report it was.
            starts: what it handed over, as given to ``receivers``.
            rng: the coordinator's.

        Returns:
            Start states that were held back until now.
        """

    def schedule(self) -> Collection[str] | None:
        """The roles that act and learn now; None for all."""

    def learns(self, role: str) -> bool:
        """Whether a scheduled role explores and learns; otherwise its greedy policy makes whole attempts."""

    def entries(self) -> QEntries:
        """What the upper level has learned as (q, role, value), for messages, checkpoints and exported policies."""

    def load(self, entries: Iterable[tuple[int, str, float]]) -> None:
        """Replace what the upper level has learned by the ``entries`` of another object."""

    def state_dict(self) -> State:
        """What the coordinator's object knows beyond its ``entries``, for a checkpoint."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state``, after ``load`` of the entries that belong to it."""


class Unstaged:
    """The part of a method that trains its roles all along: nothing comes later, and ``entries`` tell everything."""

    def advance(self, role: str, starts: Sequence[Start], rng: np.random.Generator) -> Iterable[Delivery]:
        """Nothing is held back."""
        return ()

    def learns(self, role: str) -> bool:
        """Always."""
        return True

    def state_dict(self) -> State:
        """Nothing."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """There is nothing to load."""


class MethodModule(Protocol):
    """What a module in ``METHODS`` offers."""

    def decompose(self, config: TaskConfig, dfa: DFA, *, seed: int, deadline: Deadline | None) -> Decomposition:
        """The roles and their transitions.

        Args:
            config: settings of the task.
            dfa: its automaton.
            seed: the run's.
            deadline: of the compilation.

        Raises:
            ConfigError: if nothing is left to learn, or the deadline passes.
        """

    def build(self, config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> Method:
        """The rules for a task decomposed so; ``rho`` are the potentials of its DFA states, float64 [Q]."""


def method_module(name: str) -> MethodModule:
    """Import the module of a method.

    Raises:
        ConfigError: if there is none of that name; lists those there are.
    """
    return cast(MethodModule, METHODS.module(name))
