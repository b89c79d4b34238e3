"""A learner that reaches no target says so, with likely causes and settings to try."""

from __future__ import annotations

import json
import math
import time

import msgspec
import numpy as np
import pytest
from coordinator_events import Conversation, of
from hypothesis import given
from hypothesis import strategies as st
from small_tasks import INTO_HOLE, PICK, TO_PASSENGER_2, small_learner, small_task

from coordinator.events import LogEvent
from coordinator.learner_registry import LearnerRecord
from coordinator.run_settings import RunSettings
from coordinator.snapshot import dashboard_state, status
from coordinator.stuck import stuck_lines
from t4nmtd_dist.cli.status import page
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.wire.messages import LearnerStats
from t4nmtd_dist.wire.statistics import counted_since

STUCK = LearnerStats(
    phase="training",
    interactions=400_000,
    attempts=16_420,
    successes=18,
    recent_success=0.0,
    errors=1000,
    timeouts=15_000,
    terminated=402,
)


def record(stats: LearnerStats) -> LearnerRecord:
    made = LearnerRecord(InitialStateBuffer(10))
    made.update(stats, 0.0)
    return made


def lines(pid: str, **others: LearnerStats) -> list[str]:
    """What is said of a learner of task 7; of those that are not named nothing is known."""
    task = small_task()
    return stuck_lines(pid, {each: record(others.get(each, LearnerStats())) for each in task.decomposition.pids}, task)


def test_a_stuck_learner_names_counts_causes_and_settings() -> None:
    first, cause, cure = lines("p1", p1=STUCK)
    assert first == (
        "p1: 18 of 16,420 attempts reached a target; 91% ran out of time, 6% ended in an error state, "
        "2% were ended by the environment"
    )
    assert cause.startswith("p1: likely causes: ")
    assert "learner.attempt_steps" in cure


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"timeouts": 16_402, "errors": 0, "terminated": 0}, ("further away", "learner.attempt_steps")),
        ({"timeouts": 0, "errors": 16_402, "terminated": 0}, ("error state", "learner.error_penalty")),
        ({"timeouts": 0, "errors": 0, "terminated": 16_402}, ("terminated", "t4nmtd check")),
        ({"timeouts": 0, "errors": 0, "terminated": 0}, ("another DFA state", "t4nmtd inspect")),
        ({"successes": 0}, ("0 of 16,420", "100,000")),
    ],
)
def test_what_is_said_depends_on_how_attempts_end(changes: dict[str, int], words: tuple[str, ...]) -> None:
    told = "\n".join(lines("p1", p1=msgspec.structs.replace(STUCK, **changes)))
    assert [word for word in words if word not in told] == []


def test_a_learner_without_start_states_says_who_must_succeed_first() -> None:
    told = lines("g", p1=STUCK, p2=msgspec.structs.replace(STUCK, attempts=5, successes=0))
    assert told[0] == "g: no start state has come in 800,000 interactions of all learners, so it has made no attempt"
    assert "p1 (18 of 16,420 attempts), p2 (0 of 5 attempts)" in told[1]
    assert lines("g", p1=msgspec.structs.replace(STUCK, interactions=19_000)) == []


@given(
    interactions=st.integers(0, 10**7),
    attempts=st.integers(0, 10**6),
    share=st.floats(0, 1),
    recent=st.none() | st.floats(0, 1) | st.just(math.nan),
    ends=st.lists(st.integers(0, 10**6), min_size=3, max_size=3),
)
def test_who_succeeds_or_has_hardly_begun_is_left_alone(
    interactions: int, attempts: int, share: float, recent: float | None, ends: list[int]
) -> None:
    successes = int(attempts * share)
    stats = LearnerStats(
        phase="training",
        interactions=interactions,
        attempts=attempts,
        successes=successes,
        recent_success=recent,
        errors=ends[0],
        timeouts=ends[1],
        terminated=ends[2],
    )
    told = lines("p1", p1=stats)
    young = attempts < 2000 and interactions < 20_000
    good = successes > 0.01 * attempts or (recent is not None and recent >= 0.05)
    assert not told or not (young or good)
    if not young and not good and attempts >= 2000:
        assert told[0].startswith(f"p1: {successes:,} of {attempts:,} attempts reached a target")
    assert all(line.startswith("p1: ") and len(line) < 200 for line in told)


def test_it_is_told_once_and_again_after_ten_minutes() -> None:
    talk = Conversation()
    talk.claim("p1")

    def told(now: float, sequence: int) -> list[str]:
        talk.now = now
        actions = talk.send("w", talk.sync_message("p1", "w", sequence=sequence, stats=STUCK))
        return [action.text for action in of(LogEvent, actions) if "reached a target" in action.text]

    assert [len(told(now, n)) for n, now in enumerate((0.0, 5.0, 599.0, 601.0, 605.0), 1)] == [1, 0, 0, 1, 0]
    assert any("18 of 16,420" in event.text for event in dashboard_state(talk.state).events)


def test_status_and_dashboard_have_it_in_the_learners_row() -> None:
    talk = Conversation()
    talk.claim("p1")
    talk.sync("p1", "w", stats=STUCK)
    answer = status(talk.state, 0.0)
    hints = {row.pid: row.hint for row in answer.learners}
    assert hints["p1"].startswith("p1: 18 of 16,420 attempts reached a target")
    assert hints["p2"] == ""
    assert {row.pid: row.hint for row in dashboard_state(talk.state).learners} == hints
    assert "\n  p1: 18 of 16,420 attempts reached a target" in page(answer)
    assert json.loads(msgspec.json.encode(answer))["learners"]


def test_attempts_count_how_they_end() -> None:
    learner = small_learner("p2", "ppo.num_envs=1", "learner.attempt_steps=8")
    rollout, attempts = learner.rollout, learner.rollout.statistics
    assert rollout.begin()
    for way in (INTO_HOLE, (0,) * 8, (*TO_PASSENGER_2, PICK), INTO_HOLE):
        for action in way:
            rollout.step(np.array([action]))
    assert (attempts.attempts, attempts.successes) == (4, 1)
    assert (attempts.endings.errors, attempts.endings.timeouts, attempts.endings.terminated) == (0, 1, 2)
    other = small_learner("p2", "ppo.num_envs=1", "learner.attempt_steps=8").rollout
    other.load_state_dict(rollout.state_dict())
    assert other.statistics.endings == attempts.endings
    old = rollout.state_dict()
    old["counts"] = old["counts"][:3]
    other.load_state_dict(old)
    assert (other.statistics.attempts, other.statistics.endings.errors) == (4, 0)


def test_attempts_that_break_the_formula_count_as_errors() -> None:
    flags = ("formula=F(p1) & G(!p2)", "ppo.num_envs=1", "learner.attempt_steps=8")
    rollout = small_learner("p1", *flags).rollout
    assert rollout.begin()
    for action in (*TO_PASSENGER_2, PICK):
        rollout.step(np.array([action]))
    attempts = rollout.statistics
    assert (attempts.attempts, vars(attempts.endings)) == (1, {"errors": 1, "terminated": 0, "timeouts": 0})


def test_endings_are_counted_since_the_lease_began_and_added_over_epochs() -> None:
    since = counted_since(STUCK, msgspec.structs.replace(STUCK, errors=400, timeouts=1, terminated=2))
    assert (since.errors, since.timeouts, since.terminated) == (600, 14_999, 400)
    made = record(STUCK)
    made.begin_epoch()
    made.update(since, 1.0)
    assert (made.total.errors, made.total.timeouts, made.total.terminated) == (1600, 29_999, 802)


@pytest.mark.slow
def test_a_real_run_whose_attempts_are_too_short_says_so() -> None:
    run = SerialRun(small_task("learner.attempt_steps=2"), RunSettings(0, 10**9, lease_s=float("inf")), time.monotonic)
    for _ in range(300):
        run.round()
        if any("reached a target" in event.text for event in run.coordinator.events):
            break
    told = [event.text for event in run.coordinator.events if "attempts reached a target" in event.text]
    assert told
    assert "ran out of time" in told[0]
