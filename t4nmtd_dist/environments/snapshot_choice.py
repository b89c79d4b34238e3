"""Chooses the first snapshot adapter that restores exactly, verified by stepping."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.opening import Env, open_environment
from t4nmtd_dist.environments.restore_messages import difference, refusal
from t4nmtd_dist.environments.single_env import SingleEnv, SingleStep
from t4nmtd_dist.environments.snapshots import ADAPTERS, Adapter, has_own_state, is_mujoco, keeps_contract

TRIALS = 5
WALKS = (0, 1, 4, 12, 30)  # steps before the snapshot
STEPS_COMPARED = 12
SIZE_UNIT = 64


@dataclass(frozen=True)
class AdapterChoice:
    """The adapter that restores exactly.

    Attributes:
        snapshot_bytes: size reserved for a snapshot; twice the largest seen.
        failures: adapters tried before, and why they failed.
    """

    adapter: Adapter
    snapshot_bytes: int
    failures: dict[Adapter, str]


def with_snapshots(config: EnvironmentConfig, propositions: Sequence[str]) -> EnvironmentConfig:
    """Resolve ``snapshots = "auto"``, verified unless the environment implements our own contract."""
    if config.snapshots == "replay" or config.snapshot_bytes:
        return config
    env = open_environment(config)
    trusted = keeps_contract(env) and config.snapshots in ("auto", "own")
    env.close()
    if trusted:
        return dataclasses.replace(config, snapshots="own")
    return with_choice(config, choose_snapshots(config, propositions))


def with_choice(config: EnvironmentConfig, choice: AdapterChoice) -> EnvironmentConfig:
    """The settings with the chosen adapter."""
    return dataclasses.replace(
        config, snapshots=choice.adapter, snapshot_bytes=config.snapshot_bytes or choice.snapshot_bytes
    )


def choose_snapshots(config: EnvironmentConfig, propositions: Sequence[str], *, trials: int = TRIALS) -> AdapterChoice:
    """The first adapter that restores exactly.

    Raises:
        EnvError: if none does; the message says why each failed.
    """
    failures: dict[Adapter, str] = {}
    wanted = _candidates(open_environment(config)) if config.snapshots == "auto" else (config.snapshots,)
    for adapter in wanted:
        try:
            size = check_restore(dataclasses.replace(config, snapshots=adapter), propositions, trials=trials)
        except InexactRestoreError as error:
            if config.snapshots != "auto" and type(error.__cause__) is EnvError:
                raise error.__cause__ from None  # it failed in the user's code, and says where
            failures[adapter] = str(error)
        else:
            return AdapterChoice(adapter, size, failures)
    raise EnvError(refusal(config.id, failures))


def _candidates(env: Env) -> tuple[Adapter, ...]:
    unfit = {"own": not has_own_state(env), "mujoco": not is_mujoco(env), "attributes": is_mujoco(env)}
    return tuple(adapter for adapter in ADAPTERS if not unfit.get(adapter, False))


class InexactRestoreError(EnvError):
    """After restoring, the environment continued differently."""


def check_restore(config: EnvironmentConfig, propositions: Sequence[str], *, trials: int = TRIALS) -> int:
    """Restore snapshots into the same environment and into a copy, and compare the next steps.

    Returns:
        Bytes to reserve for a snapshot, 0 if the adapter needs none.

    Raises:
        InexactRestoreError: if a step differs, or the adapter fails.
        EnvError: if labels cannot be read.
    """
    first, second = SingleEnv(config, propositions), SingleEnv(config, propositions)
    biggest = max(_trial(first, second, trial) for trial in range(trials))
    if config.snapshots == "replay" or keeps_contract(first.env):
        return 0
    return -(-2 * biggest // SIZE_UNIT) * SIZE_UNIT


def _trial(first: SingleEnv, second: SingleEnv, trial: int) -> int:
    """Test one snapshot; returns its size in bytes."""
    first.action_space.seed(trial)
    seen = _walk(first, trial, WALKS[trial % len(WALKS)])
    state = _guarded(first.get_state)
    before = [first.action_space.sample() for _ in range(STEPS_COMPARED)]
    expected = _course(first, before, trial)
    _walk(second, 1000 + trial, 3)
    for env, where in ((second, "into another copy"), (first, "into the same copy")):
        observation = _guarded(env.set_state, state)
        _compare(difference("observation", observation, seen, env.propositions), 0, where)
        for t, (now, then) in enumerate(zip(_course(env, before, trial), expected, strict=False), start=1):
            for name in ("observation", "labels", "terminated", "truncated"):
                _compare(difference(name, getattr(now, name), getattr(then, name), env.propositions), t, where)
    return int(state.nbytes)


def _walk(env: SingleEnv, seed: int, steps: int) -> NDArray[np.float32]:
    """Reset and act at random without ending the episode; returns the last observation."""
    for allowed in (steps, steps // 2, 0):
        observation = env.reset(seed)
        for _ in range(allowed):
            step = env.step(env.action_space.sample())
            observation = step.observation
            if step.terminated or step.truncated:
                break
        else:
            break
    return observation


def _course(env: SingleEnv, actions: Sequence[Any], seed: int) -> list[SingleStep]:
    env.reseed(seed)
    steps: list[SingleStep] = []
    for action in actions:
        steps.append(env.step(action))
        if steps[-1].terminated or steps[-1].truncated:
            break
    return steps


def _guarded(function: Any, *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except EnvError as error:
        raise InexactRestoreError(str(error)) from error


def _compare(found: str | None, t: int, where: str) -> None:
    if found is not None:
        when = "right after restoring" if t == 0 else f"after {t} step{'s' if t > 1 else ''}"
        raise InexactRestoreError(f"restored {where}, {when}, {found}")
