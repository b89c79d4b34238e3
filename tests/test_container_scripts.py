"""What the containers' scripts do with a coordinator that ends in this way or that."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
from small_tasks import small_task

from coordinator.run_settings import RunSettings
from coordinator.snapshot import status
from coordinator.state import CoordinatorState

COMPOSE_TEST = Path(__file__).parent.parent / "deploy" / "test-compose.sh"
SCRIPT = Path(__file__).parent.parent / "deploy" / "container" / "t4nmtd-run-coordinator"
CRASHED, SOLVED = 9, 0
STAND_IN = """#!/bin/sh
echo "$@" >> calls
call=$(wc -l < calls)
while [ $# -gt 0 ]; do
  case $1 in --run-dir) [ "$call" -gt "$UNTIL" ] && mkdir -p "$2/checkpoints" && touch "$2/checkpoints/run.json" ;; esac
  shift
done
exit $(echo "$CODES" | cut -d' ' -f"$call")
"""


def calls(folder: Path, codes: Sequence[int], *, before_identity: int = 0, **settings: str) -> tuple[int, list[str]]:
    """The script's exit code, and with what it started a coordinator that ends with these codes one after the other."""
    program = folder / "bin" / "t4nmtd-coordinator"
    program.parent.mkdir()
    program.write_text(STAND_IN, encoding="utf-8")
    program.chmod(0o755)
    path = f"{program.parent}:{os.environ['PATH']}"
    given = {"PATH": path, "CODES": " ".join(map(str, codes)), "UNTIL": str(before_identity), "SEED": "5"}
    done = subprocess.run(["sh", str(SCRIPT)], cwd=folder, env={**given, "TASK": "task7", **settings}, timeout=60)
    return done.returncode, (folder / "calls").read_text(encoding="utf-8").splitlines()


def an_older_run(folder: Path, name: str) -> None:
    checkpoints = folder / "runs" / name / "old" / "checkpoints"
    checkpoints.mkdir(parents=True)
    (checkpoints / "run.json").write_text("{}", encoding="utf-8")
    (folder / "runs" / name / "latest").symlink_to("old")


def test_after_a_crash_its_own_run_goes_on(tmp_path: Path) -> None:
    an_older_run(tmp_path, "task7")
    code, (first, second) = calls(tmp_path, [CRASHED, SOLVED])
    run = first.split("--run-dir ")[1].split()[0]
    assert first.startswith("--task task7 --seed 5 --run-dir runs/task7/")
    assert run.endswith("-s5")
    assert second.startswith(f"--resume {run} --trust ")
    assert "--trust" not in first
    assert code == SOLVED


def test_a_coordinator_that_crashes_before_it_has_a_run_resumes_no_other(tmp_path: Path) -> None:
    an_older_run(tmp_path, "task7")
    assert calls(tmp_path, [CRASHED, SOLVED], before_identity=1)[0] == CRASHED


def test_a_resumed_run_is_resumed_again_whatever_the_task_is_by_default(tmp_path: Path) -> None:
    for name in ("task7", "task8"):
        an_older_run(tmp_path, name)
    code, told = calls(tmp_path, [CRASHED, CRASHED, SOLVED], RESUME="runs/task8/latest")
    assert (code, len(told)) == (SOLVED, 3)
    assert all(line.startswith("--resume runs/task8/latest ") for line in told)
    assert ["--trust" in line for line in told] == [False, True, True]


def test_a_resumed_run_is_trusted_from_the_start_only_where_the_user_says_so(tmp_path: Path) -> None:
    an_older_run(tmp_path, "task8")
    _, (told,) = calls(tmp_path, [SOLVED], RESUME="runs/task8/latest", TRUST="1")
    assert told.startswith("--resume runs/task8/latest --trust ")


@pytest.mark.parametrize("code", [2, 3, 130])
def test_an_end_that_is_none_of_its_doing_is_passed_on(code: int, tmp_path: Path) -> None:
    assert calls(tmp_path, [code])[0] == code


def test_it_gives_up_after_five_crashes(tmp_path: Path) -> None:
    code, told = calls(tmp_path, [CRASHED] * 10)
    assert (code, len(told)) == (CRASHED, 6)


def test_method_and_preset_are_passed_on(tmp_path: Path) -> None:
    _, (first,) = calls(tmp_path, [SOLVED], PRESET="paper", METHOD="random")
    assert first.startswith("--task task7 --method random --preset paper --seed 5 ")


def test_the_compose_test_asks_for_what_a_status_has() -> None:
    """Every Python expression of the script can be evaluated; one that cannot reads as "not yet" for ever."""
    script = COMPOSE_TEST.read_text(encoding="utf-8")
    state = CoordinatorState(small_task(), RunSettings(0, 1000))
    told = json.loads(json.dumps(msgspec.to_builtins(status(state, 0.0))))
    quoted = re.findall(r"""(?:until_true|\(ask) (?:'([^']+)'|"([^"\\]+)")""", script)
    learner = re.search(r'^learner="(.+)"$', script, re.MULTILINE)
    assert learner is not None
    expressions = [one or other for one, other in quoted if (one or other) != "$1"]
    assert len(expressions) >= 4
    for expression in expressions:
        filled = expression.replace("$learner", learner[1]).replace("$pid", "p1")
        eval(filled, {"s": told})  # noqa: S307 - the repository's own text
