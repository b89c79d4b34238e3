"""Files of a run directory that are not what they should be: symbolic links, and damaged counts and summaries."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from test_resume_plan import stopped_run

from t4nmtd_dist.cli.options import RunOptions
from t4nmtd_dist.cli.plan import plan_run
from t4nmtd_dist.errors import RunError
from t4nmtd_dist.runs.checkpoints import newest_checkpoint, write_checkpoint
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.resuming import write_counts

NAMES = [
    "config.toml",
    "summary.json",
    "versions.json",
    "endpoints.json",
    "events.jsonl",
    ".lock",
    ".config.toml.new",
    "checkpoints",
    "checkpoints/run.json",
    "checkpoints/counts.json",
    "checkpoints/coordinator",
    "checkpoints/coordinator/000001",
    "checkpoints/coordinator/000001/state.json",
    "metrics",
    "metrics/p1.csv",
    "logs",
    "logs/p1.log",
    "tensorboard",
    "policy",
    "policy/policy.json",
]


def full_run(folder: Path) -> Path:
    """A stopped run with something of everything that a run writes."""
    run = stopped_run(folder)
    write_counts(run / "checkpoints", {"run_id": ""})
    write_checkpoint(run / "checkpoints" / "coordinator", {}, {"a": np.zeros(3)})
    for name in NAMES:
        if not (run / name).exists():
            (run / name).parent.mkdir(exist_ok=True)
            (run / name).write_text("", encoding="utf-8") if "." in name else (run / name).mkdir()
    return run


def link_out(path: Path, outside: Path) -> Path:
    """Move a file or folder away, and leave a link to it in its place."""
    outside.mkdir()
    path.rename(outside / path.name)
    path.symlink_to(outside / path.name)
    return outside / path.name


@pytest.mark.parametrize("name", NAMES)
def test_a_resume_follows_no_link_inside_the_run_directory(name: str, tmp_path: Path) -> None:
    run = full_run(tmp_path)
    assert plan_run(RunOptions(resume=run)).resumes
    RunDirectory(run, resume=True)
    link_out(run / name, tmp_path / "outside")
    says = rf"{re.escape(str(run / name))} is a symbolic link"
    with pytest.raises(RunError, match=says):
        plan_run(RunOptions(resume=run))
    with pytest.raises(RunError, match=says):
        RunDirectory(run, resume=True)


def test_the_run_directory_itself_may_be_a_link_and_so_may_what_no_run_writes(tmp_path: Path) -> None:
    run = full_run(tmp_path)
    (run / "notes").symlink_to(tmp_path)
    (tmp_path / "mine").symlink_to(run)
    assert plan_run(RunOptions(resume=tmp_path / "mine")).directory == run
    assert RunDirectory(tmp_path / "mine", resume=True).path == run


@pytest.mark.parametrize("name", ["events.jsonl", "metrics/evaluations.csv", "logs", ".lock"])
def test_a_new_run_follows_no_link_that_lies_in_its_folder(name: str, tmp_path: Path) -> None:
    path = tmp_path / "run" / name
    path.parent.mkdir(parents=True)
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RunError, match=r"is a symbolic link"):
        RunDirectory(tmp_path / "run")
    assert not (tmp_path / "elsewhere").exists()


def test_links_put_into_the_folder_of_a_running_run_are_not_written_through(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    victim = tmp_path / "victim"
    victim.write_text("precious", encoding="utf-8")
    (run.checkpoints).mkdir()
    for link in ("events.jsonl", "metrics/p1.csv", ".summary.json.new", "checkpoints/.counts.json.new"):
        (run.path / link).symlink_to(victim)
    with pytest.raises(OSError, match="symbolic link"):
        run.log_event(0.0, "text")
    with pytest.raises(OSError, match="symbolic link"):
        run.append_metrics("p1", {"a": 1})
    run.write_summary({"a": 1})
    write_counts(run.checkpoints, {"a": 1})
    assert victim.read_text(encoding="utf-8") == "precious"
    assert not (run.path / "summary.json").is_symlink()
    assert not (run.checkpoints / "counts.json").is_symlink()


@pytest.mark.parametrize("name", ["", "000002", "000002/state.json", "000002/manifest.json"])
def test_a_checkpoint_behind_a_link_is_passed_over_with_a_warning(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "p1"
    for number in (1, 2):
        write_checkpoint(folder, {}, {"number": number})
    link_out(folder / name, tmp_path / "outside")
    warnings: list[str] = []
    found = newest_checkpoint(folder, lambda about: True, warnings.append)
    assert (found is None) if not name else (found is not None and found.state["number"] == 1)
    assert len(warnings) == 1
    assert "symbolic link" in warnings[0]


def test_no_checkpoint_is_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "p1").symlink_to(tmp_path / "outside")
    with pytest.raises(RunError, match="symbolic link"):
        write_checkpoint(tmp_path / "p1", {}, {"number": 1})
    assert os.listdir(tmp_path / "outside") == []
