"""What every environment promises beyond Gymnasium.

Labels. ``propositions`` names the propositions of an environment. After every step and at reset, ``info["labels"]``
holds those that are true in the state *after* the step. The environment knows nothing of automata and its reward is
0; the product with the DFA pays the task's reward.

Snapshots. ``get_state`` returns everything that decides the future as one flat array; ``set_state`` restores
it exactly: the same actions then give bit-identical observations, labels and snapshots. There is no step
counter in an environment, hence none in a snapshot.

The loop a batched environment is meant for::

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
    """A single environment, besides being a ``gymnasium.Env``.

    ``info["labels"]`` is a frozenset of the names that are true.

    Attributes:
        propositions: the names that labels may contain, in a fixed order.
    """

    propositions: tuple[str, ...]

    def get_state(self) -> NDArray[Any]:
        """A snapshot: array of shape (s,), a copy."""
        ...

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns the observation there.

        Raises:
            ValueError: if ``state`` is no snapshot of this environment; the environment then stays as it was.
        """
        ...


@runtime_checkable
class SnapshotVectorEnv(Protocol):
    """A batch of N environments, besides being a ``gymnasium.vector.VectorEnv`` with autoreset disabled.

    - ``step(actions[N])`` returns observations float32 [N, d], rewards of zero [N], terminated bool [N],
      truncated all false [N], and ``info["labels"]``, bool [N, P] with the columns in the order of
      ``propositions``. Every returned array is fresh: later steps leave it alone.
    - ``reset(seed=, options={"reset_mask": bool [N]})`` resets the rows of the mask, without a mask all rows,
      and returns the observations and labels of all N rows.
    - A row that has terminated stays as it is, whatever the action, and keeps reporting ``terminated`` until
      it is reset or set.

    An environment with random generators beside Gymnasium's ``np_random`` lists them as ``generators``; a training
    can be resumed with exactly the same chance.

    Attributes:
        propositions: the names of the label columns.
    """

    propositions: tuple[str, ...]

    def get_states(self, indices: ArrayLike) -> NDArray[Any]:
        """Snapshots of the rows ``indices`` [k]: array of shape (k, s), a copy.

        Raises:
            ValueError: if an index is not an integer in 0..N-1.
        """
        ...

    def set_states(self, indices: ArrayLike, states: NDArray[Any]) -> NDArray[np.float32]:
        """Restore snapshots (k, s) into the rows ``indices`` [k]; returns their observations (k, d).

        Raises:
            ValueError: if an index is out of range or named twice, or a row of ``states`` is no snapshot of
                this environment; no row is changed then.
        """
        ...
