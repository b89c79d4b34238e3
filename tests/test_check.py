"""``t4nmtd check``: what it finds in good tasks and in bad ones, and with which exit code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from small_tasks import own_task

from t4nmtd_dist.cli.check import check
from t4nmtd_dist.errors import ConfigError, WorldError

HERE = Path(__file__).parent

CORRIDOR = f"""
name = "corridor"
formula = "F(left & X(F(right))) & G(!again)"
propositions = ["left", "right", "again"]
acceptance = "first"
[environment]
id = "own_environments:Corridor"
path = "{HERE}"
horizon = 30
"""


def checked(task: str, capsys: pytest.CaptureFixture[str], *flags: str, steps: int = 300) -> tuple[int, dict[str, Any]]:
    code = check(task, steps=steps, seed=0, flags=flags, as_json=True)
    return code, json.loads(capsys.readouterr().out)


def test_a_sound_task_is_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = checked(str(own_task(tmp_path, CORRIDOR)), capsys)
    assert code == 0
    assert found["usable"]
    assert (found["observation_size"], found["action_space"], found["steps"]) == (7, "Discrete(2)", 300)
    assert found["snapshots"]["adapter"] == "attributes"
    assert found["snapshots"]["bytes"] % 64 == 0
    assert found["automaton"] == {"states": 4, "transitions": 9}
    assert found["subtasks"] == {"left": 1, "right": 1}
    assert 0 < found["labels"]["left"] < 1
    assert sum(found["endings"].values()) == found["episodes"] > 0
    assert found["never_true"] == found["problems"] == found["exclusive_violations"] == []


def test_labels_are_counted_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = CORRIDOR.replace("horizon = 30", 'horizon = 30\nlabels = "own_environments:nothing_holds"')
    code, found = checked(str(own_task(tmp_path, text)), capsys)
    assert code == 0
    assert found["labels"] == {"left": 0.0, "right": 0.0, "again": 0.0}
    assert found["never_true"] == ["left", "right", "again"]
    assert "never held under 300 random steps" in found["warnings"][0]


def test_an_exclusive_group_that_does_not_hold_makes_the_task_unusable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = CORRIDOR.replace("[environment]", 'exclusive = [["left", "again"]]\n[environment]')
    code, found = checked(str(own_task(tmp_path, text)), capsys)
    assert code == 2
    assert "exclusive says that left and again never hold together, but they did on" in found["problems"][0]
    assert found["exclusive_violations"][0]["together"] == ["left", "again"]


def test_actions_that_no_learner_can_take_make_the_task_unusable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = CORRIDOR.replace("own_environments:Corridor", "Pendulum-v1")
    text = text.replace("horizon = 30", 'horizon = 30\nlabels = "own_environments:nothing_holds"')
    code, found = checked(str(own_task(tmp_path, text)), capsys, 'learner.algorithm="ppo"')
    assert code == 2
    assert found["problems"] == [f"PPO needs a Discrete action space; Pendulum-v1 has {found['action_space']}"]
    assert found["snapshots"]["adapter"] == "attributes"


def test_a_replay_is_said_to_be_slow(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = CORRIDOR.replace("Corridor", "Opaque")
    code, found = checked(str(own_task(tmp_path, text)), capsys, steps=60)
    assert code == 0
    assert found["snapshots"]["adapter"] == "replay"
    assert list(found["snapshots"]["inexact"]) == ["attributes"]
    assert "by replaying actions from a seeded reset, which is slow" in found["warnings"][-1]


def test_the_packages_own_tasks_can_be_checked(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = checked("task7", capsys, steps=200)
    assert code == 0
    assert found["snapshots"] == {"adapter": "own", "bytes": 0, "inexact": {}}
    assert found["endings"].keys() <= {"terminated", "horizon", "error"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("own_environments:Corridor", "own_environments:Erratic", "cannot be put back into an earlier state"),
        ("horizon = 30", 'horizon = 30\nlabels = "own_environments:undeclared"', "reported 'middle'"),
        ("horizon = 30", 'horizon = 30\nlabels = "own_environments:raising"', "raised KeyError"),
        ('"left", "right", "again"]', '"left", "right"]', "again"),
    ],
)
def test_what_cannot_be_run_at_all_is_named(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = CORRIDOR.replace("& G(!again)", "") if "again" in old else CORRIDOR
    with pytest.raises(WorldError, match=message):
        check(str(own_task(tmp_path, text.replace(old, new))), steps=100, seed=0, flags=(), as_json=False)


def test_the_page_tells_the_same_to_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(str(own_task(tmp_path, CORRIDOR)), steps=300, seed=0, flags=(), as_json=False) == 0
    page = " ".join(capsys.readouterr().out.split())
    for words in ("Discrete(7): 7 numbers", "restore exactly by 'attributes'", "4 states, 9 transitions", "usable"):
        assert words in page


def test_steps_must_be_some(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--steps 0"):
        check("task7", steps=0, seed=0, flags=(), as_json=False)
