"""The examples: each is one short module and one task file, fits together, and is trained with the settings it has."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest
from processes import Processes

EXAMPLES = Path(__file__).parent.parent / "examples"
NAMES = ("balance", "courier", "doorkey", "reacher")
MOST_LINES = 60
MOST_SETTINGS = 3
LEAST_SUCCESS = 0.97


@pytest.mark.parametrize("name", NAMES)
def test_an_example_is_short_and_needs_few_settings(name: str) -> None:
    assert len((EXAMPLES / f"{name}.py").read_text(encoding="utf-8").splitlines()) <= MOST_LINES
    task = tomllib.loads((EXAMPLES / f"{name}.toml").read_text(encoding="utf-8"))
    tuned = [
        task.get(section, {}) for section in ("learner", "ppo", "sac", "evaluation", "high_level", "decomposition")
    ]
    assert sum(map(len, tuned)) <= MOST_SETTINGS


@pytest.mark.parametrize("name", NAMES)
def test_an_example_fits_together(name: str, commands: Processes) -> None:
    checked = commands.start("t4nmtd", "check", str(EXAMPLES / f"{name}.toml"), "--steps", "500", "--json")
    assert checked.wait(60) == 0, checked.story()
    found = json.loads(checked.out)
    assert found["problems"] == []
    assert found["snapshots"]["adapter"] != "replay"


@pytest.mark.training
@pytest.mark.timeout(420)
@pytest.mark.parametrize("name", [NAMES[0], *(pytest.param(name, marks=pytest.mark.nightly) for name in NAMES[1:])])
def test_an_example_is_learned(name: str, tmp_path: Path, commands: Processes) -> None:
    run = tmp_path / "run"
    where = ["--task", str(EXAMPLES / f"{name}.toml"), "--seed", "100", "--run-dir", str(run), "--no-dashboard"]
    training = commands.start("t4nmtd", "train", *where)
    assert training.wait(300) == 0, training.story()
    evaluation = commands.start("t4nmtd", "evaluate", str(run), "--episodes", "100", "--seed", "4711", "--json")
    assert evaluation.wait(100) == 0, evaluation.story()
    assert json.loads(evaluation.out)["success_rate"] >= LEAST_SUCCESS
