"""Methods: found by name, one module each, and run by coordinator, learners and evaluator without knowing which."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from typing import Any

import modular_method
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_sac import AT_G1, small_sac
from small_sac import START as CAR_START
from small_sac import TINY as TINY_SAC
from small_tasks import CARRYING_2, START, TINY, TO_PASSENGER_2, small_learner, snapshot_after

from coordinator.run_settings import RunSettings
from t4nmtd_dist.agents.common.peer_values import LocalPeers, NoPeers, Questions
from t4nmtd_dist.agents.common.successors import draw_successors
from t4nmtd_dist.core.config import TaskConfig, task_config
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.method_settings import method_configs
from t4nmtd_dist.core.registry import METHODS
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.method.protocol import NO_TARGET, Change, Method, method_module
from t4nmtd_dist.tasks import load_task

SHORT = ("environment.horizon=20", "learner.attempt_steps=12", "evaluation.every=100", "evaluation.episodes=2")


def config_of(*flags: str, name: str = "task7") -> TaskConfig:
    tiny = TINY if name in ("task7", "task8") else TINY_SAC
    return load_task(name, flags=[*tiny, *SHORT, *flags])


def run_of(*flags: str, name: str = "task7") -> SerialRun:
    task = compile_task(config_of(*flags, name=name))
    return SerialRun(task, RunSettings(0, 10**9, lease_s=float("inf")), lambda: 0.0)


@pytest.fixture
def modular(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """A third method ``modular``: one registry line, nothing else."""
    monkeypatch.setitem(METHODS.modules, "modular", "modular_method")  # type: ignore[arg-type]
    method_configs.cache_clear()
    yield monkeypatch
    method_configs.cache_clear()


# Names


@pytest.mark.parametrize(("name", "advice"), [("t4nmtb", "did you mean 't4nmtd'"), ("sarsa", "")])
def test_an_unknown_method_is_refused_with_the_known_ones(name: str, advice: str) -> None:
    with pytest.raises(
        ConfigError, match=rf"learner\.method: unknown method '{name}'; {advice}.*Known: .*random, t4nmtd"
    ):
        config_of(f"learner.method={name}")


@pytest.mark.parametrize("name", METHODS.names())
def test_every_registered_method_decomposes_and_chooses(name: str) -> None:
    task = compile_task(load_task("task7", method=name))
    method = task.method()
    chosen = method.choose(range(task.dfa.states))
    assert {q for q, role in enumerate(chosen) if role is not None} == {q for q, _ in task.decomposition.transitions}
    targets = {name: set(map(tuple, np.argwhere(method.role(name).tables.target).tolist())) for name in method.roles}
    assert set.union(*targets.values()) == set(task.decomposition.transitions)
    assert method.shares_env == (task.decomposition.pids == ("policies",))
    if not method.shares_env:
        assert targets == {pid: set(transitions) for pid, transitions in task.decomposition.subtasks.items()}
    networks = {method.role(name).network for name in method.roles}
    assert len(networks) in (1, len(method.roles))
    goals = [method.role(name).goal for name in method.roles]
    assert goals == ([None] * len(goals) if len(networks) == len(goals) else list(range(len(goals))))


# Random decomposition


@pytest.mark.parametrize("name", ["task4", "task7", "task8"])
def test_random_deals_the_same_transitions_to_as_many_sub_tasks_from_the_runs_seed(name: str) -> None:
    random = config_of("learner.method=random", name=name)
    own = compile_task(config_of(name=name)).decomposition
    dealt = [compile_task(random, seed=seed).decomposition for seed in (5, 5, 6)]
    assert dealt[0] == dealt[1] != dealt[2]
    for each in dealt:
        assert len(each.pids) == len(own.pids)
        assert Counter(tau for taus in each.subtasks.values() for tau in taus) == Counter(
            tau for taus in own.subtasks.values() for tau in taus
        )
    older = config_of("decomposition.mode=random", name=name)
    assert compile_task(older, seed=5).decomposition == dealt[0]


def test_random_with_literal_sub_tasks_is_refused() -> None:
    with pytest.raises(ConfigError, match=r'learner\.method = "random" deals out'):
        compile_task(config_of("learner.method=random", "decomposition.mode=literal"))


def test_a_run_with_the_random_decomposition_learns_like_one_of_t4nmtd() -> None:
    run = run_of("learner.method=random")
    for _ in range(3):
        run.round()
    assert set(run.sessions) == {"r1", "r2", "r3", "r4"}
    assert any(session.learner.version == 3 for session in run.sessions.values())
    assert run.coordinator.evaluations.history


# The rules of T4NMTD


def test_told_changes_move_q_and_failures_pull_it_to_zero() -> None:
    method = compile_task(config_of("high_level.alpha=0.5")).method()
    method.told("p2", [Change(START, CARRYING_2, 7, 4.0)])
    assert method.entries() == [(START, "p2", 4.0)]
    method.told("p2", [Change(START, NO_TARGET, 3, 0.0)])
    assert method.entries() == [(START, "p2", 2.0)]
    copy = compile_task(config_of()).method()
    copy.load(method.entries())
    assert copy.entries() == method.entries()


def test_a_greedy_choice_is_the_best_known_among_those_allowed() -> None:
    method = compile_task(config_of()).method()
    method.load([(START, "p1", 1.0), (START, "p2", 3.0), (START, "p3", 2.0)])
    assert method.choose([START]) == ["p2"]
    assert method.choose([START], among={"p1", "p3"}) == ["p3"]
    assert method.choose([START], np.random.default_rng(0), among={"p1"}) == ["p1"]
    assert method.choose([START], among=()) == [None]


def test_the_successor_is_drawn_by_e_and_is_the_role_itself_where_nobody_is_available() -> None:
    task = compile_task(config_of("high_level.epsilon=0"))
    method, rng = task.method(), np.random.default_rng(0)
    method.load([(START, "p3", 5.0)])
    able = {q for q, _ in task.decomposition.transitions}
    nowhere = next(q for q in range(task.dfa.states) if q not in able)
    assert method.successors("g", np.array([START, nowhere], np.int32), rng) == ["p3", "g"]
    assert set(method.receivers("g", START, rng)) == {"p3"}
    assert not method.receivers("g", nowhere, rng)


class Named:
    """Successors as given by DFA state; all that ``draw_successors`` asks of a method."""

    def __init__(self, by_state: dict[int, str | None]) -> None:
        self.by_state = by_state

    def successors(self, role: str, q_next: np.ndarray, rng: np.random.Generator) -> list[str | None]:
        return [self.by_state[q] for q in q_next.tolist()]


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 2)), max_size=20))
def test_rows_across_a_boundary_are_asked_of_their_successor_or_worth_nothing(rows: list[tuple[bool, int]]) -> None:
    method = Named({0: "own", 1: "peer", 2: None})
    boundary = np.array([crosses for crosses, _ in rows], np.bool_)
    q_next = np.array([q for _, q in rows], np.int32)
    found = draw_successors(method, "own", boundary, q_next, np.random.default_rng(0))  # type: ignore[arg-type]
    assert found.rows.tolist() == [row for row, pair in enumerate(rows) if pair == (True, 1)]
    assert found.pids == ("peer",) * len(found.rows)
    assert found.without_value.tolist() == [row for row, pair in enumerate(rows) if pair == (True, 2)]


class NobodyInherits:
    """A method whose successors are None, as of options that end; all else is another's."""

    def __init__(self, method: Method) -> None:
        self._method = method

    def __getattr__(self, name: str) -> Any:
        return getattr(self._method, name)

    def successors(self, role: str, q_next: np.ndarray, rng: np.random.Generator) -> list[str | None]:
        return [None] * len(q_next)


def test_sac_bootstraps_from_zero_where_nobody_inherits() -> None:
    learner = small_sac("g1", starts=((CAR_START, AT_G1),))
    while not learner.gradient_steps:
        learner.iterate(NoPeers())
    learner.batches.method = NobodyInherits(learner.batches.method)
    drawn = [learner.batches.draw(number, 0.0) for number in range(20)]
    states = drawn[0].states.shape[1] - 6
    crossed = [
        each.discounts[np.argmax(each.states[:, states:], 1) != np.argmax(each.next_states[:, states:], 1)]
        for each in drawn
    ]
    assert sum(map(len, crossed)) > 20
    assert not np.concatenate(crossed).any()
    assert all(len(each.asked_rows) == 0 for each in drawn)
    assert any(each.discounts.any() for each in drawn)


def test_ppo_bootstraps_from_zero_where_nobody_inherits() -> None:
    beside = snapshot_after(*TO_PASSENGER_2)
    learner = small_learner("p2", "ppo.rollout=32", "learner.attempt_steps=6", starts=((START, beside),))
    learner.method = NobodyInherits(learner.method)
    assert learner.rollout.begin()
    learner.collect(NoPeers())
    with torch.no_grad():
        _, next_values = learner.bootstrap(NoPeers())
    trajectory = learner.trajectory
    crossed = trajectory.boundary & (trajectory.boundary_q != START)
    assert crossed.sum() > 3
    assert not next_values[crossed].any()
    assert next_values[trajectory.boundary & ~crossed].all(), "time-outs bootstrap from the own critic"


# A third method, without a change anywhere else


class AskedAbout(LocalPeers):
    """Peers of this process that keep which DFA states they were asked about, and whose value was wanted."""

    asked: set[tuple[str, int]]

    def ask(self, batch: int, questions: Questions) -> None:
        self.asked |= set(zip(questions.pids, questions.q.tolist(), strict=True))
        super().ask(batch, questions)


def asked_in(run: SerialRun, rounds: int) -> set[tuple[str, int]]:
    """Who was asked about which DFA state in so many rounds."""
    asked: set[tuple[str, int]] = set()
    for pid in run.sessions:
        others = {other: s.learner.critic_values for other, s in run.sessions.items() if other != pid}
        run.peers[pid] = AskedAbout(others)
        run.peers[pid].asked = asked  # type: ignore[attr-defined]
    for _ in range(rounds):
        run.round()
    return asked


def trained(run: SerialRun) -> Collection[str]:
    return {pid for pid, session in run.sessions.items() if session.learner.gradient_steps}


def test_a_module_per_state_trains_from_stored_states_to_the_end_of_a_serial_run(
    modular: pytest.MonkeyPatch,
) -> None:
    modular.setattr(modular_method, "STORED", True)
    run = run_of("learner.method=modular")
    assert set(run.sessions) == {"q0", "q1", "q2", "q4"}
    beside = snapshot_after(*TO_PASSENGER_2)
    run.sessions["q0"].buffer.add(START, beside)
    asked = asked_in(run, 12)
    assert {"q0", "q2"} <= set(trained(run)), "q2 starts where q0 picked up passenger 2"
    assert ("q2", 2) in asked
    assert {(pid, q) for pid, q in asked if pid != f"q{q}"} == set(), "the module of q' is asked about q'"
    told = run.coordinator.method.reported  # type: ignore[attr-defined]
    assert {(role, change.q) for role, change in told if role != f"q{change.q}"} == set()
    assert run.coordinator.interactions == sum(s.learner.rollout.interactions for s in run.sessions.values())
    assert run.coordinator.evaluations.history


def test_a_method_brings_its_own_settings(modular: pytest.MonkeyPatch) -> None:
    config = load_task("task7", flags=["learner.method=modular", "modular.spare_modules=2"])
    assert config.method == modular_method.ModularConfig(2)
    assert task_config(config.to_dict()) == config
    assert load_task("task7").method is None
    with pytest.raises(ConfigError, match=r"modular.spare_modules = -1: expected"):
        load_task("task7", flags=["modular.spare_modules=-1"])
    with pytest.raises(ConfigError, match=r"unknown key 'modular.spare'; did you mean 'modular.spare_modules'\?"):
        load_task("task7", flags=["modular.spare=1"])


def test_a_module_that_only_starts_at_the_reset_stores_nothing_and_the_others_wait(modular: pytest.MonkeyPatch) -> None:
    run = run_of("learner.method=modular")
    run.sessions["q0"].buffer.add(START, snapshot_after(*TO_PASSENGER_2))  # so that the DFA does move
    assert ("q2", 2) in asked_in(run, 12), "bootstraps come from modules that do not act"
    assert trained(run) == {"q0"}
    assert all(len(record.buffer) == 0 for record in run.coordinator.records.values())


def test_modules_of_continuous_tasks_learn_from_own_rows_only(modular: pytest.MonkeyPatch) -> None:
    run = run_of("learner.method=modular", "sac.peer_share=0.5", name="task5")
    for _ in range(6):
        run.round()
    assert trained(run) == {"q0"}
    learner = run.sessions["q0"].learner
    assert learner.peer_rows == learner.peer_steps == 0
    assert run_of("sac.peer_share=0.5", name="task5").sessions["g1"].learner.peer_steps > 0


def test_only_scheduled_roles_act(modular: pytest.MonkeyPatch) -> None:
    modular.setattr(modular_method, "PASSIVE", frozenset({"q0"}))
    run = run_of("learner.method=modular")
    run.round()
    assert run.coordinator.interactions == 0
    modular.setattr(modular_method, "PASSIVE", frozenset({"q2"}))
    run.round()
    assert run.coordinator.interactions == run.sessions["q0"].learner.rollout.interactions > 0


def test_the_module_of_a_method_is_imported_when_it_is_asked_for(modular: pytest.MonkeyPatch) -> None:
    assert method_module("modular") is modular_method  # type: ignore[comparison-overlap]
