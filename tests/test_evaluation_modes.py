"""Greedy and sampled evaluations: when each is played, what is reported, and that both follow from the seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_sac import small_sac_task
from small_tasks import own_task, small_config

from coordinator.run_settings import RunSettings
from t4nmtd_dist.core.config import EvaluationConfig, task_config
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.environments.preparation import prepared
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.policy.evaluation import Evaluator
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.tasks import load_task, task_names
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import EvaluationJob, EvaluationReport, Granted
from workers.evaluation_session import EvaluationSession

HERE = Path(__file__).parent
CORRIDOR = f"""
name = "corridor"
formula = "F(left)"
propositions = ["left", "right", "again"]
[environment]
id = "own_environments:Corridor"
path = "{HERE}"
horizon = 30
[learner]
hidden = [2]
attempt_steps = 10
[ppo]
num_envs = 4
rollout = 16
[evaluation]
episodes = 20
every = 100
"""
GOES_LEFT, GOES_RIGHT, WAVERS = (3.0, -3.0), (-3.0, 3.0), (-0.05, 0.05)
"""Logits: greedily, the last one always goes right, away from the goal; sampled, it often comes to the left."""


def corridor(folder: Path, *flags: str) -> CompiledTask:
    return prepared(compile_task(load_task(str(own_task(folder, CORRIDOR)), flags=flags), translator="python"))


def weights(task: CompiledTask, bias: tuple[float, float]) -> dict[str, NDArray[np.float32]]:
    return {
        "actor.0.weight": np.zeros((2, 7 + task.dfa.states), np.float32),
        "actor.0.bias": np.zeros(2, np.float32),
        "actor.2.weight": np.zeros((2, 2), np.float32),
        "actor.2.bias": np.array(bias, np.float32),
    }


def policy_of(task: CompiledTask, bias: tuple[float, float], **options: Any) -> GlobalPolicy:
    actors = {"left": weights(task, bias)}
    return GlobalPolicy(task, [], actors, **options)


# Settings


def test_tasks_play_the_better_mode_unless_they_say_otherwise_and_bundled_ones_are_greedy() -> None:
    assert EvaluationConfig().actions == "best"
    assert EvaluationConfig().success == 1.0
    assert {load_task(name).evaluation.actions for name in task_names()} == {"greedy"}


@pytest.mark.parametrize("success", ["0.0", "-0.5", "1.01", "nan"])
def test_a_threshold_that_no_or_every_evaluation_reaches_is_refused(success: str) -> None:
    with pytest.raises(ConfigError, match=r"evaluation\.success = .*above 0 and at most 1"):
        load_task("task7", flags=[f"evaluation.success={success}"])


def test_another_way_to_play_is_refused() -> None:
    with pytest.raises(ConfigError, match="random"):
        load_task("task7", flags=["evaluation.actions=random"])


def test_the_settings_travel() -> None:
    config = small_config("evaluation.actions=sampled", "evaluation.success=0.9")
    assert task_config(config.to_dict()).evaluation == config.evaluation
    assert (config.evaluation.actions, config.evaluation.success) == ("sampled", 0.9)


# Episodes


def test_sampled_episodes_reach_what_the_arg_max_never_does(tmp_path: Path) -> None:
    task = corridor(tmp_path)
    policy = policy_of(task, WAVERS)
    evaluator = Evaluator(policy, 40, seed=0)
    assert evaluator.run(policy).success_rate == 0.0
    assert 0.2 < evaluator.run(policy, actions="sampled").success_rate < 1.0
    own = policy_of(task, WAVERS, mode="sampled")
    assert evaluator.run(own).success_rate > 0.2, "without a word, it is the policy's own mode"


def test_sampled_episodes_follow_from_the_seed_and_go_on_from_a_checkpoint(tmp_path: Path) -> None:
    policy = policy_of(corridor(tmp_path), WAVERS)

    def lengths(evaluator: Evaluator) -> list[int]:
        return [int(n) for n in evaluator.run(policy, actions="sampled").lengths]

    first, again, other = (Evaluator(policy, 20, seed=seed) for seed in (1, 1, 2))
    assert lengths(first) == lengths(again) != lengths(other)
    resumed = Evaluator(policy, 20, seed=3)
    resumed.load_state_dict(first.state_dict())
    assert lengths(resumed) == lengths(first) == lengths(again)


def test_sampling_does_not_change_where_greedy_episodes_begin(tmp_path: Path) -> None:
    policy = policy_of(corridor(tmp_path), GOES_LEFT)
    found = []
    for before in ("greedy", "sampled"):
        evaluator = Evaluator(policy, 20, seed=4)
        evaluator.run(policy, actions=before)
        found.append(evaluator.run(policy, perturb=2, actions="greedy").lengths.tolist())
    assert found[0] == found[1]
    assert len(set(found[0])) > 1


def test_a_checkpoint_without_sampling_is_gone_on_from(tmp_path: Path) -> None:
    policy = policy_of(corridor(tmp_path), WAVERS)
    evaluator = Evaluator(policy, 2, seed=1)
    state = evaluator.state_dict()
    del state["sampling"]
    Evaluator(policy, 2, seed=1).load_state_dict(state)


# Jobs


def session(task: CompiledTask) -> EvaluationSession:
    return EvaluationSession(
        Granted(
            role="evaluator",
            pid="evaluator",
            epoch=1,
            lease_s=1.0,
            seed=0,
            task=task.config.to_dict(),
            dfa=task.dfa.to_json(),
            decomposition=task.decomposition.to_json(),
            rho=[float(x) for x in task.rho],
        )
    )


def report(task: CompiledTask, bias: tuple[float, float], *actions: str) -> EvaluationReport:
    arrays = {f"left/weights.{name}": array for name, array in weights(task, bias).items()}
    return session(task).evaluate(Envelope(EvaluationJob(job=1, actions=actions), arrays))  # type: ignore[arg-type]


def test_the_second_mode_is_played_only_where_the_first_falls_short(tmp_path: Path) -> None:
    task = corridor(tmp_path)
    perfect = report(task, GOES_LEFT, "greedy", "sampled")
    assert (perfect.success_rate, perfect.actions, perfect.other_success_rate) == (1.0, "greedy", None)
    sampled_first = report(task, GOES_LEFT, "sampled", "greedy")
    if sampled_first.success_rate == 1.0 and sampled_first.actions == "sampled":
        assert sampled_first.other_success_rate is None
    wavering = report(task, WAVERS, "greedy", "sampled")
    assert (wavering.actions, wavering.other_success_rate) == ("sampled", 0.0)
    assert 0.0 < wavering.success_rate < 1.0
    assert report(task, WAVERS, "greedy").other_success_rate is None


def test_of_equals_the_greedy_mode_is_reported(tmp_path: Path) -> None:
    task = corridor(tmp_path, "environment.horizon=2")
    for order in (("greedy", "sampled"), ("sampled", "greedy")):
        hopeless = report(task, GOES_RIGHT, *order)
        assert (hopeless.success_rate, hopeless.actions, hopeless.other_success_rate) == (0.0, "greedy", 0.0)


def test_what_falls_short_depends_on_the_threshold(tmp_path: Path) -> None:
    low = corridor(tmp_path, "evaluation.success=0.1", "evaluation.actions=sampled")
    enough = report(low, WAVERS, "sampled", "greedy")
    assert (enough.actions, enough.other_success_rate) == ("sampled", None)


# Whole runs


def begun(folder: Path, kind: str) -> SerialRun:
    if kind == "ppo":
        task = corridor(folder, "environment.options.slip=0.4", "environment.horizon=5")  # never perfect
    else:
        flags = ("evaluation.actions=best", "evaluation.every=20", "evaluation.episodes=2", "environment.horizon=10")
        task = small_sac_task(*flags)
    return SerialRun(task, RunSettings(1, 10**9, lease_s=float("inf")), float)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ppo", "sac"])
def test_a_serial_run_with_both_modes_goes_on_exactly(kind: str, tmp_path: Path) -> None:
    def rows(run: SerialRun) -> list[Any]:
        return [
            (r.job, r.success_rate, r.other_success_rate, r.mean_length) for r in run.coordinator.evaluations.history
        ]

    whole, first, second = (begun(tmp_path, kind) for _ in range(3))
    for _ in range(8):
        whole.round()
    for _ in range(4):
        first.round()
    second.load_state_dict(first.state_dict())
    for _ in range(4):
        second.round()
    assert rows(second) == rows(whole) != []
    assert any(row.other_success_rate is not None for row in whole.coordinator.evaluations.history)
