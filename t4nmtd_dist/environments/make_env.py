"""Opens N copies of a task's environment, vectorised if possible."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.batched import BatchedEnv
from t4nmtd_dist.environments.looped_env import LoopedEnv
from t4nmtd_dist.environments.native_env import NativeBatchedEnv
from t4nmtd_dist.environments.opening import Spec, find_spec
from t4nmtd_dist.environments.single_env import SingleEnv
from t4nmtd_dist.environments.snapshot_choice import with_snapshots
from t4nmtd_dist.environments.user_errors import calls, described


def make_env(config: EnvironmentConfig, count: int, propositions: Sequence[str] = ()) -> BatchedEnv:
    """Open ``count`` copies of the configured environment.

    Uses a vector environment that implements ``envs.protocol`` directly; steps all others in a loop. ``propositions``
    is for environments that do not declare their own.

    Raises:
        EnvError: if the environment is unknown, rejects its options, or lacks labels or snapshots.
    """
    spec = find_spec(config)
    if not config.labels and spec is not None and _keeps_vector_contract(spec):
        return NativeBatchedEnv(_open_vector(config, spec, count), config.leave_out)
    config = with_snapshots(config, propositions)
    return LoopedEnv([SingleEnv(config, propositions) for _ in range(count)])


def _keeps_vector_contract(spec: Spec) -> bool:
    if spec.vector_entry_point is None:
        return False
    entry_point = spec.vector_entry_point
    made = gym.envs.registration.load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return all(hasattr(made, name) for name in ("get_states", "set_states"))


def _open_vector(config: EnvironmentConfig, spec: Spec, count: int) -> Any:
    try:
        return gym.make_vec(spec.id, count, "vector_entry_point", **config.options)
    except (TypeError, ValueError) as error:
        text = f"environment {config.id!r} refused its options {config.options}: {error}{calls(error)}"
        raise EnvError(text) from None
    except (gym.error.Error, ImportError) as error:
        raise EnvError(f"environment {config.id!r}: {error}{calls(error)}") from None
    except Exception as error:  # user code may raise anything
        text = f"making environment {config.id!r} with {config.options}: {described(error)}"
        raise EnvError(text) from error
