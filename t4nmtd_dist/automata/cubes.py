"""Boolean functions over few propositions: truth tables in, cubes and prime implicants out.

A *literal* is ``p`` or ``~p``; a *cube* is a conjunction of literals (the empty cube is true); a *guard* is a
disjunction of cubes (no cube at all is false). A truth table is a bool array of shape (2**n,) indexed by
letters: bit i of the index says whether ``propositions[i]`` holds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Cube = tuple[str, ...]
Guard = tuple[Cube, ...]
TruthTable = NDArray[np.bool_]


def irredundant_cover(table: TruthTable, propositions: tuple[str, ...]) -> Guard:
    """An irredundant sum of cubes for a truth table (Minato and Morreale's recursion)."""
    cubes, _ = _isop(table, table, len(propositions) - 1)
    named = (tuple(_literal(propositions[i], value) for i, value in sorted(cube)) for cube in cubes)
    return tuple(sorted(named, key=lambda cube: (len(cube), cube)))


def _literal(name: str, value: bool) -> str:
    return name if value else f"~{name}"


def _isop(
    lower: TruthTable, upper: TruthTable, variable: int
) -> tuple[list[tuple[tuple[int, bool], ...]], TruthTable]:
    """Cubes whose union lies between ``lower`` and ``upper``, and that union as a truth table."""
    if not lower.any():
        return [], np.zeros_like(lower)
    if upper.all():
        return [()], np.ones_like(lower)
    half = lower.size // 2
    low0, low1, up0, up1 = lower[:half], lower[half:], upper[:half], upper[half:]
    cubes0, cover0 = _isop(low0 & ~up1, up0, variable - 1)
    cubes1, cover1 = _isop(low1 & ~up0, up1, variable - 1)
    rest, cover = _isop((low0 & ~cover0) | (low1 & ~cover1), up0 & up1, variable - 1)
    cubes = [(*c, (variable, False)) for c in cubes0] + [(*c, (variable, True)) for c in cubes1] + rest
    return cubes, np.concatenate([cover0 | cover, cover1 | cover])
