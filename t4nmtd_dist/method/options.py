"""Options: roles that an upper level chooses among by observation and DFA state, and what it learns from.

An option is held until the method's ``ends`` says ``CHOOSE`` or the episode ends, a time-out included. The loop of a
runner, for N copies of the environment that are stepped together::

    method.upper = ...                                                  # a table, a network
    options = method.open_options(N, d)
    active = method.choose(q, rng, observations=observations)
    options.open(all rows, observations, q, active)
    while True:
        ...                                                             # step
        options.earn(rewards)                                           # method.upper_rewards, for each role's copies
        closed = options.close(rows, next_observations, q_next, ended)  # rows: CHOOSE, RESTART, or the episode is over
        method.upper.learn(closed)
        ...                                                             # reset, choose, open
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.protocol import Ending, Mask, States
from t4nmtd_dist.method.rewards import ACCEPTANCE_REWARD, environment_rewards
from t4nmtd_dist.method.roles import Role, error_penalty, role_of
from t4nmtd_dist.method.shared_rows import SharedRows

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


OPTIONS = "options"
"""Name of the network that all options share."""


def option_role(
    config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64], name: str
) -> Role:
    """An option that pursues ``name``'s transitions; its goal is its place in the decomposition.

    An option ends where the DFA state changes. Under ``shaping = "potential"`` all states but its targets therefore
    have the potential 0 after a change, and only its targets pay for acceptance: leaving a state elsewhere is worth as
    much as staying forever.
    """
    role = replace(role_of(config, dfa, decomposition, rho, name), network=OPTIONS, goal=decomposition.pids.index(name))
    if config.learner.shaping != "potential":
        return role
    tables = role.tables
    changed = ~np.eye(dfa.states, dtype=np.bool_)
    missed = changed & ~tables.target
    kept = np.where(tables.terminal, 0.0, rho)
    accepts = tables.accepting[None, :] & ~tables.accepting[:, None]
    unearned = np.where(accepts, ACCEPTANCE_REWARD, 0.0) + config.learner.gamma * kept[None, :]
    return replace(role, tables=replace(tables, reward=tables.reward - np.where(missed, unearned, 0.0)))


def paid_above(config: TaskConfig, dfa: DFA) -> NDArray[np.float64] | None:
    """The upper level's reward of every DFA change, float64 [Q, Q]: the environment's.

    None under ``shaping = "paper"``: there it is paid what its options are paid.
    """
    if config.learner.shaping == "paper":
        return None
    return environment_rewards(dfa, error_penalty=error_penalty(config))


@dataclass(frozen=True)
class ClosedOptions:
    """Options that came to an end, as the upper level learns from them.

    Attributes:
        observations: where the option was chosen, float32 [k, d].
        q: the DFA state there, int32 [k].
        choices: the option as its number in ``Method.roles``, int64 [k].
        rewards: sum of its steps' rewards, discounted per step or not, unscaled, float64 [k].
        next_observations: where it ended, float32 [k, d].
        q_next: the DFA state there, int32 [k].
        discounts: of the bootstrap; 0 where nothing follows, float64 [k].
        mask: the options available in ``q_next``; some one is wherever the discount is not 0, bool [k, roles].
    """

    observations: Floats
    q: States
    choices: Rows
    rewards: NDArray[np.float64]
    next_observations: Floats
    q_next: States
    discounts: NDArray[np.float64]
    mask: Mask


class OptionValues(Protocol):
    """Values of options."""

    def values(self, observations: Floats, q: States) -> NDArray[np.floating[Any]]:
        """Q((s, q), option) of all options, available or not, [N, roles]."""


class UpperLearner(OptionValues, Protocol):
    """Learns the values of options."""

    def learn(self, closed: ClosedOptions) -> None:
        """Learn from options that came to an end: towards rewards + discounts * max over ``mask`` of the values."""


@dataclass(frozen=True)
class LinearSchedule:
    """A share that goes from ``start`` to ``end`` within ``over`` decisions and stays there."""

    start: float
    end: float
    over: int = 1

    def after(self, decisions: int) -> float:
        """The share after some decisions."""
        return self.end + (self.start - self.end) * max(0.0, 1.0 - decisions / self.over)


class OpenOptions:
    """The option that each of N rows follows: where it was chosen, and what it has earned since.

    Args:
        count: N.
        observation_size: d.
        roles: the options' names.
        available: whether an option is available in a DFA state, bool [Q, roles].
        gamma: discount of one step if ``smdp``, else of one decision.
        smdp: whether rewards and bootstrap are discounted per step.
    """

    def __init__(
        self, count: int, observation_size: int, roles: Sequence[str], available: Mask, *, gamma: float, smdp: bool
    ) -> None:
        self._numbers = {name: number for number, name in enumerate(roles)}
        self._available, self._gamma, self._smdp = available, gamma, smdp
        self._observations = np.zeros((count, observation_size), np.float32)
        self._q = np.zeros(count, np.int32)
        self._choices = np.zeros(count, np.int64)
        self._rewards = np.zeros(count)
        self._discounts = np.ones(count)

    def open(self, rows: Rows, observations: Floats, q: States, roles: Sequence[str]) -> None:
        """Begin the options ``roles`` in ``rows`` [k], chosen in ``observations`` [k, d] and ``q`` [k]."""
        self._observations[rows], self._q[rows] = observations, q
        self._choices[rows] = [self._numbers[name] for name in roles]
        self._rewards[rows], self._discounts[rows] = 0.0, 1.0

    def earn(self, rewards: NDArray[np.float64]) -> None:
        """Add what one step of every row paid, ``upper_rewards`` [N]."""
        self._rewards += self._discounts * rewards
        if self._smdp:
            self._discounts *= self._gamma

    def close(self, rows: Rows, observations: Floats, q: States, ended: Mask) -> ClosedOptions:
        """End the options of ``rows`` [k].

        Args:
            rows: row numbers.
            observations: where they ended, before any reset [k, d].
            q: the DFA states there [k].
            ended: whether nothing follows: F, E, or the environment terminated; not a time-out [k].
        """
        mask = self._available[q]
        discounts = self._discounts[rows] if self._smdp else np.full(len(rows), self._gamma)
        discounts = np.where(ended | ~mask.any(axis=1), 0.0, discounts)
        return ClosedOptions(
            observations=self._observations[rows],
            q=self._q[rows],
            choices=self._choices[rows],
            rewards=self._rewards[rows],
            next_observations=np.asarray(observations, np.float32),
            q_next=np.asarray(q, np.int32),
            discounts=discounts,
            mask=mask,
        )

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Arrays for a checkpoint."""
        return {
            "observations": self._observations,
            "q": self._q,
            "choices": self._choices,
            "rewards": self._rewards,
            "discounts": self._discounts,
        }

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a ``state_dict``."""
        for name, column in self.state_dict().items():
            column[:] = state[name]


class OptionMethod(SharedRows):
    """Options under an upper level; what is left to say is when an option ends and which rows it reads.

    Args:
        roles: the options, in the order of their goals.
        gamma: see ``OpenOptions``.
        smdp: see ``OpenOptions``.
        epsilon: the upper level's share of uniform choices, by exploring choices made.
        environment: what the upper level is paid for every change of the DFA state, float64 [Q, Q]; without it, what
            the acting option is paid.

    Attributes:
        upper: values of the options; choices are uniform without it.
        decisions: exploring choices made.
    """

    def __init__(
        self,
        roles: Iterable[Role],
        *,
        gamma: float,
        smdp: bool,
        epsilon: LinearSchedule,
        environment: NDArray[np.float64] | None = None,
    ) -> None:
        super().__init__(roles)
        self._gamma, self._smdp, self._epsilon, self._environment = gamma, smdp, epsilon, environment
        self._available: Mask = np.stack([role.tables.available for role in self._roles.values()], axis=1)
        self._names = np.array([*self._roles, None], dtype=object)  # the last stands for no option
        self.upper: OptionValues | None = None
        self.decisions = 0

    def open_options(self, count: int, observation_size: int) -> OpenOptions:
        """The options of N rows; none is open yet."""
        return OpenOptions(count, observation_size, self.roles, self._available, gamma=self._gamma, smdp=self._smdp)

    def upper_rewards(self, role: str, q: States, q_next: States, terminated: Mask) -> NDArray[np.float64]:
        """What the upper level is paid for steps of an option from q to q' [N], unscaled, float64 [N]."""
        if self._environment is None:
            return self.role(role).tables.transition_rewards(q, q_next, terminated)
        paid: NDArray[np.float64] = self._environment[q, q_next]
        return paid

    def passed_on(self, over: Mask, q_next: States) -> NDArray[np.int8]:
        """``Ending`` values [N]: where an option is over, another is chosen, or an attempt begins if there is none."""
        going_on = np.where(self._available[q_next].any(axis=1), Ending.CHOOSE, Ending.RESTART)
        return np.where(over, going_on, Ending.KEEP).astype(np.int8)

    def successors(self, role: str, q_next: States, rng: np.random.Generator) -> list[str | None]:
        """An option ends with the DFA state, and nothing of it follows."""
        return [None] * len(q_next)

    def choose(
        self,
        q: Sequence[int],
        rng: np.random.Generator | None = None,
        *,
        observations: Floats | None = None,
        among: Collection[str] | None = None,
    ) -> list[str | None]:
        """Epsilon-greedy over the options available in each q, ties at random; greedy without ``rng``.

        Raises:
            ValueError: if there are values, but no observations to look them up for.
        """
        states = np.asarray(q, np.int32)
        able = self._available[states]
        if among is not None:
            able = able & np.array([name in among for name in self._roles])
        values = np.where(able, self._values(states, observations), -np.inf)
        if rng is None:
            chosen = values.argmax(axis=1)
        else:
            best = able & (values == values.max(axis=1, keepdims=True))
            explores = rng.random(len(states)) < self._epsilon.after(self.decisions)
            drawn = np.where(explores[:, None], able, best) * (1.0 - rng.random(able.shape))
            chosen = drawn.argmax(axis=1)
            self.decisions += len(states)
        named: list[str | None] = self._names[np.where(able.any(axis=1), chosen, -1)].tolist()
        return named

    def _values(self, q: States, observations: Floats | None) -> NDArray[np.floating[Any]]:
        if self.upper is None:
            return np.zeros((len(q), len(self._roles)))
        if observations is None:
            raise ValueError("the upper level values options by observation and DFA state: pass observations=...")
        return self.upper.values(observations, q)

    def state_dict(self) -> dict[str, int]:
        """What the choices depend on beside the upper learner, for a checkpoint."""
        return {"decisions": self.decisions}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state_dict``."""
        self.decisions = state["decisions"]
