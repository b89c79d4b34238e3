"""Event files: what TensorBoard's own reader finds in them, and what the coordinator writes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from coordinator_events import Conversation
from hypothesis import given
from hypothesis import strategies as st
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from coordinator.events import RecordEvaluation
from coordinator.run_logger import RunLogger
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.runs import event_files
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.event_files import EventFiles, open_event_files
from t4nmtd_dist.wire.messages import EvaluationRow, Intervention, LearnerStats

Points = list[tuple[int, float]]
ROW = EvaluationRow(
    job=1, interactions=7168, elapsed_s=3.0, success_rate=0.5, mean_length=12.0, std_length=1.0, mean_return=66.5,
    dfa_path=[0, 1],
)  # fmt: skip


def curves(folder: Path) -> dict[str, Points]:
    """What TensorBoard shows of one group of curves."""
    reader = EventAccumulator(str(folder))
    reader.Reload()
    return {name: [(event.step, event.value) for event in reader.Scalars(name)] for name in reader.Tags()["scalars"]}


@given(values=st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=1, max_size=20))
def test_tensorboard_reads_every_point_before_the_files_are_closed(
    values: list[float], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("events")
    files = EventFiles(folder)
    for step, value in enumerate(values):
        files.add("p1", 1000 * step, {"entropy": value, "success": 1.0})
    shown = curves(folder / "p1")
    files.close()
    assert shown["entropy"] == [(1000 * step, value) for step, value in enumerate(values)]
    assert len(shown["success"]) == len(values)


def test_a_value_that_is_not_known_yet_is_left_out(tmp_path: Path) -> None:
    files = EventFiles(tmp_path)
    files.add("g", 0, {"entropy": None, "steps_per_s": 0.0})
    files.add("g", 10, {"entropy": 1.5, "steps_per_s": 2.0})
    assert curves(tmp_path / "g") == {"entropy": [(10, 1.5)], "steps_per_s": [(0, 0.0), (10, 2.0)]}


def test_a_resumed_run_takes_the_place_of_what_was_written_beyond_its_checkpoint(tmp_path: Path) -> None:
    before = EventFiles(tmp_path)
    for step in (10, 20, 30):
        before.add("g", step, {"success": 0.0})
    before.close()
    after = EventFiles(tmp_path, step=20)
    for step in (20, 30):
        after.add("g", step, {"success": 1.0})
    assert curves(tmp_path / "g")["success"] == [(10, 0.0), (20, 1.0), (30, 1.0)]


def test_a_coordinator_draws_its_evaluations_and_every_learner(tmp_path: Path) -> None:
    talk = Conversation()
    talk.claim("p1")
    peers = Intervention(asked=10, answered=8, own_used=2, lag_total=4)
    stats = LearnerStats(interactions=640, recent_success=0.25, entropy=1.5, value_loss=0.5, intervention=peers)
    talk.send("w", talk.sync_message("p1", "w", stats=stats))
    recorder = RunLogger(talk.state, RunDirectory(tmp_path / "run"), "on")
    recorder.record(RecordEvaluation(ROW))
    recorder.metrics()
    written = tmp_path / "run" / "tensorboard"
    assert {path.name for path in written.iterdir()} == {"evaluations", "p1", "p2", "p3", "g"}
    evaluations = {"success_rate": [(7168, 0.5)], "mean_length": [(7168, 12.0)], "mean_return": [(7168, 66.5)]}
    assert curves(written / "evaluations") == evaluations
    learner = {name: value for name, [(step, value)] in curves(written / "p1").items() if step == 640}
    assert learner == pytest.approx(
        {
            "recent_success": 0.25, "entropy": 1.5, "critic_loss": 0.5, "steps_per_s": 0.0, "updates_per_s": 0.0,
            "own_used_share": 0.2, "mean_lag": 0.5,
        }
    )  # fmt: skip
    assert set(curves(written / "g")) == {"steps_per_s", "updates_per_s"}


def test_without_the_package_only_who_asked_for_it_is_told_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_files, "_installed", lambda: False)
    assert open_event_files(tmp_path, "auto") is None
    with pytest.raises(ConfigError, match="pip install"):
        open_event_files(tmp_path, "on")


def test_a_package_that_cannot_be_imported_is_an_error_that_says_how_to_do_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard.compat.proto", None)
    with pytest.raises(ConfigError, match="--tensorboard off"):
        open_event_files(tmp_path, "auto")


def test_files_are_written_if_the_package_is_there_and_not_if_unwanted(tmp_path: Path) -> None:
    assert isinstance(open_event_files(tmp_path, "auto"), EventFiles)
    assert open_event_files(tmp_path, "off") is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.command
def test_writing_needs_neither_torch_nor_tensorflow() -> None:
    code = (
        "import sys; from pathlib import Path; from t4nmtd_dist.runs.event_files import open_event_files\n"
        "open_event_files(Path('.'), 'on')\n"
        "assert not {'torch', 'tensorflow'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_serial_training_writes_them(tmp_path: Path) -> None:
    from t4nmtd_dist.cli.commands import Train

    run = tmp_path / "run"
    flags = ["ppo.num_envs=4", "ppo.rollout=8", "ppo.epochs=1", "learner.hidden=[8]", "evaluation.every=10"]
    command = Train(task="task7", run_dir=run, serial=True, max_interactions=200, set=flags, tensorboard="on")
    assert command.run() == 3
    assert {path.name for path in (run / "tensorboard").iterdir()} >= {"p1", "p2", "p3", "g"}
    assert curves(run / "tensorboard" / "g")["steps_per_s"][-1][0] >= 200
