"""``t4nmtd plot``: draws learning curves of runs."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.runs.curves import Axis, Floats, MeanCurve, Metric, RunCurves, mean_curve, read_run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg")
AXES: dict[str, tuple[Axis, ...]] = {
    "interactions": ("interactions",),
    "time": ("time",),
    "both": ("interactions", "time"),
}
TITLES = {"success": "success rate", "length": "episode length (steps)", "return": "validation reward"}
UNITS = ((3 * 3600.0, 3600.0, "h"), (180.0, 60.0, "min"), (0.0, 1.0, "s"))
PANEL_INCHES = (5.4, 2.5)
DOTS_PER_INCH = 120
# Makes images reproducible: SVG ids are hashes with this salt, and there is no date.
SALT = "t4nmtd"
NO_DATE: dict[str, dict[str, Any]] = {".png": {"Software": None}, ".svg": {"Date": None}}


def plot(
    paths: Sequence[Path],
    out: Path,
    *,
    x: Literal["interactions", "time", "both"] = "both",
    metrics: str = "success,length,return",
    labels: Sequence[str] = (),
) -> int:
    """Draw the curves of runs into ``out``; returns the exit code.

    Runs with the same label (by default the task's name) become a mean with 95 % interval, see
    ``t4nmtd_dist.runs.curves``; a single run is drawn as it is. Duplicates count once.

    Raises:
        ConfigError: if the file's format is unknown, the file cannot be written, a package is missing, or metrics or
            labels do not fit.
        RunError: if a folder holds no evaluations, or runs of one label have no common range.
    """
    check_out(out)
    wanted = _metrics(metrics)
    groups = grouped(paths, labels)
    figure = draw(groups, AXES[x], wanted)
    save(figure, out)
    counts = ", ".join(f"{label}: {len(runs)} run{'s'[: len(runs) != 1]}" for label, runs in groups.items())
    print(f"{counts}; picture in {out}")
    return 0


def check_out(out: Path) -> None:
    """Check that a picture can be written.

    Raises:
        ConfigError: for an unknown format, a missing package or folder.
    """
    if out.suffix not in FORMATS:
        raise ConfigError(f"--out {out}: expected a name that ends in {' or '.join(FORMATS)}")
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError("a plot needs the package matplotlib: pip install 't4nmtd-dist[plot]'")
    if not out.parent.is_dir():
        raise ConfigError(f"--out {out}: no folder {out.parent}")


def _metrics(text: str) -> list[Metric]:
    known = get_args(Metric)
    wanted = [name.strip() for name in text.split(",")]
    for name in wanted:
        if name not in known:
            raise ConfigError(f"--metrics {text}: expected some of {', '.join(known)}, with commas between them")
    return [metric for metric in known if metric in wanted]


def grouped(paths: Sequence[Path], labels: Sequence[str]) -> dict[str, list[RunCurves]]:
    """Runs by label, in the given order, without duplicates.

    Raises:
        ConfigError: if there is no run, or the number of labels does not fit.
        RunError: if a folder holds no evaluations.
    """
    if not paths:
        raise ConfigError("expected at least one RUN: a run directory, for instance runs/task7/latest")
    if len(labels) not in (0, 1, len(paths)):
        raise ConfigError(f"{len(labels)} labels for {len(paths)} runs: expected one for all, or one for each in order")
    groups: dict[str, list[RunCurves]] = {}
    seen: set[Path] = set()
    for index, path in enumerate(paths):
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        run = read_run(path)
        label = labels[index % len(labels)] if labels else run.task
        groups.setdefault(label, []).append(run)
    return groups


def draw(groups: Mapping[str, Sequence[RunCurves]], axes: Sequence[Axis], metrics: Sequence[Metric]) -> Figure:
    """A figure with a row per metric and a column per axis; each label keeps its colour.

    The picture ends where the metric does: success at 0 and 1, length at 0. No interval goes beyond.

    Raises:
        RunError: if runs of one label have no common range.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"svg.hashsalt": SALT}):
        width, height = PANEL_INCHES
        figure = Figure(figsize=(width * len(axes), height * len(metrics) + 0.4), layout="constrained")
        panels = figure.subplots(len(metrics), len(axes), squeeze=False, sharex="col", sharey="row")
        for column, axis in enumerate(axes):
            scale, title = _scale(axis, groups)
            panels[-1, column].set_xlabel(title)
            for row, metric in enumerate(metrics):
                _panel(panels[row, column], groups, axis, metric, scale)
        for row, metric in enumerate(metrics):
            _format(panels[row, 0], metric)
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=len(axes))
    return figure


def _scale(axis: Axis, groups: Mapping[str, Sequence[RunCurves]]) -> tuple[float, str]:
    """The divisor of x, and its title."""
    if axis == "interactions":
        return 1.0, "interactions of all learners"
    longest = max(float(run.columns["time"][-1]) for runs in groups.values() for run in runs)
    unit, name = next((unit, name) for least, unit, name in UNITS if longest >= least)
    return unit, f"time ({name})"


def _panel(panel: Axes, groups: Mapping[str, Sequence[RunCurves]], axis: Axis, metric: Metric, scale: float) -> None:
    from matplotlib.ticker import EngFormatter

    for number, (label, runs) in enumerate(groups.items()):
        curve = mean_curve(runs, axis, metric)
        name = label if curve.runs == 1 else f"{label}, mean of {curve.runs} runs with 95 % interval"
        _curve(panel, curve, curve.x / scale, f"C{number}", name)
    panel.grid(alpha=0.3)
    if axis == "interactions":
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))


def _curve(panel: Axes, curve: MeanCurve, x: Floats, colour: str, name: str) -> None:
    marker = "o" if len(x) == 1 else ""
    panel.plot(x, curve.mean, color=colour, drawstyle="steps-post", linewidth=1.5, marker=marker, label=name)
    if curve.runs > 1:
        panel.fill_between(x, curve.low, curve.high, color=colour, step="post", alpha=0.2, linewidth=0)


def _format(panel: Axes, metric: Metric) -> None:
    from matplotlib.ticker import PercentFormatter

    panel.set_ylabel(TITLES[metric])
    if metric == "success":
        panel.set_ylim(-0.03, 1.03)
        panel.yaxis.set_major_formatter(PercentFormatter(1.0))
    elif metric == "length":
        panel.set_ylim(bottom=0)


def save(figure: Figure, out: Path) -> None:
    """Write a figure atomically through a temporary file.

    Raises:
        ConfigError: if it cannot be written.
    """
    import matplotlib

    fresh = out.with_name(f".{out.stem}.new{out.suffix}")
    try:
        with matplotlib.rc_context({"svg.hashsalt": SALT}):
            figure.savefig(fresh, dpi=DOTS_PER_INCH, metadata=NO_DATE[out.suffix])
        os.replace(fresh, out)
    except OSError as error:
        raise ConfigError(f"--out {out}: cannot be written: {error.strerror}") from None
    finally:
        fresh.unlink(missing_ok=True)
