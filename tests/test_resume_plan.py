"""What may be resumed, with which flags, and in what order a run directory is afterwards."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path

import pytest

from t4nmtd_dist.agents.sac.config import SACConfig
from t4nmtd_dist.core.errors import ConfigError, RunError
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import plan_run
from t4nmtd_dist.runs.resuming import new_identity, read_stopped_run, write_identity
from t4nmtd_dist.tasks import load_task


def stopped_run(folder: Path, *, outcome: str = "stopped", serial: bool = False) -> Path:
    run = RunDirectory(folder / "run")
    run.write_settings(load_task("task7"), 3, 1000)
    write_identity(run.path, new_identity(serial=serial))
    run.write_summary({"outcome": outcome, "interactions_total": 1000})
    return run.path


CONTRADICTIONS = {
    "restart": ({"restart": True}, "give one of them"),
    "seed": ({"seed": 4}, "has seed 3"),
    "task": ({"task": "task8"}, "is of task7"),
    "setting": ({"set": ["learner.gamma=0.5"]}, "learner.gamma = 0.5 contradicts"),
    "folder": ({"run_dir": Path("elsewhere")}, "--run-dir elsewhere"),
    "less": ({"max_interactions": 999}, "can only be raised"),
}


@pytest.mark.parametrize("what", CONTRADICTIONS)
def test_flags_that_contradict_the_run_are_refused(what: str, tmp_path: Path) -> None:
    fields, text = CONTRADICTIONS[what]
    with pytest.raises(ConfigError, match=text):
        plan_run(RunOptions(resume=stopped_run(tmp_path), **fields))


def test_flags_that_say_what_the_run_says_are_taken(tmp_path: Path) -> None:
    run = stopped_run(tmp_path)
    gamma = load_task("task7").learner.gamma
    flags = [f"learner.gamma={gamma}", f'environment.id="{load_task("task7").environment.id}"']
    plan = plan_run(RunOptions(resume=run, task="task7", seed=3, run_dir=run, set=flags, max_interactions=2000))
    assert (plan.seed, plan.config.max_interactions, plan.directory, plan.resumes) == (3, 2000, run, True)
    assert plan.config.learner == load_task("task7").learner
    assert plan.identity == plan_run(RunOptions(resume=run)).identity


def test_the_time_to_compile_the_task_can_be_changed(tmp_path: Path) -> None:
    plan = plan_run(RunOptions(resume=stopped_run(tmp_path), set=["decomposition.time_limit=77"]))
    assert plan.config.decomposition.time_limit == 77
    with pytest.raises(ConfigError, match=r"decomposition\.keep = 'all' contradicts"):
        plan_run(RunOptions(resume=stopped_run(tmp_path / "b"), set=["decomposition.keep=all"]))


def test_a_run_of_an_earlier_version_is_refused_with_what_still_works(tmp_path: Path) -> None:
    run = stopped_run(tmp_path)
    path = run / "config.toml"
    text = path.read_text(encoding="utf-8")
    assert "run_format = 2\n" in text
    first = text.replace("run_format = 2\n", "").replace("num_envs = ", "worlds = ")  # as version 0.1.0 wrote it
    path.write_text(first, encoding="utf-8")
    with pytest.raises(RunError, match=r"cannot be resumed: another version .* \(run format 1; .*t4nmtd evaluate"):
        plan_run(RunOptions(resume=run))
    path.write_text(text.replace("run_format = 2\n", "run_format = 3\n"), encoding="utf-8")
    with pytest.raises(RunError, match="run format 3"):
        plan_run(RunOptions(resume=run))


def test_settings_written_are_complete_and_read_back_the_same(tmp_path: Path) -> None:
    for name in ("task1", "task4", "task7"):
        run = RunDirectory(tmp_path / name)
        run.write_settings(load_task(name), 0, 77)
        write_identity(run.path, new_identity(serial=False))
        found = read_stopped_run(run.path).config
        assert found.to_dict() == load_task(name).to_dict() | {"max_interactions": 77}
        assert set(found.to_dict()["sac"]) == {each.name for each in fields(SACConfig)}


def test_a_spent_budget_wants_more_and_a_solved_run_nothing(tmp_path: Path) -> None:
    spent = stopped_run(tmp_path / "a", outcome="budget spent")
    with pytest.raises(RunError, match="--max-interactions"):
        plan_run(RunOptions(resume=spent))
    assert plan_run(RunOptions(resume=spent, max_interactions=1001)).solved == ""
    assert "solved task7 already" in plan_run(RunOptions(resume=stopped_run(tmp_path / "b", outcome="solved"))).solved


def test_a_run_is_resumed_the_way_it_was_begun(tmp_path: Path) -> None:
    serial, other = stopped_run(tmp_path / "a", serial=True), stopped_run(tmp_path / "b")
    with pytest.raises(ConfigError, match="only with --serial"):
        plan_run(RunOptions(resume=serial))
    with pytest.raises(ConfigError, match="only without --serial"):
        plan_run(RunOptions(resume=other), serial=True)


def test_what_is_no_run_or_has_no_checkpoints_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="holds no run"):
        plan_run(RunOptions(resume=tmp_path))
    run = stopped_run(tmp_path)
    (run / "checkpoints" / "run.json").unlink()
    with pytest.raises(RunError, match="no checkpoints"):
        plan_run(RunOptions(resume=run))
    with pytest.raises(ConfigError, match="--task NAME"):
        plan_run(RunOptions())


def test_a_run_that_is_there_is_refused_with_both_ways_out(tmp_path: Path) -> None:
    run = stopped_run(tmp_path)
    with pytest.raises(RunError, match=r"--resume .* --restart"):
        RunDirectory(run)
    going_on = RunDirectory(run, resume=True)
    going_on.lock()
    for options in ({"resume": True}, {"restart": True}):
        with pytest.raises(RunError, match="still going on"):
            RunDirectory(run, **options)
    going_on.unlock()
    assert RunDirectory(run, restart=True).path == run
    assert not (run / "config.toml").exists()


def test_a_seed_below_0_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--seed -1: expected 0 or more"):
        plan_run(RunOptions(task="task7", seed=-1, run_dir=tmp_path / "run"))


@pytest.mark.parametrize("theirs", ["thesis.tex", ".git", "data"])
def test_a_restart_deletes_nothing_that_no_run_has_written(theirs: str, tmp_path: Path) -> None:
    run = stopped_run(tmp_path)
    (run / theirs).mkdir()
    with pytest.raises(RunError, match=rf"--restart would delete .* with {re.escape(theirs)}"):
        RunDirectory(run, restart=True)
    assert (run / "config.toml").exists()


def test_a_restart_does_not_take_any_settings_for_a_runs(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("[tool]\nname = 1\n", encoding="utf-8")
    with pytest.raises(RunError, match=r"--restart would delete .* with config\.toml"):
        RunDirectory(tmp_path, restart=True)


def test_a_link_or_a_dot_names_the_folder_that_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = stopped_run(tmp_path)
    assert RunDirectory(tmp_path / "latest", restart=True).path == run
    monkeypatch.chdir(run)
    assert RunDirectory(Path(), restart=True).path == run
    assert (tmp_path / "latest").resolve() == run


def test_a_file_called_latest_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "latest").write_text("mine", encoding="utf-8")
    RunDirectory(tmp_path / "run")
    assert (tmp_path / "latest").read_text(encoding="utf-8") == "mine"


def test_a_resume_mends_what_a_killed_process_left_half_written(tmp_path: Path) -> None:
    run = RunDirectory(stopped_run(tmp_path), resume=True)
    for elapsed in (1.0, 2.0, 3.0):
        run.append_metrics("p1", {"elapsed_s": elapsed, "interactions": 10 * elapsed})
        run.log_event(elapsed, f"at {elapsed}")
    metrics, log = run.path / "metrics" / "p1.csv", run.path / "events.jsonl"
    metrics.write_text(metrics.read_text() + "4.0,4")
    log.write_text(log.read_text() + '{"utc": "20')
    run.mend(2.0)
    assert metrics.read_text().split() == ["elapsed_s,interactions", "1.0,10.0", "2.0,20.0"]
    assert [json.loads(line)["text"] for line in log.read_text().splitlines()] == ["at 1.0", "at 2.0", "at 3.0"]


def test_the_link_to_the_latest_run_is_followed(tmp_path: Path) -> None:
    run = stopped_run(tmp_path)
    assert plan_run(RunOptions(resume=tmp_path / "latest")).directory == run
    assert RunDirectory(plan_run(RunOptions(resume=tmp_path / "latest")).directory, resume=True).path == run
    assert (tmp_path / "latest").resolve() == run
