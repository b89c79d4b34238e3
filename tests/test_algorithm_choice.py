"""The algorithm follows from the action space, with its own defaults, unless the task file names one."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from small_tasks import TINY, own_task

from coordinator.run_settings import RunSettings
from t4nmtd_dist.cli.check import check
from t4nmtd_dist.core.config import EnvironmentConfig, LearnerConfig, TaskConfig, task_config
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.decisions import with_algorithm
from t4nmtd_dist.environments.preparation import prepared
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.tasks import load_task, task_names

ROOT = Path(__file__).parent.parent
HERE = Path(__file__).parent

PUSHED = f"""
name = "pushed"
formula = "F(left & X(F(right)))"
propositions = ["left", "right", "again"]
[environment]
id = "own_environments:Pushed"
path = "{HERE}"
horizon = 30
"""
SAC_DEFAULTS = {"gamma": 0.98, "shaping": "subtask", "error_penalty": 10.0, "reward_scale": 0.1, "hidden": (128, 128)}


def ready(text: str, folder: Path, *flags: str) -> CompiledTask:
    return prepared(compile_task(load_task(str(own_task(folder, text)), flags=flags), translator="python"))


def test_real_actions_are_learned_by_sac_with_its_defaults(tmp_path: Path) -> None:
    learner = ready(PUSHED, tmp_path).config.learner
    assert learner.algorithm == "sac"
    assert {key: getattr(learner, key) for key in SAC_DEFAULTS} == SAC_DEFAULTS


def test_what_the_task_file_gives_is_kept(tmp_path: Path) -> None:
    """Even where it gives just what PPO's default would be."""
    text = PUSHED + '\n[learner]\ngamma = 0.99\nshaping = "potential"\n'
    learner = ready(text, tmp_path, "learner.error_penalty=3").config.learner
    assert (learner.algorithm, learner.gamma, learner.shaping, learner.error_penalty) == ("sac", 0.99, "potential", 3)
    assert (learner.reward_scale, learner.hidden) == (0.1, (128, 128))


def test_settings_made_in_a_program_are_kept() -> None:
    made = TaskConfig("t", "F(a)", ("a",), EnvironmentConfig("x", 1), learner=LearnerConfig(gamma=0.5))
    chosen = with_algorithm(made, "sac").learner
    assert (chosen.gamma, chosen.shaping, chosen.algorithm) == (0.5, "subtask", "sac")


def test_choices_are_learned_by_ppo(tmp_path: Path) -> None:
    task = prepared(compile_task(load_task(str(ROOT / "examples" / "mountain_car.toml")), translator="python"))
    assert "algorithm" not in (ROOT / "examples" / "mountain_car.toml").read_text(encoding="utf-8")
    assert (task.config.learner.algorithm, task.config.learner.gamma) == ("ppo", 0.95)
    corridor = ready(PUSHED.replace("Pushed", "Corridor"), tmp_path).config.learner
    assert (corridor.algorithm, corridor.shaping) == ("ppo", "potential")


def test_a_chosen_algorithm_comes_back_from_a_runs_file(tmp_path: Path) -> None:
    config = ready(PUSHED, tmp_path, "learner.gamma=0.9").config
    assert task_config(config.to_dict()) == config


@pytest.mark.parametrize(("name", "algorithm"), [("Pushed", "ppo"), ("Corridor", "sac")])
def test_a_given_algorithm_that_does_not_fit_is_refused(name: str, algorithm: str, tmp_path: Path) -> None:
    with pytest.raises(EnvError, match=f"{algorithm.upper()} needs a "):
        ready(PUSHED.replace("Pushed", name), tmp_path, f"learner.algorithm={algorithm}")


def test_the_packages_own_tasks_name_theirs() -> None:
    algorithms = [load_task(name).learner.algorithm for name in task_names()]
    assert algorithms == ["sac"] * 6 + ["ppo"] * 2


def test_one_of_the_packages_own_tasks_can_be_left_to_its_action_space() -> None:
    task = prepared(compile_task(load_task("task5", flags=["learner.algorithm=auto"]), translator="python"))
    assert task.config.learner.algorithm == "sac"


def test_the_choice_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(own_task(tmp_path, PUSHED))
    assert check(path, steps=50, seed=0, flags=(), as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["algorithm"] == "sac"
    assert check(path, steps=50, seed=0, flags=(), as_json=False) == 0
    assert "sac, which these actions call for" in " ".join(capsys.readouterr().out.split())


def test_both_kinds_train_in_lock_step(tmp_path: Path) -> None:
    tiny = (*TINY, "sac.num_envs=2", "sac.batch=16", "sac.learning_starts=20", "sac.replay_rows=200")
    for name in ("Pushed", "Corridor"):
        run = SerialRun(ready(PUSHED.replace("Pushed", name), tmp_path, *tiny), RunSettings(0, 100_000), float)
        for _ in range(4):
            run.round()
        assert sum(session.learner.gradient_steps for session in run.sessions.values()) > 0


def train(*arguments: str) -> int:
    command = [sys.executable, "-m", "t4nmtd_dist.cli.main", "train", "--serial", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=90).returncode


@pytest.mark.slow
@pytest.mark.command
def test_a_run_writes_down_what_was_chosen_and_goes_on_with_it(tmp_path: Path) -> None:
    path, run = own_task(tmp_path, PUSHED), tmp_path / "run"
    flags = ("--set", "learner.hidden=[8]", "--max-interactions", "200")
    assert train("--task", str(path), "--run-dir", str(run), *flags) == 3
    written = tomllib.loads((run / "config.toml").read_text(encoding="utf-8"))["learner"]
    assert (written["algorithm"], written["gamma"], written["hidden"]) == ("sac", 0.98, [8])
    assert written["normalise_observations"] == "on"
    assert train("--resume", str(run), "--max-interactions", "400") == 3
    assert tomllib.loads((run / "config.toml").read_text(encoding="utf-8"))["learner"] == written
