"""The policies in benchmarks/policies still do what was reported of them, and how they and the table come about."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from benchmark_modules import BENCHMARKS, benchmark
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open

from t4nmtd_dist.cli.evaluate import evaluate
from t4nmtd_dist.policy.evaluation import Evaluator
from t4nmtd_dist.policy.loading import load

POLICIES = sorted(path for path in (BENCHMARKS / "policies").glob("*") if path.is_dir())
EPISODES, FRESH_SEED = 10, 987_654
RANDOM_RESETS = "HalfCheetah"  # one of ten episodes may fail there; all other environments begin in one state
MOST_BYTES = 2_000_000


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def by_task(path: Path) -> str:
    return path.name


# Policies


def test_there_are_kept_policies() -> None:
    assert POLICIES, "benchmarks/policies is empty or missing"


@pytest.mark.slow
@pytest.mark.parametrize("folder", POLICIES, ids=by_task)
def test_a_kept_policy_succeeds_from_the_reset_with_a_fresh_seed(folder: Path) -> None:
    policy = load(folder)
    result = Evaluator(policy, EPISODES, seed=FRESH_SEED).run(policy)
    assert len(result.success) == EPISODES
    assert result.success.sum() >= EPISODES - (RANDOM_RESETS in policy.config.environment.id)


@pytest.mark.parametrize("folder", POLICIES, ids=by_task)
def test_a_kept_policy_is_small_and_holds_actors_alone(folder: Path) -> None:
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert {path.name for path in files} == {"policy.json", "actors.safetensors"}
    assert sum(path.stat().st_size for path in files) <= MOST_BYTES
    with safe_open(folder / "actors.safetensors", "numpy") as arrays:
        assert [name for name in arrays.keys() if not name.partition("/")[2].startswith("actor.")] == []  # noqa: SIM118


@pytest.mark.parametrize("folder", POLICIES, ids=by_task)
def test_a_kept_policy_is_of_a_solved_run_among_the_results(folder: Path) -> None:
    policy = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
    run = BENCHMARKS / "results" / f"{folder.name}-s{policy['about']['seed']}"
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert summary["solved"]
    assert summary["task"] == policy["task"]["name"] == folder.name
    assert summary["interactions"] <= policy["about"]["interactions"] <= summary["interactions_total"]


def test_evaluate_takes_the_folder_of_a_kept_policy(capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(POLICIES[-1], episodes=2, seed=FRESH_SEED, perturb=0, as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 2


# How they are kept


@pytest.fixture(scope="module")
def train_tasks() -> ModuleType:
    return benchmark("train_tasks")


def small_run(home: Path, seed: int, *, solved: bool = True, rows: int = 3, policy_bytes: int = 10) -> Path:
    """A finished run with what is kept of one; its interactions are a thousand for every seed."""
    run = home / "runs" / f"task9-s{seed}"
    for folder in ("metrics", "policy"):
        (run / folder).mkdir(parents=True)
    summary = {
        "task": "task9", "seed": seed, "solved": solved, "interactions": 1000 * seed, "wall_s": 60.0 + seed,
        "gradient_steps": 500, "intervention": {"asked": 200, "own_used": 2 * seed},
    }  # fmt: skip
    (run / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    (run / "policy" / "policy.json").write_text(f'{{"about": {{"seed": {seed}}}}}', encoding="utf-8")
    (run / "policy" / "actors.safetensors").write_bytes(bytes(policy_bytes))
    for name in ("config.toml", "versions.json"):
        (run / name).write_text("", encoding="utf-8")
    for name in ("evaluations", "p1"):
        lines = ["elapsed_s,interactions", *(f"{row},{10 * row}" for row in range(rows))]
        (run / "metrics" / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return run


def kept(train_tasks: ModuleType, home: Path, seed: int, success: float = 1.0, **options: Any) -> None:
    run = small_run(home, seed, **options)
    evaluation = {name: {"mean_length": 10.0 + seed, "success_rate": success} for name in ("plain", "perturbed")}
    train_tasks.keep(run, run.name, evaluation, home)
    train_tasks.keep_policy(run, "task9", seed, home)


def kept_seed(home: Path) -> int | None:
    path = home / "policies" / "task9" / "policy.json"
    return int(json.loads(path.read_text(encoding="utf-8"))["about"]["seed"]) if path.exists() else None


def test_the_policy_of_the_lowest_good_seed_is_kept(train_tasks: ModuleType, tmp_path: Path) -> None:
    def seeds() -> Iterator[int | None]:
        for seed, solved, success in (
            (0, False, 1.0),
            (3, True, 1.0),
            (4, True, 1.0),
            (1, True, 0.96),
            (2, True, 0.97),
        ):
            kept(train_tasks, tmp_path, seed, success, solved=solved)
            yield kept_seed(tmp_path)

    assert list(seeds()) == [None, 3, 3, 3, 2]


def test_runs_begin_go_on_or_are_left_alone(train_tasks: ModuleType, tmp_path: Path) -> None:
    def command() -> list[str]:
        found: list[str] = train_tasks.training_command("task9", 1, run, ["sac.batch=8", "learner.gamma=0.9"])
        return found

    run = tmp_path / "task9-s1"
    begun = command()
    assert begun[:2] == ["t4nmtd", "train"]
    assert begun[-4:] == ["--set", "sac.batch=8", "--set", "learner.gamma=0.9"]
    run.mkdir()
    killed = command()
    assert killed == ["t4nmtd", "train", "--resume", str(run), "--no-dashboard"]
    for outcome, resumed in (("stopped", True), ("solved", False), ("budget spent", False), (None, True)):
        (run / "summary.json").write_text(json.dumps({"outcome": outcome}), encoding="utf-8")
        assert command() == (killed if resumed else []), outcome


def test_a_policy_that_is_too_large_is_refused(
    train_tasks: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept(train_tasks, tmp_path, 1, policy_bytes=MOST_BYTES)
    assert kept_seed(tmp_path) is None
    message = capsys.readouterr().err
    assert "task9-s1" in message
    assert "more than 2,000,000" in message


def test_long_metrics_are_thinned_and_evaluations_are_whole(train_tasks: ModuleType, tmp_path: Path) -> None:
    kept(train_tasks, tmp_path, 1, rows=1001)
    result = tmp_path / "results" / "task9-s1"
    assert len((result / "evaluations.csv").read_text(encoding="utf-8").splitlines()) == 1002
    lines = (result / "metrics" / "p1.csv").read_text(encoding="utf-8").splitlines()
    assert (len(lines), lines[0], lines[1], lines[-1]) == (201, "elapsed_s,interactions", "0,0", "1000,10000")
    assert not (result / "metrics" / "evaluations.csv").exists()


@given(rows=st.integers(0, 60), most=st.integers(2, 20))
def test_thinned_rows_are_in_order_and_evenly_spaced(rows: int, most: int) -> None:
    header, *found = benchmark("train_tasks").thinned(["header", *map(str, range(rows))], most)
    numbers = [int(row) for row in found]
    assert header == "header"
    assert len(numbers) == min(rows, most)
    gaps = {b - a for a, b in itertools.pairwise(numbers)}
    assert not gaps or (min(gaps) >= 1 and max(gaps) - min(gaps) <= 1)
    assert not numbers or (numbers[0], numbers[-1]) == (0, rows - 1)


def test_the_table_is_made_from_what_is_kept(train_tasks: ModuleType, tmp_path: Path) -> None:
    for seed, solved in ((12, False), (4, True), (2, True)):
        kept(train_tasks, tmp_path, seed, solved=solved)
    _, _, *lines = train_tasks.table(train_tasks.read_rows(tmp_path))
    assert lines == [
        "| task9 | 2 | yes | 2,000 | - | 62 | 500 | 12 | 100% | 100% | 2.0% |",
        "| task9 | 4 | yes | 4,000 | - | 64 | 500 | 14 | 100% | 100% | 4.0% |",
        "| task9 | 12 | no | 12,000 | - | 72 | 500 | 22 | 100% | 100% | 12.0% |",
        "| task9 | mean | 2 of 3 | 3,000 | - | 63 | 500 | 13 | 100% | 100% | 6.0% |",
    ]


def test_interactions_are_compared_to_the_papers(
    train_tasks: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(train_tasks.PAPER, "task9", 8000.0)
    kept(train_tasks, tmp_path, 1)
    kept(train_tasks, tmp_path, 2)
    _, _, *lines = train_tasks.table(train_tasks.read_rows(tmp_path))
    assert [line.split(" | ")[4] for line in lines] == ["12.5%", "25.0%", "18.8%"]


def test_a_task_that_no_run_solved_has_no_mean_count(train_tasks: ModuleType, tmp_path: Path) -> None:
    kept(train_tasks, tmp_path, 1, solved=False)
    *_, mean = train_tasks.table(train_tasks.read_rows(tmp_path))
    assert mean == "| task9 | mean | 0 of 1 | - | - | - | - | - | 100% | 100% | 1.0% |"


def test_the_table_of_the_repository_has_every_result() -> None:
    module = benchmark("train_tasks")
    results = list((BENCHMARKS / "results").glob("*-s*"))
    rows = module.read_rows()
    assert {f"{row.task}-s{row.seed}" for row in rows} == {path.name for path in results}
