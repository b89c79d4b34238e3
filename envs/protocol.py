"""The contract of every environment beyond Gymnasium.

Labels. After every step and at reset, ``info["labels"]`` holds the ``propositions`` that are true *after* the step.
Environments know nothing about automata and their reward is 0; the product with the DFA provides the reward.

Snapshots. ``get_state`` returns everything that determines the future as one flat array. After ``set_state``, the same
actions give bit-identical observations, labels and snapshots. Environments have no step counter.

Intended loop of a batched environment::

    observations, info = environment.reset(seed=0)
    while learning:
        observations, _, terminated, _, info = environment.step(choose(observations))
        ended = np.flatnonzero(terminated | out_of_time | reached_target(info["labels"]))
        observations[ended] = environment.set_states(ended, start_states(ended.size))
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray


@runtime_checkable
class SnapshotEnv(Protocol):
    """A single environment that is also a ``gymnasium.Env``.

    ``info["labels"]`` is a frozenset of the true propositions.

    Attributes:
        propositions: all label names, in a fixed order.
    """

    propositions: tuple[str, ...]

    def get_state(self) -> NDArray[Any]:
        """A snapshot: array (s,), a copy."""
        ...

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns its observation.

        Raises:
            ValueError: if ``state`` is not a snapshot of this environment, which is then unchanged.
        """
        ...


@runtime_checkable
class SnapshotVectorEnv(Protocol):
    """A batch of N environments that is also a ``gymnasium.vector.VectorEnv`` with autoreset disabled.

    - ``step(actions[N])`` returns observations float32 [N, d], rewards of zero [N], terminated bool [N], truncated all
      false [N], and ``info["labels"]``, bool [N, P] with columns in the order of ``propositions``. All arrays are new.
    - ``reset(seed=, options={"reset_mask": bool [N]})`` resets the masked rows, by default all, and returns
      observations and labels of all N rows.
    - A terminated row stays so, unchanged, until it is reset or restored.

    Random generators besides Gymnasium's ``np_random`` are listed as ``generators``, so that resumed trainings have
    exactly the same randomness.

    Attributes:
        propositions: names of the label columns.
    """

    propositions: tuple[str, ...]

    def get_states(self, indices: ArrayLike) -> NDArray[Any]:
        """Snapshots of the rows ``indices`` [k]: shape (k, s), a copy.

        Raises:
            ValueError: if an index is not an integer in 0..N-1.
        """
        ...

    def set_states(self, indices: ArrayLike, states: NDArray[Any]) -> NDArray[np.float32]:
        """Restore snapshots (k, s) into the rows ``indices`` [k]; returns their observations (k, d).

        Raises:
            ValueError: if an index is out of range or duplicate, or a snapshot is invalid; no row is changed then.
        """
        ...
