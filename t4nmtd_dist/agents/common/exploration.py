"""Exploration that is correlated in time, for learners that have not succeeded yet (docs/decisions/014)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.state_dict import State

Flags = NDArray[np.bool_]
FREQUENCIES = (0.05, 0.3)  # cycles a step
HOLD_CHANCE = 0.1
LONGEST_HOLD = 20


def driven_share(share: float, success: float) -> float:
    """Share of the attempts that exploration drives; it falls with the square of the share of attempts that fail.

    Args:
        share: of a learner without success.
        success: share of the recent attempts that succeeded.
    """
    return share * (1.0 - success) ** 2


class SinusoidExploration:
    """Some attempts are driven by sinusoids: per attempt one frequency (cycles a step), per action a random phase.

    Args:
        count: copies of the environment.
        action_size: A.
        share: share of the attempts of a learner without success that are driven so (``driven_share``).
        rng: source of randomness.
    """

    def __init__(self, count: int, action_size: int, share: float, rng: np.random.Generator) -> None:
        self._share, self._rng = share, rng
        self._driven = np.zeros(count, np.bool_)
        self._frequency = np.zeros((count, 1))
        self._phase = np.zeros((count, action_size))
        self._time = np.zeros((count, 1))

    def begin(self, copies: Flags, success: float) -> None:
        """Decide for attempts that have just begun in ``copies`` whether they are driven."""
        rows = np.flatnonzero(copies)
        self._driven[rows] = self._rng.random(len(rows)) < driven_share(self._share, success)
        self._frequency[rows] = self._rng.uniform(*FREQUENCIES, size=(len(rows), 1))
        self._phase[rows] = self._rng.uniform(0, 2 * np.pi, size=(len(rows), self._phase.shape[1]))
        self._time[rows] = 0

    def state_dict(self) -> State:
        """The sinusoid of every copy, for a checkpoint; the source of randomness is its owner's affair."""
        return {name: column.copy() for name, column in self._columns().items()}

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state``."""
        for name, column in self._columns().items():
            column[:] = state[name]

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {"driven": self._driven, "frequency": self._frequency, "phase": self._phase, "time": self._time}

    def drive(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """The actions [N, A] in [-1, 1] to take: the policy's, or the sinusoid's in driven attempts."""
        waves = np.sin(2 * np.pi * self._frequency * self._time + self._phase)
        self._time += 1
        driven: NDArray[np.float32] = np.where(self._driven[:, None], waves, actions).astype(np.float32)
        return driven


class HeldActionExploration:
    """Some attempts follow the policy, interrupted by uniform random actions, each held for some steps.

    Epsilon-greedy whose random actions last (Dabney et al., 2021): the policy keeps the attempt alive in between,
    and what is held carries it to places that it would not reach by trembling. In every step without one an action
    is taken up with probability 0.1, and held for 1 to 20 steps.

    Args:
        count: copies of the environment.
        action_size: A.
        share: share of the attempts of a learner without success that are interrupted (``driven_share``).
        rng: source of randomness.
    """

    def __init__(self, count: int, action_size: int, share: float, rng: np.random.Generator) -> None:
        self._share, self._rng = share, rng
        self._interrupted = np.zeros(count, np.bool_)
        self._left = np.zeros(count, np.int64)
        self._held = np.zeros((count, action_size), np.float32)

    def begin(self, copies: Flags, success: float) -> None:
        """Decide for attempts that have just begun in ``copies`` whether they are interrupted."""
        rows = np.flatnonzero(copies)
        self._interrupted[rows] = self._rng.random(len(rows)) < driven_share(self._share, success)
        self._left[rows] = 0

    def drive(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """The actions [N, A] in [-1, 1] to take: the policy's, or those that are held."""
        rng = self._rng
        taken_up = self._interrupted & (self._left == 0) & (rng.random(len(self._left)) < HOLD_CHANCE)
        rows = np.flatnonzero(taken_up)
        self._left[rows] = rng.integers(1, LONGEST_HOLD + 1, size=len(rows))
        self._held[rows] = rng.uniform(-1, 1, size=(len(rows), self._held.shape[1]))
        holding = self._left > 0
        self._left[holding] -= 1
        driven: NDArray[np.float32] = np.where(holding[:, None], self._held, actions)
        return driven

    def state_dict(self) -> State:
        """What is held in every copy, for a checkpoint; the source of randomness is its owner's affair."""
        return {name: column.copy() for name, column in self._columns().items()}

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state``."""
        for name, column in self._columns().items():
            column[:] = state[name]

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {"interrupted": self._interrupted, "left": self._left, "held": self._held}


class Exploration:
    """Held actions, sinusoids, both or none, each in the same share of the attempts.

    Each kind draws its attempts independently; where both fall on one attempt, the sinusoid drives it. A kind that is
    not chosen has share 0 and draws random numbers all the same, so that they are the same for every choice.

    Args:
        kinds: ``held+sinusoid``, ``held``, ``sinusoid`` or ``none``.
        share: of the attempts of a learner without success, for each kind (``driven_share``).
        count: copies of the environment.
        action_size: A.
        rng: source of randomness.
    """

    def __init__(self, kinds: str, share: float, count: int, action_size: int, rng: np.random.Generator) -> None:
        chosen = kinds.split("+")
        self._sinusoid = SinusoidExploration(count, action_size, share if "sinusoid" in chosen else 0.0, rng)
        self._held = HeldActionExploration(count, action_size, share if "held" in chosen else 0.0, rng)

    def begin(self, copies: Flags, success: float) -> None:
        """Decide for attempts that have just begun in ``copies`` how they are driven."""
        self._sinusoid.begin(copies, success)
        self._held.begin(copies, success)

    def drive(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """The actions [N, A] in [-1, 1] to take, given the policy's."""
        return self._sinusoid.drive(self._held.drive(actions))

    def state_dict(self) -> State:
        """State of both kinds; the source of randomness is its owner's affair."""
        return {"sinusoid": self._sinusoid.state_dict(), "held": self._held.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state``."""
        self._sinusoid.load_state_dict(state["sinusoid"])
        self._held.load_state_dict(state["held"])
