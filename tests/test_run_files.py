"""Files of a run directory that are not what they should be: symbolic links, and damaged counts and summaries."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from coordinator_events import Conversation
from hypothesis import given
from hypothesis import strategies as st
from test_resume import talked
from test_resume_plan import stopped_run

from coordinator.checkpointing import resume_state
from coordinator.saved_state import saved_counts, saved_state
from coordinator.snapshot import summary
from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.runs.checkpoints import newest_checkpoint, write_checkpoint
from t4nmtd_dist.runs.counts import read_counts, write_counts
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import plan_run
from t4nmtd_dist.runs.resuming import read_stopped_run

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


# Damage

DAMAGED = {
    "empty": b"",
    "cut off": b'{"run_id": "", "totals": {"p1',
    "a list": b"[]",
    "nothing": b"null",
    "no text": b"\xff\xfe\x00",
    "other types": b'{"run_id": "", "interactions_total": "many", "outcome": 7, "totals": [], "epochs": 1}',
    "out of range": b'{"run_id": "", "interactions_total": -5, "elapsed_s": NaN, "evaluated": -1, "totals": {"p1": 1}}',
    "too deep": b"[" * 100_000,
}


@pytest.mark.parametrize("how", DAMAGED)
def test_damaged_counts_and_summary_do_not_block_a_resume_from_whole_checkpoints(how: str, tmp_path: Path) -> None:
    run, talk = stopped_run(tmp_path), talked()
    write_checkpoint(
        run / "checkpoints" / "coordinator", {"run_id": "", "place": "coordinator"}, saved_state(talk.state)
    )
    (run / "summary.json").write_bytes(DAMAGED[how])
    (run / "checkpoints" / "counts.json").write_bytes(DAMAGED[how])
    stopped = plan_run(RunOptions(resume=run)).stopped
    assert stopped is not None
    assert [text.split(" ")[0] for text in stopped.warnings] == [str(run / "summary.json")]
    warnings: list[str] = []
    fresh = Conversation()
    assert "from checkpoint 000001" in resume_state(fresh.state, run / "checkpoints", warnings.append)
    assert fresh.fingerprint() == talk.fingerprint()
    assert len(warnings) == 1
    assert "counts.json" in warnings[0]


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)
fields = st.fixed_dictionaries(
    {},
    optional={
        "run_id": st.just(""),
        "elapsed_s": json_values,
        "epochs": json_values | st.dictionaries(st.sampled_from(["p1", "g"]), json_values),
        "evaluated": json_values,
        "totals": json_values | st.dictionaries(st.sampled_from(["p1", "p2"]), json_values),
        "wall_s": json_values,
        "learners": json_values | st.dictionaries(st.sampled_from(["p1", "p2"]), json_values),
    },
)


@given(counts=st.binary() | fields, told=st.binary() | fields)
@pytest.mark.slow
def test_whatever_counts_and_summary_hold_a_resume_goes_on(
    counts: object, told: object, tmp_path_factory: pytest.TempPathFactory
) -> None:
    run = tmp_path_factory.mktemp("run")
    (run / "checkpoints").mkdir()
    for path, content in ((run / "checkpoints" / "counts.json", counts), (run / "summary.json", told)):
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    fresh = Conversation()
    resume_state(fresh.state, run / "checkpoints", [].append)
    assert fresh.state.interactions >= 0
    assert fresh.state.elapsed_s >= 0
    fresh.tick()


def gone(folder: Path) -> Path:
    """A run whose coordinator has kept counts and a summary, and has no checkpoint any more."""
    run, talk = stopped_run(folder), talked()
    (run / "summary.json").write_text(json.dumps(summary(talk.state)), encoding="utf-8")
    write_counts(run / "checkpoints", {"run_id": "", **saved_counts(talk.state)})
    return run


@pytest.mark.parametrize("damaged", [True, False])
def test_a_summary_stands_in_for_checkpoints_and_counts_that_are_gone(damaged: bool, tmp_path: Path) -> None:
    run = gone(tmp_path)
    counts = run / "checkpoints" / "counts.json"
    if damaged:
        counts.write_bytes(b"{")
        write_checkpoint(run / "checkpoints" / "coordinator", {"run_id": "", "place": "coordinator"}, {})
        (run / "checkpoints" / "coordinator" / "000001" / "state.json").write_bytes(b"{")
    else:
        counts.unlink()
    fresh, warnings = Conversation(max_interactions=9500), list[str]()
    says = resume_state(fresh.state, run / "checkpoints", warnings.append)
    spent = "resumed after 9000 interactions from no checkpoint: summary.json has what was spent"
    assert says == f"{spent}; Q and evaluations begin anew"
    assert fresh.state.elapsed_s == 40.0
    assert fresh.state.records["p1"].total.attempts == 7
    assert fresh.state.records["p1"].total.successes == 3
    assert fresh.state.outcome is None
    assert len(warnings) == 2 * damaged


def test_counts_stand_in_for_checkpoints_that_are_gone(tmp_path: Path) -> None:
    fresh = Conversation()
    says = resume_state(fresh.state, gone(tmp_path) / "checkpoints", pytest.fail)
    spent = "resumed after 9000 interactions from no checkpoint: counts.json has what was spent"
    assert says == f"{spent}; Q and evaluations begin anew"
    assert fresh.claim("p1").epoch == 2


def test_a_budget_that_counts_say_is_spent_stays_spent_when_the_summary_is_damaged(tmp_path: Path) -> None:
    run, talk = stopped_run(tmp_path, outcome="budget spent"), talked()
    write_counts(run / "checkpoints", {"run_id": "", **saved_counts(talk.state), "outcome": "budget spent"})
    (run / "summary.json").write_bytes(b"{")
    stopped = read_stopped_run(run)
    assert (stopped.outcome, stopped.interactions) == ("budget spent", 9000)
    with pytest.raises(RunError, match="--max-interactions"):
        plan_run(RunOptions(resume=run))


def test_saved_counts_are_read_back_as_they_were(tmp_path: Path) -> None:
    counts = {"run_id": "", "place": "coordinator", **saved_counts(talked().state)}
    write_counts(tmp_path, counts)
    assert read_counts(tmp_path) == json.loads(json.dumps(counts))
