"""Code of a user's own that raises: the message has the file, the line and the function, wherever it was called."""

from __future__ import annotations

import dataclasses
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from processes import Processes
from small_tasks import own_task

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.make_env import make_env
from t4nmtd_dist.environments.opening import import_module
from t4nmtd_dist.environments.single_env import SingleEnv
from t4nmtd_dist.environments.snapshot_choice import choose_snapshots

NAMES = ("left", "right", "again")
END_S = 100.0

BROKEN = '''
"""Fails where it is told to, and after as many steps as it is told, counted over all copies of the process."""

import numpy as np
from own_environments import Named

WHERE, AFTER = "", 0
taken = 0


def fail(where):
    if where == WHERE and taken >= AFTER:
        return np.zeros(3)[7]  # this line is the one
    return None


class Broken(Named):
    def __init__(self, where="", after=0, render_mode=None):
        global WHERE, AFTER
        WHERE, AFTER = where or WHERE, after or AFTER
        super().__init__(render_mode=render_mode)
        fail("constructor")

    def reset(self, *, seed=None, options=None):
        fail("reset")
        return super().reset(seed=seed)

    def step(self, action):
        global taken
        taken += 1
        fail("step")
        return super().step(action)

    def render(self):
        fail("render")
        return super().render()

    def get_state(self):
        fail("get_state")
        return super().get_state()

    def set_state(self, state):
        fail("set_state")
        super().set_state(state)


def labels(observation, info):
    fail("labels")
    return info["labels"]
'''
LINE = next(i for i, line in enumerate(BROKEN.splitlines(), start=1) if "this line" in line)
CALLERS = {"constructor": "__init__"}
PLACES = ("constructor", "reset", "step", "labels", "get_state", "set_state", "render")


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    (tmp_path / "broken.py").write_text(BROKEN, encoding="utf-8")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "broken", raising=False)
    yield import_module("broken", config(tmp_path))
    sys.modules.pop("broken", None)


def config(folder: Path, **settings: Any) -> EnvironmentConfig:
    chosen = {"snapshots": "own", "snapshot_bytes": 512, "labels": "broken:labels", **settings}
    return EnvironmentConfig("broken:Broken", 30, path=str(folder), **chosen)


def assert_told(text: str, place: str, folder: Path) -> None:
    """The exception, the line that raised it with its source, and how it was reached: of the user's own code only."""
    assert re.search(r"IndexError( in [\w() ]+)?: index 7 is out of bounds for axis 0 with size 3\n", text)
    assert f'File "{folder / "broken.py"}", line {LINE}, in fail' in text
    assert "return np.zeros(3)[7]" in text
    assert f"in {CALLERS.get(place, place)}\n" in text
    files = re.findall(r'File "([^"]+)"', text)
    assert set(files) == {str(folder / "broken.py")}
    assert len(text.splitlines()) <= 12


def everything(environment: EnvironmentConfig) -> None:
    """All that training and recording ask of a copy."""
    copy = SingleEnv(environment, NAMES, render_mode="rgb_array")
    copy.reset(0)
    copy.step(0)
    copy.set_state(copy.get_state())
    copy.render()


@pytest.mark.parametrize("place", PLACES)
def test_an_error_in_a_users_code_is_told_with_file_and_line(place: str, broken: ModuleType, tmp_path: Path) -> None:
    broken.WHERE = place
    with pytest.raises(EnvError) as raised:
        everything(config(tmp_path))
    assert_told(str(raised.value), place, tmp_path)
    assert place == "constructor" or place in str(raised.value).splitlines()[0]


@pytest.mark.parametrize("place", ["constructor", "reset", "step", "get_state", "set_state"])
def test_an_error_while_snapshots_are_checked_is_told_so_too(place: str, broken: ModuleType, tmp_path: Path) -> None:
    broken.WHERE = place
    with pytest.raises(EnvError) as raised:
        choose_snapshots(config(tmp_path, snapshot_bytes=0), NAMES)
    assert f'File "{tmp_path / "broken.py"}", line {LINE}, in fail' in str(raised.value)
    assert "cause" not in str(raised.value)


def test_a_step_of_a_batch_is_told_likewise(broken: ModuleType, tmp_path: Path) -> None:
    env = make_env(config(tmp_path), 3, NAMES)
    env.reset(np.arange(3), 0)
    broken.WHERE, broken.AFTER = "step", 5
    env.step(np.zeros(3, np.int64))
    with pytest.raises(EnvError) as raised:
        env.step(np.zeros(3, np.int64))
    assert_told(str(raised.value), "step", tmp_path)


BATCHED = """
import gymnasium
from gymnasium import spaces


class Batch(gymnasium.vector.VectorEnv):
    propositions, metadata = ("left",), {"autoreset_mode": gymnasium.vector.AutoresetMode.DISABLED}
    single_observation_space, single_action_space = spaces.Box(-1, 1, (2,)), spaces.Discrete(2)

    def __init__(self, num_envs, broken=False):
        self.num_envs = num_envs
        if broken:
            raise RuntimeError("no licence")

    def get_states(self, rows):
        raise RuntimeError("no states")

    def set_states(self, rows, states):
        raise RuntimeError("no states")

    def step(self, actions):
        raise RuntimeError("no steps")


gymnasium.register(ID, entry_point=Batch, vector_entry_point=Batch)
"""


def test_environments_that_step_their_own_batch_are_told_likewise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"batch_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(BATCHED.replace("ID", repr(f"{name}-v0")), encoding="utf-8")
    monkeypatch.setattr(sys, "path", list(sys.path))
    environment = EnvironmentConfig(f"{name}:{name}-v0", 10, path=str(tmp_path))
    with pytest.raises(EnvError, match=r"RuntimeError: no licence\n  File .*, line 13, in __init__"):
        make_env(dataclasses.replace(environment, options={"broken": True}), 2)
    env = make_env(environment, 2)
    for call in (
        lambda: env.snapshot(np.arange(2)),
        lambda: env.restore(np.arange(1), [np.zeros(1)]),
        lambda: env.step(np.zeros(2, np.int64)),
    ):
        with pytest.raises(EnvError, match=r"raised RuntimeError in \w+\(\): no st\w+\n  File .*, line \d+, in"):
            call()


MODULES = {
    "an error": ("x = {}['speed']\n", "KeyError: 'speed'", "line 1, in <module>"),
    "bad syntax": ("\ndef make(:\n", "SyntaxError: ", "line 2"),
    "a missing package": ("\nimport no_such_package\n", "No module named 'no_such_package'", "line 2, in <module>"),
}


@pytest.mark.parametrize("kind", MODULES)
def test_a_module_that_cannot_be_imported_is_told_with_file_and_line(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, *told = MODULES[kind]
    name = f"module_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(EnvError) as raised:
        import_module(name, EnvironmentConfig(f"{name}:make", 1, path=str(tmp_path)))
    for piece in (*told, str(tmp_path / f"{name}.py")):
        assert piece in str(raised.value)
    assert "importlib" not in str(raised.value)


@pytest.mark.parametrize("place", ["step", "labels", "get_state"])
def test_an_error_in_mid_training_ends_the_run_and_is_shown(place: str, commands: Processes) -> None:
    (commands.folder / "broken.py").write_text(BROKEN, encoding="utf-8")
    text = f"""
name = "corridor"
formula = "F(left & X(F(right)))"
propositions = ["left", "right", "again"]
[environment]
id = "broken:Broken"
labels = "broken:labels"
options = {{ where = "{place}", after = 1500 }}
horizon = 30
[learner]
hidden = [8]
[ppo]
num_envs = 4
rollout = 16
[evaluation]
every = 1000000
"""
    run = commands.folder / "run"
    command = ["--task", str(own_task(commands.folder, text)), "--run-dir", str(run), "--no-dashboard"]
    started = commands.start("t4nmtd", "train", *command, env={"PYTHONPATH": str(Path(__file__).parent)})
    assert started.wait(END_S) == 2, started.story()
    _, _, told = started.err.partition(
        "t4nmtd-worker: labelling" if place == "labels" else "t4nmtd-worker: environment"
    )
    assert "Traceback" not in started.err, started.story()
    assert f'File "{commands.folder / "broken.py"}", line {LINE}, in fail' in told, started.story()
