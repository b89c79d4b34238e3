"""A sub-task of two propositions, ``left&again``, through a whole run: files, command lines, policy, dashboard."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from processes import LOOPBACK, Processes, endpoints
from small_tasks import TINY, own_task

from t4nmtd_dist.policy.loading import load

HERE = Path(__file__).parent
JOINT = f"""
name = "joint"
formula = "F(right & X(F(left & again)))"
propositions = ["left", "right", "again"]
[environment]
id = "own_environments:Corridor"
path = "{HERE}"
horizon = 30
"""
PID, FILE = "left&again", "left+again"


def flags() -> list[str]:
    return [part for flag in (*TINY, "evaluation.every=500") for part in ("--set", flag)]


def test_a_serial_run_keeps_its_files_under_safe_names(tmp_path: Path, commands: Processes) -> None:
    task, run = own_task(tmp_path, JOINT), tmp_path / "run"
    where = ["--run-dir", str(run), "--max-interactions", "1500", "--tensorboard", "on"]
    training = commands.start("t4nmtd", "train", "--serial", "--task", str(task), *where, *flags())
    assert training.wait(90) in (0, 3), training.story()
    with (run / "metrics" / f"{FILE}.csv").open(encoding="utf-8") as file:
        assert int(list(csv.DictReader(file))[-1]["interactions"]) > 0
    assert {folder.name for folder in (run / "tensorboard").iterdir()} >= {FILE, "right"}
    assert not [path for path in run.rglob("*") if "&" in path.name]
    policy = load(run / "policy")
    assert policy.decomposition.pids == (PID, "right")


def test_a_worker_takes_it_by_name_and_the_dashboard_shows_it(tmp_path: Path, commands: Processes) -> None:
    task, run, picture = own_task(tmp_path, JOINT), tmp_path / "run", tmp_path / "page.svg"
    bound = ["--bind", LOOPBACK, "--publish", LOOPBACK, "--no-dashboard", "--run-dir", str(run)]
    coordinator = commands.start("t4nmtd-coordinator", "--task", str(task), *bound, *flags())
    commands.until(lambda: (run / "endpoints.json").exists(), "the coordinator listens")
    control, state = endpoints(run)
    kept = ["--checkpoints", str(run / "checkpoints"), "--checkpoint-every", "0.5"]
    worker = commands.start("t4nmtd-worker", "--pid", PID, "--connect", control, *kept)
    folder = run / "checkpoints" / FILE
    commands.until(folder.exists, "the worker writes a checkpoint")
    shown = commands.start("t4nmtd", "dashboard", "--connect", state, "--svg", str(picture))
    assert shown.wait(60) == 0, shown.story()
    assert "left&amp;again" in picture.read_text(encoding="utf-8").replace("&#160;", " ")
    assert worker.process.poll() is None, worker.story()
    asked = commands.start("t4nmtd", "status", "--connect", control, "--json")
    assert asked.wait(30) == 0, asked.story()
    assert PID in json.dumps(json.loads(asked.out))
    assert coordinator.process.poll() is None, coordinator.story()
