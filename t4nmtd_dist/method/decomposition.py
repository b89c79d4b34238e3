"""Task decomposition: the transitions of a DFA dealt to sub-tasks, one per literal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np

from t4nmtd_dist.automata.acceptance import unfulfilled_states
from t4nmtd_dist.automata.cubes import Cube, TruthTable, prime_implicants
from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.reduction import (
    ExclusiveGroups,
    ReducedAutomaton,
    Transition,
    allowed_symbols,
    reduce_automaton,
)
from t4nmtd_dist.automata.simple_paths import edges_on_simple_paths
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.method.helpful import merged, without_useless

Mode = Literal["objective", "literal", "random"]
Keep = Literal["helpful", "all"]

TICK = "tick"


@dataclass(frozen=True)
class Decomposition:
    """Sub-tasks of a task: each a set of transitions that count as reaching its goal.

    Attributes:
        subtasks: pid -> its transitions (q, q'), sorted; pids in sorted order; none is empty.
        left_out: pids that were dropped because they never bring acceptance nearer; for human readers.
    """

    subtasks: Mapping[str, tuple[Transition, ...]]
    left_out: tuple[str, ...] = field(default=(), compare=False)
    _targets: dict[tuple[str, int], frozenset[int]] = field(init=False, repr=False, compare=False)
    _available: dict[int, tuple[str, ...]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        ordered = {pid: tuple(sorted(set(taus))) for pid, taus in sorted(self.subtasks.items()) if taus}
        targets: dict[tuple[str, int], set[int]] = {}
        for pid, taus in ordered.items():
            for q, target in taus:
                targets.setdefault((pid, q), set()).add(target)
        available: dict[int, list[str]] = {}
        for pid, q in targets:
            available.setdefault(q, []).append(pid)
        object.__setattr__(self, "subtasks", MappingProxyType(ordered))
        object.__setattr__(self, "_targets", {key: frozenset(to) for key, to in targets.items()})
        object.__setattr__(self, "_available", {q: tuple(pids) for q, pids in available.items()})

    @property
    def pids(self) -> tuple[str, ...]:
        """The names of all sub-tasks, sorted."""
        return tuple(self.subtasks)

    @property
    def transitions(self) -> tuple[Transition, ...]:
        """Every transition of any sub-task once, sorted."""
        return tuple(sorted({tau for taus in self.subtasks.values() for tau in taus}))

    def q_target(self, pid: str, q: int) -> frozenset[int]:
        """Q_target(q, T) = {q' : some transition of T goes from q to q'}.

        Raises:
            ConfigError: if there is no sub-task of that name.
        """
        if pid not in self.subtasks:
            raise ConfigError(f"unknown sub-task {pid!r}; expected one of {', '.join(self.pids)}")
        return self._targets.get((pid, q), frozenset())

    def available(self, q: int) -> tuple[str, ...]:
        """The sub-tasks that have a transition out of q, sorted."""
        return self._available.get(q, ())

    def to_json(self) -> dict[str, Any]:
        """A JSON-ready form that ``from_json`` reads back."""
        return {pid: [list(tau) for tau in taus] for pid, taus in self.subtasks.items()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Decomposition:
        """Rebuild a decomposition from ``to_json``.

        Raises:
            ConfigError: if a sub-task is not a list of pairs of state numbers.
        """
        try:
            return cls({pid: tuple((int(q), int(target)) for q, target in data[pid]) for pid in data})
        except (TypeError, ValueError) as error:
            raise ConfigError(f"sub-tasks: expected {{pid: [[q, q'], ...]}}, got {data!r}") from error


def decompose(
    dfa: DFA,
    *,
    exclusive: ExclusiveGroups = (),
    mode: Mode = "objective",
    prune: bool = True,
    error_transitions: bool = False,
    keep: Keep = "all",
    order: Sequence[str] = (),
    seed: int = 0,
    deadline: Deadline | None = None,
) -> Decomposition:
    """Deal the transitions of a task automaton to sub-tasks.

    Every mode starts from the same transitions: those of the automaton without the symbols that ``exclusive``
    rules out, less self-loops, transitions out of F and transitions into E; ``prune`` leaves out those that
    lie on no simple path from q0 to F, except those that make a formula true again whose trace ends with the
    episode (``automata.acceptance.unfulfilled_states``). What differs is who gets them:

    - ``objective``: the literals of the guard's prime implicants that do not hold already while waiting in q;
      of each implicant the positive ones, or if it has none, the negative ones. ``keep="helpful"`` then leaves
      out those that never bring acceptance nearer (only with ``prune``) and merges equal ones: ``a&b``.
    - ``literal``: every literal of the label as :attr:`DFA.edges` writes it, the paper's wording at face value.
    - ``random``: as many sub-tasks ``r1`` .. ``rn`` as ``objective`` finds, sizes even to within one; each
      transition lies in as many of them as it does there.

    Args:
        dfa: the task automaton; sub-tasks speak of its states.
        exclusive: groups of propositions that can never hold together.
        mode: how labels become sub-tasks.
        prune: leave out the transitions that no simple path to acceptance takes.
        error_transitions: deal the transitions into E, too, which no pruning leaves out.
        keep: ``all`` is the rule of the paper; a task's setting is ``helpful`` by default.
        order: of the names in merged sub-tasks.
        seed: of the random decomposition; the other modes do not use it.
        deadline: of the compilation that this is part of.

    Raises:
        ConfigError: for an unknown mode or a proposition named ``tick``, if acceptance cannot be reached,
            if the automaton is too large and tangled to prune, or if the deadline passes.
    """
    _check_choices(dfa, mode, keep)
    reduced = _solvable(dfa, exclusive)
    if mode == "literal":
        dfa.find_edges(deadline)
    goals = _goals(dfa, reduced, prune, deadline)
    if error_transitions:
        goals = sorted({*goals, *reduced.failures})
    allowed = allowed_symbols(dfa, exclusive)
    dealt = _dealt(goals, dfa, allowed, literal=mode == "literal", deadline=deadline)
    if mode == "literal" or keep == "all":
        decomposition = _decomposition(dealt)
    else:
        helpful = without_useless(dealt, dfa, reduced.accepting, allowed, deadline) if prune else dealt
        decomposition = _decomposition(merged(helpful, order), left_out=sorted(dealt.keys() - helpful.keys()))
    return _shuffled(decomposition, seed) if mode == "random" else decomposition


def _check_choices(dfa: DFA, mode: Mode, keep: Keep) -> None:
    if mode not in get_args(Mode):
        raise ConfigError(f"unknown decomposition {mode!r}; expected one of {', '.join(get_args(Mode))}")
    if keep not in get_args(Keep):
        raise ConfigError(f"unknown keep {keep!r}; expected one of {', '.join(get_args(Keep))}")
    if TICK in dfa.propositions:
        raise ConfigError(f"{TICK!r} names the sub-task that only waits; give the proposition another name")


def _solvable(dfa: DFA, exclusive: ExclusiveGroups) -> ReducedAutomaton:
    """The automaton without excluded symbols, if acceptance is still reachable."""
    reduced = reduce_automaton(dfa, exclusive)
    if not reduced.accepting:
        raise ConfigError(
            f"no accepting state can be reached with the exclusive propositions {_groups_text(exclusive)}; "
            "change the formula or the groups"
        )
    return reduced


def _decomposition(subtasks: Mapping[str, Sequence[Transition]], left_out: Sequence[str] = ()) -> Decomposition:
    return Decomposition({pid: tuple(taus) for pid, taus in subtasks.items()}, tuple(left_out))


def _goals(dfa: DFA, reduced: ReducedAutomaton, prune: bool, deadline: Deadline | None) -> list[Transition]:
    """The transitions that sub-tasks may aim at, sorted."""
    progress = reduced.progress
    if not prune:
        return list(progress)
    unfulfilled = unfulfilled_states(dfa)
    fulfilling = {(q, target) for q, target in progress if q in unfulfilled and target not in unfulfilled}
    return sorted(edges_on_simple_paths(progress, dfa.initial, reduced.accepting, deadline) | fulfilling)


def _dealt(
    goals: Sequence[Transition], dfa: DFA, allowed: TruthTable, *, literal: bool, deadline: Deadline | None
) -> dict[str, list[Transition]]:
    """The transitions of every sub-task."""
    dealt: dict[str, list[Transition]] = {}
    waiting = {q: _entailed(dfa.symbols(q, q) & allowed, dfa.propositions) for q in {q for q, _ in goals}}
    for tau in goals:
        if deadline is not None:
            deadline.check("dealing its transitions to sub-tasks")
        pids = _literal_pids(dfa, tau, allowed) if literal else _objectives(dfa, tau, allowed, waiting[tau[0]])
        for pid in pids:
            dealt.setdefault(pid, []).append(tau)
    return dealt


def _objectives(dfa: DFA, tau: Transition, allowed: TruthTable, waiting: frozenset[str]) -> set[str]:
    """The pids of a transition: what its guard asks for beyond what holds while waiting in its source."""
    label = prime_implicants(dfa.symbols(*tau) & allowed, ~allowed, dfa.propositions)
    return {pid for implicant in label for pid in _implicant_pids(implicant, waiting)}


def _implicant_pids(implicant: Cube, waiting: frozenset[str]) -> tuple[str, ...]:
    if not implicant:
        return (TICK,)
    objectives = tuple(literal for literal in implicant if literal not in waiting)
    positive = tuple(literal for literal in objectives if not literal.startswith("~"))
    return positive or objectives


def _entailed(symbols: TruthTable, propositions: tuple[str, ...]) -> frozenset[str]:
    """The literals that hold in all the given symbols; none if there is no symbol."""
    held = np.flatnonzero(symbols)
    if not held.size:
        return frozenset()
    always = int(np.bitwise_and.reduce(held))
    ever = int(np.bitwise_or.reduce(held))
    positive = {name for i, name in enumerate(propositions) if always >> i & 1}
    return frozenset(positive | {f"~{name}" for i, name in enumerate(propositions) if not ever >> i & 1})


def _literal_pids(dfa: DFA, tau: Transition, allowed: TruthTable) -> set[str]:
    """Every literal of the label as written, leaving out cubes that no allowed symbol satisfies."""
    cubes = [cube for cube in dfa.edges[tau] if _satisfiable(dfa, cube, allowed)]
    return {literal for cube in cubes for literal in cube or (TICK,)}


def _satisfiable(dfa: DFA, cube: Cube, allowed: TruthTable) -> bool:
    """Whether some allowed symbol makes every literal of a cube true."""
    symbols = np.flatnonzero(allowed)
    for literal in cube:
        holds = (symbols & dfa.symbol([literal.removeprefix("~")])) > 0
        symbols = symbols[holds != literal.startswith("~")]
    return symbols.size > 0


def _shuffled(decomposition: Decomposition, seed: int) -> Decomposition:
    """The same transitions, each as often as before, dealt at random to as many sub-tasks."""
    shares = Counter(tau for taus in decomposition.subtasks.values() for tau in taus)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(shares))
    deck = [tau for _, tau in sorted(zip(order, sorted(shares), strict=True)) for _ in range(shares[tau])]
    count = len(decomposition.pids)
    # Copies of a transition are neighbours in the deck and fewer than the sub-tasks, so no one gets two.
    return Decomposition({f"r{k + 1}": tuple(deck[k::count]) for k in range(count)})


def _groups_text(exclusive: ExclusiveGroups) -> str:
    return "; ".join(", ".join(group) for group in exclusive) or "(none)"
