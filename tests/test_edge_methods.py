"""What methods of edges share: their roles and rewards, and attempts of a policy that does not learn meanwhile."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from coordinator_events import Conversation, changes, starts
from edge_methods import edge_run, edge_task, upper_of
from small_sac import AT_G1, small_sac
from small_sac import START as CAR_START
from small_tasks import CARRYING_2, DOWN, LEFT, PICK, START, TO_PASSENGER_2, small_learner, snapshot_after

from coordinator.events import Received, Send
from coordinator.saved_state import load_saved_state, saved_state
from t4nmtd_dist.agents.actors import make_actor
from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.core.state_dict import copied, joined, split
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.edges import EdgePlan
from t4nmtd_dist.method.protocol import Ending
from t4nmtd_dist.tasks import load_task
from t4nmtd_dist.wire.codec import Envelope

COUNTS = {"task1": 33, "task2": 56, "task3": 3, "task4": 6, "task5": 4, "task6": 34, "task7": 12, "task8": 20}
METHODS = ("lsts", "dirl")


def compiled(name: str, *flags: str) -> CompiledTask:
    return compile_task(load_task(name, flags=["learner.method=lsts", *flags]))


# Roles


@pytest.mark.parametrize("name", COUNTS)
def test_there_is_an_edge_for_every_transition_of_a_sub_task(name: str) -> None:
    task, own = compiled(name), compile_task(load_task(name))
    assert len(task.decomposition.pids) == COUNTS[name]
    assert task.decomposition.transitions == own.decomposition.transitions
    for edge, transitions in task.decomposition.subtasks.items():
        assert transitions == (tuple(map(int, edge.removeprefix("e").split("-"))),)


@pytest.mark.parametrize("name", METHODS)
def test_an_attempt_ends_at_any_change_and_only_the_target_is_handed_over(name: str) -> None:
    method = edge_task(name).method()
    q, q_next = np.zeros(4, np.int32), np.array([0, 2, 1, 0], np.int32)
    ending = method.ends("e0-2", q, q_next, np.array([1, 1, 1, 12], np.int32))
    assert ending.tolist() == [Ending.KEEP, Ending.RESTART, Ending.RESTART, Ending.RESTART]
    assert method.hands_over("e0-2", q, q_next).tolist() == [False, True, False, False]
    assert method.successors("e0-2", q_next, np.random.default_rng(0)) == [None] * 4
    assert not method.receivers("e0-2", 2, np.random.default_rng(0))
    reading = method.reads("e0-2")
    assert (reading.q.tolist(), reading.rows) == ([0], "own")
    assert method.role("e0-2").reset_q == 0
    assert method.role("e2-5").reset_q is None


@pytest.mark.parametrize("shaping", ["paper", "potential", "subtask"])
@pytest.mark.parametrize("edge", ["e2-4", "e2-5"])
def test_of_all_ways_out_only_the_edges_own_target_pays(shaping: str, edge: str) -> None:
    """By the return of an attempt that stays for a while and then leaves."""
    gamma = 0.95
    task = compiled("task7", f"learner.shaping={shaping}", f"learner.gamma={gamma}")
    tables = task.method().role(edge).tables
    ((source, target),) = task.decomposition.subtasks[edge]

    def value(way_out: int, stays: int) -> float:
        waiting = sum(gamma**step * tables.reward[source, source] for step in range(stays))
        return float(waiting + gamma**stays * tables.reward[source, way_out])

    never = sum(gamma**step * tables.reward[source, source] for step in range(2000))
    assert value(target, 2) > value(target, 5) > never or (shaping == "paper" and edge == "e2-4")
    for way_out in {*range(task.dfa.states)} - {source, target}:
        assert value(way_out, 3) == pytest.approx(never, abs=1e-6)


def test_where_the_environment_ends_no_potential_stays_paid() -> None:
    task = compiled("task7", "learner.shaping=potential")
    tables = task.method().role("e2-4").tables
    q, ended = np.full(3, 2, np.int32), np.ones(3, np.bool_)
    rewards = tables.transition_rewards(q, np.array([2, 4, 1], np.int32), ended)
    assert rewards == pytest.approx(np.full(3, -task.rho[2]))


@pytest.mark.parametrize("name", METHODS)
def test_before_anything_is_planned_nobody_is_scheduled(name: str) -> None:
    method = edge_task(name).method()
    assert not set(method.schedule() or ())
    assert method.entries() == []
    method.told("e0-1", [])
    method.advance("e0-1", [], np.random.default_rng(0))
    assert len(set(method.schedule() or ())) == 1


# The coordinator


@pytest.mark.parametrize("name", METHODS)
def test_a_resumed_coordinator_knows_whose_states_are_held_back(name: str) -> None:
    talk = Conversation(task=edge_task(name))
    talk.claim("e0-1")
    talk.claim("e0-2", "v")
    talk.sync("e0-2", "v")
    talk.sync("e0-1", "w", arrays={**changes((0, 1, 5, 1.0), (0, -1, 9, 0.0)), **starts((1, 17))})
    fresh = Conversation(task=edge_task(name))
    load_saved_state(fresh.state, joined(*split(copied(saved_state(talk.state)))))
    assert fresh.fingerprint() == talk.fingerprint()
    ours: Any = fresh.state.method
    theirs: Any = talk.state.method
    kept, expected = (joined(*split(copied(method.state_dict()))) for method in (ours, theirs))
    assert str(kept) == str(expected)
    assert len(theirs._reached["e0-1"]) == (name == "lsts"), "in DIRL these are states of the training"


# Attempts of a policy as it is


class Scripted:
    """Acts by the number of the call, alike in all copies or not."""

    def __init__(self, *actions: list[int]) -> None:
        self.actions, self.calls = actions, 0

    def act(self, states: np.ndarray) -> np.ndarray:
        self.calls += 1
        return np.array(self.actions[min(self.calls, len(self.actions)) - 1])


def test_every_copy_makes_one_whole_attempt_however_long_that_takes() -> None:
    learner = small_learner("p2", "learner.attempt_steps=12")
    learner.rollout.begin()
    learner.rollout.step(np.full(4, LEFT))
    learner.rollout.take_progress()
    before = learner.rollout.interactions
    quick = [*TO_PASSENGER_2, PICK]
    actor = Scripted(*([action, LEFT, LEFT, action] for action in quick), [PICK, LEFT, LEFT, DOWN])
    assert learner.rehearse(actor)
    assert learner.rollout.interactions - before == 12 * 4
    progress = learner.rollout.take_progress()
    told = sorted((change.q_next, change.steps) for change in progress.changes)
    assert told == [(-1, 12), (-1, 12), (CARRYING_2, 7), (CARRYING_2, 7)], "nothing of the attempt before, nor after"
    assert len(progress.starts) == 2
    assert (learner.rollout.statistics.attempts, learner.rollout.statistics.successes) == (4, 2)
    assert learner.rollout.q.tolist() == [START] * 4
    assert learner.version == learner.gradient_steps == 0


def test_ppo_learns_nothing_from_a_rehearsal_and_goes_on_after_it() -> None:
    learner = small_learner("p2", "learner.attempt_steps=6")
    assert learner.iterate(NoPeers())
    learner.rollout.take_progress()
    before, weights = learner.version, learner.weights()
    assert learner.rehearse(make_actor(learner._context.settings, weights))
    assert len(learner.rollout.take_progress().changes) == 4
    assert learner.version == before
    assert all((learner.weights()[name] == array).all() for name, array in weights.items())
    assert learner.iterate(NoPeers())
    assert len(learner.rollout.take_progress().changes) == 4 * (16 // 6)


def test_a_rehearsal_needs_a_start_state() -> None:
    learner = small_learner("g")
    assert not learner.rehearse(make_actor(learner._context.settings, learner.weights()))


def test_an_off_policy_learner_keeps_attempts_before_and_after_a_rehearsal_apart() -> None:
    learner = small_sac("g1", starts=((CAR_START, AT_G1),))
    for _ in range(2):
        assert learner.iterate(NoPeers())
    buffer = learner.replay_buffer
    newest = buffer.rows_of(buffer.written - 1, 1)[0]
    before, gradient_steps = buffer.written, learner.gradient_steps
    buffer.ended[newest] = False
    assert learner.rehearse(make_actor(learner._context.settings, learner.weights()))
    assert (buffer.written, learner.gradient_steps) == (before, gradient_steps)
    assert buffer.ended[newest].all()
    assert learner._begun.all()
    assert learner.iterate(NoPeers())


def test_what_a_learner_has_not_told_yet_is_dropped_when_it_is_to_show_its_policy() -> None:
    run = edge_run("dirl")
    run.round()
    run.round()
    session = run.sessions["e0-1"]
    assert upper_of(run).current == "e0-1"
    assert session.iterate(run.peers["e0-1"])
    assert session.learner.rollout.progress.changes
    sync = session.next_sync(float("inf"), 0.0)
    assert sync is not None
    assert session.iterate(run.peers["e0-1"])
    assert session.learner.rollout.progress.changes
    upper_of(run).phase = "estimating"  # as if the last report had ended the training
    for action in run.coordinator.handle(Received(0.0, b"serial", sync)):
        if isinstance(action, Send):
            session.take_reply(Envelope(action.message, action.arrays))
    assert not session.method.learns("e0-1")
    assert not session.learner.rollout.progress.changes
    rounds = session.learner.version
    assert session.iterate(run.peers["e0-1"])
    assert session.learner.version == rounds
    assert len(session.learner.rollout.progress.changes) == 4


def test_a_plan_names_the_source_for_worth_and_the_target_for_work() -> None:
    edges = {"e0-1": (0, 1), "e1-2": (1, 2)}
    plan = EdgePlan({"e0-1": 0.5, "e1-2": -1.0}, {"e1-2": False})
    assert plan.entries(edges) == [(0, "e0-1", 0.5), (1, "e1-2", -1.0), (2, "e1-2", 0.0)]
    assert EdgePlan.of(plan.entries(edges), edges) == plan


def test_a_stored_start_is_only_restored_where_its_edge_begins() -> None:
    run = edge_run("lsts")
    beside = snapshot_after(*TO_PASSENGER_2)
    role = run.coordinator.method.role("e0-2")
    drawn = run.sessions["e0-2"].method.starts("e0-2", run.sessions["e0-2"].buffer, 50, np.random.default_rng(0))
    assert {start.q for start in drawn} == {role.reset_q} == {START}
    assert {None if start.state is None else start.state.tobytes() for start in drawn} == {None, beside.tobytes()}
