"""Statistics of learners: declared once; sums, CSV columns, curves and dashboard columns follow."""

from __future__ import annotations

import csv
from dataclasses import fields
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

from t4nmtd_dist.agents.common.peer_values import InterventionCounts
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.wire.fields import LARGEST_AMOUNT, LARGEST_COUNT, Count
from t4nmtd_dist.wire.messages import Intervention, LearnerStats
from t4nmtd_dist.wire.messages.statistics import PER_SECOND, View, counter
from t4nmtd_dist.wire.statistics import added, by_name, counted_since, declared, rated, scalars, viewed, views

COUNTS = st.integers(0, LARGEST_COUNT // 4)
GAUGES = st.none() | st.floats(0, 1)
INTERVENTIONS = st.builds(Intervention, **dict.fromkeys(Intervention.__struct_fields__, COUNTS))
COUNTERS = [name for name, found in declared(LearnerStats).items() if found.statistic.counter]
WHOLE = [name for name in LearnerStats.__struct_fields__ if isinstance(getattr(LearnerStats(), name), int)]
STATS = st.builds(
    LearnerStats,
    phase=st.sampled_from(["waiting", "training"]),
    recent_success=GAUGES,
    episode_steps=GAUGES,
    entropy=GAUGES,
    value_loss=GAUGES,
    processor_s=st.integers(0, 10**6).map(float),
    intervention=INTERVENTIONS,
    **dict.fromkeys(WHOLE, COUNTS),
)


def test_every_field_but_the_phase_declares_a_statistic() -> None:
    named = {*LearnerStats.__struct_fields__, *Intervention.__struct_fields__} - {"phase", "intervention"}
    assert set(declared(LearnerStats)) == named


def test_what_learners_count_of_interventions_is_what_travels() -> None:
    assert Intervention.__struct_fields__ == tuple(each.name for each in fields(InterventionCounts))


@given(STATS, STATS)
def test_sums_add_counters_and_keep_the_newest_gauges(earlier: LearnerStats, newest: LearnerStats) -> None:
    total, before, now = by_name(added(earlier, newest)), by_name(earlier), by_name(newest)
    for name, value in total.items():
        assert value == ((before[name] or 0) + (now[name] or 0) if name in COUNTERS else now[name])
    assert added(earlier, newest).phase == newest.phase


@given(STATS, STATS)
def test_a_difference_undoes_a_sum(earlier: LearnerStats, newest: LearnerStats) -> None:
    assert counted_since(added(earlier, newest), earlier) == newest


def test_sums_stop_at_what_messages_can_hold() -> None:
    most = LearnerStats(
        interactions=LARGEST_COUNT, processor_s=LARGEST_AMOUNT, intervention=Intervention(asked=LARGEST_COUNT)
    )
    assert added(most, most) == most


def test_a_view_is_the_value_its_rate_or_a_ratio() -> None:
    stats = LearnerStats(interactions=600, intervention=Intervention(asked=10, own_used=2))
    assert viewed("interactions", View(), stats, {}) == 600
    assert viewed("interactions", View(per=PER_SECOND), stats, {"interactions": 3.5}) == 3.5
    assert viewed("own_used", View(per="asked"), stats, {}) == 0.2
    assert viewed("lag_total", View(per="answered"), stats, {}) is None, "nothing was answered"


def test_names_of_curves_and_headings_are_distinct() -> None:
    curves = [view.scalar for _, view in views() if view.scalar]
    headings = [view.heading for _, view in views() if view.format]
    assert len(set(curves)) == len(curves) == len(scalars(LearnerStats(), {}))
    assert len(set(headings)) == len(headings)
    assert all(view.per in ("", PER_SECOND, *declared(LearnerStats)) for _, view in views())


class WithOneMore(LearnerStats, frozen=True):
    """A record with one line added."""

    resets: Annotated[Count, counter(View("resets", "resets", "count"))] = 0


def test_one_line_declares_a_statistic() -> None:
    assert declared(WithOneMore)["resets"].statistic.views == (View("resets", "resets", "count"),)
    assert added(WithOneMore(resets=2), WithOneMore(resets=3)).resets == 5
    assert counted_since(WithOneMore(resets=5), WithOneMore(resets=2)).resets == 3


def test_rates_are_shown_of_counters_only() -> None:
    assert set(rated()) <= set(COUNTERS)
    assert rated() == ["interactions", "gradient_steps"]


@pytest.mark.parametrize("later", [{"b": 2, "c": 3, "a": 1}, {"b": 2, "a": 1}])
def test_a_resumed_run_appends_by_the_columns_that_its_csv_file_has(tmp_path: Path, later: dict[str, int]) -> None:
    run = RunDirectory(tmp_path / "run")
    run.append_metrics("g", {"a": 1, "b": 2})
    run.append_metrics("g", later)
    with (tmp_path / "run" / "metrics" / "g.csv").open(newline="") as file:
        assert list(csv.DictReader(file)) == [{"a": "1", "b": "2"}] * 2
