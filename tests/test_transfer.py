"""Transfer: which networks begin where, what becomes of DFA columns, and what is refused."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from coordinator.run_settings import RunSettings
from coordinator.snapshot import summary
from t4nmtd_dist.agents.actors import make_actor
from t4nmtd_dist.agents.common.product_states import product_states
from t4nmtd_dist.agents.protocol import Learner
from t4nmtd_dist.agents.registry import build_learner
from t4nmtd_dist.agents.weights import acting_parameters
from t4nmtd_dist.core.errors import ConfigError, PolicyError
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.policy.export import LEARNERS_FILE, export_policy
from t4nmtd_dist.policy.loading import load
from t4nmtd_dist.policy.transfer import Source, _with_columns, read_source, transferred
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import plan_run
from t4nmtd_dist.tasks import load_task

PAIRS = [("task5", "task6", 23, "g1"), ("task7", "task8", 83, "p1")]
SMALL = ("learner.hidden=[16]", "sac.num_envs=2", "sac.replay_rows=2000", "ppo.num_envs=2")


@cache
def compiled(name: str, *flags: str) -> CompiledTask:
    return compile_task(load_task(name, flags=[*SMALL, *flags]))


def learner_of(task: CompiledTask, pid: str, seed: int = 0) -> Learner:
    return build_learner(task, pid, task.start_buffer(), task.method(), seed=seed)


@cache
def source_of(name: str, *flags: str) -> Source:
    task = compiled(name, *flags)
    weights = {pid: learner_of(task, pid).weights() for pid in task.decomposition.pids}
    return Source(Path("source"), task.config, task.dfa.states, task.decomposition, weights)


@pytest.mark.parametrize(("one", "other", "size", "pid"), PAIRS)
def test_networks_see_the_mean_of_the_states_in_which_the_sub_task_was_available(
    one: str, other: str, size: int, pid: str
) -> None:
    source, target = source_of(one), compiled(other)
    mapped = transferred(source, target, size)
    assert pid in mapped
    assert mapped.keys() == set(source.weights) & set(target.decomposition.pids)
    available = sorted({q for q, _ in source.decomposition.subtasks[pid]})
    observations = np.random.default_rng(0).normal(size=(4, size)).astype(np.float32)
    mixed = np.zeros((4, size + source.dfa_states), np.float32)
    mixed[:, :size] = observations
    mixed[:, [size + q for q in available]] = 1 / len(available)
    actors = [
        make_actor(task.config.learner, acting_parameters(weights))
        for task, weights in ((source, source.weights[pid]), (target, mapped[pid]))
    ]
    expected = actors[0].act(mixed)
    for q in range(target.dfa.states):
        actions = actors[1].act(product_states(observations, np.full(4, q), target.dfa.states))
        np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("one", "other", "size", "pid"), PAIRS)
def test_a_learner_loads_what_was_transferred_and_everything_else_is_kept(
    one: str, other: str, size: int, pid: str
) -> None:
    source, target = source_of(one), compiled(other)
    mapped = transferred(source, target, size)[pid]
    learner = learner_of(target, pid, seed=3)
    before = {name: array.shape for name, array in learner.weights().items()}
    learner.load(mapped, 1)
    assert {name: array.shape for name, array in learner.weights().items()} == before
    same = [name for name, array in source.weights[pid].items() if array.shape == mapped[name].shape]
    assert all(np.array_equal(source.weights[pid][name], mapped[name]) for name in same if name != "actor.0.weight")
    if "log_alpha" in mapped:
        assert {"critics", "targets", "average", "log_alpha"} <= {name.partition(".")[0] for name in mapped}


@given(
    hnp.arrays(np.float64, (3, 8), elements=st.floats(-9, 9)), st.sets(st.integers(0, 3), min_size=1), st.integers(1, 6)
)
def test_columns_of_observations_and_actions_stay_and_those_of_states_become_their_mean(
    array: np.ndarray, available: set[int], wanted: int
) -> None:
    mapped = _with_columns(array, 1, 2, 4, sorted(available), wanted)
    np.testing.assert_array_equal(mapped[:, :2], array[:, :2])
    np.testing.assert_array_equal(mapped[:, 2 + wanted :], array[:, 6:])
    mean = array[:, [2 + q for q in sorted(available)]].mean(axis=1)
    np.testing.assert_allclose(mapped[:, 2 : 2 + wanted], np.repeat(mean[:, None], wanted, axis=1))


def test_what_does_not_fit_is_refused_by_name() -> None:
    source, target = source_of("task5"), compiled("task6")
    with pytest.raises(PolicyError, match="sees observations of 23 numbers, this task's environment has 24"):
        transferred(source, target, 24)
    with pytest.raises(PolicyError, match=r"it has learner.hidden = \(16,\), this task has \(8,\)"):
        transferred(source, compiled("task6", "learner.hidden=[8]"), 23)
    with pytest.raises(PolicyError, match=r"learner\.algorithm = 'sac', this task has 'ppo'"):
        transferred(source, compiled("task7"), 83)
    with pytest.raises(PolicyError, match="its sub-tasks are h2, h3, h4, those of this task g1, g2, g3, g4"):
        transferred(source_of("task3"), compiled("task5"), 23)


def test_only_the_networks_of_namesakes_are_given_and_all_else_begins_new() -> None:
    source, target = source_of("task7"), compiled("task8")
    weights = transferred(source, target, 83)
    run = SerialRun(target, RunSettings(0, 1000, transfer_from="source"), lambda: 0.0, transferred=weights)
    plain = SerialRun(target, RunSettings(0, 1000), lambda: 0.0)
    assert set(weights) == {"p1", "p2", "p3"}
    for pid, session in run.sessions.items():
        begun, other = session.learner.weights(), plain.sessions[pid].learner.weights()
        expected = weights.get(pid, other)
        assert all(np.array_equal(begun[name], expected[name]) for name in other)
        assert session.learner.gradient_steps == 0
        assert len(session.buffer) == len(plain.sessions[pid].buffer)
    assert run.coordinator.method.entries() == []
    assert summary(run.coordinator)["transfer_from"] == "source"
    assert any("p1, p2, p3: begin with the networks of source" in line.text for line in run.coordinator.events)
    run.round()


def test_an_export_of_a_solved_run_has_all_parameters_and_a_policy_needs_them_not(tmp_path: Path) -> None:
    source, task = source_of("task7"), compiled("task7")
    for learners in (False, True):
        export_policy(tmp_path / "policy", task, [], source.weights, {}, learners=learners)
        assert (tmp_path / "policy" / LEARNERS_FILE).exists() == learners
        assert load(tmp_path).config.name == "task7"
    found = read_source(tmp_path)
    assert found.dfa_states == task.dfa.states
    for pid, weights in source.weights.items():
        assert all(np.array_equal(found.weights[pid][name], array) for name, array in weights.items())
    (tmp_path / "policy" / LEARNERS_FILE).write_bytes(b"no")
    with pytest.raises(PolicyError, match="cannot be read"):
        read_source(tmp_path)
    (tmp_path / "policy" / LEARNERS_FILE).unlink()
    with pytest.raises(PolicyError, match="takes a solved run"):
        read_source(tmp_path)


def test_a_resumed_run_takes_no_transfer(tmp_path: Path) -> None:
    options = RunOptions(resume=tmp_path, transfer_from=tmp_path)
    with pytest.raises(ConfigError, match="--transfer-from begins a run"):
        plan_run(options)


def test_a_run_until_converged_needs_lengths_that_are_alike() -> None:
    from coordinator.evaluations import EvaluationSchedule
    from t4nmtd_dist.core.config import EvaluationConfig
    from t4nmtd_dist.wire.messages import EvaluationRow

    def row(length: float) -> EvaluationRow:
        return EvaluationRow(
            job=1,
            interactions=1,
            elapsed_s=1.0,
            success_rate=1.0,
            mean_length=length,
            std_length=0.0,
            mean_return=1.0,
            dfa_path=[],
        )

    for until, lengths, ends in (
        ("solved", [10.0, 90.0], True),
        ("converged", [10.0, 90.0], False),
        ("converged", [10.0, 10.5], True),
    ):
        config = dataclasses.replace(EvaluationConfig(in_a_row=2), until=until)
        assert EvaluationSchedule(config, history=[row(length) for length in lengths]).solved is ends
