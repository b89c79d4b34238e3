"""DIRL: the search's traces, estimates of what a policy is worth, whose states start whose attempts, and runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from edge_methods import (
    Edges,
    arrived,
    edge_run,
    edge_task,
    failed,
    fingerprint,
    graphs,
    method_on,
    named,
    resumed,
    simple_paths,
    snapshot,
    upper_of,
)
from hypothesis import given
from hypothesis import strategies as st

from coordinator.run_settings import RunSettings
from t4nmtd_dist.core.state_dict import joined, split
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method import dirl
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.method.dirl_planner import Candidate, Planner
from t4nmtd_dist.method.edge_attempts import Attempt
from t4nmtd_dist.tasks import load_task

FIVE = named((0, 1), (0, 2), (1, 3), (2, 3), (3, 4))
RATES = {"e0-1": 0.9, "e0-2": 0.6, "e1-3": 0.3, "e2-3": 0.9, "e3-4": 1.0}
"""A graph on which the greedy choice at 0 is wrong."""

MakePlanner = Callable[..., Planner]


def searched(make: MakePlanner, edges: Edges, rates: Mapping[str, float], accepting: int) -> Planner:
    """A search in which every edge turns out to have its scripted success rate."""
    planner = make(edges, 0, {accepting}, interactions=100)
    trained = []
    planner.advance()
    while not planner.is_over:
        assert planner.current is not None
        trained.append(planner.current)
        planner.estimated(planner.current, rates[planner.current])
        planner.advance()
    assert len(set(trained)) == len(trained), "no edge is trained twice"
    assert set(trained) == set(planner.p)
    return planner


def success_of(path: tuple[str, ...], rates: Mapping[str, float]) -> float:
    return math.prod(rates[edge] for edge in path)


# The search


def check_search(make: MakePlanner) -> None:
    planner = searched(make, FIVE, RATES, 4)
    assert planner.explored == [0, 1, 2, 3, 4]
    assert planner.path == ("e0-2", "e2-3", "e3-4")
    assert success_of(planner.path, RATES) == pytest.approx(0.54)


def test_the_search_finds_the_most_probable_path() -> None:
    check_search(Planner)


class Greedy(Planner):
    """Goes where the last edge succeeds most often, whatever it took to get there."""

    def _explore_nearest(self) -> None:
        last = self.explored[-1]
        self._queue = [
            Candidate(each.cost if self._edges[each.edge][0] == last else each.cost + 100.0, *each[1:])
            for each in self._queue
        ]
        super()._explore_nearest()


class FirstComeFirstServed(Planner):
    def _explore_nearest(self) -> None:
        self._queue = [Candidate(float(each.number), *each[1:]) for each in self._queue]
        super()._explore_nearest()


class Additive(Planner):
    """Adds up 1 - p instead of -log p."""

    def estimated(self, edge: str, p: float) -> None:
        super().estimated(edge, 0.0 if p == 0.0 else math.exp(p - 1.0))


@pytest.mark.parametrize("broken", [Greedy, FirstComeFirstServed])
def test_the_trace_shows_a_wrong_order(broken: MakePlanner) -> None:
    with pytest.raises(AssertionError):
        check_search(broken)


def test_a_greedy_choice_takes_the_worse_path() -> None:
    planner = searched(Greedy, FIVE, RATES, 4)
    assert planner.path == ("e0-1", "e1-3", "e3-4")
    assert success_of(planner.path, RATES) == pytest.approx(0.27)


def check_most_probable(make: MakePlanner, edges: Edges, accepting: int, rates: Mapping[str, float]) -> None:
    planner = searched(make, edges, rates, accepting)
    best = max(success_of(path, rates) for path in simple_paths(edges, 0, accepting))
    if best == 0.0:
        assert planner.path == ()
        assert accepting not in planner.explored
    else:
        assert success_of(planner.path, rates) == pytest.approx(best)
        walk = [edges[edge] for edge in planner.path]
        assert (walk[0][0], walk[-1][1]) == (0, accepting)
        assert all(a[1] == b[0] for a, b in pairwise(walk))
    costs = [planner._cost[vertex] for vertex in planner.explored]
    assert costs == sorted(costs)


@given(graphs(), st.data())
def test_of_all_simple_paths_it_is_the_most_probable(graph: Any, data: st.DataObject) -> None:
    edges, accepting = graph
    rates = {edge: data.draw(st.sampled_from([0.0, 0.02, 0.3, 0.5, 0.7, 0.98, 1.0])) for edge in edges}
    check_most_probable(Planner, edges, accepting, rates)


def test_sums_of_failure_rates_are_another_order() -> None:
    edges, rates = named((0, 1), (0, 2), (1, 3), (2, 3)), {"e0-1": 0.5, "e1-3": 0.5, "e0-2": 1.0, "e2-3": 0.2}
    check_most_probable(Planner, edges, 3, rates)
    with pytest.raises(AssertionError):
        check_most_probable(Additive, edges, 3, rates)


def test_a_dead_end_loses_to_the_longer_path() -> None:
    edges = named((0, 1), (1, 4), (0, 2), (2, 3), (3, 4))
    rates = {"e0-1": 1.0, "e1-4": 0.0, "e0-2": 0.5, "e2-3": 0.5, "e3-4": 0.5}
    planner = searched(Planner, edges, rates, 4)
    assert planner.path == ("e0-2", "e2-3", "e3-4")
    assert planner.p["e1-4"] == 0.0


@pytest.mark.parametrize("stop", ["e0-1", "e1-2"])
def test_without_a_path_nobody_acts_and_what_was_tried_trains_on(stop: str) -> None:
    edges = named((0, 1), (1, 2))
    planner = searched(Planner, edges, dict.fromkeys(edges, 1.0) | {stop: 0.0}, 2)
    assert planner.path == ()
    method = method_on(edges, planner)
    spent = dict.fromkeys(planner.p, 0)
    for _ in range(20):
        method.advance("e0-1", [], np.random.default_rng(0))
        assert method.choose([0, 1]) == [None, None]
        ((edge, learns),) = planner.working().items()
        assert learns
        spent[edge] += 7
        planner.attempted(edge, [Attempt(True, 7)])
    assert planner.is_over
    assert max(spent.values()) - min(spent.values()) <= 7


# Training and estimates


def at_first_edge(**settings: int) -> Planner:
    planner = Planner(FIVE, 0, {4}, **({"interactions": 1000} | settings))
    planner.advance()
    assert planner.current == "e0-1"
    return planner


def test_an_edge_trains_for_k_interactions() -> None:
    planner = at_first_edge()
    planner.attempted("e0-1", [Attempt(False, 60)] * 16)
    assert planner.working() == {"e0-1": True}
    planner.attempted("e0-1", [Attempt(False, 40)])
    assert planner.working() == {"e0-1": False}


def test_20_successes_in_a_row_end_the_training_early() -> None:
    planner = at_first_edge()
    planner.attempted("e0-1", [Attempt(True, 1)] * 19)
    planner.attempted("e0-1", [Attempt(False, 1)])
    planner.attempted("e0-1", [Attempt(True, 1)] * 19)
    assert planner.phase == "training"
    planner.attempted("e0-1", [Attempt(True, 1)])
    assert planner.phase == "estimating"


def test_the_estimate_is_of_50_attempts_made_after_training() -> None:
    planner = at_first_edge()
    planner.attempted("e0-1", [Attempt(True, 1)] * 200)
    assert planner.p == {}, "those of the training do not count"
    planner.attempted("e0-1", [Attempt(number % 4 == 0, 5) for number in range(40)])
    planner.attempted("e0-2", [Attempt(True, 5)] * 50)
    assert planner.p == {}
    planner.attempted("e0-1", [Attempt(False, 5)] * 24)
    assert planner.p == {"e0-1": 10 / 64}
    planner.advance()
    planner.attempted("e0-1", [Attempt(True, 5)] * 50)
    assert (planner.current, planner.phase, planner.p) == ("e0-2", "training", {"e0-1": 10 / 64})


def test_k_is_an_equal_share_of_the_budget_unless_it_is_given() -> None:
    for flags, expected in (((), 5_000_000 // 12), (("dirl.edge_interactions=700",), 700)):
        method: Any = edge_task("dirl", *flags).method()
        assert method.upper._interactions == expected


# Whose states


def check_starts(make: MakePlanner) -> None:
    """On ``FIVE`` the edge out of 3 starts in states that were reached through 2, while the policy was estimated."""
    planner = make(FIVE, 0, {4}, interactions=100)
    method, rng = method_on(FIVE, planner), np.random.default_rng(0)
    delivered: dict[str, list[int]] = {edge: [] for edge in FIVE}

    def report(edge: str, successes: int, attempts: int, *numbers: int) -> None:
        u, v = FIVE[edge]
        method.told(edge, [arrived(u, v)] * successes + [failed(u)] * (attempts - successes))
        for receiver, q, state in method.advance(edge, [(v, snapshot(number)) for number in numbers], rng):
            assert q == FIVE[receiver][0]
            delivered[receiver].append(int(state[0]))

    planner.advance()
    for number, (edge, rate) in enumerate([("e0-1", 0.9), ("e0-2", 0.6), ("e1-3", 0.3), ("e2-3", 0.9)], start=1):
        assert planner.current == edge
        source = FIVE[edge][0]
        assert delivered[edge] == ([] if source == 0 else [10 * source + 1, 10 * source + 2])
        report(edge, 0, 10, 10 * number)
        assert not method.learns(edge)
        report(edge, round(25 * rate), 25, 10 * number + 1)
        report(edge, round(50 * rate) - round(25 * rate), 25, 10 * number + 2)
        report(edge, 3, 3, 10 * number + 2)
    assert planner.current == "e3-4"
    assert planner.p == pytest.approx({edge: RATES[edge] for edge in ("e0-1", "e0-2", "e1-3", "e2-3")})
    assert delivered["e3-4"] == [41, 42], "the states of e2-3; not those of e1-3, which also leads to 3"


class AnyReachedState(Planner):
    def origin(self, vertex: int) -> str | None:
        return next((edge for edge in self.p if self._edges[edge][1] == vertex), None)


class TrainingStatesToo(Planner):
    def keeps(self, edge: str) -> bool:
        return True


@pytest.mark.parametrize("broken", [AnyReachedState, TrainingStatesToo])
def test_attempts_start_where_the_parents_policy_arrived(broken: MakePlanner) -> None:
    check_starts(Planner)
    with pytest.raises(AssertionError):
        check_starts(broken)


@given(graphs(), st.data())
def test_every_scheduled_edge_has_start_states_or_begins_at_the_reset(graph: Any, data: st.DataObject) -> None:
    edges, accepting = graph
    planner = Planner(edges, 0, {accepting}, interactions=20)
    method, rng = method_on(edges, planner), np.random.default_rng(0)
    starts = dict.fromkeys(edges, 0)
    method.advance(next(iter(edges)), [], rng)
    for _ in range(30):
        (edge,) = method.schedule()
        u, v = edges[edge]
        assert u == 0 or starts[edge]
        assert planner.is_over or edge not in planner.p
        assert u in planner.explored
        successes = data.draw(st.integers(0, 50))
        method.told(edge, [arrived(u, v)] * successes + [failed(u)] * (50 - successes))
        for receiver, *_ in method.advance(edge, [(v, snapshot(n)) for n in range(min(successes, 5))], rng):
            starts[receiver] += 1


@given(graphs(), st.lists(st.integers(0, 50), max_size=12), st.lists(st.integers(0, 50), max_size=9))
def test_a_planner_goes_on_from_its_state(graph: Any, before: list[int], after: list[int]) -> None:
    edges, accepting = graph

    def going_on(planner: Planner, course: list[int]) -> None:
        for successes in course:
            planner.advance()
            assert planner.current is not None
            planner.attempted(planner.current, [Attempt(n < successes, 1) for n in range(50)])

    first, second = (Planner(edges, 0, {accepting}, interactions=60) for _ in range(2))
    going_on(first, before)
    second.load_state_dict(joined(*split(first.state_dict())))
    for planner in (first, second):
        going_on(planner, after)
    assert second.state_dict() == first.state_dict()
    assert (second.path, second.worth()) == (first.path, first.worth())


# Runs


def quick(monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    """Edges are trained and estimated soon; settings that go with that."""
    monkeypatch.setattr(dirl, "Planner", partial(Planner, in_a_row=3, estimate_attempts=6))
    return ("dirl.edge_interactions=500",)


@pytest.mark.slow
def test_in_a_run_estimates_change_no_policy_and_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    run = edge_run("dirl", *quick(monkeypatch))
    planner, rehearsed = upper_of(run), 0
    for _ in range(120):
        before = {
            pid: (s.learner.version, s.learner.gradient_steps, s.learner.rollout.interactions)
            for pid, s in run.sessions.items()
        }
        learns = {pid: session.method.learns(pid) for pid, session in run.sessions.items()}
        run.round()
        for pid, session in run.sessions.items():
            learner = session.learner
            if not learns[pid] and learner.rollout.interactions > before[pid][2]:
                rehearsed += 1
                assert (learner.version, learner.gradient_steps) == before[pid][:2]
    assert rehearsed >= 2 * len(planner.p)
    assert planner.p.get("e0-2", 0.0) > 0.0
    assert 2 in planner.explored
    assert run.coordinator.interactions == sum(s.learner.rollout.interactions for s in run.sessions.values())
    origins = {planner.origin(q) for q in range(6)}
    for pid, record in run.coordinator.records.items():
        source = run.task.decomposition.subtasks[pid][0][0]
        assert bool(len(record.buffer)) == (planner.origin(source) is not None)
    assert origins <= {None, *(edge for edge, p in planner.p.items() if p > 0.0)}


@pytest.mark.slow
def test_a_resumed_run_equals_the_uninterrupted_one(monkeypatch: pytest.MonkeyPatch) -> None:
    flags = quick(monkeypatch)
    whole, first = edge_run("dirl", *flags), edge_run("dirl", *flags)
    milestones: list[Callable[[Planner], bool]] = [
        lambda planner: planner.current is not None,
        lambda planner: planner.phase == "estimating" and planner._tries > 0,
        lambda planner: len(planner.p) == 1,
        lambda planner: 2 in planner.explored,
        lambda planner: planner.phase == "estimating",
        lambda planner: len(planner.p) > 3,
    ]
    for reached in milestones:
        for _ in range(200):
            whole.round()
            first.round()
            if reached(upper_of(whole)):
                break
        assert reached(upper_of(whole))
        first = resumed(first, "dirl", *flags)
        assert fingerprint(first) == fingerprint(whole)


@pytest.mark.training
@pytest.mark.timeout(300)
def test_dirl_learns_an_edge_of_task_7() -> None:
    """About 25 s; with this seed it finds a path and solves the task."""
    flags = ["learner.method=dirl", "max_interactions=200000"]
    run = SerialRun(compile_task(load_task("task7", flags=flags)), RunSettings(100, 200_000), lambda: 0.0)
    for _ in run.steps():
        pass
    planner = upper_of(run)
    assert max(planner.p.values()) > 0.8
    assert len(planner.explored) > 1
