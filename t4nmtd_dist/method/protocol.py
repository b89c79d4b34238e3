"""The method protocol: a task's policies, their starts, ends and bootstrap values.

A method is a module with the functions of ``MethodModule``, listed in ``t4nmtd_dist.core.registry.METHODS`` and
selected by ``learner.method``.
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
    """What a role does after a step: continue, leave the choice to ``choose``, or restart."""

    KEEP = 0
    CHOOSE = 1
    RESTART = 2


class Change(NamedTuple):
    """A DFA change seen by a role, or the end of its attempt without one.

    Attributes:
        q: DFA state before.
        q_next: DFA state after; ``NO_TARGET`` if the attempt failed.
        steps: steps since q was entered.
        reward: shaped reward of the last step, unscaled; 0 if the attempt failed.
    """

    q: int
    q_next: int
    steps: int
    reward: float


@dataclass(frozen=True)
class Reading:
    """The replay rows that a role learns from.

    Attributes:
        q: DFA states in which rows may be read, whatever state they were recorded in, int32 [k].
        rows: its ``own``, recorded while it acted and read in the DFA state they were recorded in, or those of ``all``
            roles, read in any of ``q``. The agent's settings say in which shares.
    """

    q: States
    rows: Literal["own", "all"]


class Method(Protocol):
    """The rules of one method for one compiled task.

    Coordinator, learners and evaluator each run their part of this loop on their own object::

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

    Roles are named as in the task's ``Decomposition``; their targets are their transitions there.

    Where roles share one environment (``shares_env``), one learner holds all networks, and the ``Decomposition`` has
    one pid with all transitions. N copies are stepped together, each with an active role::

        active = method.choose(q, rng, observations=observations)
        while True:
            q_next, symbols = ...                                       # step all copies, each with its role's actor
            ending = method.ends(role, q, q_next, steps)                # for the copies of each role
            active[chosen] = method.choose(q_next, rng, ...)            # where CHOOSE, or after a reset

    Attributes:
        shares_env: whether a copy of the environment passes from role to role within an episode.
        roles: names of all roles, in the order of their goals.
    """

    @property
    def shares_env(self) -> bool:
        """See above."""

    @property
    def roles(self) -> tuple[str, ...]:
        """See above."""

    def role(self, name: str) -> Role:
        """One role with its tables.

        Raises:
            ConfigError: if the role does not exist.
        """

    def starts(
        self, role: str, buffer: InitialStateBuffer, count: int, rng: np.random.Generator
    ) -> Sequence[StartState]:
        """Draw the starts of ``count`` attempts: the environment's reset or stored states.

        Returns:
            The starts; empty if there are none yet.
        """

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        """``Ending`` values int8 [N] after a step from q to q' [N], the ``steps``-th of the attempt.

        F, E and environment termination always start a new attempt.
        """

    def hands_over(self, role: str, q: States, q_next: States) -> Mask:
        """Which steps reach a state to store as a start, bool [N]; terminals are never stored."""

    def receivers(self, role: str, q: int, rng: np.random.Generator) -> Collection[str]:
        """Roles whose buffers store a state <s, q> handed over by ``role``."""

    def reads(self, role: str) -> Reading:
        """The replay rows that a role learns from."""

    def successors(self, role: str, q_next: States, rng: np.random.Generator) -> list[str | None]:
        """Whose value ``role`` bootstraps from after a change to each q' [N] outside F and E.

        Its own name means its own critic; None means the value 0.
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
            rng: for exploration; without it, the choice is greedy.
            observations: float32 [N, d], if known.
            among: roles to choose from; None for all.

        Returns:
            Names [N]; None where no role is available.
        """

    def told(self, role: str, changes: Iterable[Change]) -> None:
        """Train the high level on a role's reported changes, in order."""

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
        """Roles that act and learn now; None for all."""

    def learns(self, role: str) -> bool:
        """Whether a scheduled role explores and learns; otherwise its greedy policy makes whole attempts."""

    def entries(self) -> QEntries:
        """The learned high level as (q, role, value), for messages, checkpoints and exports."""

    def load(self, entries: Iterable[tuple[int, str, float]]) -> None:
        """Replace the learned high level with ``entries`` of another object."""

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
    """Functions of a module in ``METHODS``.

    Its docstring begins with a line for ``t4nmtd tasks --methods``. A module whose roles share an environment has
    ``SHARES_ENV = True``.
    """

    def decompose(self, config: TaskConfig, dfa: DFA, *, seed: int, deadline: Deadline | None) -> Decomposition:
        """The roles and their transitions.

        Raises:
            ConfigError: if there is nothing to learn, or the deadline has passed.
        """

    def build(self, config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> Method:
        """The rules for a decomposed task; ``rho`` are its potentials, float64 [Q]."""


def method_module(name: str) -> MethodModule:
    """Import a method's module.

    Raises:
        ConfigError: if it does not exist; lists the known methods.
    """
    return cast(MethodModule, METHODS.module(name))
