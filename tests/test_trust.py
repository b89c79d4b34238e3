"""Code named by a stranger's policy, run or coordinator runs only with --trust, or after a yes on a terminal."""

from __future__ import annotations

import dataclasses
import os
import pty
import select
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from processes import Processes, Started, endpoints, events
from strangers import Stranger

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import TrustError
from t4nmtd_dist.environments import trusted_code
from t4nmtd_dist.environments.named_code import code_named
from t4nmtd_dist.environments.trust import require_trust
from t4nmtd_dist.environments.trusted_code import is_remembered, remember
from t4nmtd_dist.tasks import load_task, task_names
from t4nmtd_dist.wire.auth.key_folders import make_coordinator_folder

TESTS = str(Path(__file__).parent)
END_S = 60.0
ATTACKS = (
    "a function of Python's",
    "a module of their own",
    "several folders",
    "a labelling function",
    "a labelling function for a bundled environment",
    "an id that a module registers",
)

OWN = """
name = "corridor"
formula = "F(left & X(F(right)))"
propositions = ["left", "right", "again"]
[environment]
id = "planted:Corridor"
path = "code"
horizon = 30
[learner]
hidden = [8]
[ppo]
num_envs = 4
rollout = 16
[evaluation]
every = 50
episodes = 2
"""


@pytest.fixture
def stranger(tmp_path: Path) -> Stranger:
    return Stranger(tmp_path)


def start(commands: Processes, program: str, *arguments: str, user: str = "me") -> Started:
    """A command of a user whose trusted code is remembered in a folder of the test's own."""
    env = {"XDG_STATE_HOME": str(commands.folder / user), "PYTHONPATH": TESTS}
    return commands.start(program, *arguments, env=env)


def refused(commands: Processes, started: Started, stranger: Stranger, *texts: str) -> None:
    commands.until(lambda: stranger.mark.exists() or started.process.poll() is not None, "it refuses", END_S)
    assert not stranger.mark.exists(), f"the stranger's code was run\n{started.story()}"
    assert started.wait(END_S) == 2, started.story()
    assert "Traceback" not in started.err, started.story()
    for text in (*texts, "--trust"):
        assert text in started.err, started.story()


# Policies and runs


@pytest.mark.parametrize("attack", ATTACKS)
def test_evaluating_a_strangers_policy_runs_nothing_that_it_names(
    attack: str, commands: Processes, stranger: Stranger
) -> None:
    environment = stranger.attacks()[attack]
    policy = stranger.policy(environment)
    refused(
        commands, start(commands, "t4nmtd", "evaluate", str(policy), "--episodes", "1"), stranger, environment["id"]
    )


@pytest.mark.parametrize("attack", ["a function of Python's", "a labelling function"])
def test_recording_a_strangers_policy_runs_nothing_that_it_names(
    attack: str, commands: Processes, stranger: Stranger
) -> None:
    policy, film = stranger.policy(stranger.attacks()[attack]), commands.folder / "film.gif"
    refused(commands, start(commands, "t4nmtd", "record", str(policy), "--out", str(film)), stranger)
    assert not film.exists()


@pytest.mark.parametrize(
    "program", [("t4nmtd", "train"), ("t4nmtd", "train", "--serial"), ("t4nmtd-coordinator",)], ids=" ".join
)
def test_resuming_a_strangers_run_runs_nothing_that_it_names(
    program: tuple[str, ...], commands: Processes, stranger: Stranger
) -> None:
    run = stranger.run(stranger.attacks()["a function of Python's"], serial="--serial" in program)
    before = sorted(run.rglob("*"))
    refused(
        commands, start(commands, *program, "--no-dashboard", "--resume", str(run)), stranger, "'os:system'", str(run)
    )
    assert sorted(run.rglob("*")) == before


def test_trust_lets_it_run(commands: Processes, stranger: Stranger) -> None:
    policy = stranger.policy(stranger.attacks()["a module of their own"])
    evaluated = start(commands, "t4nmtd", "evaluate", str(policy), "--episodes", "1", "--trust")
    assert evaluated.wait(END_S) in (0, 2)  # the environment reports other propositions than task 7's
    assert stranger.mark.exists(), evaluated.story()


def test_modules_in_a_strangers_folder_shadow_nothing(commands: Processes, stranger: Stranger) -> None:
    """A bundled environment opens without trust, and the folder that comes with it is not searched."""
    stranger.plant("envs/__init__", "envs/frozenlake", "envs.frozenlake", "pygame", "pymunk", "mujoco", "torch")
    for name in ("t4nmtd/FrozenLake-v0", "t4nmtd/Waterworld-v0"):
        policy = stranger.policy({"id": f"envs:{name}", "path": str(stranger.code)})
        evaluated = start(commands, "t4nmtd", "evaluate", str(policy), "--episodes", "1")
        evaluated.wait(END_S)
        assert not stranger.mark.exists(), evaluated.story()
        assert "--trust" not in evaluated.err, evaluated.story()


# What is the user's own


def test_what_the_user_trained_here_is_his_own(commands: Processes, stranger: Stranger) -> None:
    """Nobody is asked about his own run, policy or module, changed or not; somebody else is."""
    stranger.plant("planted")
    task, run = commands.folder / "own.toml", commands.folder / "run"
    task.write_text(OWN, encoding="utf-8")
    command = ["--serial", "--no-dashboard", "--run-dir", str(run)]
    trained = start(commands, "t4nmtd", "train", *command, "--task", str(task), "--max-interactions", "300")
    assert trained.wait(END_S) == 3, trained.story()
    policy = ("t4nmtd", "evaluate", str(run), "--episodes", "1")
    resumed = ("t4nmtd", "train", *command, "--resume", str(run), "--max-interactions", "400")
    stranger.mark.unlink()
    for other in (policy, resumed):
        refused(commands, start(commands, *other, user="other"), stranger, "'planted:Corridor'")
    with (stranger.code / "planted.py").open("a", encoding="utf-8") as module:
        module.write("\n# changed\n")
    evaluated = start(commands, *policy)
    assert evaluated.wait(END_S) == 0, evaluated.story()
    trained = start(commands, *resumed)
    assert trained.wait(END_S) == 3, trained.story()


def at_a_terminal(commands: Processes, policy: Path, answer: str) -> tuple[int, str]:
    """The exit code of an evaluation, and what it showed, when a user types an answer to its question."""
    ours, theirs = pty.openpty()
    env = {"XDG_STATE_HOME": str(commands.folder / "me"), "PYTHONPATH": TESTS}
    started = commands.start("t4nmtd", "evaluate", str(policy), "--episodes", "1", env=env, terminal=theirs)
    os.close(theirs)
    shown = b""

    def until(text: bytes) -> None:
        nonlocal shown
        deadline = time.monotonic() + END_S
        while text not in shown and time.monotonic() < deadline:
            if not select.select([ours], [], [], 0.1)[0]:
                continue
            try:
                shown += os.read(ours, 1000)
            except OSError:  # the other end is closed
                return

    until(b"[y/N]")
    os.write(ours, answer.encode() + b"\n")
    until(b"there is no such text")
    os.close(ours)
    return started.wait(END_S), shown.decode()


@pytest.mark.parametrize(("answer", "runs"), [("", False), ("no", False), ("y", True), ("Yes", True)])
def test_a_user_at_a_terminal_is_asked_and_remembered(
    answer: str, runs: bool, commands: Processes, stranger: Stranger
) -> None:
    policy = stranger.policy(stranger.attacks()["a labelling function"])
    code, shown = at_a_terminal(commands, policy, answer)
    assert "environment.labels = 'planted:ends'" in shown
    assert stranger.mark.exists() == runs, shown
    assert code == 2  # its labels raise, if they are read
    stranger.mark.unlink(missing_ok=True)
    again = start(commands, "t4nmtd", "evaluate", str(policy), "--episodes", "1")
    assert again.wait(END_S) == 2
    assert stranger.mark.exists() == runs, again.story()
    assert ("--trust" in again.err) != runs


def test_what_is_shown_cannot_be_made_to_look_like_something_else() -> None:
    named = code_named(EnvironmentConfig("os:system\x1b[2K\r\n", 1, path="/x\u202e"))
    assert all(text.isprintable() for text in named)


# Which sections name code

TEXTS = st.text(st.characters(codec="utf-8"), max_size=12)


@given(id=TEXTS, labels=TEXTS, path=TEXTS)
def test_only_bundled_and_plain_ids_name_no_code(id: str, labels: str, path: str) -> None:
    named = code_named(EnvironmentConfig(id, 1, labels=labels, path=path))
    assert bool(named) == (":" in id or labels != "")


@pytest.mark.parametrize("task", task_names())
def test_no_bundled_task_names_code(task: str) -> None:
    environment = load_task(task).environment
    assert code_named(environment) == []
    assert code_named(dataclasses.replace(environment, path="/x")) == []
    assert code_named(dataclasses.replace(environment, id=f"{environment.id} ")) != []


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"size": 5, "slippery": True, "sizes": [1, 2.5], "more": {"x": 1}}, False),
        ({"env_id": "os:x"}, True),
        ({"more": [{"xml_file": "/x"}]}, True),
    ],
)
def test_text_among_the_options_of_a_registered_id_counts_as_code(options: dict[str, Any], names: bool) -> None:
    assert bool(code_named(EnvironmentConfig("CartPole-v1", 1, options=options))) == names


@pytest.mark.parametrize("path", ["code", "", ("/x", "../code")])
def test_relative_folders_are_refused_whatever_the_user_says(path: Any) -> None:
    config = EnvironmentConfig("module:make", 1, path=path)
    if not path:
        require_trust(config, "the policy in X", given=True)
        return
    with pytest.raises(TrustError, match=r"the policy in X names the relative folder .*expected an absolute folder"):
        require_trust(config, "the policy in X", given=True)


# What is remembered


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "t4nmtd" / "trusted"


ONE = EnvironmentConfig("module:make", 10, {"size": 5}, "module:labels", "/x")


def test_trust_holds_for_everything_that_names_code_and_for_nothing_else(state: Path) -> None:
    assert not is_remembered(ONE)
    remember(ONE)
    remember(ONE)
    assert is_remembered(dataclasses.replace(ONE, horizon=5, snapshots="replay", snapshot_bytes=64))
    for change in ({"id": "m:f"}, {"labels": ""}, {"path": ("/x", "/y")}, {"options": {"size": 6}}, {"options": {}}):
        assert not is_remembered(dataclasses.replace(ONE, **change))


def test_trust_ends_when_a_folder_belongs_to_somebody_else(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = dataclasses.replace(ONE, path=str(tmp_path))
    remember(config)
    assert is_remembered(config)
    monkeypatch.setattr(trusted_code, "_owner", lambda folder: 12345)
    assert not is_remembered(config)


def test_only_the_user_can_read_or_write_what_is_remembered(state: Path) -> None:
    remember(ONE)
    (note,) = state.iterdir()
    assert (state.stat().st_mode & 0o777, note.stat().st_mode & 0o777) == (0o700, 0o600)
    state.chmod(0o777)
    assert not is_remembered(ONE)


def test_what_cannot_be_remembered_is_a_warning(state: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state.parent.mkdir(parents=True)
    state.touch()
    require_trust(ONE, "the policy in X", given=True)
    assert "warning: cannot remember" in capsys.readouterr().err
    with pytest.raises(TrustError):
        require_trust(ONE, "the policy in X", given=False)


def test_the_oldest_notes_are_forgotten(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trusted_code, "MOST_ENTRIES", 3)
    configs = [dataclasses.replace(ONE, id=f"module:make{i}") for i in range(5)]
    for age, config in enumerate(configs):
        remember(config)
        os.utime(next(path for path in state.iterdir() if config.id in path.read_text()), (age, age))
    assert is_remembered(configs[2]), "and with that it is the newest"
    remember(configs[0])
    assert [is_remembered(config) for config in configs] == [True, False, True, False, True]


def test_processes_remember_at_the_same_time(state: Path) -> None:
    configs = [dataclasses.replace(ONE, id=f"module:make{i % 5}") for i in range(60)]
    with ProcessPoolExecutor(4) as pool:
        list(pool.map(remember, configs))
    assert len(list(state.iterdir())) == 5
    assert all(is_remembered(config) for config in configs)


# Workers


def coordinator_of_a_stranger(commands: Processes, stranger: Stranger, *arguments: str) -> Path:
    stranger.plant("planted")
    task, run = stranger.folder / "own.toml", stranger.folder / "run"
    task.write_text(OWN, encoding="utf-8")
    where = ["--bind", "tcp://127.0.0.1:*", "--publish", "tcp://127.0.0.1:*", "--no-dashboard"]
    command = ["--task", str(task), "--run-dir", str(run), *where, *arguments]
    start(commands, "t4nmtd-coordinator", *command, user="stranger")
    commands.until(lambda: (run / "endpoints.json").exists(), "the coordinator listens")
    assert stranger.mark.exists()
    stranger.mark.unlink()
    return run


def worker(commands: Processes, run: Path, *arguments: str, user: str = "me") -> Started:
    return start(commands, "t4nmtd-worker", "--connect", endpoints(run)[0], *arguments, user=user)


def test_a_worker_runs_no_code_for_a_coordinator_that_it_does_not_know(commands: Processes, stranger: Stranger) -> None:
    run = coordinator_of_a_stranger(commands, stranger)
    refused(
        commands, worker(commands, run, "--pid", "left", "--instance", "a"), stranger, "'planted:Corridor'", "--keys"
    )
    refused(commands, worker(commands, run, "--evaluate"), stranger, "'planted:Corridor'", "--keys")
    commands.until(lambda: any("left given back" in text for text in events(run)), "its lease is free again")
    worker(commands, run, "--pid", "left", "--trust")
    commands.until(stranger.mark.exists, "with --trust it works")


def test_a_worker_that_is_started_where_the_task_was_needs_no_trust(commands: Processes, stranger: Stranger) -> None:
    run = coordinator_of_a_stranger(commands, stranger)
    worker(commands, run, "--pid", "left", user="stranger")
    commands.until(stranger.mark.exists, "a worker of the user who named the task file works")


def test_a_worker_takes_code_from_a_coordinator_with_keys(commands: Processes, stranger: Stranger) -> None:
    keys = commands.folder / "keys"
    make_coordinator_folder(keys, clients=1)
    run = coordinator_of_a_stranger(commands, stranger, "--keys", str(keys))
    worker(commands, run, "--pid", "left", "--keys", str(keys / "clients" / "client1"))
    commands.until(stranger.mark.exists, "the worker works")
