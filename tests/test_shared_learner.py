"""Methods whose roles share an environment: who acts, what is stored, what is drawn for whom, and how runs go on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from processes import Processes
from small_shared import OPTIONS, SHARED, shared_learner, shared_run

from coordinator.run_settings import RunSettings
from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.shared.learner import SharedLearner
from t4nmtd_dist.agents.shared.role_rows import RoleRows
from t4nmtd_dist.agents.weight_checks import check_weights
from t4nmtd_dist.core.errors import ConfigError, PolicyError
from t4nmtd_dist.core.state_dict import copied, joined, split
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.method.options import ClosedOptions
from t4nmtd_dist.method.protocol import Ending
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.policy.loading import load
from t4nmtd_dist.runs.directory import read_summary
from t4nmtd_dist.tasks import load_task


def role_rows_of(learner: SharedLearner) -> RoleRows:
    return learner._role_rows


# Runs


@pytest.mark.slow
@pytest.mark.parametrize("name", ["task7", "task5"])
@pytest.mark.parametrize("method", SHARED)
def test_a_run_learns_evaluates_and_goes_on_bit_for_bit(method: str, name: str) -> None:
    first, second = (shared_run(method, name=name) for _ in range(2))
    for _ in range(8):
        first.round()
    plain, arrays = split(first.state_dict())
    second.load_state_dict(joined(plain, {key: array.copy() for key, array in arrays.items()}))
    for run in (first, second):
        for _ in range(8):
            run.round()
    (left,), (right,) = first.sessions.values(), second.sessions.values()
    assert left.learner.gradient_steps == right.learner.gradient_steps > 20
    assert first.coordinator.interactions == second.coordinator.interactions == 16 * 20
    assert len(first.coordinator.evaluations.history) == len(second.coordinator.evaluations.history) >= 1
    for key, array in left.learner.weights().items():
        assert np.array_equal(array, right.learner.weights()[key]), key


@pytest.mark.parametrize("method", SHARED)
def test_gradient_steps_per_interaction_do_not_depend_on_the_number_of_networks(method: str) -> None:
    learner = shared_learner(method, iterations=10)
    upper = learner._options.gradient_steps if learner._options else 0
    due = 0.5 * (learner.rollout.interactions - 50)
    assert learner.gradient_steps - upper == pytest.approx(due, abs=0.5 * 20 + len(learner.agents) * 16)


def test_on_policy_agents_are_refused_before_a_run() -> None:
    with pytest.raises(ConfigError, match=r"'ppo': learner.method = 'crm' learns from a replay buffer; .* dqn, sac"):
        compile_task(load_task("task7", flags=["learner.method=crm"]))
    assert compile_task(load_task("task7", method="crm")).config.learner.algorithm == "dqn"


# Who acts


@pytest.mark.parametrize("method", SHARED)
def test_the_role_that_acts_is_available_and_held_until_the_method_ends_it(method: str) -> None:
    learner = shared_learner(method)
    rules, roles = learner._method, learner._roles
    learner.iterate(NoPeers())
    for _ in range(60):
        before, q, steps = learner._active.numbers.copy(), learner.rollout.q.copy(), learner._active._steps.copy()
        learner._step()
        q_next, after = learner._replay.q, learner._active.numbers
        newest = learner._replay.rows_of(learner._replay.written - 1, 1)[0]
        assert learner._role_rows._role[newest].tolist() == before.tolist()
        assert q_next[newest].tolist() == q.tolist()
        for copy, row in enumerate(newest):
            reached = int(learner._context.task.dfa.delta[q[copy], learner._replay.symbols[row]])
            ending = rules.ends(
                roles[before[copy]].name, q[copy : copy + 1], np.array([reached], np.int32), steps[copy : copy + 1] + 1
            )[0]
            if ending == Ending.KEEP and not learner._begun[copy]:
                assert after[copy] == before[copy]
                assert learner._active._steps[copy] == steps[copy] + 1
            assert roles[after[copy]].tables.available[learner.rollout.q[copy]]


# What is stored


@given(st.data())
def test_rows_belong_to_the_role_that_recorded_them(data: st.DataObject) -> None:
    roles, copies = 3, 2
    replay = ReplayBuffer(data.draw(st.integers(1, 6)), copies, 1, 1)
    kept, log = RoleRows(replay, roles), []
    zeros, no = np.zeros((copies, 1), np.float32), np.zeros(copies, np.bool_)
    for _ in range(data.draw(st.integers(1, 20))):
        acted = data.draw(st.lists(st.integers(0, roles - 1), min_size=copies, max_size=copies))
        reached = np.array(data.draw(st.lists(st.booleans(), min_size=copies, max_size=copies)))
        ended = np.array(data.draw(st.lists(st.booleans(), min_size=copies, max_size=copies)))
        replay.add(zeros, no.astype(np.int32), zeros, no.astype(np.int64), zeros, no, ended, no)
        kept.record(np.array(acted, np.int32), reached)
        log.append((acted, reached, ended))
    first = max(0, len(log) - replay.steps)
    expected: dict[int, set[int]] = {role: set() for role in range(roles)}
    before: dict[int, set[int]] = {role: set() for role in range(roles)}
    for copy in range(copies):
        for step in range(first, len(log)):
            expected[log[step][0][copy]].add(step % replay.steps * copies + copy)
            if log[step][1][copy]:
                back, role = step, log[step][0][copy]
                while back >= first and log[back][0][copy] == role and (back == step or not log[back][2][copy]):
                    before[role].add(back % replay.steps * copies + copy)
                    back -= 1
    for role in range(roles):
        assert set(kept._own[role].members.tolist()) == expected[role]
        assert set(kept._before_target[role].members.tolist()) == before[role]
    copy_of = RoleRows(replay, roles)
    copy_of.load_state_dict(copied(kept.state_dict()))
    assert [rows.members.tolist() for rows in copy_of._own] == [rows.members.tolist() for rows in kept._own]


def test_a_goal_that_is_given_up_ends_its_returns_but_bootstraps() -> None:
    learner = shared_learner("hdqn", iterations=4)
    replay, rows = learner._replay, np.arange(len(learner._replay))
    delta = learner._context.task.dfa.delta
    changed = delta[replay.q[rows], replay.symbols[rows]] != replay.q[rows]
    switched = role_rows_of(learner)._role[rows[:-2]] != role_rows_of(learner)._role[rows[2:]]
    given_up = switched & ~changed[:-2] & ~replay.terminated[rows[:-2]]
    assert given_up.any()
    assert replay.ended[rows[:-2]][given_up].all()
    number = int(role_rows_of(learner)._role[rows[:-2]][given_up][0])
    returns = replay.returns(
        rows[:-2][given_up][:1], replay.q[rows[:-2]][given_up][:1], learner._roles[number].tables, delta, 0.9, 3
    )
    assert returns.discount.tolist() == [0.9]


@pytest.mark.parametrize("method", OPTIONS)
def test_an_option_that_is_open_at_a_time_out_is_closed_and_bootstraps(method: str) -> None:
    learner = shared_learner(method, "environment.horizon=1")
    assert learner._options is not None
    told: list[ClosedOptions] = []
    learner._options._upper.learn = told.append  # type: ignore[method-assign]
    learner._begin()
    learner._step()
    (closed,) = told
    assert closed.q.tolist() == closed.q_next.tolist() == [0, 0]
    assert closed.discounts.tolist() == [0.95, 0.95]
    assert closed.mask.any(axis=1).all()
    assert learner._active._steps.tolist() == [0, 0]


# What is drawn


@pytest.mark.parametrize("method", SHARED)
def test_every_row_of_a_batch_is_one_that_its_role_reads(method: str) -> None:
    learner = shared_learner(method, iterations=15)
    states, size = learner._context.dfa_states, learner._context.observation_size
    for network in learner.agents:
        if not learner.batches.rows_for(network):
            continue
        drawn = learner.batches.draw(network)
        q = drawn.read.states[:, size : size + states].argmax(1)
        goals = drawn.read.states[:, size + states :]
        assert drawn.read.states.shape == drawn.read.next_states.shape == (16, learner._network_context(network).inputs)
        for row in range(16):
            able = [role for role in learner._roles if role.network == network]
            (role,) = [role for role in able if not len(goals[row]) or goals[row][role.goal or 0]]
            assert q[row] in learner._method.reads(role.name).q
            if len(goals[row]):
                assert goals[row].sum() == 1
                assert np.array_equal(goals[row], drawn.read.next_states[row, size + states :])


def test_a_module_bootstraps_from_the_module_of_the_state_that_it_leads_to() -> None:
    learner = shared_learner("mod", iterations=3)
    observed, q = learner.rollout.observations[:1], learner.rollout.q[:1]
    for module, target in (("q0", 2), ("q0", 1)):
        drawn = learner.batches.draw(module)
        rows = np.array([3])
        successors = type(drawn.successors)(rows, (f"q{target}",), np.empty(0, np.int64))
        states = learner._states(np.repeat(observed, 16, 0), np.full(16, target, np.int32))
        answers = learner._successors_values(module, type(drawn)(drawn.read, successors), states)
        expected = learner.agents[f"q{target}"].values(states[rows])
        assert answers.rows.tolist() == [3]
        assert answers.values.tolist() == expected.tolist()
    assert q.tolist() == [0]


def test_the_value_beyond_a_time_out_counts() -> None:
    """Horizon 1, as if every episode had one step: a time-out is not an end."""
    learner = shared_learner("crm", "environment.horizon=1", iterations=5)
    drawn = learner.batches.draw("policies")
    delta = learner._context.task.dfa.delta
    assert learner._replay.ended[: len(learner._replay)].all()
    assert (delta[0, learner._replay.symbols[: len(learner._replay)]] == 0).all(), "nothing is reached in one step"
    own = drawn.read.q_next == drawn.read.states[:, learner._context.observation_size :].argmax(1)
    assert own.any()
    assert (drawn.read.discounts[own] == np.float32(learner._context.settings.gamma)).all()


# Weights and policies


@pytest.mark.parametrize("method", SHARED)
def test_weights_pass_the_coordinators_check_and_others_are_refused(method: str) -> None:
    learner = shared_learner(method, "learner.normalise_observations=on", iterations=4)
    task, weights = learner._context.task, learner.weights()
    sizes = check_weights(weights, task.config, task.dfa.states)
    assert sizes.action == 6
    assert sizes.observation == learner._context.observation_size + (len(learner._roles) if method in OPTIONS else 0)
    name = next(key for key in weights if key.endswith("actor.0.weight"))
    with pytest.raises(PolicyError, match=r"is missing|do not fit"):
        check_weights({key: array for key, array in weights.items() if key != name}, task.config, task.dfa.states)
    with pytest.raises(PolicyError, match="expected float32"):
        check_weights(weights | {name: weights[name].astype(np.float64)}, task.config, task.dfa.states)
    other = shared_learner(method, "learner.normalise_observations=on")
    other.load(weights, 7)
    assert all(np.array_equal(array, other.weights()[key]) for key, array in weights.items())
    with pytest.raises(PolicyError, match="expected"):
        other.load(
            {f"elsewhere:{key}": array for key, array in weights.items() if ":" not in key} | {"x:y": weights[name]}, 8
        )


@pytest.mark.parametrize("normalise", ["on", "off"])
@pytest.mark.parametrize("method", SHARED)
def test_a_policy_acts_as_the_learner_that_it_comes_from_would_greedily(method: str, normalise: str) -> None:
    learner = shared_learner(method, f"learner.normalise_observations={normalise}", iterations=12)
    policy = GlobalPolicy(learner._context.task, [], {"policies": learner.weights()})
    observations, q = learner.rollout.observations.copy(), learner.rollout.q.copy()
    actions, known = policy.actions(observations, q)
    assert known.all()
    chosen = learner._method.choose(q.tolist(), observations=observations)
    for row, name in enumerate(chosen):
        assert name is not None
        role = learner._method.role(name)
        learner._active.numbers[row] = learner._method.roles.index(name)
        states = learner._with_goals(learner._states(observations[[row]], q[[row]]), np.array([row]))
        assert actions[row] == learner.agents[role.network].q_values(states).argmax(1)[0]


@pytest.mark.parametrize("method", OPTIONS)
def test_a_policy_holds_its_option_until_the_dfa_changes_or_its_steps_are_spent(method: str) -> None:
    learner = shared_learner(method, iterations=6)
    policy = GlobalPolicy(learner._context.task, [], {"policies": learner.weights()})
    asked: list[int] = []
    values = policy._method.upper.values
    policy._method.upper.values = lambda observations, q: asked.append(len(q)) or values(observations, q)
    observations, q = learner.rollout.observations[[0]], np.zeros(1, np.int32)
    policy.begin(1)
    for _ in range(14):
        policy.actions(observations, q)
    assert asked == ([1] if method == "hrm" else [1, 1]), "attempt_steps is 12"
    policy.actions(observations, np.array([2], np.int32))
    assert len(asked) == (2 if method == "hrm" else 3)
    policy.begin(1)
    policy.actions(observations, q)
    assert len(asked) == (3 if method == "hrm" else 4)


# From the command line


@pytest.mark.timeout(180)
def test_a_run_in_processes_is_stopped_resumed_and_exported(tmp_path: Path, commands: Processes) -> None:
    flags = ["--set", "learner.hidden=[32]", "--set", "evaluation.every=1000", "--max-interactions", "4000"]
    begun = ["--task", "task7", "--method", "hrm", "--run-dir", str(tmp_path / "run"), "--no-dashboard", *flags]
    first = commands.start("t4nmtd", "train", *begun)
    assert first.wait(120) == 3, first.story()
    summary = read_summary(tmp_path / "run")
    assert summary["outcome"] == "budget spent"
    policy = load(tmp_path / "run")
    assert policy.config.learner.method == "hrm"
    again = ["--resume", str(tmp_path / "run"), "--no-dashboard", "--max-interactions", "6000"]
    second = commands.start("t4nmtd", "train", *again)
    assert second.wait(120) == 3, second.story()
    assert read_summary(tmp_path / "run")["interactions_total"] >= 6000


@pytest.mark.training
@pytest.mark.timeout(1500)
@pytest.mark.parametrize(
    "method", ["crm", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("hrm", "mod", "product", "qrm"))]
)
def test_task_7_is_solved(method: str) -> None:
    """h-DQN is not among them: of three seeds tried it solved two within this budget (docs/experiments.md)."""
    task = compile_task(load_task("task7", method=method))
    run = SerialRun(task, RunSettings(100, 300_000, lease_s=np.inf), lambda: 0.0)
    for _ in run.steps():
        pass
    assert run.coordinator.outcome == "solved"
