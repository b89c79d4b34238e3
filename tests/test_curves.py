"""Learning curves: what is read of a run, how runs meet on one grid, and the interval around their mean."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.runs.curves import RunCurves, common_grid, mean_curve, read_run, step_values

RESULTS = Path(__file__).parent.parent / "benchmarks" / "results"
HEADER = "elapsed_s,interactions,success_rate,mean_length,std_length,mean_return"

points = st.lists(
    st.tuples(st.integers(1, 200), st.floats(0, 1)), min_size=1, max_size=12, unique_by=lambda point: point[0]
)


def curves(evaluations: list[tuple[int, float]], *, solved: bool = True) -> RunCurves:
    """A run with these (interactions, success), evaluated every second."""
    x, y = (np.array(column, np.float64) for column in zip(*sorted(evaluations), strict=True))
    columns = {"interactions": x, "time": np.arange(len(x)) + 1.0, "success": y, "length": y, "return": y}
    return RunCurves(Path("run"), "task7", solved, columns)


def run_directory(folder: Path, *rows: str, solved: bool | None = True, header: str = HEADER) -> Path:
    """A run with these rows of evaluations; ``solved`` None: it goes on."""
    (folder / "metrics").mkdir(parents=True)
    (folder / "metrics" / "evaluations.csv").write_text("\n".join([header, *rows, ""]), encoding="utf-8")
    (folder / "config.toml").write_text('name = "task7"\n', encoding="utf-8")
    if solved is not None:
        (folder / "summary.json").write_text(json.dumps({"task": "task7", "solved": solved}), encoding="utf-8")
    return folder


def held(evaluations: list[tuple[int, float]], x: float) -> float:
    """What the newest evaluation says at x, by search from the end."""
    return next(y for at, y in sorted(evaluations, reverse=True) if at <= x)


@given(evaluations=points, grid=st.lists(st.floats(0, 250), min_size=1, max_size=10))
def test_an_evaluation_holds_until_the_next_and_none_is_made_up_before_the_first(
    evaluations: list[tuple[int, float]], grid: list[float]
) -> None:
    x, y = (np.array(column, np.float64) for column in zip(*sorted(evaluations), strict=True))
    for at, value in zip(grid, step_values(x, y, np.array(grid)), strict=True):
        if at < x[0]:
            assert np.isnan(value)
        else:
            assert value == held(evaluations, at)


@given(runs=st.lists(points, min_size=1, max_size=6))
def test_the_mean_of_solved_runs_is_exact_everywhere_and_goes_on_with_their_last_values(
    runs: list[list[tuple[int, float]]],
) -> None:
    curve = mean_curve([curves(run) for run in runs], "interactions", "success")
    assert curve.x[0] == max(min(run)[0] for run in runs)
    assert curve.x[-1] == max(max(run)[0] for run in runs)
    for x, mean, low, high in zip(curve.x, curve.mean, curve.low, curve.high, strict=True):
        values = [held(run, x) for run in runs]
        assert mean == pytest.approx(np.mean(values))
        assert 0 <= low <= mean <= high <= 1
        assert min(values) - 1e-12 <= low
        assert high <= max(values) + 1e-12


@given(runs=st.lists(points, min_size=1, max_size=5), unsolved=points)
def test_the_mean_ends_with_the_first_run_that_ends_unsolved(
    runs: list[list[tuple[int, float]]], unsolved: list[tuple[int, float]]
) -> None:
    all_runs = [curves(unsolved, solved=False), *(curves(run) for run in runs)]
    begin, end = max(min(run)[0] for run in (unsolved, *runs)), max(unsolved)[0]
    if end < begin:
        with pytest.raises(RunError, match="no stretch in common"):
            common_grid(all_runs, "interactions")
    else:
        grid = common_grid(all_runs, "interactions")
        assert (grid[0], grid[-1]) == (begin, end)
        assert not np.isnan(mean_curve(all_runs, "interactions", "success").mean).any()


@given(evaluations=points, solved=st.booleans())
def test_one_run_is_drawn_as_it_was_without_an_interval(evaluations: list[tuple[int, float]], solved: bool) -> None:
    run = curves(evaluations, solved=solved)
    curve = mean_curve([run], "time", "success")
    assert curve.runs == 1
    for one, other in ((curve.x, run.columns["time"]), *((y, run.columns["success"]) for y in (curve.mean, curve.low))):
        np.testing.assert_array_equal(one, other)


def test_the_interval_is_that_of_all_samples_of_the_runs() -> None:
    values = [0.2, 0.4, 0.9, 1.0]
    means = sorted(sum(drawn) / 4 for drawn in itertools.product(values, repeat=4))
    curve = mean_curve([curves([(1, value)]) for value in values], "interactions", "success")
    assert curve.mean == pytest.approx([0.625])
    assert (curve.low[0], curve.high[0]) == pytest.approx((means[6], means[-7]))  # 2.5 % of 256 at either end


def test_runs_that_all_succeed_leave_no_doubt_of_each_other() -> None:
    curve = mean_curve([curves([(1, 0.5), (at, 1.0)]) for at in (2, 3, 4)], "interactions", "success")
    assert (curve.low[-1], curve.mean[-1], curve.high[-1]) == (1, 1, 1)


def test_the_same_runs_always_have_the_same_interval() -> None:
    runs = [curves([(1, value), (2, 1 - value)]) for value in (0.13, 0.2, 0.41, 0.55, 0.62, 0.77, 0.9)]
    first, second = (mean_curve(runs, "interactions", "success") for _ in range(2))
    np.testing.assert_array_equal((first.low, first.high), (second.low, second.high))


def test_a_run_directory_and_its_copy_in_the_results_read_alike(tmp_path: Path) -> None:
    kept = RESULTS / "tasks" / "t4nmtd" / "task7-s0"
    (tmp_path / "metrics").mkdir()
    shutil.copy(kept / "evaluations.csv", tmp_path / "metrics")
    shutil.copy(kept / "summary.json", tmp_path)
    run, copy = read_run(tmp_path), read_run(kept)
    assert (run.task, run.solved) == (copy.task, copy.solved) == ("task7", True)
    for name, column in copy.columns.items():
        np.testing.assert_array_equal(run.columns[name], column)
    time, interactions, success, length, *_ = (
        (kept / "evaluations.csv").read_text(encoding="utf-8").split()[-1].split(",")
    )
    last = {"interactions": interactions, "time": time, "success": success, "length": length}
    assert {name: copy.columns[name][-1] for name in last} == {name: float(text) for name, text in last.items()}


def test_a_run_that_goes_on_counts_as_unsolved(tmp_path: Path) -> None:
    run = read_run(run_directory(tmp_path / "run", "1.0,100,1.0,5,0,66", solved=None))
    assert (run.task, run.solved) == ("task7", False)


@given(starts=st.lists(st.integers(1, 30), min_size=1, max_size=4), length=st.integers(1, 6))
def test_of_a_stretch_that_a_resumed_run_repeated_the_last_time_counts(
    starts: list[int], length: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    at = [start + step for start in starts for step in range(length)]  # each start: a checkpoint gone back to
    rows = [f"{at_step},{at_step},{number},5,0,1" for number, at_step in enumerate(at)]
    run = read_run(run_directory(tmp_path_factory.mktemp("runs") / "run", *rows))
    last: dict[int, int] = {}
    for number, at_step in enumerate(at):
        last = {x: y for x, y in last.items() if x < at_step} | {at_step: number}
    assert run.columns["interactions"].tolist() == list(last)
    assert run.columns["success"].tolist() == list(last.values())


DAMAGED = {
    "no column 'success_rate'": (("1,100",), "elapsed_s,interactions"),
    "is damaged: could not convert": (("1,100,?,5,0,1",), HEADER),
    "is damaged: could not convert string to float: ''": (("1,100",), HEADER),
    "must be finite": (("nan,100,1,5,0,1",), HEADER),
    "elapsed_s falls": (("2,100,1,5,0,1", "1,200,1,5,0,1"), HEADER),
    "has no evaluation yet": ((), HEADER),
}


@pytest.mark.parametrize(("text", "content"), DAMAGED.items())
def test_damaged_evaluations_are_named(text: str, content: tuple[tuple[str, ...], str], tmp_path: Path) -> None:
    rows, header = content
    with pytest.raises(RunError, match=text):
        read_run(run_directory(tmp_path / "run", *rows, header=header))


@pytest.mark.parametrize("summary", ["{", "[]", "{}", '{"task": "task7"}'])
def test_a_damaged_summary_is_named(summary: str, tmp_path: Path) -> None:
    run = run_directory(tmp_path / "run", "1,100,1,5,0,1")
    (run / "summary.json").write_text(summary, encoding="utf-8")
    with pytest.raises(RunError, match=r"summary\.json"):
        read_run(run)


def test_a_folder_that_holds_runs_is_answered_with_their_names(tmp_path: Path) -> None:
    run_directory(tmp_path / "s0", "1,100,1,5,0,1")
    with pytest.raises(RunError, match=f"name them: {tmp_path}/s0"):
        read_run(tmp_path)
    with pytest.raises(RunError, match="expected a run directory"):
        read_run(tmp_path / "nothing")
