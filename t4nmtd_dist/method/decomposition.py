"""Task decomposition: assigns the DFA's transitions to sub-tasks, one per literal."""

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
    """The sub-tasks of a task, each a set of transitions that reach its goal.

    Attributes:
        subtasks: pid -> its transitions (q, q'), never empty; pids and transitions are sorted.
        left_out: pids dropped because they never reduce the distance to acceptance; for display.
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
        """Names of all sub-tasks, sorted."""
        return tuple(self.subtasks)

    @property
    def transitions(self) -> tuple[Transition, ...]:
        """The union of all sub-tasks' transitions, sorted."""
        return tuple(sorted({tau for taus in self.subtasks.values() for tau in taus}))

    def q_target(self, pid: str, q: int) -> frozenset[int]:
        """Q_target(q, T) = {q' : T has a transition from q to q'}.

        Raises:
            ConfigError: if the sub-task does not exist.
        """
        if pid not in self.subtasks:
            raise ConfigError(f"unknown sub-task {pid!r}; expected one of {', '.join(self.pids)}")
        return self._targets.get((pid, q), frozenset())

    def available(self, q: int) -> tuple[str, ...]:
        """Sub-tasks with a transition out of q, sorted."""
        return self._available.get(q, ())

    def to_json(self) -> dict[str, Any]:
        """JSON-ready form for ``from_json``."""
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
    """Assign the transitions of a task automaton to sub-tasks.

    Every mode starts from the transitions taken by symbols that ``exclusive`` allows, without self-loops, transitions
    out of F and transitions into E. ``prune`` drops those on no simple path from q0 to F, unless they make a formula
    true again whose trace ends with the episode (``automata.acceptance.unfulfilled_states``). The modes assign them as
    follows:

    - ``objective``: by the literals of the guard's prime implicants that do not hold while waiting in q; of each
      implicant the positive ones, or else the negative ones. ``keep="helpful"`` then drops sub-tasks that never reduce
      the distance to acceptance (only with ``prune``) and merges equal ones: ``a&b``.
    - ``literal``: by every literal of the label as :attr:`DFA.edges` writes it, the paper's wording at face value.
    - ``random``: to as many sub-tasks ``r1`` .. ``rn`` as ``objective`` finds, equally sized to within one; each
      transition belongs to as many of them as there.

    Args:
        dfa: the task automaton.
        exclusive: groups of propositions that never hold together.
        mode: how labels become sub-tasks.
        prune: drop transitions on no simple path to acceptance.
        error_transitions: also assign the transitions into E, which pruning keeps.
        keep: ``all`` is the paper's rule; tasks default to ``helpful``.
        order: order of names in merged sub-tasks.
        seed: for the random decomposition only.
        deadline: of the compilation.

    Raises:
        ConfigError: for an unknown mode, a proposition named ``tick``, unreachable acceptance, an automaton too complex
            to prune, or a passed deadline.
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
    """The automaton without excluded symbols; requires that acceptance is reachable."""
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
    """Transitions that sub-tasks may aim at, sorted."""
    progress = reduced.progress
    if not prune:
        return list(progress)
    unfulfilled = unfulfilled_states(dfa)
    fulfilling = {(q, target) for q, target in progress if q in unfulfilled and target not in unfulfilled}
    return sorted(edges_on_simple_paths(progress, dfa.initial, reduced.accepting, deadline) | fulfilling)


def _dealt(
    goals: Sequence[Transition], dfa: DFA, allowed: TruthTable, *, literal: bool, deadline: Deadline | None
) -> dict[str, list[Transition]]:
    """Transitions by sub-task."""
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
    """What the guard of a transition requires beyond what holds while waiting in its source."""
    label = prime_implicants(dfa.symbols(*tau) & allowed, ~allowed, dfa.propositions)
    return {pid for implicant in label for pid in _implicant_pids(implicant, waiting)}


def _implicant_pids(implicant: Cube, waiting: frozenset[str]) -> tuple[str, ...]:
    if not implicant:
        return (TICK,)
    objectives = tuple(literal for literal in implicant if literal not in waiting)
    positive = tuple(literal for literal in objectives if not literal.startswith("~"))
    return positive or objectives


def _entailed(symbols: TruthTable, propositions: tuple[str, ...]) -> frozenset[str]:
    """Literals that hold in all given symbols, if any."""
    held = np.flatnonzero(symbols)
    if not held.size:
        return frozenset()
    always = int(np.bitwise_and.reduce(held))
    ever = int(np.bitwise_or.reduce(held))
    positive = {name for i, name in enumerate(propositions) if always >> i & 1}
    return frozenset(positive | {f"~{name}" for i, name in enumerate(propositions) if not ever >> i & 1})


def _literal_pids(dfa: DFA, tau: Transition, allowed: TruthTable) -> set[str]:
    """Literals of the label as written, without unsatisfiable cubes."""
    cubes = [cube for cube in dfa.edges[tau] if _satisfiable(dfa, cube, allowed)]
    return {literal for cube in cubes for literal in cube or (TICK,)}


def _satisfiable(dfa: DFA, cube: Cube, allowed: TruthTable) -> bool:
    """Whether some allowed symbol satisfies a cube."""
    symbols = np.flatnonzero(allowed)
    for literal in cube:
        holds = (symbols & dfa.symbol([literal.removeprefix("~")])) > 0
        symbols = symbols[holds != literal.startswith("~")]
    return symbols.size > 0


def _shuffled(decomposition: Decomposition, seed: int) -> Decomposition:
    """Redistribute the transitions at random, with the same multiplicities."""
    shares = Counter(tau for taus in decomposition.subtasks.values() for tau in taus)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(shares))
    deck = [tau for _, tau in sorted(zip(order, sorted(shares), strict=True)) for _ in range(shares[tau])]
    count = len(decomposition.pids)
    # Copies of a transition are adjacent in the deck and at most as many as the sub-tasks, so none gets two.
    return Decomposition({f"r{k + 1}": tuple(deck[k::count]) for k in range(count)})


def _groups_text(exclusive: ExclusiveGroups) -> str:
    return "; ".join(", ".join(group) for group in exclusive) or "(none)"
