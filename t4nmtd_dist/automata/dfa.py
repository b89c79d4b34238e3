"""A task's deterministic finite automaton: states, transition table, and JSON form."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.cubes import Guard, irredundant_cover
from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.core.errors import ConfigError

MAX_PROPOSITIONS = 16


@dataclass(frozen=True, eq=False)
class DFA:
    """A complete DFA <Q, 2^AP, delta, q0, F> whose symbols are sets of propositions.

    Bit i of a symbol is set iff ``propositions[i]`` holds. States are numbered by breadth-first search from ``initial``
    (always 0) with symbols ascending, so equal languages have equal automata.

    Attributes:
        propositions: AP, sorted, at most 16 names.
        delta: int32 array of shape (states, 2**len(propositions)); ``delta[q, symbol]`` is the next state.
        accepting: F, never with the initial state, since traces are not empty.
    """

    propositions: tuple[str, ...]
    delta: NDArray[np.int32]
    accepting: frozenset[int]
    initial: int = 0
    _bit: dict[str, int] = field(init=False, repr=False)
    _edges: dict[tuple[int, int], Guard] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        if self.delta.shape[1] != 1 << len(self.propositions):
            raise ValueError(f"delta has {self.delta.shape[1]} symbols, expected {1 << len(self.propositions)}")
        object.__setattr__(self, "_bit", {name: 1 << i for i, name in enumerate(self.propositions)})
        self.delta.setflags(write=False)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, DFA):
            return NotImplemented
        return (
            self.propositions == other.propositions
            and self.accepting == other.accepting
            and self.initial == other.initial
            and np.array_equal(self.delta, other.delta)
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def states(self) -> int:
        """Number of states."""
        return int(self.delta.shape[0])

    @cached_property
    def _table(self) -> list[list[int]]:
        """``delta`` as nested lists, which Python indexes faster than numpy scalars."""
        rows: list[list[int]] = self.delta.tolist()
        return rows

    def symbol(self, labels: Iterable[str]) -> int:
        """The symbol in which exactly ``labels`` hold; names outside AP are ignored."""
        bit = self._bit
        code = 0
        for name in labels:
            code |= bit.get(name, 0)
        return code

    def step(self, q: int, labels: Iterable[str]) -> int:
        """delta(q, labels): the state after reading one set of propositions."""
        return self._table[q][self.symbol(labels)]

    @cached_property
    def error(self) -> frozenset[int]:
        """E: states from which no accepting state is reachable."""
        alive = set(self.accepting)
        grew = True
        while grew:
            into = np.isin(self.delta, list(alive)).any(axis=1)
            found = {int(q) for q in np.flatnonzero(into)} - alive
            alive |= found
            grew = bool(found)
        return frozenset(range(self.states)) - alive

    @property
    def edges(self) -> dict[tuple[int, int], Guard]:
        """Every (source, target) pair with its guard as an irredundant list of cubes, sorted by pair."""
        return self.find_edges()

    def find_edges(self, deadline: Deadline | None = None) -> dict[tuple[int, int], Guard]:
        """``edges``, computed within a deadline and cached.

        Raises:
            ConfigError: if the deadline passes.
        """
        if not self._edges:
            found: dict[tuple[int, int], Guard] = {}
            for q in range(self.states):
                row = self.delta[q]
                for target in np.unique(row):
                    if deadline is not None:
                        deadline.check("writing down its guards")
                    found[q, int(target)] = irredundant_cover(row == target, self.propositions)
            self._edges.update(found)
        return self._edges

    def symbols(self, source: int, target: int) -> NDArray[np.bool_]:
        """Truth table of a guard: bool (2**|AP|,), true where delta(source, symbol) = target."""
        table: NDArray[np.bool_] = np.equal(self.delta[source], target)
        return table

    def accepts(self, trace: Iterable[Iterable[str]]) -> bool:
        """Whether the automaton accepts a non-empty trace of label sets."""
        q = self.initial
        for labels in trace:
            q = self.step(q, labels)
        return q in self.accepting

    def to_json(self) -> dict[str, Any]:
        """JSON-ready form for ``from_json``, with readable guards."""
        return {
            "propositions": list(self.propositions),
            "states": self.states,
            "initial": self.initial,
            "accepting": sorted(self.accepting),
            "error": sorted(self.error),
            "edges": [
                {"source": s, "target": t, "guard": [list(cube) for cube in guard]}
                for (s, t), guard in self.edges.items()
            ],
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> DFA:
        """Rebuild a DFA from ``to_json``.

        Raises:
            ConfigError: if guards overlap, leave a symbol without a target, or name unknown propositions.
        """
        propositions = tuple(data["propositions"])
        bit = {name: 1 << i for i, name in enumerate(propositions)}
        symbols = np.arange(1 << len(propositions))
        delta = np.full((int(data["states"]), symbols.size), -1, dtype=np.int32)
        for edge in data["edges"]:
            for cube in edge["guard"]:
                positive = sum(bit[lit] for lit in cube if not lit.startswith("~"))
                negative = sum(bit[lit[1:]] for lit in cube if lit.startswith("~"))
                hit = ((symbols & positive) == positive) & ((symbols & negative) == 0)
                row = delta[edge["source"]]
                if np.any(hit & (row != -1) & (row != edge["target"])):
                    raise ConfigError(f"state {edge['source']}: two guards hold for one letter; expected a DFA")
                row[hit] = edge["target"]
        if np.any(delta < 0):
            raise ConfigError(f"state {int(np.argwhere(delta < 0)[0][0])}: some letter has no transition")
        return cls(propositions, delta, frozenset(data["accepting"]), int(data["initial"]))
