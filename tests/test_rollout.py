"""Rollouts in the real FrozenLake: what ends them, what is counted, what is told, and where they begin again."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_tasks import (
    ACCEPTING,
    CARRYING_2,
    DROP,
    INTO_HOLE,
    LEFT,
    PICK,
    START,
    TO_GOAL,
    TO_PASSENGER_2,
    small_learner,
    small_task,
    snapshot_after,
)

from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.common.rollout import Rollout, RolloutStep
from t4nmtd_dist.method.protocol import NO_TARGET

WORLDS = 4
WITH_2 = snapshot_after(*TO_PASSENGER_2, PICK)


def rollout_of(pid: str, *flags: str, starts: tuple[tuple[int, np.ndarray], ...] = ()) -> Rollout:
    rollout = small_learner(pid, "learner.shaping=paper", *flags, starts=starts).rollout
    rollout.begin()
    return rollout


def act(rollout: Rollout, actions: Iterable[int]) -> RolloutStep:
    """The same actions in every copy; the last step."""
    step = None
    for action in actions:
        step = rollout.step(np.full(WORLDS, action))
    assert step is not None
    return step


def flags_of(step: RolloutStep) -> tuple[bool, bool, bool]:
    """(changed, terminal, ended), which must be the same in all copies."""
    for mask in (step.changed, step.terminal, step.ended):
        assert len(set(mask.tolist())) == 1
    return bool(step.changed[0]), bool(step.terminal[0]), bool(step.ended[0])


def test_a_time_out_ends_the_attempt_but_is_no_terminal() -> None:
    """Trap: a time-out treated as a terminal."""
    rollout = rollout_of("p2", "learner.attempt_steps=5")
    assert flags_of(act(rollout, [LEFT] * 4)) == (False, False, False)
    assert flags_of(act(rollout, [LEFT])) == (False, False, True)
    assert rollout.take_progress().changes == [(START, NO_TARGET, 5, 0.0)] * WORLDS
    assert rollout.statistics.recent_success == 0.0
    assert flags_of(act(rollout, [LEFT] * 4)) == (False, False, False), "the count begins anew"


def test_a_hole_is_terminal_and_a_failure() -> None:
    rollout = rollout_of("p2")
    step = act(rollout, INTO_HOLE)
    assert flags_of(step) == (False, True, True)
    assert step.reward.tolist() == [0.0] * WORLDS
    progress = rollout.take_progress()
    assert progress.changes == [(START, NO_TARGET, len(INTO_HOLE), 0.0)] * WORLDS
    assert progress.starts == []


def test_reaching_a_target_is_paid_told_and_handed_over() -> None:
    task = small_task("learner.shaping=paper")
    rollout = rollout_of("p2")
    step = act(rollout, [*TO_PASSENGER_2, PICK])
    assert flags_of(step) == (True, False, True)
    gamma = task.config.learner.gamma
    assert step.reward == pytest.approx(gamma * task.rho[CARRYING_2] - task.rho[START])
    progress = rollout.take_progress()
    assert [(q, to, steps) for q, to, steps, _ in progress.changes] == [(START, CARRYING_2, 7)] * WORLDS
    assert [q for q, _ in progress.starts] == [CARRYING_2] * WORLDS
    assert all(state.tolist() == WITH_2.tolist() for _, state in progress.starts)
    assert (rollout.statistics.attempts, rollout.statistics.successes, rollout.statistics.recent_success) == (
        WORLDS,
        WORLDS,
        1.0,
    )
    assert rollout.statistics.recent_length == 7


def test_acceptance_is_terminal_and_no_start_state() -> None:
    rollout = rollout_of("g", starts=((CARRYING_2, WITH_2),))
    step = act(rollout, TO_GOAL)
    assert flags_of(step) == (True, True, True)
    assert step.q_next.tolist() == [ACCEPTING] * WORLDS
    assert (step.reward > 100).all()
    assert rollout.take_progress().starts == []
    assert rollout.statistics.successes == WORLDS


def test_after_a_restart_the_dfa_is_where_the_start_is() -> None:
    """Trap: the DFA state after an automatic reset read as progress."""
    rollout = rollout_of("p2")
    begun = rollout.observations.copy()
    step = act(rollout, [*TO_PASSENGER_2, PICK])
    assert rollout.q.tolist() == [START] * WORLDS
    assert np.array_equal(rollout.observations, begun)
    assert not np.array_equal(step.next_observations, begun), "the experience keeps the state before the restart"
    rollout.take_progress()
    assert flags_of(act(rollout, [LEFT])) == (False, False, False)
    assert rollout.take_progress().changes == []


def test_a_restart_from_a_start_state_is_no_progress_either() -> None:
    rollout = rollout_of("g", starts=((CARRYING_2, WITH_2),))
    begun = rollout.observations.copy()
    act(rollout, TO_GOAL)
    assert rollout.q.tolist() == [CARRYING_2] * WORLDS
    assert np.array_equal(rollout.observations, begun)
    rollout.take_progress()
    assert flags_of(act(rollout, TO_GOAL[:1])) == (False, False, False)
    assert rollout.take_progress().changes == []


def test_attempts_stranded_where_the_subtask_has_no_transition_end() -> None:
    rollout = rollout_of("g", starts=((CARRYING_2, WITH_2),))
    step = act(rollout, [DROP])
    assert flags_of(step) == (True, False, True)
    assert step.q_next.tolist() == [START] * WORLDS
    assert rollout.statistics.successes == 0
    progress = rollout.take_progress()
    assert progress.changes == [(CARRYING_2, START, 1, 0.0)] * WORLDS
    assert progress.starts == []


def test_another_change_into_a_state_where_the_subtask_goes_on_does_not_end_the_attempt() -> None:
    rollout = rollout_of("p1")
    assert flags_of(act(rollout, [*TO_PASSENGER_2, PICK])) == (True, False, False)
    assert flags_of(act(rollout, [LEFT, DROP])) == (True, False, False)
    changes = rollout.take_progress().changes
    assert changes == [(START, CARRYING_2, 7, 0.0)] * WORLDS + [(CARRYING_2, START, 2, 0.0)] * WORLDS
    assert (rollout.statistics.attempts, rollout.statistics.successes) == (0, 0)


def test_without_a_start_state_nothing_moves() -> None:
    learner = small_learner("g")
    assert not learner.iterate(NoPeers())
    assert (learner.rollout.interactions, learner.gradient_steps, learner.version) == (0, 0, 0)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.lists(st.integers(0, 5), min_size=WORLDS, max_size=WORLDS), min_size=1, max_size=40))
def test_interactions_are_steps_times_copies(actions: list[list[int]]) -> None:
    rollout = rollout_of("p2", "learner.attempt_steps=7")
    for row in actions:
        rollout.step(np.array(row))
    assert rollout.interactions == len(actions) * WORLDS


def test_roll_outs_count_every_step_of_every_copy() -> None:
    """Trap: steps of PPO roll-outs under-counted."""
    learner = small_learner("p1", "ppo.num_envs=3", "ppo.rollout=11", "learner.attempt_steps=4")
    for rounds in range(1, 4):
        learner.iterate(NoPeers())
        assert learner.rollout.interactions == rounds * 3 * 11


@settings(max_examples=20, deadline=None)
@given(st.lists(st.lists(st.integers(0, 5), min_size=WORLDS, max_size=WORLDS), min_size=1, max_size=60))
def test_what_is_told_adds_up(actions: list[list[int]]) -> None:
    """Every attempt that ended is in the progress, and the steps told never exceed those made."""
    rollout = rollout_of("p2", "learner.attempt_steps=9", starts=((START, snapshot_after(*TO_PASSENGER_2)),))
    ended = changed = 0
    for row in actions:
        before = rollout.q.copy()
        step = rollout.step(np.array(row))
        assert (step.changed == (step.q_next != before)).all()
        assert (step.ended | ~step.terminal).all(), "a terminal always ends the attempt"
        ended, changed = ended + int(step.ended.sum()), changed + int((step.changed | step.ended).sum())
    progress = rollout.take_progress()
    assert rollout.statistics.attempts == ended
    assert len(progress.changes) == changed
    assert sum(steps for _, _, steps, _ in progress.changes) <= rollout.interactions
    assert len(progress.starts) == rollout.statistics.successes
    assert rollout.take_progress().changes == []


@settings(max_examples=20, deadline=None)
@given(st.lists(st.lists(st.integers(0, 5), min_size=WORLDS, max_size=WORLDS), min_size=1, max_size=40))
@pytest.mark.parametrize("shaping", ["paper", "potential", "subtask"])
def test_a_step_pays_the_same_when_it_is_made_and_when_it_is_replayed(shaping: str, actions: list[list[int]]) -> None:
    flags = (f"learner.shaping={shaping}", "learner.error_penalty=3.0")
    learner = small_learner("p2", *flags, starts=((START, snapshot_after(*TO_PASSENGER_2)),))
    rollout, tables = learner.rollout, learner.method.role("p2").tables
    rollout.begin()
    replay = ReplayBuffer(len(actions), WORLDS, rollout.observations.shape[1], 1)
    steps = []
    for row in actions:
        observations, q = rollout.observations.copy(), rollout.q.copy()
        step = rollout.step(np.array(row))
        taken = np.array(row, np.float32)[:, None]
        ends = (step.terminated, step.ended, step.reached)
        replay.add(observations, q, taken, step.symbols, step.next_observations, *ends)
        steps.append(step)
    rows = np.arange(len(replay))
    found = replay.returns(rows, replay.q, tables, small_task().dfa.delta, 0.9, 1)
    assert found.reward.tolist() == np.concatenate([step.reward for step in steps]).tolist()
    assert (found.discount == 0).tolist() == np.concatenate([step.terminal for step in steps]).tolist()
