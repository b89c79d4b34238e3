"""Covers and prime implicants of boolean functions."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from t4nmtd_dist.automata.cubes import (
    Cube,
    Guard,
    TruthTable,
    cube_text,
    guard_text,
    irredundant_cover,
    prime_implicants,
)
from t4nmtd_dist.core.errors import ConfigError

NAMES = ("a", "b", "c", "d")


def holds(cube: Cube, symbol: int, names: tuple[str, ...]) -> bool:
    true = {name for i, name in enumerate(names) if symbol >> i & 1}
    return all((lit[1:] not in true) if lit[0] == "~" else (lit in true) for lit in cube)


def table_of(guard: Guard, names: tuple[str, ...]) -> TruthTable:
    return np.array([any(holds(cube, a, names) for cube in guard) for a in range(1 << len(names))])


def all_cubes(names: tuple[str, ...]) -> list[Cube]:
    choices = product(*([None, name, f"~{name}"] for name in names))
    return [tuple(lit for lit in choice if lit) for choice in choices]


def primes_by_definition(on: TruthTable, dont_care: TruthTable, names: tuple[str, ...]) -> set[Cube]:
    cover = {cube: table_of((cube,), names) for cube in all_cubes(names)}
    implicants = {cube for cube, table in cover.items() if not (table & ~(on | dont_care)).any()}
    maximal = {cube for cube in implicants if not any(set(other) < set(cube) for other in implicants)}
    return {cube for cube in maximal if (cover[cube] & on).any()}


@st.composite
def functions(draw: st.DrawFn) -> tuple[TruthTable, TruthTable, tuple[str, ...]]:
    names = NAMES[: draw(st.integers(0, 4))]
    bits = st.lists(st.booleans(), min_size=1 << len(names), max_size=1 << len(names))
    return np.array(draw(bits)), np.array(draw(bits)), names


@given(functions())
def test_prime_implicants_are_those_of_the_definition(
    function: tuple[TruthTable, TruthTable, tuple[str, ...]],
) -> None:
    found = prime_implicants(*function)
    assert len(set(found)) == len(found)
    assert set(found) == primes_by_definition(*function)


@given(functions())
def test_irredundant_cover_is_exact_and_no_cube_can_go(
    function: tuple[TruthTable, TruthTable, tuple[str, ...]],
) -> None:
    on, _, names = function
    cover = irredundant_cover(on, names)
    assert np.array_equal(table_of(cover, names), on)
    for left_out in cover:
        rest = tuple(cube for cube in cover if cube != left_out)
        assert not np.array_equal(table_of(rest, names), on)


def test_dont_cares_shorten_implicants() -> None:
    symbols = np.arange(8)
    only_a = symbols == 1
    several = np.array([a.bit_count() > 1 for a in symbols.tolist()])
    assert prime_implicants(only_a, np.zeros(8, bool), ("a", "b", "c")) == (("a", "~b", "~c"),)
    assert prime_implicants(only_a, several, ("a", "b", "c")) == (("a",),)


def test_a_sparse_guard_over_sixteen_propositions_is_found() -> None:
    names = tuple(f"p{i:02}" for i in range(16))
    symbols = np.arange(1 << 16)
    on = ((symbols & 0b1000_0000_0000_0001) == 1) | ((symbols & 0b110) == 0b110)
    assert prime_implicants(on, np.zeros_like(on), names) == (("p00", "~p15"), ("p01", "p02"))


def test_a_guard_over_too_many_propositions_is_refused() -> None:
    names = tuple(f"p{i:02}" for i in range(15))
    on = np.arange(1 << 15) == 0
    with pytest.raises(ConfigError, match="15 propositions"):
        prime_implicants(on, np.zeros_like(on), names)


def test_texts_name_the_constant_guards() -> None:
    assert cube_text(()) == "true"
    assert guard_text(()) == "false"
    assert guard_text((("a", "~b"), ("c",))) == "a & ~b | c"
