"""Checkpoints are whole or passed over: truncation, flipped bytes, crashes and full disks."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from safetensors.numpy import load_file

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.core.state_dict import copied, joined, split
from t4nmtd_dist.runs import checkpoints
from t4nmtd_dist.runs.array_file import array_file_parts
from t4nmtd_dist.runs.background import BackgroundWriter
from t4nmtd_dist.runs.checkpoints import (
    ARRAYS_FILE,
    MANIFEST_FILE,
    STATE_FILE,
    delete_checkpoints,
    newest_checkpoint,
    write_checkpoint,
)
from t4nmtd_dist.runs.resuming import checkpoint_folder

FILES = (MANIFEST_FILE, STATE_FILE, ARRAYS_FILE)
ABOUT = {"run_id": "r", "place": "p1"}
DTYPES = ["bool", "int8", "int32", "int64", "uint8", "uint32", "uint64", "float32", "float64"]

some_arrays = st.sampled_from(DTYPES).flatmap(
    lambda kind: arrays(np.dtype(kind), array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
)
leaves = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**130), 2**130),
    st.floats(allow_nan=False),
    st.text(max_size=8),
    some_arrays,
)
trees = st.dictionaries(
    st.text(max_size=6),
    st.recursive(
        leaves, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner), max_leaves=6
    ),
    max_size=4,
)


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and bool(a == b)


def state_of(number: int) -> dict[str, Any]:
    """Every part of it tells which one it is, so that a mixture shows."""
    rng = np.random.default_rng(number)
    return {
        "number": number,
        "weights": {"actor.0": np.full((3, 5), number, np.float32), "alpha": np.array(number, np.float64)},
        "rng": rng.bit_generator.state,
        "empty": np.zeros((0, 4), np.float32),
    }


def whole(found: checkpoints.Checkpoint | None) -> int | None:
    """The number of the state that was found, once it is seen to be nothing but that."""
    if found is None:
        return None
    number: int = found.state["number"]
    assert same(found.state, state_of(number))
    assert found.about == ABOUT
    return number


@contextmanager
def temporary() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp())
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def newest(folder: Path, warnings: list[str] | None = None) -> int | None:
    told: list[str] = [] if warnings is None else warnings
    return whole(newest_checkpoint(folder, lambda about: about == ABOUT, told.append))


@given(trees)
@settings(max_examples=30, deadline=None)
def test_any_state_comes_back_from_files_as_it_was(state: dict[str, Any]) -> None:
    with temporary() as folder:
        write_checkpoint(folder, ABOUT, state)
        found = newest_checkpoint(folder, lambda about: about == ABOUT, pytest.fail)
        assert found is not None
        assert same(found.state, state)


@given(trees)
@settings(max_examples=40, deadline=None)
def test_a_state_split_and_joined_is_the_same_and_a_copy_shares_no_array(state: dict[str, Any]) -> None:
    assert same(joined(*split(state)), state)
    copy = copied(state)
    assert same(copy, state)
    originals, copies = split(state)[1], split(copy)[1]
    assert not any(np.shares_memory(originals[name], copies[name]) for name in originals)


def test_a_generator_goes_on_as_it_would_have(tmp_path: Path) -> None:
    rng, other = np.random.default_rng(5), np.random.default_rng(6)
    rng.normal(size=7)
    write_checkpoint(tmp_path, ABOUT, {"rng": rng.bit_generator.state})
    found = newest_checkpoint(tmp_path, lambda about: True, pytest.fail)
    assert found is not None
    other.bit_generator.state = found.state["rng"]
    assert rng.random(9).tolist() == other.random(9).tolist()


def test_what_no_file_can_hold_is_refused() -> None:
    with pytest.raises(TypeError, match="set"):
        split({"a": {"b": {1, 2}}})
    with pytest.raises(TypeError, match="key 3"):
        split({"a": {3: 1}})
    with pytest.raises(TypeError, match="complex"):
        list(array_file_parts({"a": np.zeros(2, np.complex64)}))


def test_others_read_the_arrays_as_safetensors(tmp_path: Path) -> None:
    path = write_checkpoint(tmp_path, ABOUT, state_of(4))
    found = load_file(path / ARRAYS_FILE)
    assert found["/weights/actor.0"].tolist() == [[4.0] * 5] * 3


def test_the_last_three_are_kept_and_the_newest_is_found(tmp_path: Path) -> None:
    for number in range(1, 6):
        write_checkpoint(tmp_path, ABOUT, state_of(number))
        assert newest(tmp_path) == number
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000003", "000004", "000005"]


def test_those_of_another_run_are_passed_over_in_silence(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, ABOUT, state_of(1))
    write_checkpoint(tmp_path, {**ABOUT, "run_id": "other"}, state_of(2))
    warnings: list[str] = []
    assert newest(tmp_path, warnings) == 1
    assert warnings == []


def damaged_copy(folder: Path, name: str, change: Any) -> None:
    """Two good checkpoints, of which the newer is then damaged."""
    for number in (1, 2):
        write_checkpoint(folder, ABOUT, state_of(number))
    path = folder / "000002" / name
    path.write_bytes(change(path.read_bytes()))


@given(st.sampled_from(FILES), st.floats(0, 1, exclude_max=True))
@settings(max_examples=40, deadline=None)
def test_a_file_cut_off_anywhere_sends_back_to_the_one_before(name: str, where: float) -> None:
    with temporary() as folder:
        damaged_copy(folder, name, lambda data: data[: int(where * len(data))])
        warnings: list[str] = []
        assert newest(folder, warnings) == 1
        assert len(warnings) == 1
        assert "000002 is damaged" in warnings[0]


@given(st.sampled_from(FILES), st.floats(0, 1, exclude_max=True), st.integers(0, 7))
@settings(max_examples=60, deadline=None)
def test_a_flipped_bit_never_gives_another_state(name: str, where: float, bit: int) -> None:
    def flip(data: bytes) -> bytes:
        place = int(where * len(data))
        return data[:place] + bytes([data[place] ^ (1 << bit)]) + data[place + 1 :]

    with temporary() as folder:
        damaged_copy(folder, name, flip)
        found = newest(folder)
        assert found == 1 or (found == 2 and name == MANIFEST_FILE)  # a changed blank in the manifest changes nothing


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_sends_back_to_the_one_before(name: str, tmp_path: Path) -> None:
    for number in (1, 2):
        write_checkpoint(tmp_path, ABOUT, state_of(number))
    (tmp_path / "000002" / name).unlink()
    assert newest(tmp_path) == 1


@pytest.mark.parametrize("name", [STATE_FILE, ARRAYS_FILE])
def test_files_of_two_checkpoints_are_never_mixed(name: str, tmp_path: Path) -> None:
    for number in (1, 2, 3):
        write_checkpoint(tmp_path, ABOUT, state_of(number))
    shutil.copy(tmp_path / "000002" / name, tmp_path / "000003" / name)
    assert newest(tmp_path) == 2


def test_nothing_whole_gives_nothing_and_a_warning_for_each(tmp_path: Path) -> None:
    for number in (1, 2):
        path = write_checkpoint(tmp_path, ABOUT, state_of(number))
        (path / ARRAYS_FILE).write_bytes(b"")
    warnings: list[str] = []
    assert newest(tmp_path, warnings) is None
    assert len(warnings) == 2
    assert newest(tmp_path / "nowhere") is None


class CrashError(Exception):
    """Stands for the end of the process."""


CALLS = ("fsync", "replace", "rename")


@given(st.sampled_from(CALLS), st.integers(0, 6), st.booleans())
@settings(max_examples=25, deadline=None)
def test_a_crash_between_any_two_calls_leaves_the_one_before_or_the_new_one(call: str, after: int, full: bool) -> None:
    left = [after]
    real = getattr(os, call)

    def fails(*arguments: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device") if full else CrashError
        return real(*arguments)

    with temporary() as folder, pytest.MonkeyPatch.context() as patch:
        write_checkpoint(folder, ABOUT, state_of(1))
        patch.setattr(shutil, "rmtree", lambda *arguments, **options: None)  # a dead process tidies nothing up
        patch.setattr(os, call, fails)
        try:
            write_checkpoint(folder, ABOUT, state_of(2))
            done = True
        except (CrashError, RunError):
            done = False
        patch.undo()
        found = newest(folder)
        assert found == 2 if done else found in (1, 2)
        write_checkpoint(folder, ABOUT, state_of(3))
        assert newest(folder) == 3
        assert not [path for path in folder.iterdir() if not path.name.isdigit()]


def test_a_disk_that_cannot_be_written_is_told_and_ends_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RunError, match="cannot write a checkpoint"):
        write_checkpoint(tmp_path / "file", ABOUT, state_of(1))
    told: list[str] = []
    writer = BackgroundWriter(told.append)
    writer.begin(tmp_path / "file", ABOUT, state_of(1))
    writer.wait()
    assert len(told) == 1
    assert "cannot write a checkpoint" in told[0]


def test_writing_aside_ends_before_the_next_begins(tmp_path: Path) -> None:
    told: list[str] = []
    writer = BackgroundWriter(told.append)
    for number in (1, 2):
        writer.begin(tmp_path, ABOUT, state_of(number))
    writer.wait()
    assert not writer.busy
    assert newest(tmp_path) == 2
    assert len(told) == 2
    assert "written in" in told[0]


def test_an_unexpected_exception_while_writing_aside_is_raised_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    writer = BackgroundWriter(told.append)
    with monkeypatch.context() as broken:
        broken.setattr("t4nmtd_dist.runs.background.write_checkpoint", lambda *_: 1 / 0)
        writer.begin(tmp_path, ABOUT, state_of(1))
        with pytest.raises(ZeroDivisionError):
            writer.wait()
    writer.begin(tmp_path, ABOUT, state_of(2))
    writer.wait()
    assert newest(tmp_path) == 2


def test_a_checkpoint_that_is_gone_before_it_is_measured_is_no_trouble(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr("t4nmtd_dist.runs.background.write_checkpoint", lambda *_: tmp_path / "gone")
    BackgroundWriter(told.append).write(tmp_path, ABOUT, state_of(1))
    assert "written in" in told[0]


def test_a_solved_run_leaves_none(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "p1", ABOUT, state_of(1))
    delete_checkpoints(tmp_path / "p1")
    delete_checkpoints(tmp_path / "p1")
    assert not (tmp_path / "p1").exists()


def test_every_subtask_has_a_folder_of_its_own() -> None:
    pids = ["p1", "~p1", "coordinator", "~coordinator", "serial", "tick"]
    folders = {checkpoint_folder(Path("c"), pid).name for pid in pids}
    assert len(folders) == len(pids)
    assert not folders & {"coordinator", "serial"}
    assert checkpoint_folder(Path("c"), "p1") == Path("c/p1")
    assert not any("~" in name for name in folders)


def test_a_checkpoint_of_another_version_is_passed_over_with_a_word(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, ABOUT, {"n": 1})
    newest = write_checkpoint(tmp_path, ABOUT, {"n": 2})
    manifest = newest / MANIFEST_FILE
    manifest.write_text(manifest.read_text().replace('"format": 2', '"format": 1'))
    said: list[str] = []
    found = newest_checkpoint(tmp_path, lambda about: True, said.append)
    assert found is not None
    assert found.state["n"] == 1
    assert len(said) == 1
    assert "written by another version (format 1; this version reads 2)" in said[0]
