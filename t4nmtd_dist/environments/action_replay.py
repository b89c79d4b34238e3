"""Snapshots by replay of a seed and actions, for environments with unreadable state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.observations import Flattener, Vector
from t4nmtd_dist.environments.serialization import padded, reseed, unpadded


class ActionReplay:
    """A seed and the actions since; restoring resets the environment and replays them.

    Episodes are cut after ``horizon`` steps, which keeps snapshots at one size. Reseeding is recorded too.

    Attributes:
        replayed: steps taken to restore; they count as interactions.
    """

    def __init__(self, env: Any, flattener: Flattener, horizon: int) -> None:
        self._env, self._flattener, self._horizon = env, flattener, horizon
        space = env.action_space
        self._record = np.dtype([("seed", "<u4"), ("action", space.dtype.newbyteorder("<"), space.shape)])
        self._seeds = np.random.default_rng(0)
        self._history: list[tuple[int, Any]] = []
        self._seed = self._reseeded = 0
        self.replayed = 0
        self._observation = self._flattener.flatten(self.reset(0))

    def reset(self, seed: int | None) -> Any:
        """See ``Snapshots.reset``; draws a seed if none is given."""
        if seed is not None:
            self._seeds = np.random.default_rng(seed)
        self._seed = int(self._seeds.integers(2**31)) if seed is None else seed
        self._history, self._reseeded = [], 0
        return self._env.reset(seed=self._seed)[0]

    def acted(self, action: Any, observation: Vector) -> bool:
        """See ``Snapshots.acted``."""
        self._history.append((self._reseeded, action))
        self._reseeded = 0
        return len(self._history) >= self._horizon

    def get(self) -> NDArray[np.uint8]:
        """See ``Snapshots.get``."""
        data = self._seed.to_bytes(8, "little") + np.array(self._history, self._record).tobytes()
        return padded(data, 8 + self._horizon * self._record.itemsize)

    def set(self, state: NDArray[Any]) -> Vector:
        """See ``Snapshots.set``."""
        try:
            data = unpadded(state)
            history = np.frombuffer(data[8:], self._record)
        except ValueError as error:
            raise EnvError(f"no snapshot of {self._env}: {error}") from None
        observation = self.reset(int.from_bytes(data[:8], "little"))
        for seed, action in history:
            if seed:
                self._reseed(int(seed))
            observation = self._env.step(action if self._env.action_space.shape else int(action))[0]
            self.acted(action, self._observation)
        self.replayed += len(history)
        return self._flattener.flatten(observation)

    def reseed(self, seed: int) -> None:
        """See ``Snapshots.reseed``."""
        self._reseed(seed % (2**32 - 1) + 1)

    def bookkeeping(self) -> State:
        """The seed set since the last step, if any, and the generator of reset seeds."""
        return {"rng": self._reseeded, "seeds": self._seeds.bit_generator.state}

    def load_bookkeeping(self, state: State) -> None:
        """See ``Snapshots.load_bookkeeping``."""
        self._reseeded = state["rng"]
        self._seeds.bit_generator.state = state["seeds"]

    def _reseed(self, seed: int) -> None:
        """Reseed; the next step records it (0: none)."""
        self._reseeded = seed
        reseed(self._env, seed)
