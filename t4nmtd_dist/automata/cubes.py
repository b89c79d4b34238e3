"""Boolean functions of few propositions: truth tables to cubes and prime implicants.

A *literal* is ``p`` or ``~p``; a *cube* is a conjunction of literals (empty: true); a *guard* is a disjunction of cubes
(empty: false). A truth table is a bool array of shape (2**n,) indexed by symbols: bit i of the index is set if
``propositions[i]`` holds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ConfigError

Cube = tuple[str, ...]
Guard = tuple[Cube, ...]
TruthTable = NDArray[np.bool_]

SUPPORT_LIMIT = 14


def irredundant_cover(table: TruthTable, propositions: tuple[str, ...]) -> Guard:
    """An irredundant sum of cubes for a truth table (Minato and Morreale's recursion)."""
    single = _single_cube(table, propositions)
    if single is not None:
        return (single,)
    cubes, _ = _isop(table, table, len(propositions) - 1)
    named = (tuple(_literal(propositions[i], value) for i, value in sorted(cube)) for cube in cubes)
    return tuple(sorted(named, key=lambda cube: (len(cube), cube)))


def prime_implicants(on: TruthTable, dont_care: TruthTable, propositions: tuple[str, ...]) -> Guard:
    """Prime implicants of ``on | dont_care`` that hold in some symbol of ``on``.

    Evaluates all 3**n cubes over the n relevant propositions in one array.

    Args:
        on: symbols in which the function must hold, shape (2**len(propositions),).
        dont_care: symbols with an arbitrary value, same shape; ``on`` takes precedence.
        propositions: names, lowest bit of a symbol first.

    Returns:
        The cubes, shortest first; none if ``on`` is empty.

    Raises:
        ConfigError: if the function depends on more than 14 propositions.
    """
    if not on.any():
        return ()
    single = None if dont_care.any() else _single_cube(on, propositions)
    if single is not None and len(single) <= SUPPORT_LIMIT:
        return (single,)
    implied, required, support = _project(on | dont_care, on, len(propositions))
    if len(support) > SUPPORT_LIMIT:
        raise ConfigError(
            f"a guard depends on {len(support)} propositions at once; expected at most {SUPPORT_LIMIT}: "
            "split the task or leave out propositions that it does not need"
        )
    prime = _prime_table(implied, required, len(support))
    names = [propositions[i] for i in support]
    cubes = (
        tuple(_literal(name, digit == 1) for name, digit in zip(names, digits, strict=True) if digit < 2)
        for digits in np.argwhere(prime).tolist()
    )
    return tuple(sorted(cubes, key=lambda cube: (len(cube), cube)))


def cube_text(cube: Cube) -> str:
    """A cube for display: ``p & ~q``, or ``true`` if empty."""
    return " & ".join(cube) if cube else "true"


def guard_text(guard: Guard) -> str:
    """A guard for display: ``p & ~q | r``, or ``false`` if empty."""
    return " | ".join(map(cube_text, guard)) if guard else "false"


def _single_cube(table: TruthTable, propositions: tuple[str, ...]) -> Cube | None:
    """The cube equal to a truth table, if any."""
    held = np.flatnonzero(table)
    if not held.size:
        return None
    always, ever = int(np.bitwise_and.reduce(held)), int(np.bitwise_or.reduce(held))
    fixed = ~(always ^ ever) & (len(table) - 1)
    if held.size << fixed.bit_count() != len(table):
        return None
    return tuple(_literal(name, bool(always >> i & 1)) for i, name in enumerate(propositions) if fixed >> i & 1)


def _project(table: TruthTable, kept: TruthTable, n: int) -> tuple[TruthTable, TruthTable, list[int]]:
    """Both tables, with one axis per proposition that ``table`` depends on, and these propositions."""
    # Bit i of a symbol is axis n - 1 - i of the reshaped table; the transpose puts proposition i on axis i.
    table, kept = (t.reshape((2,) * n).transpose() for t in (table, kept))
    support = [i for i in range(n) if not np.array_equal(table.take(0, axis=i), table.take(1, axis=i))]
    others = tuple(i for i in range(n) if i not in support)
    return np.asarray(table.all(axis=others)), np.asarray(kept.any(axis=others)), support


def _prime_table(implied: TruthTable, required: TruthTable, n: int) -> TruthTable:
    """Which of the 3**n cubes are prime implicants; indices are 0 ``~p``, 1 ``p``, 2 neither."""
    for i in range(n):
        no, yes = np.split(implied, 2, axis=i)
        implied = np.concatenate([no, yes, no & yes], axis=i)
        no, yes = np.split(required, 2, axis=i)
        required = np.concatenate([no, yes, no | yes], axis=i)
    prime = implied & required
    for i in range(n):
        wider = implied.take([2], axis=i)
        prime &= np.concatenate([~wider, ~wider, np.ones_like(wider)], axis=i)
    return prime


def _literal(name: str, value: bool) -> str:
    return name if value else f"~{name}"


def _isop(lower: TruthTable, upper: TruthTable, variable: int) -> tuple[list[tuple[tuple[int, bool], ...]], TruthTable]:
    """Cubes whose union lies between ``lower`` and ``upper``, and that union."""
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
