"""Sums, differences and views of learner statistics, derived from their declarations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar, get_args, get_type_hints

from msgspec import Meta

from t4nmtd_dist.wire.fields import LARGEST_COUNT
from t4nmtd_dist.wire.messages.base import Message
from t4nmtd_dist.wire.messages.statistics import PER_SECOND, LearnerStats, Statistic, View

StatsT = TypeVar("StatsT", bound=Message)
Number = float | None  # an integer for counts
Rates = Mapping[str, float]


@dataclass(frozen=True)
class Declared:
    """A statistic's declaration.

    Attributes:
        most: maximum of its type.
        part: field of ``LearnerStats`` that holds its record; empty for its own fields.
    """

    statistic: Statistic
    most: float
    part: str = ""


@cache
def declared(record: type[Message], part: str = "") -> dict[str, Declared]:
    """A record's statistics by name, nested ones included, in order of declaration."""
    found: dict[str, Declared] = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        if isinstance(hint, type) and issubclass(hint, Message):
            found |= declared(hint, name)
        for statistic in get_args(hint):
            if isinstance(statistic, Statistic):
                bounds = [meta.le for meta in get_args(hint) if isinstance(meta, Meta) and meta.le is not None]
                found[name] = Declared(statistic, min(bounds, default=LARGEST_COUNT), part)
    return found


def added(earlier: StatsT, newest: StatsT) -> StatsT:
    """Merge two leases: sum counters up to their types' maximum, take the rest from ``newest``."""
    return _merged(earlier, newest, lambda before, now, most: min(before + now, most))


def counted_since(now: StatsT, before: StatsT) -> StatsT:
    """Statistics with the counters of ``before`` subtracted."""
    return _merged(before, now, lambda before, now, _: now - before)


def _merged(before: StatsT, now: StatsT, count: Callable[[Any, Any, Any], Any]) -> StatsT:
    """Merge records: counters by ``count(before, now, maximum)``, the rest from ``now``."""
    statistics, merged = declared(type(now)), {}
    for name in now.__struct_fields__:
        old, new = getattr(before, name), getattr(now, name)
        if isinstance(new, Message):
            merged[name] = _merged(old, new, count)
        elif name in statistics and statistics[name].statistic.counter:
            merged[name] = count(old, new, statistics[name].most)
        else:
            merged[name] = new
    return type(now)(**merged)


def by_name(stats: LearnerStats) -> dict[str, Number]:
    """All statistics by name, as the columns of a CSV file."""
    return {name: _value(stats, name) for name in declared(LearnerStats)}


def _value(stats: LearnerStats, name: str) -> Number:
    part = declared(LearnerStats)[name].part
    value: Number = getattr(getattr(stats, part) if part else stats, name)
    return value


def views() -> Iterator[tuple[str, View]]:
    """All views with the names of their statistics, in order of declaration."""
    for name, found in declared(LearnerStats).items():
        for view in found.statistic.views:
            yield name, view


def viewed(name: str, view: View, stats: LearnerStats, rates: Rates) -> Number:
    """What a view shows of a statistic; None if unknown.

    Args:
        name: the statistic.
        view: one of its views.
        stats: of a learner.
        rates: of counters, per second, by name.
    """
    if view.per == PER_SECOND:
        return rates.get(name)
    value = _value(stats, name)
    if not view.per:
        return value
    whole = _value(stats, view.per)
    return value / whole if value is not None and whole else None


def rated() -> list[str]:
    """Names of the counters whose rates are shown."""
    return [name for name, view in views() if view.per == PER_SECOND]


def scalars(stats: LearnerStats, rates: Rates) -> dict[str, Number]:
    """A learner's TensorBoard scalars by name; None where there is no value yet."""
    return {view.scalar: viewed(name, view, stats, rates) for name, view in views() if view.scalar}
