"""Graphs, worlds and runs for the tests of methods whose policies are edges."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st
from numpy.typing import NDArray
from small_tasks import START, TINY, TO_PASSENGER_2, snapshot_after

from coordinator.run_settings import RunSettings
from t4nmtd_dist.automata.simple_paths import edges_on_simple_paths
from t4nmtd_dist.core.state_dict import copied, joined, split
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.edges import EdgeMethod, UpperLevel
from t4nmtd_dist.method.protocol import NO_TARGET, Change
from t4nmtd_dist.tasks import load_task

Transition = tuple[int, int]
Edges = dict[str, Transition]

SHORT = ("environment.horizon=20", "learner.attempt_steps=12", "evaluation.every=100", "evaluation.episodes=2")


@st.composite
def graphs(draw: st.DrawFn) -> tuple[Edges, int]:
    """Edges of a graph of up to seven vertices that all lie on simple paths from 0 to F, and F."""
    count = draw(st.integers(2, 7))
    pairs = [(u, v) for u in range(count - 1) for v in range(count) if u != v]
    chosen = draw(st.lists(st.sampled_from(pairs), unique=True, min_size=1))
    found = edges_on_simple_paths(sorted(chosen), 0, frozenset({count - 1}), None)
    assume(found)
    return named(*sorted(found)), count - 1


def named(*transitions: Transition) -> Edges:
    return {f"e{u}-{v}": (u, v) for u, v in transitions}


def simple_paths(edges: Edges, source: int, target: int, seen: tuple[int, ...] = ()) -> Iterator[tuple[str, ...]]:
    """All of them, as edges."""
    if source == target:
        yield ()
    for edge, (u, v) in edges.items():
        if u == source and v not in seen:
            for rest in simple_paths(edges, v, target, (*seen, source)):
                yield (edge, *rest)


def method_on(edges: Edges, upper: UpperLevel) -> EdgeMethod:
    """The rules for a graph without a task: only those that need no role."""
    dfa: Any = SimpleNamespace(states=1 + max(v for _, v in edges.values()))
    decomposition = Decomposition({edge: (transition,) for edge, transition in edges.items()})
    nothing: Any = None
    return EdgeMethod(nothing, dfa, decomposition, nothing, upper)


def failed(q: int, steps: int = 10) -> Change:
    return Change(q, NO_TARGET, steps, 0.0)


def arrived(q: int, q_next: int, steps: int = 10) -> Change:
    return Change(q, q_next, steps, 1.0)


def snapshot(number: int) -> NDArray[Any]:
    return np.array([number])


@cache
def edge_task(name: str, *flags: str) -> CompiledTask:
    """Task 7 for a method, with tiny learners and short attempts."""
    return compile_task(load_task("task7", flags=[*TINY, *SHORT, f"learner.method={name}", *flags]))


def edge_run(name: str, *flags: str) -> SerialRun:
    """A run in which the first edge to passenger 2 often begins where the passenger waits."""
    run = SerialRun(edge_task(name, *flags), RunSettings(3, 10**9, lease_s=float("inf")), lambda: 0.0)
    run.sessions["e0-2"].buffer.add(START, snapshot_after(*TO_PASSENGER_2))
    return run


def upper_of(run: SerialRun) -> Any:
    method: Any = run.coordinator.method
    return method.upper


def resumed(run: SerialRun, name: str, *flags: str) -> SerialRun:
    """A fresh run that goes on from the other's state, as files keep it."""
    fresh = SerialRun(edge_task(name, *flags), RunSettings(3, 10**9, lease_s=float("inf")), lambda: 7.0)
    fresh.load_state_dict(joined(*split(copied(run.state_dict()))))
    return fresh


def fingerprint(run: SerialRun) -> Mapping[str, Any]:
    """All that a run comes to."""
    method: Any = run.coordinator.method
    return {
        "upper": method.upper.state_dict(),
        "entries": method.entries(),
        "interactions": run.coordinator.interactions,
        "weights": {
            f"{pid}/{name}": array.tobytes()
            for pid, session in run.sessions.items()
            for name, array in session.learner.weights().items()
        },
        "buffers": {
            pid: [(cursor, q, state.tobytes()) for cursor, q, state in record.buffer.since(0, 10**6)]
            for pid, record in run.coordinator.records.items()
        },
        "evaluations": [(row.interactions, row.success_rate) for row in run.coordinator.evaluations.history],
        "attempts": {pid: session.learner.rollout.statistics.counts for pid, session in run.sessions.items()},
    }
