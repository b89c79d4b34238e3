"""The policies in benchmarks/policies still do what was reported of them, and the tables are those of their runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from benchmark_modules import BENCHMARKS
from safetensors import safe_open

from t4nmtd_dist.cli.evaluate import evaluate
from t4nmtd_dist.experiments.arms import experiment
from t4nmtd_dist.experiments.results import read_results
from t4nmtd_dist.experiments.tables import run_table
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
    run = BENCHMARKS / "results" / "tasks" / "t4nmtd" / f"{folder.name}-s{policy['about']['seed']}"
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert summary["solved"]
    assert summary["task"] == policy["task"]["name"] == folder.name
    assert summary["interactions"] <= policy["about"]["interactions"] <= summary["interactions_total"]


def test_evaluate_takes_the_folder_of_a_kept_policy(capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(POLICIES[-1], episodes=2, seed=FRESH_SEED, perturb=0, as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 2


# The table


def test_the_tables_of_the_documentation_are_those_of_the_kept_runs() -> None:
    lines = run_table(read_results(experiment("tasks"), BENCHMARKS / "results")).splitlines()
    text = (BENCHMARKS.parent / "docs" / "results.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 2 + 28 + 8
    assert set(lines) <= set(text)
