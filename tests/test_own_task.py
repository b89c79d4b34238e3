"""A task of one's own, from the task file to the policy: the example of docs/own-task.md, and tasks that are wrong."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from processes import Processes
from small_tasks import TINY, own_task

from coordinator.run_settings import RunSettings
from t4nmtd_dist.core.config import EnvironmentConfig, task_config
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments import snapshot_choice
from t4nmtd_dist.environments.make_env import make_env
from t4nmtd_dist.environments.opening import import_module
from t4nmtd_dist.environments.preparation import prepared
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.rewards import SymbolReader
from t4nmtd_dist.tasks import is_bundled, load_task

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "examples" / "mountain_car.toml"
HERE = Path(__file__).parent
ONE = np.array([0])

BROKEN = f"""
name = "corridor"
formula = "F(left & X(F(right)))"
propositions = ["left", "right", "again"]
[environment]
id = "own_environments:Corridor"
labels = "own_environments:undeclared"
path = "{HERE}"
horizon = 30
"""


def example(*flags: str) -> CompiledTask:
    return compile_task(load_task(str(EXAMPLE), flags=flags), translator="python")


# The example


def test_modules_are_looked_for_beside_the_task_file(tmp_path: Path) -> None:
    assert example().config.environment.path == str(EXAMPLE.parent)
    text = BROKEN.replace(str(HERE), "code")
    assert load_task(str(own_task(tmp_path, text))).environment.folders == (str(tmp_path), str(tmp_path / "code"))
    assert load_task("task7").environment.path == ""


@pytest.mark.parametrize("path", ["", 'path = "more"', 'path = ["more", "../even_more"]'])
def test_further_folders_are_searched_after_the_task_files_own(path: str, tmp_path: Path) -> None:
    folders = {"task": tmp_path / "task", "more": tmp_path / "task" / "more", "even_more": tmp_path / "even_more"}
    for name, folder in folders.items():
        folder.mkdir(parents=True)
        for module in (f"only_in_{name}_{tmp_path.name}", f"everywhere_{tmp_path.name}"):
            where = f"WHERE = {name!r}\nfrom own_environments import Corridor as Place\n"
            (folder / f"{module}.py").write_text(where, encoding="utf-8")
    text = BROKEN.replace(f'path = "{HERE}"', path)
    config = task_config(json.loads(json.dumps(load_task(str(own_task(folders["task"], text))).to_dict()))).environment
    given = [name for name in folders if name == "task" or name in path]
    assert config.folders == tuple(str(folders[name]) for name in given)
    assert import_module(f"everywhere_{tmp_path.name}", config).WHERE == "task"
    for name in given:
        assert name == import_module(f"only_in_{name}_{tmp_path.name}", config).WHERE
    with pytest.raises(EnvError, match=r"no module 'no_such' in .*task.*nor among what is installed"):
        import_module("no_such", config)


@pytest.mark.slow
def test_random_actions_hardly_ever_succeed() -> None:
    task, count = example(), 100
    env = make_env(task.config.environment, count, task.config.propositions)
    reader, rng = SymbolReader(task.dfa, env.propositions), np.random.default_rng(0)
    accepted = []
    for episode in range(2):
        env.reset(np.arange(count), 1000 * episode)
        q, over = np.full(count, task.dfa.initial), np.zeros(count, np.bool_)
        for _ in range(task.config.environment.horizon):
            step = env.step(rng.integers(3, size=count))
            q = np.where(over, q, task.dfa.delta[q, reader.symbols(step.labels)])
            over |= step.terminated
        accepted.append(np.isin(q, list(task.dfa.accepting)).mean())
    assert np.mean(accepted) <= 0.05


@pytest.mark.command
def test_a_worker_elsewhere_goes_on_where_another_arrived(tmp_path: Path) -> None:
    """Another process, in another folder, that knows only what the coordinator sends it."""
    config = prepared(example()).config
    assert config.environment.snapshots == "attributes"
    env = make_env(config.environment, 1, config.propositions)
    env.reset(ONE, 3)
    for _ in range(4):
        env.step(np.array([0]))
    (state,) = env.snapshot(ONE)
    sent = json.dumps({"task": config.to_dict(), "state": state.tolist()})
    code = """
import json, sys
import numpy as np
from t4nmtd_dist.core.config import task_config
from t4nmtd_dist.environments.make_env import make_env
sent = json.load(sys.stdin)
config = task_config(sent["task"])
environment = make_env(config.environment, 1, config.propositions)
environment.restore(np.array([0]), [np.array(sent["state"], np.uint8)])
print(json.dumps([environment.step(np.array([2])).observations.tolist() for _ in range(5)]))
"""
    done = subprocess.run([sys.executable, "-c", code], input=sent, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [env.step(np.array([2])).observations.tolist() for _ in range(5)]


def test_all_roles_work_on_the_example_in_lock_step() -> None:
    task = prepared(example(*TINY, "learner.attempt_steps=5"))
    run = SerialRun(task, RunSettings(0, 100_000), float)
    for _ in range(12):
        run.round()
    assert run.coordinator.interactions >= 12 * 4 * 16
    assert task_config(run.coordinator.task.config.to_dict()) == task.config


def test_the_pages_code_is_the_examples() -> None:
    page = (ROOT / "docs" / "own-task.md").read_text(encoding="utf-8")
    toml = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert toml == [EXAMPLE.read_text(encoding="utf-8")]
    example_lines = {line.strip() for line in EXAMPLE.with_suffix(".py").read_text(encoding="utf-8").splitlines()}
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    code = [line.strip() for block in blocks for line in block.splitlines() if line.strip()]
    assert len(code) > 10
    assert [line for line in code if line not in example_lines] == []


@pytest.mark.training
@pytest.mark.timeout(280)
def test_the_example_is_trained_until_solved(commands: Processes) -> None:
    run = commands.folder / "run"
    arguments = ["--task", str(EXAMPLE), "--run-dir", str(run), "--no-dashboard", "--seed", "1"]
    training = commands.start("t4nmtd", "train", *arguments)
    assert training.wait(240) == 0, training.story()
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert (summary["solved"], summary["success_rate"]) == (True, 1.0)
    played = [module(EXAMPLE.with_suffix(".py")).play(str(run)) for _ in range(3)]
    assert sum(played) >= 2


def module(path: Path) -> ModuleType:
    specification = importlib.util.spec_from_file_location(path.stem, path)
    assert specification is not None
    assert specification.loader is not None
    found = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(found)
    return found


# A run never starts half-configured


@pytest.mark.parametrize("program", ["t4nmtd", "t4nmtd-coordinator"])
def test_a_labelling_function_that_is_wrong_stops_a_run_before_anything_is_written(
    program: str, commands: Processes
) -> None:
    run = commands.folder / "run"
    arguments = ["--task", str(own_task(commands.folder, BROKEN)), "--run-dir", str(run), "--no-dashboard"]
    started = commands.start(program, *(["train"] if program == "t4nmtd" else []), *arguments)
    assert started.wait(60) == 2
    (line,) = started.err.splitlines()
    assert line.startswith(f"{program}: own_environments:undeclared reported 'middle', which is not declared")
    assert not run.exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("own_environments:undeclared", "own_environments:raising", "raised KeyError: 'speed'"),
        ('labels = "own_environments:undeclared"', "", "environment 'own_environments:Broken' raised ZeroDivision"),
        ("own_environments:Corridor", "own_environments:NoSuch", "has no 'NoSuch'"),
        ("own_environments:Corridor", "own_environments:Erratic", "reported 'middle'"),
    ],
)
def test_what_is_wrong_is_found_before_a_run(
    old: str, new: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import own_environments

    class Broken(own_environments.Corridor):
        def reset(self, **_: Any) -> Any:
            return 1 / 0

    monkeypatch.setattr(own_environments, "Broken", Broken, raising=False)
    text = BROKEN.replace(old, new)
    text = text if new else text.replace("Corridor", "Broken")
    with pytest.raises(EnvError, match=message):
        prepared(compile_task(load_task(str(own_task(tmp_path, text))), translator="python"))


def test_formulas_must_keep_to_what_an_environment_says_that_it_reports(tmp_path: Path) -> None:
    text = """
name = "lake"
formula = "F(p1 & X(F(ship)))"
propositions = ["p1", "ship"]
[environment]
id = "envs:t4nmtd/FrozenLake-v0"
horizon = 100
"""
    with pytest.raises(EnvError, match="'ship', which the environment does not report; it reports p1, p2, p3, g"):
        prepared(compile_task(load_task(str(own_task(tmp_path, text))), translator="python"))


def test_the_packages_own_tasks_are_not_checked_at_every_start(monkeypatch: pytest.MonkeyPatch) -> None:
    def unwanted(*_: object, **__: object) -> None:
        raise AssertionError("checked")

    monkeypatch.setattr(snapshot_choice, "choose_snapshots", unwanted)
    task = compile_task(load_task("task7"), translator="python")
    assert prepared(task) is task
    changed = load_task("task7", flags=["environment.horizon=10"])
    assert not is_bundled(changed)
    with pytest.raises(EnvError, match="checked"):
        prepared(compile_task(changed, translator="python"))


@pytest.mark.parametrize(
    ("name", "flags", "message"),
    [
        ("task5", ["learner.algorithm=ppo"], "PPO needs a Discrete action space; envs:t4nmtd/Racecar"),
        ("task7", ["learner.algorithm=sac"], "SAC needs a Box action space; envs:t4nmtd/FrozenLake"),
        ("task7", ["formula=F(ship)", 'propositions=["ship"]'], "'ship', which the environment does not report"),
    ],
)
def test_the_packages_own_tasks_are_checked_if_changed_in_what_they_need(
    name: str, flags: list[str], message: str
) -> None:
    with pytest.raises(EnvError, match=message):
        prepared(compile_task(load_task(name, flags=flags), translator="python"))


@pytest.mark.command
def test_preparing_one_of_the_packages_own_tasks_imports_nothing_heavy() -> None:
    code = """
import sys
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.environments.preparation import prepared
from t4nmtd_dist.tasks import load_task
prepared(compile_task(load_task("task7"), translator="python"))
print([name for name in ("torch", "gymnasium") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_workers_get_the_choice_and_make_none_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    environment: EnvironmentConfig = prepared(example()).config.environment
    monkeypatch.setattr(snapshot_choice, "choose_snapshots", None)
    assert make_env(environment, 2, ("left", "flag", "wall")).count == 2
