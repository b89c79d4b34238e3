"""Selects the sub-tasks worth a learner: useful ones, one per set of transitions.

Both rules are ours (docs/decisions/019); with ``keep = "all"`` neither applies, as in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from t4nmtd_dist.automata.acceptance import unfulfilled_states
from t4nmtd_dist.automata.cubes import TruthTable
from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.reduction import Transition, shortest_distances

SubTasks = Mapping[str, Sequence[Transition]]


def without_useless(
    subtasks: SubTasks, dfa: DFA, accepting: Collection[int], allowed: TruthTable, deadline: Deadline | None = None
) -> dict[str, Sequence[Transition]]:
    """Drop sub-tasks whose literal never reduces the distance to acceptance.

    Distances count only the transitions of ``subtasks``. A literal helps with a transition (q, q') if q' is nearer to
    acceptance than q and, without the literal, some symbol of the transition would lead farther away than q'. A
    sub-task that helps with no transition is dropped, unless a state would lose its last transition towards acceptance.

    Args:
        subtasks: pid -> its transitions, assigned by objectives.
        dfa: the task automaton.
        accepting: the reachable part of F.
        allowed: symbols that can occur, shape (2**|AP|,).
        deadline: of the compilation.
    """
    distances = shortest_distances(
        {tau for taus in subtasks.values() for tau in taus}, accepting, unfulfilled_states(dfa)
    )
    dist = np.array([distances.get(q, math.inf) for q in range(dfa.states)])
    useless = [pid for pid in sorted(subtasks) if not _helps(pid, subtasks[pid], dfa, dist, allowed, deadline)]
    kept = dict(subtasks)
    for pid in useless:
        fewer = {other: taus for other, taus in kept.items() if other != pid}
        if _advancing(fewer, dist) == _advancing(kept, dist):
            kept = fewer
    return kept


def merged(subtasks: SubTasks, order: Sequence[str] = ()) -> dict[str, Sequence[Transition]]:
    """Merge sub-tasks with equal transitions into ``a&b``, names ordered by ``order``, others last."""
    places = {name: place for place, name in enumerate(order)}
    names: dict[frozenset[Transition], list[str]] = {}
    ordered = sorted(subtasks, key=lambda pid: (places.get(pid.removeprefix("~"), len(places)), pid))
    for pid, taus in ((pid, subtasks[pid]) for pid in ordered):
        names.setdefault(frozenset(taus), []).append(pid)
    return {"&".join(pids): sorted(taus) for taus, pids in names.items()}


def _helps(
    pid: str,
    taus: Sequence[Transition],
    dfa: DFA,
    dist: np.ndarray[tuple[int], np.dtype[np.float64]],
    allowed: TruthTable,
    deadline: Deadline | None,
) -> bool:
    """Whether a literal (or ``tick``) helps with one of its transitions."""
    bit = dfa.symbol([pid.removeprefix("~")])
    symbols = np.arange(allowed.size)
    usable = allowed & allowed[symbols ^ bit] & (((symbols & bit) > 0) != pid.startswith("~"))
    for q, target in taus:
        if deadline is not None:
            deadline.check("choosing sub-tasks")
        if dist[target] < dist[q]:
            taking = symbols[usable & dfa.symbols(q, target)]
            if not bit or (dist[dfa.delta[q, taking ^ bit]] > dist[target]).any():
                return True
    return False


def _advancing(subtasks: SubTasks, dist: np.ndarray[tuple[int], np.dtype[np.float64]]) -> set[int]:
    """States from which some sub-task reduces the distance to acceptance."""
    return {q for taus in subtasks.values() for q, target in taus if dist[target] < dist[q]}
