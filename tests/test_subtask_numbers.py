"""Sub-tasks by number: p1 is the first where no sub-task has such a name; commands that name them can be pasted."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from coordinator_events import Conversation
from hypothesis import given
from hypothesis import strategies as st

from coordinator.numbering import numbered
from coordinator.snapshot import dashboard_state, missing, status
from coordinator.worker_commands import WorkerCommands
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.tasks import load_task
from t4nmtd_dist.wire.addresses import split_endpoint
from t4nmtd_dist.wire.messages import Claim, Granted, Missing
from workers.state import Exit, Print, SendClaim, SendRelease, StartWork, WorkerState

ENDPOINT = "tcp://127.0.0.1:5570"
NAMES = st.text("abcpgh~&|_0123456789", min_size=1, max_size=6)


def task5() -> Conversation:
    return Conversation(task=compile_task(load_task("task5")))


def worker(*pids: str) -> WorkerState:
    return WorkerState("learner", "w", pids, ENDPOINT, "tcp://127.0.0.1:9001", 60.0, now=0.0)


def test_a_number_is_granted_as_the_name_behind_it() -> None:
    granted = task5().claim("p2")
    assert (granted.pid, granted.asked) == ("g2", "p2")


def test_a_name_is_granted_as_itself_and_none_as_any() -> None:
    talk = task5()
    assert (talk.claim("g3").pid, talk.claim("g3").asked) == ("g3", "g3")
    granted = talk.claim(None, "other")
    assert (granted.pid, granted.asked) == ("g1", "")


def test_names_win_over_numbers_and_no_number_is_granted_beside_them() -> None:
    talk = Conversation()
    assert talk.claim("p1").pid == "p1"
    refused = talk.refused("p4", "w")
    assert (refused.reason, refused.final) == ("unknown pid", True)
    assert refused.text.endswith("the sub-tasks of task7 are g, p1, p2, p3")


def test_a_refusal_lists_names_with_numbers() -> None:
    talk = task5()
    assert "g1 (p1), g2 (p2), g3 (p3), g4 (p4)" in talk.refused("p5", "w").text
    talk.claim("g2", "first")
    refused = talk.refused("p2", "second")
    assert refused.text.startswith("p2 is g2; g2 is held by first")
    assert refused.pid == "g2"


@given(st.lists(NAMES, unique=True, max_size=6))
def test_numbers_never_collide_with_names(pids: list[str]) -> None:
    numbers = numbered(pids)
    assert set(numbers) & set(pids) == set()
    assert list(numbers.values()) in ([], pids)


def grants(state: WorkerState, talk: Conversation, now: float) -> list[object]:
    """Let a worker claim what is due now from a coordinator, and hear the answers; all that it does then."""
    talk.now = now
    answers = [talk.answer("w", ask.claim) for ask in state.tick(now) if isinstance(ask, SendClaim)]
    return [action for message in answers for action in state.receive(now, message)]


def test_a_worker_holds_the_subtask_behind_its_number_and_says_so() -> None:
    state, talk = worker("p1"), task5()
    done = grants(state, talk, 0.0)
    assert [type(action) for action in done] == [StartWork, Print]
    assert done[1] == Print("p1 is g1; holds g1 (epoch 1)")
    assert state.held == ["g1"]
    assert grants(state, talk, 30.0) == []


def test_a_worker_claims_its_number_again_from_a_coordinator_started_again() -> None:
    state, first, second = worker("p2"), task5(), task5()
    grants(state, first, 0.0)
    refused = second.answer("w", first.sync_message("g2", "w"))
    assert not [action for action in state.receive(1.0, refused) if isinstance(action, Exit)]
    done = grants(state, second, 1.1)
    assert [type(action) for action in done] == [StartWork, Print]
    assert state.held == ["g2"]


@pytest.mark.parametrize("pids", [("p1", "g1"), ("g1", "p1"), ("p1", "p1"), ("g1", "g1")])
def test_a_subtask_asked_for_twice_is_held_once(pids: tuple[str, str]) -> None:
    state, talk = worker(*pids), task5()
    done = [action for step in range(100) for action in grants(state, talk, step * 0.1)]
    assert state.held == ["g1"]
    assert not [action for action in done if isinstance(action, SendRelease | Exit)]
    lease = talk.state.leases.get("g1")
    assert lease is not None
    assert lease.epoch <= 2


@given(st.lists(NAMES, unique=True, min_size=1, max_size=6), st.sampled_from([None, Path("/a key's folder")]))
def test_a_shell_reads_the_commands_as_the_worker_needs_them(pids: list[str], keys: Path | None) -> None:
    numbers = {pid: number for number, pid in numbered(pids).items()}
    commands = WorkerCommands(pids, "tcp://127.0.0.1:7000", keys)
    where = ["--connect", "tcp://127.0.0.1:7000", *([] if keys is None else ["--keys", str(keys)])]
    for pid in pids:
        command = ["t4nmtd-worker", "--pid", numbers.get(pid, pid), *where]
        assert shlex.split(commands.learner(pid)) == command
        assert any(shlex.split(line, comments=True) == command for line in commands.welcome("own").splitlines()[1:])


def test_the_default_endpoint_is_left_out_and_all_addresses_become_one() -> None:
    assert WorkerCommands(["a"], ENDPOINT).learner("a") == "t4nmtd-worker --pid p1"
    assert WorkerCommands(["a"], ENDPOINT).evaluator() == "t4nmtd-worker --evaluate"
    command = shlex.split(WorkerCommands(["a"], "tcp://0.0.0.0:7000").learner("a"))
    host, port = split_endpoint(command[command.index("--connect") + 1])
    assert (host != "0.0.0.0", port) == (True, "7000")


def commands(talk: Conversation) -> WorkerCommands:
    return WorkerCommands(talk.state.task.decomposition.pids, ENDPOINT)


def lacks(talk: Conversation) -> list[str]:
    talk.tick()
    return [lack.text for lack in missing(talk.state, commands(talk))]


EVALUATOR = "no evaluator: t4nmtd-worker --evaluate (until then workers evaluate between their turns)"


def test_what_is_missing_is_named_with_its_command_until_it_comes_and_when_it_is_lost() -> None:
    talk = task5()
    for number in (2, 3, 4):
        talk.claim(f"p{number}", f"w{number}")
    first = "missing g1: t4nmtd-worker --pid p1"
    assert lacks(talk) == [first, EVALUATOR]
    talk.claim("g1", "w1")
    assert lacks(talk) == [EVALUATOR]
    talk.claim_evaluator("e")
    assert lacks(talk) == []
    talk.now = 11.0
    for number in (2, 3, 4):
        talk.sync(f"g{number}", f"w{number}")
    assert lacks(talk) == [first, EVALUATOR]


def test_screens_and_status_get_what_is_missing_only_where_people_start_workers() -> None:
    talk = task5()
    expected = missing(talk.state, commands(talk))
    assert expected[0] == Missing(what="g1", command="t4nmtd-worker --pid p1")
    assert dashboard_state(talk.state, commands(talk)).missing == expected
    assert status(talk.state, 0.0, commands(talk)).missing == expected
    assert dashboard_state(talk.state).missing == status(talk.state, 0.0).missing == []


def test_a_claim_by_number_is_still_a_claim_of_the_evaluator() -> None:
    granted = task5().answer("e", Claim(role="evaluator", instance="e", pid="p1"))
    assert isinstance(granted, Granted)
    assert granted.pid == "evaluator"
