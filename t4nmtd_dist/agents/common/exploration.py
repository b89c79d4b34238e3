"""Temporally correlated exploration for learners without success (docs/decisions/014)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.state_dict import State

Rows = NDArray[np.int64]
FREQUENCIES = (0.05, 0.3)  # cycles per step
HOLD_CHANCE = 0.1
LONGEST_HOLD = 20


def driven_share(share: float, success: float) -> float:
    """Share of attempts driven by exploration: ``share`` times the squared failure rate."""
    return share * (1.0 - success) ** 2


class SinusoidExploration:
    """Drives some attempts with sinusoids: one frequency per attempt, a random phase per action.

    Arguments as for ``Exploration``.
    """

    def __init__(self, count: int, action_size: int, share: float, rng: np.random.Generator) -> None:
        self._share, self._rng = share, rng
        self._driven = np.zeros(count, np.bool_)
        self._frequency = np.zeros((count, 1))
        self._phase = np.zeros((count, action_size))
        self._time = np.zeros((count, 1))

    def begin(self, rows: Rows, success: float) -> None:
        """Decide which of the attempts just begun in copies ``rows`` are driven."""
        self._driven[rows] = self._rng.random(len(rows)) < driven_share(self._share, success)
        self._frequency[rows] = self._rng.uniform(*FREQUENCIES, size=(len(rows), 1))
        self._phase[rows] = self._rng.uniform(0, 2 * np.pi, size=(len(rows), self._phase.shape[1]))
        self._time[rows] = 0

    def state_dict(self) -> State:
        """All sinusoids, for a checkpoint, without the generator."""
        return {name: column.copy() for name, column in self._columns().items()}

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``."""
        for name, column in self._columns().items():
            column[:] = state[name]

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {"driven": self._driven, "frequency": self._frequency, "phase": self._phase, "time": self._time}

    def drive(self, rows: Rows, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """The policy's actions [k, A] in [-1, 1] of copies ``rows``, or the sinusoid's in driven attempts."""
        waves = np.sin(2 * np.pi * self._frequency[rows] * self._time[rows] + self._phase[rows])
        self._time[rows] += 1
        driven: NDArray[np.float32] = np.where(self._driven[rows][:, None], waves, actions).astype(np.float32)
        return driven


class HeldActionExploration:
    """Interrupts the policy in some attempts with uniform random actions held for some steps.

    Temporally extended epsilon-greedy (Dabney et al., 2021). The policy keeps the attempt alive in between; held
    actions reach states that per-step noise would not. In a step without one, a held action starts with probability 0.1
    and lasts 1 to 20 steps. Arguments as for ``Exploration``.
    """

    def __init__(self, count: int, action_size: int, share: float, rng: np.random.Generator) -> None:
        self._share, self._rng = share, rng
        self._interrupted = np.zeros(count, np.bool_)
        self._left = np.zeros(count, np.int64)
        self._held = np.zeros((count, action_size), np.float32)

    def begin(self, rows: Rows, success: float) -> None:
        """Decide which of the attempts just begun in copies ``rows`` are interrupted."""
        self._interrupted[rows] = self._rng.random(len(rows)) < driven_share(self._share, success)
        self._left[rows] = 0

    def drive(self, rows: Rows, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """The policy's actions [k, A] in [-1, 1] of copies ``rows``, or the held ones."""
        rng = self._rng
        taken_up = rows[self._interrupted[rows] & (self._left[rows] == 0) & (rng.random(len(rows)) < HOLD_CHANCE)]
        self._left[taken_up] = rng.integers(1, LONGEST_HOLD + 1, size=len(taken_up))
        self._held[taken_up] = rng.uniform(-1, 1, size=(len(taken_up), self._held.shape[1]))
        holding = self._left[rows] > 0
        self._left[rows[holding]] -= 1
        driven: NDArray[np.float32] = np.where(holding[:, None], self._held[rows], actions)
        return driven

    def state_dict(self) -> State:
        """All held actions, for a checkpoint, without the generator."""
        return {name: column.copy() for name, column in self._columns().items()}

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``."""
        for name, column in self._columns().items():
            column[:] = state[name]

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {"interrupted": self._interrupted, "left": self._left, "held": self._held}


class Exploration:
    """Held actions, sinusoids, both or none, each in the same share of attempts.

    Each kind selects attempts independently; sinusoids take precedence. A disabled kind still draws random numbers, so
    that all choices see the same sequence.

    Args:
        kinds: ``held+sinusoid``, ``held``, ``sinusoid`` or ``none``.
        share: share of attempts at success rate 0, for each kind (``driven_share``).
        count: number of environments.
        action_size: A.
        rng: random generator.
    """

    def __init__(self, kinds: str, share: float, count: int, action_size: int, rng: np.random.Generator) -> None:
        chosen = kinds.split("+")
        self._sinusoid = SinusoidExploration(count, action_size, share if "sinusoid" in chosen else 0.0, rng)
        self._held = HeldActionExploration(count, action_size, share if "held" in chosen else 0.0, rng)

    def begin(self, rows: Rows, success: float) -> None:
        """Decide how the attempts just begun in copies ``rows`` are driven."""
        self._sinusoid.begin(rows, success)
        self._held.begin(rows, success)

    def drive(self, rows: Rows, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions [k, A] in [-1, 1] for copies ``rows`` to take, given the policy's."""
        return self._sinusoid.drive(rows, self._held.drive(rows, actions))

    def state_dict(self) -> State:
        """State of both kinds, without the generator."""
        return {"sinusoid": self._sinusoid.state_dict(), "held": self._held.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``."""
        self._sinusoid.load_state_dict(state["sinusoid"])
        self._held.load_state_dict(state["held"])
