"""Code named by a stranger's policy, run or coordinator runs only with --trust, or after a yes on a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Processes, Started, endpoints, events
from strangers import Stranger

from t4nmtd_dist.wire.key_folders import make_coordinator_folder

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


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    started = Processes(tmp_path)
    yield started
    started.end()


@pytest.fixture
def stranger(tmp_path: Path) -> Stranger:
    return Stranger(tmp_path)


def start(processes: Processes, program: str, *arguments: str, user: str = "me") -> Started:
    """A command of a user whose trusted code is remembered in a folder of the test's own."""
    env = {"XDG_STATE_HOME": str(processes.folder / user), "PYTHONPATH": TESTS}
    return processes.start(program, *arguments, env=env)


def refused(processes: Processes, started: Started, stranger: Stranger, *texts: str) -> None:
    processes.until(lambda: stranger.mark.exists() or started.process.poll() is not None, "it refuses", END_S)
    assert not stranger.mark.exists(), f"the stranger's code was run\n{started.story()}"
    assert started.wait(END_S) == 2, started.story()
    assert "Traceback" not in started.err, started.story()
    for text in (*texts, "--trust"):
        assert text in started.err, started.story()


# Policies and runs


@pytest.mark.parametrize("attack", ATTACKS)
def test_evaluating_a_strangers_policy_runs_nothing_that_it_names(
    attack: str, processes: Processes, stranger: Stranger
) -> None:
    environment = stranger.attacks()[attack]
    policy = stranger.policy(environment)
    refused(
        processes, start(processes, "t4nmtd", "evaluate", str(policy), "--episodes", "1"), stranger, environment["id"]
    )


@pytest.mark.parametrize("attack", ["a function of Python's", "a labelling function"])
def test_recording_a_strangers_policy_runs_nothing_that_it_names(
    attack: str, processes: Processes, stranger: Stranger
) -> None:
    policy, film = stranger.policy(stranger.attacks()[attack]), processes.folder / "film.gif"
    refused(processes, start(processes, "t4nmtd", "record", str(policy), "--out", str(film)), stranger)
    assert not film.exists()


@pytest.mark.parametrize(
    "program", [("t4nmtd", "train"), ("t4nmtd", "train", "--serial"), ("t4nmtd-coordinator",)], ids=" ".join
)
def test_resuming_a_strangers_run_runs_nothing_that_it_names(
    program: tuple[str, ...], processes: Processes, stranger: Stranger
) -> None:
    run = stranger.run(stranger.attacks()["a function of Python's"], serial="--serial" in program)
    before = sorted(run.rglob("*"))
    refused(
        processes, start(processes, *program, "--no-dashboard", "--resume", str(run)), stranger, "'os:system'", str(run)
    )
    assert sorted(run.rglob("*")) == before


def test_trust_lets_it_run(processes: Processes, stranger: Stranger) -> None:
    policy = stranger.policy(stranger.attacks()["a module of their own"])
    evaluated = start(processes, "t4nmtd", "evaluate", str(policy), "--episodes", "1", "--trust")
    assert evaluated.wait(END_S) in (0, 2)  # the environment reports other propositions than task 7's
    assert stranger.mark.exists(), evaluated.story()


def test_modules_in_a_strangers_folder_shadow_nothing(processes: Processes, stranger: Stranger) -> None:
    """A bundled environment opens without trust, and the folder that comes with it is not searched."""
    stranger.plant("envs/__init__", "envs/frozenlake", "envs/frozenlake_batch", "pygame", "pymunk", "mujoco", "torch")
    for name in ("t4nmtd/FrozenLake-v0", "t4nmtd/Waterworld-v0"):
        policy = stranger.policy({"id": f"envs:{name}", "path": str(stranger.code)})
        evaluated = start(processes, "t4nmtd", "evaluate", str(policy), "--episodes", "1")
        evaluated.wait(END_S)
        assert not stranger.mark.exists(), evaluated.story()
        assert "--trust" not in evaluated.err, evaluated.story()


# Workers


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
worlds = 4
rollout = 16
"""


def coordinator_of_a_stranger(processes: Processes, stranger: Stranger, *arguments: str) -> Path:
    stranger.plant("planted")
    task, run = stranger.folder / "own.toml", stranger.folder / "run"
    task.write_text(OWN, encoding="utf-8")
    where = ["--bind", "tcp://127.0.0.1:*", "--publish", "tcp://127.0.0.1:*", "--no-dashboard"]
    command = ["--task", str(task), "--run-dir", str(run), *where, *arguments]
    start(processes, "t4nmtd-coordinator", *command, user="stranger")
    processes.until(lambda: (run / "endpoints.json").exists(), "the coordinator listens")
    assert stranger.mark.exists()
    stranger.mark.unlink()
    return run


def worker(processes: Processes, run: Path, *arguments: str, user: str = "me") -> Started:
    return start(processes, "t4nmtd-worker", "--connect", endpoints(run)[0], *arguments, user=user)


def test_a_worker_runs_no_code_for_a_coordinator_that_it_does_not_know(
    processes: Processes, stranger: Stranger
) -> None:
    run = coordinator_of_a_stranger(processes, stranger)
    refused(
        processes, worker(processes, run, "--pid", "left", "--instance", "a"), stranger, "'planted:Corridor'", "--keys"
    )
    refused(processes, worker(processes, run, "--evaluate"), stranger, "'planted:Corridor'", "--keys")
    processes.until(lambda: any("left given back" in text for text in events(run)), "its lease is free again")
    worker(processes, run, "--pid", "left", "--trust")
    processes.until(stranger.mark.exists, "with --trust it works")


def test_a_worker_that_is_started_where_the_task_was_needs_no_trust(processes: Processes, stranger: Stranger) -> None:
    run = coordinator_of_a_stranger(processes, stranger)
    worker(processes, run, "--pid", "left", user="stranger")
    processes.until(stranger.mark.exists, "a worker of the user who named the task file works")


def test_a_worker_takes_code_from_a_coordinator_with_keys(processes: Processes, stranger: Stranger) -> None:
    keys = processes.folder / "keys"
    make_coordinator_folder(keys, clients=1)
    run = coordinator_of_a_stranger(processes, stranger, "--keys", str(keys))
    worker(processes, run, "--pid", "left", "--keys", str(keys / "clients" / "client1"))
    processes.until(stranger.mark.exists, "the worker works")
