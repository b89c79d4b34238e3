"""What every environment promises beyond Gymnasium, and the checks of what it is given.

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
from gymnasium import spaces
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


def checked_choice(keyword: str, value: object, choices: tuple[object, ...]) -> None:
    """Check the value of a constructor keyword.

    Raises:
        ValueError: if ``value`` is not one of ``choices``, with the same type.
    """
    if not any(type(value) is type(choice) and value == choice for choice in choices):
        expected = " or ".join(repr(choice) for choice in choices)
        raise ValueError(f"{keyword} must be {expected}, got {value!r}")


def checked_count(num_envs: object) -> int:
    """The number of copies of a batch.

    Raises:
        ValueError: if it is not an integer of at least 1.
    """
    if type(num_envs) is not int or num_envs < 1:
        raise ValueError(f"num_envs must be an integer of at least 1, got {num_envs!r}")
    return num_envs


def checked_actions(space: spaces.Discrete, actions: ArrayLike, num_envs: int) -> NDArray[np.intp]:
    """The actions of a batch as an intp array of shape (num_envs,).

    Args:
        space: the action space of one environment, numbered from 0.
        actions: integers, one per environment.
        num_envs: N.

    Raises:
        ValueError: if the shape or type is wrong or an action is not in ``space``; names space and value.
    """
    array = np.asarray(actions)
    if array.shape != (num_envs,) or array.dtype.kind not in "iu":
        raise ValueError(
            f"actions must be integers of shape ({num_envs},) in {space}, "
            f"got {array.dtype} of shape {array.shape}: {actions!r}"
        )
    # Seen as unsigned numbers the negative ones are huge, so that one reduction checks both ends.
    numbers = array.astype(np.intp, copy=False)
    if numbers.view(np.uintp).max() >= space.n:
        row = int(np.flatnonzero((numbers < 0) | (numbers >= space.n))[0])
        raise ValueError(f"action {array[row]} of row {row} is not in {space}")
    return numbers


def checked_action(space: spaces.Discrete, action: object) -> int:
    """One discrete action as an int.

    Args:
        space: the action space, numbered from 0.
        action: an int, a numpy integer or an integer array of shape ().

    Raises:
        ValueError: if ``action`` is of another type or not in ``space``; names space and value.
    """
    array = np.asarray(action)
    if array.shape != () or array.dtype.kind not in "iu" or not 0 <= int(array) < space.n:
        raise ValueError(f"action {action!r} is not in {space}: expected an integer from 0 to {space.n - 1}")
    return int(array)


def checked_indices(indices: ArrayLike, num_envs: int) -> NDArray[np.intp]:
    """Row numbers of a batch as an intp array of shape (k,).

    Raises:
        ValueError: if they are not integers in one dimension, or one is not in 0..num_envs-1.
    """
    array = np.asarray(indices)
    if array.size == 0 and array.ndim == 1:
        return np.empty(0, dtype=np.intp)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise ValueError(f"row indices must be integers of shape (k,), got {array.dtype} {array.shape}: {indices!r}")
    outside = (array < 0) | (array >= num_envs)
    if outside.any():
        raise ValueError(f"row index {array[outside][0]} is not in 0..{num_envs - 1}")
    return array.astype(np.intp, copy=False)


def checked_reset_mask(mask: object, num_envs: int) -> NDArray[np.bool_]:
    """The ``reset_mask`` option of a batched reset, a bool array of shape (num_envs,).

    Raises:
        ValueError: if it is anything else, or true nowhere (as gymnasium's own vector environments do).
    """
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (num_envs,):
        raise ValueError(f"options['reset_mask'] must be a bool array of shape ({num_envs},), got {mask!r}")
    if not mask.any():
        raise ValueError("options['reset_mask'] is true nowhere: expected at least one row to reset")
    return mask


def checked_snapshots(env: str, states: object, count: int, size: int, kind: str) -> NDArray[Any]:
    """Check type, shape and finiteness of snapshots; what their values mean is the environment's to check.

    Args:
        env: name of the environment, for the message.
        states: what should be an array of shape (count, size).
        count: number of snapshots.
        size: length of one snapshot.
        kind: numpy kind codes that are allowed, such as ``"i"`` or ``"f"``.

    Raises:
        ValueError: if they are not such an array, or hold NaN or infinity.
    """
    if not isinstance(states, np.ndarray) or states.dtype.kind not in kind or states.shape != (count, size):
        came = f"{states.dtype} {states.shape}" if isinstance(states, np.ndarray) else type(states).__name__
        raise ValueError(
            f"{env} expects {count} snapshot(s), an array of shape ({count}, {size}), dtype kind {kind!r}, "
            f"got {came}: {states!r}"
        )
    if states.dtype.kind == "f" and not np.isfinite(states).all():
        raise ValueError(f"a snapshot of {env} must be finite, got {states!r}")
    return states
