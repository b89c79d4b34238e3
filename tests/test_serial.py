"""The serial runner: bit-reproducible from its seed, and honest in what it counts and reports."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_tasks import START, TO_PASSENGER_2, small_task, snapshot_after

from coordinator.events import Finish, RecordEvaluation
from coordinator.run_settings import RunSettings
from coordinator.snapshot import summary
from t4nmtd_dist.launch.serial import SerialRun

FLAGS = ("evaluation.every=100", "evaluation.episodes=2", "environment.horizon=20", "learner.attempt_steps=12")


def run_of(seed: int, *, rounds: int = 0, max_interactions: int = 10**9, clock: float = 0.0) -> SerialRun:
    run = SerialRun(small_task(*FLAGS), RunSettings(seed, max_interactions, lease_s=float("inf")), lambda: clock)
    run.sessions["p2"].buffer.add(START, snapshot_after(*TO_PASSENGER_2))
    for _ in range(rounds):
        run.round()
    return run


def all_weights(run: SerialRun) -> dict[str, NDArray[Any]]:
    return {f"{pid}/{k}": v for pid, s in run.sessions.items() for k, v in s.learner.weights().items()}


def same(a: dict[str, NDArray[Any]], b: dict[str, NDArray[Any]]) -> bool:
    return list(a) == list(b) and all(x.tobytes() == y.tobytes() for x, y in zip(a.values(), b.values(), strict=True))


def test_two_runs_of_one_seed_are_equal_bit_for_bit() -> None:
    first, second = run_of(3, rounds=4), run_of(3, rounds=4, clock=1234.5)
    assert same(all_weights(first), all_weights(second))
    assert first.coordinator.method.entries() == second.coordinator.method.entries()
    assert first.coordinator.method.entries() != []
    reports = [summary(run.coordinator) for run in (first, second)]
    for report in reports:
        report.pop("wall_s")
    assert reports[0] == reports[1]
    histories = [
        [
            (row.interactions, row.mean_length, row.mean_return, row.dfa_path)
            for row in run.coordinator.evaluations.history
        ]
        for run in (first, second)
    ]
    assert histories[0] == histories[1] != []


def test_another_seed_gives_another_run() -> None:
    assert not same(all_weights(run_of(3, rounds=1)), all_weights(run_of(4, rounds=1)))


def test_every_subtask_starts_from_networks_of_its_own() -> None:
    weights = all_weights(run_of(0))
    assert weights["p1/actor.0.weight"].tobytes() != weights["p2/actor.0.weight"].tobytes()


def test_interactions_are_those_of_the_learners_worlds() -> None:
    run = run_of(0, rounds=3)
    config = small_task(*FLAGS).config
    trained = {pid: s.learner.version for pid, s in run.sessions.items()}
    assert trained["p1"] == trained["p2"] == trained["p3"] == 3
    ppo = config.agents["ppo"]
    assert run.coordinator.interactions == sum(trained.values()) * ppo.num_envs * ppo.rollout


def test_the_learner_of_the_goal_gets_start_states_from_the_others() -> None:
    run = run_of(0)
    for _ in range(30):
        run.round()
        if run.sessions["g"].learner.version:
            break
    buffer = run.sessions["g"].buffer
    assert len(buffer) > 0
    available = {q for q in range(6) if "g" in small_task().decomposition.available(q)}
    assert set(buffer.states_present()) <= available
    assert len(buffer) == len(run.coordinator.records["g"].buffer)


def test_it_stops_when_the_budget_is_spent() -> None:
    run = run_of(0, max_interactions=500)
    notes = [note for taken in run.steps() for note in taken]
    assert [note.outcome for note in notes if isinstance(note, Finish)] == ["budget spent"]
    assert 500 <= run.coordinator.interactions < 500 + 3 * 64


def test_it_stops_when_told() -> None:
    run = run_of(0)
    steps = run.steps()
    next(steps)
    run.stop("enough")
    assert list(steps) == []
    assert run.coordinator.outcome == "stopped"


def test_evaluations_come_after_enough_interactions_and_on_fresh_weights() -> None:
    run = run_of(0, rounds=4)
    rows = [note.row for note in run.notes if isinstance(note, RecordEvaluation)]
    assert rows == run.coordinator.evaluations.history
    counts = [row.interactions for row in rows]
    assert all(b - a >= 100 for a, b in zip([0, *counts], counts, strict=False))


@pytest.mark.parametrize("pid", ["p1", "p2", "p3"])
def test_the_coordinator_holds_the_newest_weights(pid: str) -> None:
    run = run_of(0, rounds=2)
    record, learner = run.coordinator.records[pid], run.sessions[pid].learner
    assert record.version == learner.version == 2
    assert all(np.array_equal(record.weights[name], array) for name, array in learner.weights().items())
