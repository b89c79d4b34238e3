"""The exported policy of a run: there from the first evaluation on, always the best, and never half of it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from processes import Processes, endpoints
from small_tasks import START, small_learner, small_task
from test_coordinator_evaluations import Evaluated

from coordinator.checkpointing import resume_state
from coordinator.events import Interrupted
from coordinator.run_logger import RunLogger
from coordinator.saved_state import saved_state
from t4nmtd_dist import policy
from t4nmtd_dist.core.errors import PolicyError
from t4nmtd_dist.policy.export import POLICY_FILE, export_policy
from t4nmtd_dist.policy.loading import load
from t4nmtd_dist.runs.checkpoints import write_checkpoint
from t4nmtd_dist.runs.directory import RunDirectory

EXPORTS = 150


def about(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "policy" / POLICY_FILE).read_text(encoding="utf-8"))["about"]
    return found


# Without torch


@pytest.mark.command
def test_a_coordinator_exports_and_reads_policies_without_torch() -> None:
    code = "import sys, t4nmtd_dist.policy.export; assert not {'torch', 'gymnasium'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_package_offers_what_its_programs_use() -> None:
    assert policy.load is load
    assert {"GlobalPolicy", "load"} <= set(dir(policy))
    with pytest.raises(AttributeError, match="has no attribute 'lode'"):
        _ = policy.lode


# While others read


def test_who_loads_while_a_policy_is_exported_gets_a_whole_one(tmp_path: Path) -> None:
    """The Q table and the actors of an export belong together."""
    tables = {"p1": [(START, "p1", 1.0)], "p2": [(START, "p2", 1.0)]}
    weights = {pid: {pid: small_learner(pid).weights()} for pid in tables}

    def export(number: int) -> None:
        pid = ("p1", "p2")[number % 2]
        export_policy(tmp_path / "policy", small_task(), tables[pid], weights[pid], {"number": number})

    def export_all() -> None:
        for number in range(1, EXPORTS):
            export(number)

    export(0)
    writer = threading.Thread(target=export_all)
    writer.start()
    loaded = 0
    try:
        while writer.is_alive() or not loaded:
            policy = load(tmp_path if loaded % 2 else tmp_path / "policy")
            ((_, pid, _),) = policy.q_table
            assert set(policy.subtask_of.values()) == {pid}
            loaded += 1
    finally:
        writer.join()
    assert loaded > 10
    assert about(tmp_path)["number"] == EXPORTS - 1


def test_a_policy_that_is_missing_is_refused_at_once(tmp_path: Path) -> None:
    began = time.monotonic()
    with pytest.raises(PolicyError, match=r"no policy in .*first evaluation"):
        load(tmp_path)
    assert time.monotonic() - began < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("left_behind", ["policy.new", "policy.old"])
def test_an_export_that_was_cut_off_is_waited_for_and_then_named(left_behind: str, tmp_path: Path) -> None:
    (tmp_path / left_behind).mkdir()
    began = time.monotonic()
    with pytest.raises(PolicyError, match="no policy in"):
        load(tmp_path)
    assert 0.5 < time.monotonic() - began < 30
    weights = {"p1": small_learner("p1").weights()}
    export_policy(tmp_path / "policy", small_task(), [], weights, {})
    assert load(tmp_path).subtask_of[START] == "p1"
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]
    (tmp_path / left_behind).mkdir()
    run = RunDirectory(tmp_path)
    run.write_settings(small_task().config, 0, 1)
    RunDirectory(tmp_path, restart=True)
    assert not (tmp_path / left_behind).exists(), "a restart knows what a run may have left behind"


# During a run


class Learned(Evaluated):
    """A conversation whose learner has weights of a real actor."""

    def weights(self) -> dict[str, NDArray[np.float32]]:
        return {
            f"weights.{name}": array + self.weights_version for name, array in small_learner("p1").weights().items()
        }


@pytest.fixture
def talk() -> Learned:
    return Learned("evaluation.actions=best")


def test_every_improvement_is_exported_during_training(talk: Learned, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    recorder = RunLogger(talk.state, run)
    exported = []
    for success, mode in ((0.2, "greedy"), (0.1, "greedy"), (0.6, "sampled"), (0.6, "greedy"), (0.5, "sampled")):
        for action in talk.evaluate(success, actions=mode):
            recorder.record(action)
        told = about(run.path)
        exported.append((told["evaluation"], told["interactions"], told["success_rate"], told["actions"]))
        assert load(run.path).mode == mode or success < told["success_rate"]
        assert told["episodes"] == 20
    best = [(1, 100, 0.2, "greedy")] * 2 + [(3, 300, 0.6, "sampled")] + [(4, 400, 0.6, "greedy")] * 2
    assert exported == best


def test_the_best_policy_is_exported_at_the_end(talk: Learned, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    recorder = RunLogger(talk.state, run)
    for success in (0.5, 0.2):
        for action in talk.evaluate(success):
            recorder.record(action)
    shutil.rmtree(run.path / "policy")
    for action in talk.state.handle(Interrupted(talk.now, "enough")):
        recorder.record(action)
    recorder.close()
    assert (about(run.path)["evaluation"], about(run.path)["outcome"]) == (1, "stopped")
    assert run.read_summary()["policy"]["job"] == 1


def test_a_resumed_run_keeps_a_better_policy_that_was_exported_after_its_checkpoint(
    talk: Learned, tmp_path: Path
) -> None:
    run = RunDirectory(tmp_path / "run")
    recorder = RunLogger(talk.state, run)
    for success, mode in ((0.5, "greedy"), (0.9, "sampled")):
        for action in talk.evaluate(success, actions=mode):
            recorder.record(action)
    best = talk.state.evaluations.best
    assert best is not None
    resumed = Learned("evaluation.actions=best")
    resume_state(resumed.state, run.checkpoints, pytest.fail)
    found = resumed.state.evaluations.best
    assert found is not None
    assert found.row == best.row
    assert found.snapshot.versions == best.snapshot.versions
    assert found.snapshot.q_table == best.snapshot.q_table
    recorder = RunLogger(resumed.state, run)
    for success in (0.8, 0.95):
        for action in resumed.evaluate(success):
            recorder.record(action)
        assert about(run.path)["success_rate"] == max(success, 0.9)
    assert load(run.path).mode == "greedy"


@pytest.mark.parametrize("half", [False, True], ids=["both whole", "the new one half written"])
def test_a_kill_between_the_renames_of_an_export_loses_no_policy(half: bool, talk: Learned, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    recorder = RunLogger(talk.state, run)
    for success in (0.5, 0.9):
        for action in talk.evaluate(success):
            recorder.record(action)
        if success < 0.9:
            shutil.copytree(run.path / "policy", run.path / "policy.old")
            before = run.path / "before"
            os.replace(run.path / "policy.old", before)
    os.replace(run.path / "policy", run.path / "policy.new")
    os.replace(before, run.path / "policy.old")
    if half:
        (run.path / "policy.new" / POLICY_FILE).write_text("{", encoding="utf-8")
    resumed = Learned("evaluation.actions=best")
    resume_state(resumed.state, run.checkpoints, pytest.fail)
    found = resumed.state.evaluations.best
    assert found is not None
    assert found.row.success_rate == (0.5 if half else 0.9)
    assert about(run.path)["success_rate"] == found.row.success_rate


def test_a_worse_exported_policy_does_not_replace_that_of_the_checkpoint(talk: Learned, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    recorder = RunLogger(talk.state, run)
    for action in talk.evaluate(0.5):
        recorder.record(action)
    talk.evaluate(0.9)
    write_checkpoint(run.checkpoints / "coordinator", {"run_id": "", "place": "coordinator"}, saved_state(talk.state))
    resumed = Learned("evaluation.actions=best")
    resume_state(resumed.state, run.checkpoints, pytest.fail)
    found = resumed.state.evaluations.best
    assert found is not None
    assert found.row.success_rate == 0.9


@pytest.mark.parametrize("damage", ["{", '{"format": 1}', "[]", '{"about": {"row": {"job": "x"}}, "q_table": []}'])
def test_an_exported_policy_that_cannot_be_read_is_told_of_and_not_kept(
    damage: str, talk: Learned, tmp_path: Path
) -> None:
    run = RunDirectory(tmp_path / "run")
    recorder = RunLogger(talk.state, run)
    for action in talk.evaluate(0.5):
        recorder.record(action)
    (run.path / "policy" / POLICY_FILE).write_text(damage, encoding="utf-8")
    told: list[str] = []
    resumed = Learned()
    resume_state(resumed.state, run.checkpoints, told.append)
    assert resumed.state.evaluations.best is None
    (line,) = told
    assert str(run.path / "policy") in line


# A run of processes


@pytest.mark.timeout(120)
def test_a_run_can_be_evaluated_while_it_trains(commands: Processes) -> None:
    run = commands.folder / "run"
    settings = ["evaluation.every=500", "evaluation.episodes=2", "environment.horizon=30", "evaluation.in_a_row=1000"]
    flags = [part for setting in settings for part in ("--set", setting)]
    training = commands.start("t4nmtd", "train", "--task", "task7", "--run-dir", str(run), "--no-dashboard", *flags)
    commands.until(lambda: (run / "policy" / POLICY_FILE).exists(), "a first policy is exported")
    evaluated = commands.start("t4nmtd", "evaluate", str(run), "--episodes", "3", "--json", "--actions", "sampled")
    assert evaluated.wait(60) == 0, evaluated.story()
    found = json.loads(evaluated.out)
    assert (found["task"], found["episodes"], found["actions"]) == ("task7", 3, "sampled")
    assert training.process.poll() is None, "it still trains"
    status = commands.start("t4nmtd", "status", "--connect", endpoints(run)[0])
    assert status.wait(60) == 0, status.story()
    assert "best evaluation" in status.out
    assert str(run / "policy") in status.out
    training.send(signal.SIGINT)
    assert training.wait(60) == 130
    (line,) = training.out.splitlines()
    assert "stopped" in line
    assert "best evaluation" in line
    assert f"policy in {run / 'policy'}" in line
