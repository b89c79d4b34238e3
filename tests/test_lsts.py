"""LSTS: the teacher's traces and arithmetic, whose states start whose attempts, and runs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edge_methods import (
    arrived,
    edge_run,
    edge_task,
    failed,
    fingerprint,
    graphs,
    method_on,
    named,
    resumed,
    snapshot,
    upper_of,
)
from hypothesis import given
from hypothesis import strategies as st

from coordinator.best_policy import export_best
from coordinator.run_settings import RunSettings
from t4nmtd_dist.automata.reduction import closure, predecessors
from t4nmtd_dist.core.state_dict import joined, split
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method import lsts
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.method.edge_attempts import Attempt
from t4nmtd_dist.method.edges import EdgePlan
from t4nmtd_dist.method.lsts_teacher import SLICE_ATTEMPTS, Teacher
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.policy.loading import load
from t4nmtd_dist.tasks import load_task

RELEASE = {"0": (0, 1), "1": (0, 2), "2": (1, 3), "3": (2, 3), "4": (3, 4)}
"""The graph of the authors' release."""

MakeTeacher = Callable[..., Teacher]


def slice_of(share: float, count: int = SLICE_ATTEMPTS) -> list[Attempt]:
    return [Attempt(number < round(share * count), 10) for number in range(count)]


def train(teacher: Teacher, edge: str, *shares: float) -> None:
    """Slices of the edge with these shares of successes, whatever the teacher would choose."""
    for share in shares:
        teacher.current = edge
        teacher.attempted(edge, slice_of(share))


# The graph


def check_traces(make: MakeTeacher) -> None:
    """The two traces of the release's graph."""
    teacher = make(RELEASE, 0, {4})
    assert set(teacher.q) == {"0", "1"}
    train(teacher, "0", 1.0)
    assert (set(teacher.q), teacher.discarded) == ({"1", "2"}, set())
    train(teacher, "2", 1.0)
    assert (set(teacher.q), teacher.discarded) == ({"4"}, {"1", "3"})
    train(teacher, "4", 1.0)
    assert teacher.path == ("0", "2", "4")
    teacher = make(RELEASE, 0, {4})
    for edge in ("0", "1", "2"):
        train(teacher, edge, 1.0)
    assert (set(teacher.q), teacher.discarded) == ({"4"}, {"3"})
    assert teacher.learned == ["0", "1", "2"]


def test_the_graph_of_the_release_shrinks_as_there() -> None:
    check_traces(Teacher)


class NothingDiscarded(Teacher):
    def _discard_into(self, vertex: int) -> None:
        """As in a copy of LSTS that is known to be wrong."""


class OnlyRivalsDiscarded(Teacher):
    def _discard_into(self, vertex: int) -> None:
        self.discarded |= {e for e, (_, to) in self._edges.items() if to == vertex} - set(self.learned)
        self.q = {edge: value for edge, value in self.q.items() if edge not in self.discarded}


class LearnedDiscardedToo(Teacher):
    def _discard_into(self, vertex: int) -> None:
        super()._discard_into(vertex)
        left = {source for e, (source, _) in self._edges.items() if e not in self.discarded | {"4"}} | {3, 4}
        self.discarded |= {e for e, (_, target) in self._edges.items() if target not in left}


@pytest.mark.parametrize("broken", [NothingDiscarded, OnlyRivalsDiscarded, LearnedDiscardedToo])
def test_the_traces_show_wrong_discards(broken: MakeTeacher) -> None:
    with pytest.raises(AssertionError):
        check_traces(broken)


def test_edges_back_to_the_initial_and_to_reached_vertices_are_discarded() -> None:
    edges = named((0, 1), (0, 2), (1, 2), (2, 1), (1, 0), (1, 3), (2, 3))
    teacher = Teacher(edges, 0, {3})
    assert teacher.discarded == {"e1-0"}
    train(teacher, "e0-2", 1.0)
    assert teacher.discarded == {"e1-0", "e1-2"}
    assert set(teacher.q) == {"e0-1", "e2-1", "e2-3"}
    train(teacher, "e2-1", 1.0)
    assert teacher.discarded == {"e1-0", "e1-2", "e0-1"}
    train(teacher, "e1-3", 1.0)
    assert teacher.path == ("e0-2", "e2-1", "e1-3")


def test_the_edges_of_task_7_that_are_left_once_passenger_2_is_picked_up() -> None:
    method: Any = edge_task("lsts").method()
    method.upper.learn("e0-2")
    assert method.upper.discarded == {"e1-2", "e4-2"}
    assert set(method.upper.q) == {"e0-1", "e0-4", "e2-1", "e2-4", "e2-5"}


# The bandit


def check_arithmetic(make: MakeTeacher) -> None:
    teacher = make(RELEASE, 0, {4})
    values = []
    for share in (0.0, 0.4, 0.5):
        train(teacher, "0", share)
        values.append(teacher.q["0"])
    assert values == pytest.approx([0.0, 0.04, 0.046])


def test_q_follows_the_progress_of_the_mean_success() -> None:
    check_arithmetic(Teacher)


class LevelRewarded(Teacher):
    def _end_slice(self, edge: str) -> None:
        self._last_mean[edge] = 0.0
        super()._end_slice(edge)


def test_the_arithmetic_shows_a_teacher_rewarded_with_the_level() -> None:
    with pytest.raises(AssertionError):
        check_arithmetic(LevelRewarded)


@pytest.mark.parametrize(("successes", "learned"), [(47, False), (48, True)])
def test_an_edge_is_learned_above_95_percent_of_the_last_50(successes: int, learned: bool) -> None:
    teacher = Teacher(RELEASE, 0, {4})
    train(teacher, "0", successes / 50)
    assert (teacher.learned == ["0"]) == learned


def test_an_edge_is_not_learned_before_50_attempts() -> None:
    teacher = Teacher(RELEASE, 0, {4}, slice_attempts=20)
    for learned in (False, False, True):
        teacher.current = "0"
        teacher.attempted("0", slice_of(1.0, 20))
        assert (teacher.learned == ["0"]) == learned


def test_a_slice_ends_with_the_report_that_fills_it_and_late_attempts_are_in_no_slice() -> None:
    teacher, rng = Teacher(RELEASE, 0, {4}), np.random.default_rng(0)
    teacher.current = "0"
    teacher.attempted("0", slice_of(0.0, 49))
    teacher.advance(rng)
    assert teacher.current == "0"
    teacher.attempted("1", slice_of(1.0, 10))
    assert teacher.q == {"0": 0.0, "1": 0.0}
    teacher.attempted("0", slice_of(0.5, 51))
    assert teacher.current is None
    assert teacher.q["0"] == pytest.approx(0.1 * 0.26)


def test_half_the_choices_are_uniform_over_active_edges() -> None:
    teacher, rng = Teacher(named((0, 1), (0, 2), (0, 3), (1, 4), (2, 4), (3, 4)), 0, {4}), np.random.default_rng(1)
    teacher.q["e0-2"] = 0.1
    chosen = []
    for _ in range(6000):
        teacher.current = None
        teacher.advance(rng)
        chosen.append(teacher.current)
    shares = {edge: chosen.count(edge) / len(chosen) for edge in set(chosen)}
    assert shares == pytest.approx({"e0-1": 1 / 6, "e0-2": 2 / 3, "e0-3": 1 / 6}, abs=0.03)


def test_once_f_is_reached_the_path_trains_on_in_equal_shares() -> None:
    teacher, rng = Teacher(RELEASE, 0, {4}), np.random.default_rng(0)
    for edge in ("0", "1", "2", "4"):
        train(teacher, edge, 1.0)
    spent = dict.fromkeys(("0", "2", "4"), 0)
    for turn in range(60):
        teacher.advance(rng)
        assert teacher.current is not None
        steps = 10 + turn % 7
        spent[teacher.current] += steps
        teacher.attempted(teacher.current, [Attempt(False, steps)])
    assert max(spent.values()) - min(spent.values()) <= 20


@given(graphs(), st.data())
def test_the_teacher_schedules_edges_that_can_start_until_f_is_reached(graph: Any, data: st.DataObject) -> None:
    edges, accepting = graph
    seed = data.draw(st.integers(0, 99))
    teacher, rng = Teacher(edges, 0, {accepting}), np.random.default_rng(seed)
    for _ in range(40):
        teacher.advance(rng)
        edge = teacher.current
        assert edge is not None, "there is always something to train"
        source = edges[edge][0]
        assert source == 0 or teacher.origin(source) in teacher.learned
        if teacher.path:
            assert edge in teacher.path
        else:
            assert edge not in teacher.discarded
            assert edge not in teacher.learned
        teacher.attempted(edge, slice_of(data.draw(st.sampled_from([0.0, 0.5, 1.0]))))
        targets = [edges[each][1] for each in teacher.learned]
        assert len(set(targets)) == len(targets)
        assert 0 not in targets
        if not teacher.path:
            left = [tau for each, tau in edges.items() if each not in teacher.discarded]
            assert {edges[each][1] for each in teacher.q} <= closure({accepting}, predecessors(left))
    if teacher.path:
        walk = [edges[each] for each in teacher.path]
        assert (walk[0][0], walk[-1][1]) == (0, accepting)
        assert all(a[1] == b[0] for a, b in pairwise(walk))


@given(graphs(), st.lists(st.sampled_from([0.0, 0.3, 1.0]), max_size=12), st.lists(st.booleans(), max_size=9))
def test_a_teacher_goes_on_from_its_state(graph: Any, shares: list[float], more: list[bool]) -> None:
    edges, accepting = graph
    first, rng = Teacher(edges, 0, {accepting}), np.random.default_rng(5)
    for share in shares:
        first.advance(rng)
        assert first.current is not None
        first.attempted(first.current, slice_of(share, 30))
    second, other = Teacher(edges, 0, {accepting}), np.random.default_rng()
    second.load_state_dict(joined(*split(first.state_dict())))
    other.bit_generator.state = rng.bit_generator.state
    for success in more:
        for teacher, dice in ((first, rng), (second, other)):
            teacher.advance(dice)
            assert teacher.current is not None
            teacher.attempted(teacher.current, [Attempt(success, 3)] * 40)
    assert second.state_dict() == first.state_dict()
    assert second.worth() == first.worth()


# Who acts, and where attempts start


def test_a_learned_edge_acts_before_others_and_the_path_before_all() -> None:
    edges = named((0, 1), (0, 2), (1, 3), (2, 3), (3, 4), (5, 4))
    method = method_on(edges, teacher := Teacher(edges, 0, {4}))
    rng = np.random.default_rng(0)
    train(teacher, "e0-2", 1.0)
    train(teacher, "e0-1", 1.0)
    train(teacher, "e1-3", 0.6)
    method.advance("e1-3", [], rng)
    assert method.choose([0, 1, 2, 5]) == ["e0-1", "e1-3", "e2-3", "e5-4"]
    train(teacher, "e2-3", 1.0)
    train(teacher, "e3-4", 1.0)
    method.advance("e3-4", [], rng)
    assert method.choose([0, 1, 2, 3]) == ["e0-2", "e1-3", "e2-3", "e3-4"], "e1-3 is discarded, but known"
    assert method.choose([1, 4], among={"e0-1", "e2-3"}) == [None, None]


def check_starts(make: MakeTeacher) -> None:
    """Edges out of a vertex start where its learned edge arrived, and nowhere else."""
    edges = named((0, 1), (0, 2), (1, 3), (2, 3), (3, 4), (3, 5), (4, 6), (5, 6))
    method, rng = method_on(edges, make(edges, 0, {6})), np.random.default_rng(0)
    teacher: Any = method.upper

    def report(edge: str, successes: int, *numbers: int) -> list[tuple[str, int, int]]:
        u, v = edges[edge]
        teacher.current = edge if edge in teacher.q else None
        method.told(edge, [arrived(u, v)] * successes + [failed(u)] * (50 - successes))
        delivered = method.advance(edge, [(v, snapshot(number)) for number in numbers], rng)
        return [(receiver, q, int(state[0])) for receiver, q, state in delivered]

    assert report("e0-1", 50, 1, 2) == [("e1-3", 1, 1), ("e1-3", 1, 2)]
    assert report("e0-2", 50, 3) == [("e2-3", 2, 3)]
    assert report("e1-3", 20, 10, 11) == [], "not learned yet"
    assert report("e2-3", 30, 20) == []
    assert report("e2-3", 50, 21) == [(edge, 3, number) for edge in ("e3-4", "e3-5") for number in (20, 21)]
    assert report("e1-3", 50, 12) == [], "a discarded edge is late"
    assert report("e2-3", 0, 22) == [("e3-4", 3, 22), ("e3-5", 3, 22)], "the learned edge is not"


class AnyReachedState(Teacher):
    """Starts are the states that any edge into a vertex reached first."""

    def origin(self, vertex: int) -> str | None:
        return next((e for e, (_, to) in self._edges.items() if to == vertex and self._recent[e]), None)


def test_attempts_start_where_the_learned_edge_arrived() -> None:
    check_starts(Teacher)
    with pytest.raises(AssertionError):
        check_starts(AnyReachedState)


@given(graphs(), st.data())
def test_every_scheduled_edge_has_start_states_or_begins_at_the_reset(graph: Any, data: st.DataObject) -> None:
    edges, accepting = graph
    method = method_on(edges, Teacher(edges, 0, {accepting}))
    rng, starts = np.random.default_rng(data.draw(st.integers(0, 99))), dict.fromkeys(edges, 0)
    method.advance(next(iter(edges)), [], rng)
    for _ in range(30):
        (edge,) = method.schedule()
        u, v = edges[edge]
        assert u == 0 or starts[edge]
        assert method.learns(edge)
        successes = data.draw(st.sampled_from([0, 20, 47, 48, 50]))
        method.told(edge, [arrived(u, v)] * successes + [failed(u)] * (50 - successes))
        for receiver, q, _ in method.advance(edge, [(v, snapshot(n)) for n in range(min(successes, 5))], rng):
            assert q == edges[receiver][0]
            starts[receiver] += 1


def test_the_200_newest_arrivals_are_kept() -> None:
    edges = named((0, 1), (1, 2))
    method, rng = method_on(edges, teacher := Teacher(edges, 0, {2})), np.random.default_rng(0)
    for number in range(300):
        method.told("e0-1", [])
        assert method.advance("e0-1", [(1, snapshot(number))], rng) == []
    train(teacher, "e0-1", 1.0)
    assert [int(state[0]) for *_, state in method.advance("e0-1", [], rng)] == list(range(100, 300))


def test_entries_tell_others_all_that_they_need() -> None:
    method: Any = edge_task("lsts").method()
    train(method.upper, "e0-2", 1.0)
    train(method.upper, "e0-4", 0.4)
    method.advance("e0-4", [], np.random.default_rng(0))
    other: Any = edge_task("lsts").method()
    assert not set(other.schedule())
    other.load(method.entries())
    assert set(other.schedule()) == set(method.schedule()) == {method.upper.current}
    assert other.choose(range(6)) == method.choose(range(6))
    assert other.choose([0]) == ["e0-2"]
    assert other.entries() == method.entries()


@given(st.dictionaries(st.sampled_from(["0", "1", "2", "3", "4"]), st.floats(-1, 4)), st.booleans())
def test_a_plan_is_what_its_entries_say(worth: dict[str, float], learns: bool) -> None:
    plan = EdgePlan(worth, {"3": learns})
    assert EdgePlan.of(plan.entries(RELEASE), RELEASE) == plan


# Runs


def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Edges count as learned soon."""
    monkeypatch.setattr(lsts, "Teacher", partial(Teacher, window=8, threshold=0.3))


@pytest.mark.slow
def test_in_a_run_the_scheduled_edge_acts_from_states_of_the_learned_one(monkeypatch: pytest.MonkeyPatch) -> None:
    quick(monkeypatch)
    run = edge_run("lsts", "lsts.slice_attempts=8")
    teacher, before = upper_of(run), dict.fromkeys(run.sessions, 0)
    idle = 0
    for _ in range(80):
        scheduled = set(run.coordinator.method.schedule() or ())
        run.round()
        acted = {p for p, s in run.sessions.items() if s.learner.rollout.interactions > before[p]}
        assert acted <= scheduled
        idle = 0 if acted else idle + 1
        assert idle <= 2, "what is scheduled can start as soon as it hears of that"
        before = {pid: session.learner.rollout.interactions for pid, session in run.sessions.items()}
    for pid, record in run.coordinator.records.items():
        (source, _) = run.task.decomposition.subtasks[pid][0]
        assert bool(len(record.buffer)) == (teacher.origin(source) is not None)
    assert "e0-2" in teacher.learned
    assert run.coordinator.interactions == sum(before.values())


@pytest.mark.slow
def test_a_resumed_run_equals_the_uninterrupted_one(monkeypatch: pytest.MonkeyPatch) -> None:
    quick(monkeypatch)
    flags = ("lsts.slice_attempts=8",)
    whole, first = edge_run("lsts", *flags), edge_run("lsts", *flags)
    for rounds in (1, 9, 21, 14):
        for _ in range(rounds):
            whole.round()
            first.round()
        first = resumed(first, "lsts", *flags)
        assert fingerprint(first) == fingerprint(whole)
    assert upper_of(whole).learned


@pytest.mark.training
@pytest.mark.timeout(300)
def test_lsts_learns_a_path_of_task_7(tmp_path: Path) -> None:
    """About 20 s; with this seed the task is solved after 102,400 interactions."""
    task = compile_task(load_task("task7", flags=["learner.method=lsts", "max_interactions=250000"]))
    run = SerialRun(task, RunSettings(100, 250_000, lease_s=float("inf")), lambda: 0.0)
    for _ in run.steps():
        pass
    teacher = upper_of(run)
    assert len(teacher.learned) >= 1
    assert teacher.path or len(teacher.learned) > 1
    export_best(run.coordinator, tmp_path / "policy")
    exported, best = load(tmp_path / "policy"), run.coordinator.evaluations.best
    assert best is not None
    assert exported.config.learner.method == "lsts"
    assert exported.subtask_of == GlobalPolicy(task, best.snapshot.q_table, best.snapshot.weights).subtask_of
