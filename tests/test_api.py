"""The Python API: tasks as objects, training from a program, its result."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import psutil
import pytest
from numpy.typing import NDArray

from t4nmtd_dist import Task, TrainingResult, load, train
from t4nmtd_dist.core.errors import ConfigError, FormulaError, RunError
from t4nmtd_dist.tasks import load_task

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "examples" / "python_api.py"
FORMULA = "F(left & X(F(right)))"
SMALL = {
    "evaluation": {"every": 500, "episodes": 2},
    "learner": {"attempt_steps": 20, "hidden": [8]},
    "ppo": {"num_envs": 4, "rollout": 8, "epochs": 1},
}
FEW = 600  # interactions
DEADLINE_S = 60.0


class Corridor(gymnasium.Env[NDArray[np.float32], np.int64]):
    """Seven places in a row."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.place = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: np.int64) -> Any:
        self.place = int(np.clip(self.place + (1 if action else -1), -3, 3))
        return np.array([self.place / 3], np.float32), 0.0, False, False, {}


def labels(observation: NDArray[np.float32], info: dict[str, Any]) -> set[str]:
    return {name for name, end in (("left", -1), ("right", 1)) if observation[0] == end}


def local_task(formula: str = FORMULA) -> Task:
    """A task whose functions no other program can import."""

    def make() -> Corridor:
        return Corridor()

    def which(observation: NDArray[np.float32], info: dict[str, Any]) -> set[str]:
        return labels(observation, info)

    return Task(formula, make, labels=which, horizon=30, name="corridor", settings=SMALL)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


# Tasks


def test_a_task_and_a_task_file_are_the_same(tmp_path: Path) -> None:
    file = tmp_path / "corridor.toml"
    text = f"""
        name = "corridor"
        formula = "{FORMULA}"
        propositions = ["left", "right"]
        learner.gamma = 0.9
        evaluation.every = 700
        [environment]
        id = "test_api:Corridor"
        labels = "test_api:labels"
        horizon = 30
        path = "{Path(__file__).parent}"
    """
    file.write_text(text, encoding="utf-8")
    settings = {"learner.gamma": 0.9, "evaluation": {"every": 700}}
    task = Task(FORMULA, Corridor, labels=labels, horizon=30, name="corridor", settings=settings)
    read = Task.load(file, {"environment.path": str(Path(__file__).parent)})
    assert task.config.environment.folders == (str(Path(__file__).parent),)
    assert (task.config.formula, task.config.learner) == (read.config.formula, read.config.learner)
    assert task.config.evaluation == read.config.evaluation
    assert task.config.environment.id == read.config.environment.id
    assert Task.load("task7").config == load_task("task7")
    assert Task.load("task7") == Task.load("task7", {})
    assert Task.load("task7") != Task.load("task7", {"learner.gamma": 0.5})


def test_functions_that_can_be_imported_are_named_and_others_belong_to_this_process() -> None:
    named = Task(FORMULA, Corridor, labels=labels, horizon=30)
    assert (named.config.environment.id, named.config.environment.labels) == ("test_api:Corridor", "test_api:labels")
    assert not named.needs_this_process
    own = local_task()
    assert (own.config.environment.id, own.config.environment.labels) == ("python:make", "python:which")
    assert own.needs_this_process
    assert local_task().config.environment.id != own.config.environment.id, "another function of the same name"


def test_a_registered_id_brings_its_horizon() -> None:
    def falls(observation: Any, info: dict[str, Any]) -> set[str]:
        return set()

    assert Task("F(a)", "CartPole-v1", labels=falls).config.environment.horizon == 500
    assert Task("F(a)", "CartPole-v1", labels=falls, horizon=9).config.environment.horizon == 9


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"env": Corridor}, "horizon is missing"),
        ({"env": Corridor, "horizon": 0}, "horizon is missing"),
        ({"env": Corridor, "horizon": 9, "settings": {"learner.gama": 1}}, r"unknown key 'learner\.gama'.*gamma"),
        ({"env": Corridor, "horizon": 9, "settings": {"learner.gamma": 2}}, r"learner\.gamma"),
        ({"env": Corridor, "horizon": 9, "propositions": ["left", "right", "evaluator"]}, "evaluator"),
    ],
)
def test_wrong_arguments_are_refused_with_a_reason(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Task(FORMULA, **arguments)


def test_a_formula_that_cannot_be_parsed_is_refused() -> None:
    with pytest.raises(FormulaError):
        Task("F(left &", Corridor, horizon=9)


# Training


def test_a_serial_training_returns_policy_curves_and_directory(tmp_path: Path) -> None:
    result = train(local_task(), serial=True, max_interactions=FEW, run_dir=tmp_path / "run", progress=False)
    assert result.outcome in ("budget spent", "solved")
    assert result.run_dir == tmp_path / "run"
    assert result.summary["interactions_total"] >= FEW or result.solved
    assert {"interactions", "success", "length", "time", "return"} <= result.curves.keys()
    assert len(result.curves["success"]) == result.summary["evaluations"] >= 1
    assert result.policy.act(np.zeros(1, np.float32), set()) in (0, 1)
    assert "corridor" not in str(result)
    assert str(tmp_path / "run") in str(result)


def test_two_serial_trainings_of_one_seed_are_equal(tmp_path: Path) -> None:
    runs = [
        train(local_task(), serial=True, seed=3, max_interactions=FEW, run_dir=tmp_path / name, progress=False)
        for name in "ab"
    ]
    one, other = (load(run.run_dir) for run in runs)
    assert one.q_table == other.q_table
    assert np.array_equal(runs[0].curves["return"], runs[1].curves["return"])


def test_a_stopped_training_is_resumed_with_a_larger_budget(tmp_path: Path) -> None:
    task, folder = local_task(), tmp_path / "run"
    first = train(task, serial=True, max_interactions=FEW, run_dir=folder, progress=False)
    task = local_task()  # as if its cell had been run again
    second = train(task, serial=True, max_interactions=3 * FEW, run_dir=folder, resume=True, progress=False)
    assert second.summary["interactions_total"] > first.summary["interactions_total"] >= FEW
    with pytest.raises(ConfigError, match="another task"):
        train(
            local_task("F(right)"), serial=True, max_interactions=9 * FEW, run_dir=folder, resume=True, progress=False
        )
    with pytest.raises(ConfigError, match="pass run_dir"):
        train(task, resume=True, progress=False)


def test_a_run_is_not_overwritten(tmp_path: Path) -> None:
    train(local_task(), serial=True, max_interactions=FEW, run_dir=tmp_path / "run", progress=False)
    with pytest.raises(RunError, match="already"):
        train(local_task(), serial=True, run_dir=tmp_path / "run", progress=False)


def test_launchers_of_other_programs_refuse_functions_of_this_process() -> None:
    with pytest.raises(ConfigError, match="put them into a module"):
        train(local_task(), launcher="local", progress=False)
    with pytest.raises(ConfigError, match=r"unknown launcher 'locl'; did you mean 'local'\?"):
        train(local_task(), launcher="locl")
    with pytest.raises(ConfigError, match="contradict"):
        train(local_task(), launcher="local", serial=True)


@pytest.mark.process
@pytest.mark.parametrize("launcher", ["forked", "local"])
def test_processes_train_a_task_of_this_program(launcher: str, tmp_path: Path) -> None:
    named = Task(FORMULA, Corridor, labels=labels, horizon=30, settings=SMALL)
    task = local_task() if launcher == "forked" else named
    before = signal.getsignal(signal.SIGINT)
    result = train(task, max_interactions=FEW, run_dir=tmp_path / "run", launcher=launcher, progress=False)
    assert result.outcome in ("budget spent", "solved")
    assert {log.name for log in (tmp_path / "run" / "logs").iterdir()} >= {"coordinator.log", "left.log", "right.log"}
    assert signal.getsignal(signal.SIGINT) is before
    assert not psutil.Process().children(recursive=True)


@pytest.fixture
def event_loop_with_threads() -> Iterator[asyncio.AbstractEventLoop]:
    """What a notebook's kernel has: an event loop that signals wake up, and threads."""
    loop, over = asyncio.new_event_loop(), threading.Event()
    mine, theirs = os.pipe()
    os.set_blocking(theirs, False)
    before = signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
    threads = [threading.Thread(target=over.wait, daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    yield loop
    over.set()
    signal.set_wakeup_fd(before)
    loop.close()
    os.close(mine)
    os.close(theirs)


@pytest.mark.process
def test_forks_train_beside_an_event_loop_and_threads(
    event_loop_with_threads: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    async def cell() -> TrainingResult:
        return train(local_task(), max_interactions=FEW, run_dir=tmp_path / "run")

    result = event_loop_with_threads.run_until_complete(cell())
    assert result.outcome in ("budget spent", "solved")


@pytest.mark.process
def test_a_killed_fork_is_started_again(tmp_path: Path) -> None:
    task, folder, killed = local_task(), tmp_path / "run", threading.Event()

    def kill_a_learner() -> None:
        events, deadline = folder / "events.jsonl", time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline:
            if events.exists() and "left takes left" in events.read_text(encoding="utf-8"):
                learners = [child for child in psutil.Process().children() if child.name()]
                # the coordinator was started first, then the learners in the order of the sub-tasks
                sorted(learners, key=lambda child: (child.create_time(), child.pid))[1].kill()
                killed.set()
                return
            time.sleep(0.05)

    thread = threading.Thread(target=kill_a_learner)
    thread.start()
    evaluation = dataclasses.replace(task.config.evaluation, in_a_row=1000)
    task = Task.of(dataclasses.replace(task.config, evaluation=evaluation))
    result = train(task, max_interactions=12_000, run_dir=folder, progress=False)
    thread.join(DEADLINE_S)
    assert killed.is_set()
    told = (folder / "events.jsonl").read_text(encoding="utf-8")
    assert re.search(r"left takes left \(epoch 2\)", told)
    assert result.outcome == "budget spent"


@pytest.mark.command
def test_other_programs_say_that_they_lack_the_function(tmp_path: Path) -> None:
    train(local_task(), serial=True, max_interactions=FEW, run_dir=tmp_path / "run", progress=False)
    command = [sys.executable, "-m", "t4nmtd_dist.cli.main", "evaluate", str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S)
    assert done.returncode == 2
    assert "'python:make" in done.stderr
    assert "Put it into a module" in done.stderr


@pytest.mark.command
@pytest.mark.training
@pytest.mark.timeout(300)
def test_the_example_trains_from_a_script(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLE), str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    assert "solved after" in done.stdout
    places = [int(place) for place in done.stdout.split("places:")[1].split()]
    assert places[:7] == [0, -1, -2, -3, -4, -5, -6]
    assert places[-1] == 6
