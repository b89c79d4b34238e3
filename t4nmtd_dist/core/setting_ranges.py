"""Which values the settings of a task may have."""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING, Any

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import METHODS

if TYPE_CHECKING:
    from t4nmtd_dist.core.config import SACConfig, TaskConfig

POSITIVE = (
    "environment.horizon",
    "decomposition.time_limit",
    "learner.attempt_steps",
    "learner.start_capacity",
    "learner.reward_scale",
    "ppo.num_envs",
    "ppo.rollout",
    "ppo.epochs",
    "ppo.minibatch",
    "ppo.learning_rate",
    "sac.num_envs",
    "sac.steps_per_iteration",
    "sac.replay_rows",
    "sac.batch",
    "sac.updates_per_step",
    "sac.n_step",
    "sac.learning_rate",
    "sac.tau",
    "sac.actor_average",
    "evaluation.episodes",
    "evaluation.every",
    "evaluation.in_a_row",
    "max_interactions",
)
SHARES = (
    "learner.gamma",
    "ppo.gae_lambda",
    "sac.relabel_share",
    "sac.peer_share",
    "sac.success_share",
    "sac.wave_share",
    "sac.hold_share",
    "sac.alpha_floor",
    "sac.tau",
    "sac.actor_average",
    "sac.learning_rate_decay",
    "high_level.alpha",
    "high_level.epsilon",
)
NOT_NEGATIVE = ("learner.error_penalty", "sac.initial_alpha")
RESERVED = {"evaluator", "evaluations"}


def check_ranges(task: TaskConfig) -> None:
    """Check the settings of a task.

    Raises:
        ConfigError: if one is out of range; the text names it.
    """
    for key in NOT_NEGATIVE:
        if _value(task, key) < 0:
            raise ConfigError(f"{key} = {_value(task, key)}: expected 0 or more")
    for key in POSITIVE:
        if not _value(task, key) > 0:
            raise ConfigError(f"{key} = {_value(task, key)}: expected a number above 0")
    for key in SHARES:
        if not 0 <= _value(task, key) <= 1:
            raise ConfigError(f"{key} = {_value(task, key)}: expected a number from 0 to 1")
    if not 0 < task.evaluation.success <= 1:
        raise ConfigError(f"evaluation.success = {task.evaluation.success}: expected a number above 0 and at most 1")
    METHODS.check(task.learner.method, "learner.method")
    _check_hidden(task.learner.hidden)
    _check_replay(task.sac)
    _check_groups(task)
    _check_names(task)


def _value(task: TaskConfig, key: str) -> Any:
    return reduce(getattr, key.split("."), task)


def _check_hidden(hidden: tuple[int, ...]) -> None:
    if not hidden or min(hidden) < 1:
        raise ConfigError(f"learner.hidden = {list(hidden)}: expected one layer or more, each at least 1 wide")


def _check_replay(sac: SACConfig) -> None:
    kept = sac.replay_rows // sac.num_envs * sac.num_envs
    if kept < max(sac.num_envs, sac.learning_starts):
        raise ConfigError(
            f"sac.replay_rows = {sac.replay_rows}: expected at least sac.learning_starts = {sac.learning_starts}, "
            f"in whole steps of sac.num_envs = {sac.num_envs} copies; otherwise learning never starts"
        )


def _check_groups(task: TaskConfig) -> None:
    for group in task.exclusive:
        strange = [name for name in group if name not in task.propositions]
        if strange:
            raise ConfigError(f"exclusive names {strange[0]!r}; declared propositions: {', '.join(task.propositions)}")


def _check_names(task: TaskConfig) -> None:
    taken = sorted(RESERVED & {name.casefold() for name in task.propositions})
    if taken:
        raise ConfigError(
            f"a proposition is called {taken[0]!r}, as a process or a file of every run is; give it another name"
        )
