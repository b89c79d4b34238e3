"""Weights and start states that do not fit the task: dropped where they arrive, and nobody ends for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from coordinator_events import SIZES, Conversation, of, weights
from numpy.typing import NDArray
from small_sac import small_sac, small_sac_task
from small_tasks import START, TO_PASSENGER_2, small_learner, small_task, snapshot_after

from coordinator.events import LogEvent
from coordinator.run_settings import RunSettings
from coordinator.state import CoordinatorState
from t4nmtd_dist.agents.common.restarts import MOST_FAILURES
from t4nmtd_dist.agents.ppo.agent import PPOLearner
from t4nmtd_dist.agents.weight_checks import NetworkSizes, check_weights, expected_shapes
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.wire.messages import EvaluationJob, EvaluationPoll, Granted, LearnerStats, SyncReply
from workers.learner_session import LearnerSession

Arrays = dict[str, NDArray[Any]]


def changed(name: str, array: NDArray[Any]) -> Arrays:
    return weights() | {f"weights.{name}": array}


BAD_WEIGHTS: dict[str, Arrays] = {
    "not a number": changed("actor.0.bias", np.full(16, np.nan, np.float32)),
    "infinite": changed("critic.2.bias", np.full(1, np.inf, np.float32)),
    "of another type": {name: array.astype(np.float64) for name, array in weights().items()},
    "of another width": weights(1.0, "learner.hidden=[8]"),
    "of more layers": weights(1.0, "learner.hidden=[16, 16]"),
    "of another algorithm": weights(1.0, 'learner.algorithm="sac"'),
    "one missing": {name: array for name, array in weights().items() if name != "weights.critic.0.bias"},
    "one more": changed("more", np.zeros(1, np.float32)),
    "of no dimension": changed("actor.0.weight", np.zeros((), np.float32)),
    "inconsistent": changed("critic.0.weight", np.zeros((16, 99), np.float32)),
    "of no observation": weights(1.0, sizes=NetworkSizes(0, 2)),
    "nothing known": {"weights.w": np.zeros(3, np.float32)},
}


def tells(actions: list[Any]) -> list[str]:
    return [action.text for action in of(LogEvent, actions)]


@pytest.mark.parametrize("bad", BAD_WEIGHTS.values(), ids=BAD_WEIGHTS.keys())
@pytest.mark.parametrize("known", [True, False], ids=["with good ones before", "first of all"])
def test_unusable_weights_are_dropped_told_of_once_and_the_older_kept(bad: Arrays, known: bool) -> None:
    talk = Conversation()
    talk.claim("p1", "w")
    if known:
        talk.sync("p1", "w", version=1, sequence=1, arrays=weights(2.0))
    first = talk.send("w", talk.sync_message("p1", "w", sequence=2, version=5), bad)
    again = talk.send("w", talk.sync_message("p1", "w", sequence=3, version=6), bad)
    (text,) = tells(first)
    assert text.startswith("p1: weights of version 5 are dropped")
    assert tells(again) == []
    assert any(isinstance(action.message, SyncReply) for action in again if hasattr(action, "message"))
    record = talk.state.records["p1"]
    assert (record.version, record.sequence) == (int(known), 3)
    assert all((array == 2.0).all() for array in record.weights.values())
    talk.sync("p1", "w", sequence=4, version=7, arrays=weights(3.0))
    assert record.version == 7


def test_weights_of_all_learners_have_the_same_sizes_also_after_a_resume() -> None:
    talk = Conversation()
    for pid in ("p1", "p2"):
        talk.claim(pid, pid)
    talk.sync("p1", "p1", version=1, arrays=weights())
    others = weights(1.0, sizes=NetworkSizes(SIZES.observation + 1, SIZES.action))
    talk.sync("p2", "p2", version=1, arrays=others)
    assert talk.state.records["p2"].version == 0
    again = Conversation()
    for pid, record in again.state.records.items():
        record.load_state_dict(talk.state.records[pid].state_dict())
    again.claim("p2", "p2")
    again.sync("p2", "p2", version=1, arrays=others)
    assert again.state.records["p2"].version == 0


def test_a_version_that_could_never_be_exceeded_is_not_taken() -> None:
    talk = Conversation()
    talk.claim("p1", "w")
    talk.sync("p1", "w", version=2**53, arrays=weights())
    assert talk.state.records["p1"].version == 0


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_start_states_that_are_not_finite_are_dropped_and_the_rest_kept(number: float) -> None:
    talk = Conversation()
    talk.claim("p1", "w")
    bad = {"starts.q": np.array([1, 1], np.int32), "starts.state": np.array([[1.0, number], [1.0, 2.0]])}
    told = tells(talk.send("w", talk.sync_message("p1", "w"), bad))
    assert told == ["p1: 1 start states are dropped: they are not finite"]
    assert sum(len(record.buffer) for record in talk.state.records.values()) == 1


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_the_weights_of_real_learners_fit(algorithm: str) -> None:
    if algorithm == "ppo":
        task, learned = small_task(), small_learner("g").weights()
    else:
        task, learned = small_sac_task(), small_sac("g1").weights()
    sizes = check_weights(learned, task.config, task.dfa.states)
    assert expected_shapes(task.config, task.dfa.states, sizes) == {n: array.shape for n, array in learned.items()}


# The worker's side


def granted_with(arrays: Arrays, version: int = 4) -> tuple[Granted, Arrays]:
    state = CoordinatorState(small_task(), RunSettings(seed=0, max_interactions=10))
    talk = Conversation()
    talk.state = state
    granted = talk.claim("g")
    fields = {name: getattr(granted, name) for name in granted.__struct_fields__}
    return Granted(**{**fields, "version": version}), arrays


def own_weights() -> Arrays:
    return {f"weights.{name}": np.zeros_like(array) for name, array in small_learner("g").weights().items()}


BAD_FOR_WORKERS: dict[str, Callable[[Arrays], Arrays]] = {
    "not a number": lambda good: good | {"weights.actor.0.bias": np.full(16, np.nan, np.float32)},
    "of another shape": lambda good: good | {"weights.actor.0.bias": np.zeros(3, np.float32)},
    "one missing": lambda good: {name: array for name, array in good.items() if "critic.0.bias" not in name},
    "of another observation": lambda good: weights(1.0, sizes=NetworkSizes(3, 6)),
}


@pytest.mark.parametrize("bad", BAD_FOR_WORKERS.values(), ids=BAD_FOR_WORKERS.keys())
def test_a_learner_goes_on_without_unusable_weights_under_a_newer_version(bad: Callable[[Arrays], Arrays]) -> None:
    told: list[str] = []
    session = LearnerSession(*granted_with(bad(own_weights())), tell=told.append)
    fresh = LearnerSession(*granted_with({}, 0), tell=told.append)
    assert session.learner.version == 4, "what it learns must be newer than what the coordinator has"
    for name, array in session.learner.weights().items():
        assert array.tobytes() == fresh.learner.weights()[name].tobytes(), f"{name} was loaded in part"
    assert len(told) == 1
    assert told[0].startswith("g: learning goes on without the weights of version 4: ")


def test_a_learner_goes_on_from_usable_weights() -> None:
    told: list[str] = []
    session = LearnerSession(*granted_with(own_weights()), tell=told.append)
    assert all((array == 0).all() for array in session.learner.weights().values())
    assert told == []


# Start states on the worker's side

BAD_STATE = np.full(3, 10**9, np.int64)


def learner_with(*starts: tuple[int, NDArray[Any]]) -> tuple[PPOLearner, list[str]]:
    """A learner of the sub-task that begins after passenger 2; its environment refuses states like ``BAD_STATE``."""
    learner, told = small_learner("g", starts=starts), list[str]()
    learner.rollout.report_to(told.append)
    return learner, told


GOOD = (2, snapshot_after(*TO_PASSENGER_2))


def test_a_start_state_that_cannot_be_restored_is_dropped_and_another_taken() -> None:
    learner, told = learner_with(GOOD, (2, BAD_STATE), (2, BAD_STATE + 1), (2, BAD_STATE + 2))
    assert learner.rollout.begin()
    for _ in range(200):
        learner.rollout.step(np.zeros(4, np.int64))
    assert learner.rollout._restarts._buffer.count(2) == 1
    assert len(told) == 1
    assert "a start state of DFA state 2 is dropped" in told[0]
    assert np.isfinite(learner.rollout.observations).all()


def test_a_learner_whose_start_states_are_all_unusable_waits_for_others() -> None:
    learner, told = learner_with((2, BAD_STATE))
    assert not learner.rollout.begin()
    assert len(told) == 1
    assert not learner.rollout.begin()
    learner.rollout._restarts._buffer.add(*GOOD)
    assert learner.rollout.begin()


def test_a_world_that_restores_nothing_ends_with_what_is_wrong() -> None:
    many = [(2, BAD_STATE + number) for number in range(MOST_FAILURES + 5)]
    learner, _ = learner_with(*many)
    with pytest.raises(EnvError, match=r"(?s)in a row could not be restored.*t4nmtd check"):
        learner.rollout.begin()


def test_where_the_reset_is_a_start_bad_states_cost_nothing_but_a_line() -> None:
    learner = small_learner("p1", starts=((START, BAD_STATE),))
    told: list[str] = []
    learner.rollout.report_to(told.append)
    assert learner.rollout.begin()
    for _ in range(100):
        learner.rollout.step(np.zeros(4, np.int64))
    assert len(told) == 1


def test_a_learner_whose_weights_are_refused_does_not_stop_the_evaluations() -> None:
    talk = Conversation("evaluation.every=1")
    epoch = talk.claim_evaluator("e").epoch

    def train(number: int, p2: Arrays) -> None:
        stats = LearnerStats(phase="training", interactions=number, processor_s=100.0)
        for pid, arrays in (("p1", weights()), ("p2", p2)):
            talk.sync(pid, pid, sequence=number, version=number, stats=stats, arrays=arrays)

    def job() -> int:
        answer = talk.answer("e", EvaluationPoll(epoch=epoch))
        assert isinstance(answer, EvaluationJob)
        return answer.job

    for pid in ("p1", "p2"):
        talk.claim(pid, pid)
    train(1, weights())
    assert job() == 1
    train(2, BAD_WEIGHTS["not a number"])
    assert job() == 2, "the weights of p2 that are known are evaluated again"
    train(3, weights())
    assert job() == 3
    train(5, {})
    assert job() == 0, "p2 is waited for again"
