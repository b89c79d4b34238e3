"""``t4nmtd check``: what it finds in good tasks and in bad ones, and with which exit code."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from small_tasks import own_task

from t4nmtd_dist.cli.check import check
from t4nmtd_dist.core.errors import ConfigError, EnvError

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
    with pytest.raises(EnvError, match=message):
        check(str(own_task(tmp_path, text.replace(old, new))), steps=100, seed=0, flags=(), as_json=False)


def test_the_page_tells_the_same_to_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(str(own_task(tmp_path, CORRIDOR)), steps=300, seed=0, flags=(), as_json=False) == 0
    page = " ".join(capsys.readouterr().out.split())
    for words in ("Discrete(7): 7 numbers", "restore exactly by 'attributes'", "4 states, 9 transitions", "usable"):
        assert words in page


def test_steps_must_be_some(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--steps 0"):
        check("task7", steps=0, seed=0, flags=(), as_json=False)


# Observations


def warned(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], *flags: str) -> tuple[list[str], Any]:
    text = CORRIDOR.replace("Corridor", name).replace("& G(!again)", "")
    code, found = checked(str(own_task(tmp_path, text)), capsys, *flags)
    assert code == 0
    return [text for text in found["warnings"] if text.startswith("observation")], found


OFF = "learner.normalise_observations=off"


def test_raw_cell_numbers_are_warned_of_normalised_or_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for flags in ((), (OFF,)):
        (text,), found = warned("Cells", tmp_path, capsys, 'environment.options={kind="float"}', *flags)
        assert text.startswith("observation[1] looks like a raw cell number (whole, 0..6): one-hot learns better")
        assert "MultiDiscrete" in text
        assert found["normalised"] == (not flags)


def test_cell_numbers_that_become_one_hot_are_fine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = warned("Cells", tmp_path, capsys)[1]
    assert found["observations"] == [{"name": "observation", "size": 8, "one_hot": True, "seen": [0.0, 1.0]}]
    assert found["normalised"] is False
    assert warned("Cells", tmp_path, capsys)[0] == warned("Corridor", tmp_path, capsys)[0] == []
    (text,), found = warned("Cells", tmp_path, capsys, "environment.options={columns=40}")
    assert text.startswith("observation[1] looks like a raw cell number (whole, 0..39): one-hot learns better")
    assert found["observation_size"] == 2


def test_numbers_without_bounds_and_far_from_0_are_warned_of_unless_normalised(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    texts, found = warned("Wavering", tmp_path, capsys)
    assert (texts, found["normalised"]) == ([], True)
    (text,), found = warned("Wavering", tmp_path, capsys, OFF)
    assert "1 of its 1 numbers has no finite bounds; seen: " in text
    assert 'learner.normalise_observations = "on"' in text
    assert found["observations"][0]["seen"][1] > 100
    (text,), _ = warned("Missions", tmp_path, capsys, OFF, 'environment.leave_out=["mission"]')
    assert text.startswith("observation['image']: 21 of its 21 numbers have bounds of 0..255; seen: 0..10")
    assert warned("Missions", tmp_path, capsys, 'environment.leave_out=["mission"]')[0] == []
    assert warned("Mixed", tmp_path, capsys, OFF)[0] == []


def test_the_page_says_that_observations_are_normalised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = CORRIDOR.replace("Corridor", "Missions").replace("horizon", 'leave_out = ["mission"]\nhorizon')
    assert check(str(own_task(tmp_path, text)), steps=50, seed=0, flags=(), as_json=False) == 0
    page = " ".join(capsys.readouterr().out.split())
    assert "25 numbers, 4 of them one-hot, the others normalised by what each learner sees" in page


def test_the_packages_own_observations_are_not_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    for flags in ((), ('environment.options={goals=1, observation="raw"}',)):
        code, found = checked("task7", capsys, *flags, steps=50)
        assert code == 0
        assert [text for text in found["warnings"] if text.startswith("observation")] == []
        assert found["normalised"] is False


@pytest.mark.parametrize("command", ["train --serial", "train --no-dashboard"])
@pytest.mark.command
def test_warnings_come_before_a_training_too(command: str, tmp_path: Path) -> None:
    text = CORRIDOR.replace("Corridor", "Wavering").replace("& G(!again)", "")
    arguments = f"{command} --task {own_task(tmp_path, text)} --max-interactions 100 --run-dir {tmp_path / 'run'}"
    program = [sys.executable, "-m", "t4nmtd_dist.cli.main", *arguments.split(), "--set", OFF]
    done = subprocess.run(program, capture_output=True, text=True, timeout=110)
    assert done.returncode == 3, done.stderr
    lines = [line for line in done.stderr.splitlines() if "no finite bounds" in line]
    assert [line.startswith("t4nmtd: warning: observation: 1 of its 1 numbers") for line in lines] == [True]
