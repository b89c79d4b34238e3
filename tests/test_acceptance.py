"""Tasks whose acceptance can be lost again: the trace ends with the episode, and ``last`` says so."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import guarded_grid
import numpy as np
import pytest
from guarded_grid import STAY
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from small_tasks import own_task
from test_semantics import NAMES, formula_texts

from coordinator.run_settings import RunSettings
from coordinator.snapshot import dashboard_state
from t4nmtd_dist.automata.acceptance import LAST, acceptance_of, with_last
from t4nmtd_dist.automata.formula import parse, satisfies
from t4nmtd_dist.automata.translate import translate
from t4nmtd_dist.cli.commands import Check, Inspect
from t4nmtd_dist.core.errors import EnvError, FormulaError, PolicyError
from t4nmtd_dist.environments.preparation import prepared
from t4nmtd_dist.environments.timed import TimedEnv, make_task_env
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.decomposition import Keep, decompose
from t4nmtd_dist.policy.evaluation import Evaluator
from t4nmtd_dist.policy.export import export_policy
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.policy.loading import load
from t4nmtd_dist.tasks import load_task, task_names

HERE = Path(__file__).parent
ALL = np.arange(2)
HORIZON = 40
SAFETY, STAY_AT_GOAL, RESPONSE = "G(!hazard)", "G(!hazard) & F(G(goal))", "G(alarm -> F(goal))"
TASK = f"""
name = "guarded"
formula = "FORMULA"
propositions = ["hazard", "alarm", "goal"]
[environment]
id = "guarded_grid:GuardedGrid"
path = "{HERE}"
horizon = {HORIZON}
[evaluation]
every = 2000
success = 0.95
"""


def guarded(folder: Path, formula: str, *flags: str) -> CompiledTask:
    """A task in the guarded corridor, ready for training."""
    path = own_task(folder, TASK.replace("FORMULA", formula))
    return prepared(compile_task(load_task(str(path), flags=flags), translator="python"))


# The automaton


@settings(max_examples=150, deadline=None)
@given(formula_texts(), st.lists(st.frozensets(st.sampled_from(NAMES)), min_size=1, max_size=5))
def test_with_last_a_trace_is_accepted_exactly_where_it_ends(text: str, trace: list[frozenset[str]]) -> None:
    try:
        dfa = translate(text, translator="python")
    except FormulaError:
        assume(False)
    ended = with_last(dfa)
    assert acceptance_of(ended) == "first"  # acceptance cannot be lost any more
    assert not ended.accepts(trace)  # not before the end
    whole = [*trace[:-1], trace[-1] | {LAST}]
    assert ended.accepts(whole) == satisfies(trace, parse(text))
    over = ended.accepting | ended.error
    q = ended.initial
    for labels in whole:
        q = ended.step(q, labels)
    assert q in over  # after the end nothing is open


@pytest.mark.parametrize(
    ("formula", "acceptance"),
    [(SAFETY, "end"), (STAY_AT_GOAL, "end"), (RESPONSE, "end"), ("F(goal) & G(!hazard)", "end"), ("F(goal)", "first")],
)
def test_how_a_task_accepts_follows_from_its_automaton(formula: str, acceptance: str) -> None:
    assert acceptance_of(translate(formula, translator="python")) == acceptance


def test_letters_that_cannot_occur_lose_no_acceptance() -> None:
    dfa = translate("F(goal) & G(!(goal & hazard))", translator="python")
    assert acceptance_of(dfa) == "end"
    assert acceptance_of(dfa, [["goal", "hazard"]]) == "first"


def test_a_violation_that_cannot_be_mended_is_an_error_at_once() -> None:
    dfa = with_last(translate(SAFETY, translator="python"))
    assert dfa.step(dfa.initial, ["hazard"]) in dfa.error
    assert dfa.step(dfa.initial, []) not in dfa.error | dfa.accepting


@pytest.mark.parametrize("keep", ["all", "helpful"])
def test_an_answer_is_rewarded_though_it_leads_back_to_the_start(keep: Keep) -> None:
    """After an alarm, the goal leads back to the initial state, and so lies on no simple path from there."""
    dfa = with_last(translate(RESPONSE, translator="python"))
    open_again = dfa.step(dfa.initial, ["alarm"])
    answered = dfa.step(open_again, ["goal"])
    assert answered == dfa.initial
    found = decompose(dfa, keep=keep)
    assert answered in found.q_target("goal", open_again)
    assert answered not in found.q_target(LAST, open_again)


@pytest.mark.parametrize("name", task_names())
def test_the_tasks_of_the_paper_end_where_they_always_did(name: str) -> None:
    task = compile_task(load_task(name), translator="python")
    assert task.config.acceptance == "first"
    assert LAST not in task.dfa.propositions


def test_the_setting_overrides(tmp_path: Path) -> None:
    first = guarded(tmp_path, SAFETY, "acceptance=first")
    assert first.config.acceptance == "first"
    assert LAST not in first.dfa.propositions
    ended = guarded(tmp_path, "F(goal)", "acceptance=end")
    assert LAST in ended.dfa.propositions


def test_sixteen_propositions_leave_no_room_for_last(tmp_path: Path) -> None:
    names = [f"n{i}" for i in range(16)]
    text = TASK.replace("FORMULA", " & ".join(f"G(!{name})" for name in names))
    text = text.replace('["hazard", "alarm", "goal"]', json.dumps(names))
    with pytest.raises(FormulaError, match="at most 15"):
        compile_task(load_task(str(own_task(tmp_path, text))), translator="python")


# The environment


def test_the_world_reports_last_and_shows_the_remaining_time(tmp_path: Path) -> None:
    env = make_task_env(guarded(tmp_path, SAFETY).config, 2)
    assert env.propositions[-1] == LAST
    assert env.reset(ALL, 0)[:, -1].tolist() == [1.0, 1.0]
    for t in range(1, HORIZON + 1):
        step = env.step(np.full(2, STAY))
        assert step.labels[:, -1].tolist() == [t == HORIZON] * 2
        assert step.observations[:, -1] == pytest.approx([1 - t / HORIZON] * 2)


def test_snapshots_carry_the_time(tmp_path: Path) -> None:
    env = make_task_env(guarded(tmp_path, SAFETY).config, 2)
    env.reset(ALL, 0)
    for _ in range(HORIZON - 2):
        seen = env.step(np.full(2, 2)).observations
    states = env.snapshot(ALL)
    env.reset(np.array([0]))
    other = make_task_env(guarded(tmp_path, SAFETY).config, 2)
    other.reset(ALL, 5)
    assert np.array_equal(other.restore(np.array([1]), [states[0]])[0], seen[0])
    assert other.step(np.full(2, STAY)).labels[:, -1].tolist() == [False, False]
    assert other.step(np.full(2, STAY)).labels[:, -1].tolist() == [False, True]


@pytest.mark.parametrize("task", ["task1", "task3", "task5", "task7"])
def test_snapshots_of_our_own_worlds_travel_with_the_time(task: str) -> None:
    config = dataclasses.replace(load_task(task), acceptance="end")
    env, other = make_task_env(config, 2), make_task_env(config, 2)
    env.reset(ALL, 0)
    other.reset(ALL, 1)
    actions = np.array([env.action_space.sample() for _ in range(2)])
    env.step(actions)
    states = env.snapshot(ALL)
    assert {state.ndim for state in states} == {1}
    expected = env.step(actions)
    other.restore(ALL, states)
    now = other.step(actions)
    assert np.array_equal(now.observations, expected.observations)
    assert np.array_equal(now.labels, expected.labels)


def test_what_is_no_snapshot_is_refused(tmp_path: Path) -> None:
    env = make_task_env(guarded(tmp_path, SAFETY).config, 2)
    env.reset(ALL, 0)
    good = env.snapshot(ALL)[0]
    for bad in (good[:10], good[:0], good.astype(np.int64), np.full_like(good, 255)):
        with pytest.raises(EnvError):
            env.restore(np.array([0]), [bad])


def test_the_environments_own_limit_ends_the_trace_too(tmp_path: Path) -> None:
    env = make_task_env(guarded(tmp_path, SAFETY, "environment.options={ends_at=3}").config, 2)
    env.reset(ALL, 0)
    reported = [env.step(np.full(2, STAY)).labels[0, -1] for _ in range(3)]
    assert reported == [False, False, True]


def test_the_state_of_the_world_goes_into_checkpoints(tmp_path: Path) -> None:
    env, other = (make_task_env(guarded(tmp_path, SAFETY).config, 2) for _ in range(2))
    assert isinstance(env, TimedEnv)
    env.reset(ALL, 0)
    other.reset(ALL, 7)
    env.step(np.full(2, STAY))
    other.load_state_dict(env.state_dict())
    assert np.array_equal(env.step(np.full(2, 3)).observations, other.step(np.full(2, 3)).observations)


# Training, evaluation and the policy


def trained(task: CompiledTask, seed: int, most: int) -> SerialRun:
    """A serial training until the task is solved or ``most`` interactions are spent."""
    run = SerialRun(task, RunSettings(seed, most, lease_s=float("inf")), lambda: 0.0)
    for _ in run.steps():
        pass
    return run


def policy_of(run: SerialRun, folder: Path) -> GlobalPolicy:
    best = run.coordinator.evaluations.best
    assert best is not None
    snapshot = best.snapshot
    export_policy(folder, run.task, snapshot.q_table, snapshot.weights, {}, mode=best.row.actions)
    return load(folder)


@pytest.mark.slow
@pytest.mark.training
@pytest.mark.parametrize(
    ("formula", "pids"), [(SAFETY, (LAST,)), (STAY_AT_GOAL, ("goal", LAST)), (RESPONSE, ("goal", LAST))]
)
def test_tasks_that_end_with_the_episode_are_learned(tmp_path: Path, formula: str, pids: tuple[str, ...]) -> None:
    task = guarded(tmp_path, formula)
    assert task.decomposition.pids == pids
    run = trained(task, seed=102, most=150_000)
    assert run.coordinator.outcome == "solved"
    policy = policy_of(run, tmp_path / "policy")
    result = Evaluator(policy, 100, seed=4711).run(policy)
    assert result.success_rate >= 0.95
    assert set(result.lengths[result.success]) == {HORIZON}


@pytest.fixture(scope="module")
def safe(tmp_path_factory: pytest.TempPathFactory) -> GlobalPolicy:
    """A policy that has hardly learned, of the task to keep out of the hazard."""
    folder = tmp_path_factory.mktemp("safe")
    run = trained(guarded(folder, SAFETY), seed=101, most=3000)
    return policy_of(run, folder / "policy")


def test_one_safe_step_is_no_success(safe: GlobalPolicy) -> None:
    result = Evaluator(safe, 20, seed=0).run(safe)
    assert set(result.lengths[result.success]) <= {HORIZON}


def test_a_policy_counts_the_steps_itself(safe: GlobalPolicy) -> None:
    observation = np.eye(25, dtype=np.float32)[2]
    safe.reset()
    for _ in range(HORIZON):
        safe.act(observation, [])
    assert not safe.accepts(["hazard"])
    assert safe.accepts([])
    safe.reset()
    safe.act(observation, [])
    assert not safe.accepts([])  # it is not over yet
    assert safe.accepts([], ended=True)  # the environment's own limit
    assert safe.failed(["hazard"])
    assert not safe.failed([])


def test_the_remaining_time_is_no_number_of_the_observation(safe: GlobalPolicy) -> None:
    safe.reset()
    with pytest.raises(PolicyError, match="an observation of 3 numbers, where the policy learned from 25;"):
        safe.act(np.zeros(3, np.float32), [])


def test_perturbed_starts_keep_their_time(safe: GlobalPolicy) -> None:
    result = Evaluator(safe, 20, seed=0).run(safe, perturb=5)
    assert (result.lengths[result.success] <= HORIZON).all()
    assert (result.lengths[result.success] >= HORIZON - 5).all()


# What users are told


def test_inspect_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    Inspect(formula=SAFETY).run()
    assert "end of the episode" in " ".join(capsys.readouterr().out.split())
    Inspect(formula=SAFETY, as_json=True).run()
    found = json.loads(capsys.readouterr().out)
    assert found["acceptance"] == "end"
    assert list(found["subtasks"]) == [LAST]


def test_check_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = own_task(tmp_path, TASK.replace("FORMULA", SAFETY))
    assert Check(str(path), steps=200, as_json=True).run() == 0
    found = json.loads(capsys.readouterr().out)
    assert found["acceptance"] == "end"
    assert found["endings"]["error"] + found["endings"].get("accepted", 0) == found["episodes"]
    Check(str(path), steps=200).run()
    assert "end of the episode" in " ".join(capsys.readouterr().out.split())


def test_check_counts_the_remaining_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = own_task(tmp_path, TASK.replace("FORMULA", SAFETY))
    Check(str(path), steps=200, as_json=True).run()
    assert json.loads(capsys.readouterr().out)["observation_size"] == 25 + 1
    Check(str(path), steps=200).run()
    assert "25 numbers, one-hot, and the remaining time" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(("options", "warned"), [("ends_at = 1", True), ("fatal = true", False)])
def test_check_warns_only_of_early_ends_that_count_as_accepted(
    options: str, warned: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = TASK.replace("FORMULA", SAFETY).replace("[evaluation]", f"options = {{ {options} }}\n[evaluation]")
    Check(str(own_task(tmp_path, text)), steps=200, as_json=True).run()
    found = json.loads(capsys.readouterr().out)
    assert found["episodes"] > 0
    assert any("before the horizon, and they count as accepted" in text for text in found["warnings"]) == warned


def test_check_refuses_an_environment_that_reports_last_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["hazard", "alarm", "goal", LAST]
    monkeypatch.setattr(guarded_grid.GuardedGrid, "propositions", names, raising=False)
    path = own_task(tmp_path, TASK.replace("FORMULA", SAFETY))
    with pytest.raises(EnvError, match="reports 'last', which is the end of the episode"):
        prepared(compile_task(load_task(str(path)), translator="python"))
    assert Check(str(path), steps=100, as_json=True).run() == 2
    (problem,) = json.loads(capsys.readouterr().out)["problems"]
    assert "reports 'last', which is the end of the episode" in problem


def test_check_warns_of_a_discount_that_forgets_the_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = TASK.replace("FORMULA", SAFETY) + "[learner]\ngamma = 0.5\n"
    Check(str(own_task(tmp_path, text)), steps=200, as_json=True).run()
    warnings: list[Any] = json.loads(capsys.readouterr().out)["warnings"]
    assert any("gamma" in text for text in warnings)


def test_the_dashboard_says_so(tmp_path: Path) -> None:
    from rich.console import Console

    from coordinator.ui.dashboard import render

    run = SerialRun(guarded(tmp_path, SAFETY), RunSettings(0, 1000, lease_s=float("inf")), lambda: 0.0)
    state = dashboard_state(run.coordinator)
    assert state.acceptance == "end"
    console = Console(width=120, height=36, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(render(state, width=120, height=36))
    assert "end of the episode" in console.export_text()
