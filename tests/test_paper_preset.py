"""The preset ``paper``: every choice of Algorithm 2 as published, shown on the parts that carry it out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_tasks import own_task

from t4nmtd_dist.agents.sac.shapes import parameter_shapes
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.environments.timed import make_task_env
from t4nmtd_dist.launch.command_lines import coordinator_command
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.protocol import NO_TARGET, Change, Ending
from t4nmtd_dist.method.start_states import InitialStateBuffer, sample_starts
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import plan_run
from t4nmtd_dist.tasks import load_task, task_names
from t4nmtd_dist.tasks.presets import preset_names, preset_settings

OWN = """
name = "own"
formula = "F(a)"
propositions = ["a"]
[environment]
id = "x/Y-v0"
horizon = 10
options = { size = 5 }
[learner]
gamma = 0.5
"""
STATES = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3)), max_size=30)


def paper(task: str) -> CompiledTask:
    return compile_task(load_task(task, preset="paper"), seed=0)


@pytest.fixture(scope="module")
def task7() -> CompiledTask:
    return paper("task7")


@pytest.mark.parametrize("name", task_names())
def test_every_task_has_the_papers_settings_whatever_its_file_says(name: str) -> None:
    config = load_task(name, preset="paper")
    data = config.to_dict()
    for section, wanted in preset_settings("paper", data).items():
        for key, value in wanted.items():
            assert section == "environment" or list(np.ravel(data[section][key])) == list(np.ravel(value)), key
    assert config.environment.options["observation"] == "raw"
    assert config.learner.hidden == {"sac": (256, 256), "ppo": (64, 64)}[config.learner.algorithm]
    task = load_task(name)
    assert (config.formula, config.environment.horizon, config.learner.algorithm) == (
        task.formula,
        task.environment.horizon,
        task.learner.algorithm,
    )


@pytest.mark.parametrize("name", ["task1", "task3", "task5", "task7"])
def test_observations_are_the_worlds_own_numbers(name: str) -> None:
    sizes = []
    for preset in ("", "paper"):
        config = load_task(name, preset=preset)
        sizes.append(make_task_env(config, 1).observation_size)
    assert sizes[1] < sizes[0]


def test_transitions_into_error_states_belong_to_sub_tasks(task7: CompiledTask) -> None:
    into_error = {tau for tau in task7.decomposition.transitions if tau[1] in task7.dfa.error}
    assert into_error
    assert not {tau for tau in compile_task(load_task("task7")).decomposition.transitions if tau[1] in task7.dfa.error}
    assert {"~p1", "~p2", "~p3"} <= set(task7.decomposition.pids)


def test_line_8_pays_the_potential_difference_on_targets_and_nothing_elsewhere(task7: CompiledTask) -> None:
    method, gamma, rho = task7.method(), task7.config.learner.gamma, task7.rho
    assert rho.max() == 100.0
    for pid in task7.decomposition.pids:
        tables = method.role(pid).tables
        for q in range(task7.dfa.states):
            for q_next in range(task7.dfa.states):
                reached = q_next in task7.decomposition.q_target(pid, q)
                own = 100.0 * (q_next in task7.dfa.accepting) + gamma * rho[q_next] - rho[q]
                assert tables.reward[q, q_next] == pytest.approx(own if reached else 0.0)


def test_an_attempt_ends_at_targets_and_time_outs_only(task7: CompiledTask) -> None:
    method = task7.method()
    states = range(task7.dfa.states)
    for pid in task7.decomposition.pids:
        tables = method.role(pid).tables
        for q, q_next in ((a, b) for a in states for b in states):
            columns = (np.array([q], np.int32), np.array([q_next], np.int32))
            ends = method.ends(pid, *columns, np.array([1], np.int32))[0]
            assert (ends == Ending.RESTART) == bool(tables.target[q, q_next])
            assert method.ends(pid, *columns, np.array([300], np.int32))[0] == Ending.RESTART


def test_only_targets_are_handed_over(task7: CompiledTask) -> None:
    method = task7.method()
    for pid in task7.decomposition.pids:
        for q in range(task7.dfa.states):
            q_next = np.arange(task7.dfa.states, dtype=np.int32)
            handed = method.hands_over(pid, np.full_like(q_next, q), q_next)
            assert set(np.flatnonzero(handed)) == set(task7.decomposition.q_target(pid, q))


def test_failed_attempts_leave_q_as_it_is(task7: CompiledTask) -> None:
    method = task7.method()
    method.told("p1", [Change(task7.dfa.initial, NO_TARGET, 9, 0.0)])
    assert method.entries() == []
    ours = compile_task(load_task("task7")).method()
    ours.told("p1", [Change(task7.dfa.initial, NO_TARGET, 9, 0.0)])
    assert ours.entries() == [(task7.dfa.initial, "p1", 0.0)]


@pytest.mark.slow
@given(STATES, st.one_of(st.none(), st.integers(0, 2)), st.integers(0, 2**32 - 1))
def test_start_states_are_drawn_uniformly_from_all_that_were_stored(
    stored: list[tuple[int, int]], reset_q: int | None, seed: int
) -> None:
    buffer = InitialStateBuffer(repeats=True)
    assert all(buffer.add(q, np.array([number])) for q, number in stored)
    assert len(buffer) == len(stored)
    starts = sample_starts(buffer, reset_q, 4000, np.random.default_rng(seed), by_entry=True)
    entries = len(stored) + (reset_q is not None)
    assert len(starts) == (4000 if entries else 0)
    if entries:
        share = sum(start.state is None for start in starts) / 4000
        assert share == pytest.approx((reset_q is not None) / entries, abs=0.06)
        for q in {q for q, _ in stored}:
            kept = sum(start.q == q and start.state is not None for start in starts) / 4000
            assert kept == pytest.approx(sum(each == q for each, _ in stored) / entries, abs=0.06)


@given(STATES)
def test_a_buffer_with_repeats_forgets_all_of_a_state_and_comes_back_from_a_checkpoint(
    stored: list[tuple[int, int]],
) -> None:
    buffer = InitialStateBuffer(repeats=True)
    for q, number in stored:
        buffer.add(q, np.array([number]))
    again = InitialStateBuffer(repeats=True)
    if stored:
        again.load_state_dict(buffer.state_dict())
        assert [entry[:2] for entry in again.since(0, 99)] == [entry[:2] for entry in buffer.since(0, 99)]
        q, number = stored[0]
        again.remove(q, np.array([number]))
        assert len(again) == len(stored) - stored.count(stored[0])


def test_critics_are_plain() -> None:
    names = parameter_shapes(load_task("task5", preset="paper"), 10, 2)
    assert not [name for name in names if "gain" in name or "shift" in name]
    assert [name for name in parameter_shapes(load_task("task5"), 10, 2) if "gain" in name]


def test_files_and_flags_are_laid_over_a_preset_and_foreign_environments_keep_their_options(tmp_path: Path) -> None:
    over = tmp_path / "over.toml"
    over.write_text("[learner]\nreward_scale = 0.5\n", encoding="utf-8")
    config = load_task(str(own_task(tmp_path, OWN)), preset="paper", configs=[over], flags=["sac.batch=7"])
    assert (config.learner.gamma, config.learner.reward_scale, config.agents["sac"].batch) == (0.99, 0.5, 7)
    assert config.environment.options == {"size": 5}


def test_an_unknown_preset_is_refused_with_the_known_ones() -> None:
    assert preset_names() == ["paper"]
    with pytest.raises(ConfigError, match="unknown preset 'papre'; did you mean 'paper'"):
        load_task("task7", preset="papre")


def test_a_run_is_resumed_under_the_preset_it_was_begun_with(tmp_path: Path) -> None:
    plan = plan_run(RunOptions(task="task7", preset="paper", run_dir=tmp_path / "run"))
    assert plan.config == load_task("task7", preset="paper")


def test_a_launched_coordinator_gets_the_preset() -> None:
    from types import SimpleNamespace

    options = RunOptions(task="task7", preset="paper")
    program = SimpleNamespace(options=options, keys=None, directory=Path("run"))
    command = coordinator_command(program)  # type: ignore[arg-type]
    assert command[command.index("--preset") + 1] == "paper"
