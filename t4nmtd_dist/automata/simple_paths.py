"""Simple paths (no repeated state) of a small directed graph: edges on them, and their lengths.

Deciding whether an edge lies on a simple path is NP-hard in general, but task automata are small and mostly acyclic, so
an exact search is fast. A simple path crosses a strongly connected component in one piece, so edges between components
only need reachability and edges inside one a search within it. A branch is cut as soon as either end of the path is
blocked, and a dead end (position and free vertices) is never entered twice.

Sets of vertices are bit masks: bit v stands for vertex v.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from itertools import pairwise

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.core.errors import ConfigError

Edge = tuple[int, int]
Walk = tuple[int, int, int]  # masks: starts, possible ends, usable vertices

SEARCH_LIMIT = 20_000
DOING = "the search for simple paths"


def edges_on_simple_paths(
    edges: Collection[Edge], source: int, targets: Iterable[int], deadline: Deadline | None = None
) -> frozenset[Edge]:
    """Edges on at least one simple path from ``source`` to one of ``targets``.

    Args:
        edges: the graph, without self-loops and edges out of targets.
        source: start of every path.
        targets: possible ends of a path.
        deadline: of the compilation.

    Raises:
        ConfigError: if an edge of a large component is undecided after 20,000 dead ends, or the deadline passes.
    """
    goal = _mask(targets)
    graph = _Graph(edges, deadline)
    useful = graph.reach(1 << source) & graph.reach_back(goal)
    found: set[Edge] = set()
    for q, target in edges:
        if not (useful >> q & 1 and useful >> target & 1) or (q, target) in found:
            continue
        component = graph.component(q)
        if not component >> target & 1:
            found.add((q, target))
            continue
        entries = component & (1 << source | graph.entered(useful & ~component))
        exits = component & (goal | graph.entering(useful & ~component))
        found.update(_path_through(graph, (q, target), component, entries, exits))
    return frozenset(found)


def simple_path_lengths(
    edges: Collection[Edge], source: int, targets: Iterable[int], deadline: Deadline | None = None
) -> Iterator[int]:
    """Lengths of all simple paths from ``source`` to ``targets``; a path ends at its first target."""
    graph = _Graph(edges, deadline)
    goal = _mask(targets)

    def walk(v: int, free: int, length: int) -> Iterator[int]:
        if goal >> v & 1:
            yield length
            return
        for w in _bits(graph.successors.get(v, 0) & graph.reach_back(goal & free, free)):
            yield from walk(w, free & ~(1 << w), length + 1)

    everything = graph.reach(1 << source)
    return walk(source, everything & ~(1 << source), 0)


class _Graph:
    """Successors and predecessors of every vertex as bit masks."""

    def __init__(self, edges: Iterable[Edge], deadline: Deadline | None = None) -> None:
        self.successors: dict[int, int] = {}
        self.predecessors: dict[int, int] = {}
        self._components: dict[int, int] = {}
        self._deadline = deadline
        for q, target in edges:
            self.successors[q] = self.successors.get(q, 0) | 1 << target
            self.predecessors[target] = self.predecessors.get(target, 0) | 1 << q

    def reach(self, start: int, within: int = -1) -> int:
        """Vertices reachable from ``start`` by paths within ``within`` (after the start)."""
        if self._deadline is not None:
            self._deadline.check(DOING)
        return _closure(self.successors, start, within)

    def reach_back(self, goal: int, within: int = -1) -> int:
        """Vertices that reach ``goal`` by paths within ``within`` (before the goal)."""
        if self._deadline is not None:
            self._deadline.check(DOING)
        return _closure(self.predecessors, goal, within)

    def between(self, start: int, goal: int, allowed: int) -> int:
        """Vertices on walks from ``start`` to ``goal`` within ``allowed``; 0 if there is none."""
        return self.reach(start & allowed, allowed) & self.reach_back(goal & allowed, allowed)

    def shortest(self, start: int, goal: int, allowed: int) -> list[int]:
        """A shortest path from ``start`` to ``goal``, which must be reachable."""
        layers = [start & allowed]
        seen = layers[0]
        while not layers[-1] & goal:
            layers.append(_union(self.successors, layers[-1]) & allowed & ~seen)
            seen |= layers[-1]
        path = [next(_bits(layers.pop() & goal))]
        for layer in reversed(layers):
            path.append(next(_bits(layer & self.predecessors[path[-1]])))
        return path[::-1]

    def unavoidable(self, start: int, goal: int, allowed: int) -> int:
        """Vertices on every path from ``start`` to ``goal``, which must be reachable."""
        path = self.shortest(start, goal, allowed)
        return _mask(v for v in path if not self.between(start, goal, allowed & ~(1 << v)))

    def component(self, v: int) -> int:
        """Strongly connected component of a vertex."""
        if v not in self._components:
            component = self.reach(1 << v) & self.reach_back(1 << v)
            self._components.update(dict.fromkeys(_bits(component), component))
        return self._components[v]

    def entered(self, vertices: int) -> int:
        """Heads of all edges out of ``vertices``."""
        return _union(self.successors, vertices)

    def entering(self, vertices: int) -> int:
        """Tails of all edges into ``vertices``."""
        return _union(self.predecessors, vertices)


def _path_through(graph: _Graph, edge: Edge, component: int, entries: int, exits: int) -> list[Edge]:
    """Edges, within a component, of a simple path from an entry over ``edge`` to an exit, if any.

    Grows the path backwards from ``edge`` to an entry; its second half then only needs a reachable exit.
    """
    q, target = edge
    dead: set[tuple[int, int, int]] = set()

    def grow(v: int, free: int) -> tuple[list[int], int] | None:
        """A path from an entry to v through free vertices, and the vertices left free."""
        halves = _separate(graph, (entries, 1 << v, free | 1 << v), (1 << target, exits, free | 1 << target))
        if halves is None or (v, *halves) in dead:
            return None
        if entries >> v & 1:
            return [v], free
        for w in _bits(graph.predecessors[v] & halves[0] & free):
            if (found := grow(w, free & ~(1 << w))) is not None:
                return [*found[0], v], found[1]
        dead.add((v, *halves))
        if len(dead) > SEARCH_LIMIT:
            raise ConfigError(
                f"cannot tell whether the transition {q} -> {target} lies on a simple path: more than "
                f"{SEARCH_LIMIT} dead ends among {component.bit_count()} states; try prune=false"
            )
        return None

    found = grow(q, component & ~(1 << q | 1 << target))
    if found is None:
        return []
    return list(pairwise([*found[0], *graph.shortest(1 << target, exits, found[1] | 1 << target)]))


def _separate(graph: _Graph, first: Walk, second: Walk) -> tuple[int, int] | None:
    """Vertices usable by each of two disjoint paths, or None if there cannot be two.

    Removes each path's unavoidable vertices from the other until nothing changes. This loses no pair of disjoint paths,
    but does not prove that one exists.
    """
    (start, goal, mine), (other_start, other_goal, others) = first, second
    while True:
        region = graph.between(start, goal, mine)
        rest = graph.between(other_start, other_goal, others)
        if not (region and rest):
            return None
        mine = region & ~graph.unavoidable(other_start, other_goal, rest)
        others = rest & ~graph.unavoidable(start, goal, region)
        if (mine, others) == (region, rest):
            return region, rest


def _closure(neighbours: dict[int, int], start: int, within: int) -> int:
    seen = frontier = start
    while frontier:
        frontier = _union(neighbours, frontier) & within & ~seen
        seen |= frontier
    return seen


def _union(neighbours: dict[int, int], vertices: int) -> int:
    union = 0
    for v in _bits(vertices):
        union |= neighbours.get(v, 0)
    return union


def _bits(mask: int) -> Iterator[int]:
    """Vertices of a mask, ascending."""
    while mask:
        lowest = mask & -mask
        yield lowest.bit_length() - 1
        mask ^= lowest


def _mask(vertices: Iterable[int]) -> int:
    return sum(1 << v for v in set(vertices))
