"""Tables of an experiment in Markdown, made from stored results alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from t4nmtd_dist.experiments.arms import PAPER, Experiment
from t4nmtd_dist.experiments.results import Result, by_arm, caps, scores, times
from t4nmtd_dist.statistics.bootstrap import Estimate
from t4nmtd_dist.statistics.censoring import kaplan_meier_median, restricted_mean
from t4nmtd_dist.statistics.comparison import Comparison, compare
from t4nmtd_dist.statistics.proportions import clopper_pearson
from t4nmtd_dist.statistics.ratios import Bounds, ratio_of_medians
from t4nmtd_dist.statistics.scores import interquartile_mean, optimality_gap

SEED = 0  # of all bootstraps: the same results always make the same table
PER_TASK = (
    "task", "arm", "solved", "95 % interval", "converged", "median interactions", "mean up to the cap", "cap", "score",
    "success", "perturbed", "wall s",
)  # fmt: skip
PER_RUN = (
    "task", "arm", "seed", "solved", "interactions", "of the paper's", "wall s", "updates", "length", "success",
    "perturbed", "own critic used",
)  # fmt: skip
OVERALL = ("arm", "tasks", "IQM of scores", "optimality gap", "{first} better with probability", "p (Holm)", "verdict")
RATIOS = ("arm", "tasks", "median interactions against {first}", "95 % interval")


def tables(experiment: Experiment, results: Sequence[Result]) -> str:
    """All tables of an experiment: every task's arms, arms over tasks, and ratios of medians."""
    found = by_arm(results)
    lines = [f"# {experiment.title}", ""]
    lines += [*_per_task(found), ""]
    lines += [*_overall(experiment, found), ""]
    lines += _ratios(experiment, found)
    return "\n".join(lines).rstrip() + "\n"


def run_table(results: Sequence[Result]) -> str:
    """One row for every run, and the means over the seeds of every task and arm; costs are means of the solved runs."""
    lines = list(_head(PER_RUN))
    for arm, tasks in by_arm(results).items():
        for task, runs in tasks.items():
            lines += [
                _row(task, arm, run.seed, "yes" if run.solved else "no", *_run_cells(task, [run])) for run in runs
            ]
            solved = sum(run.solved for run in runs)
            lines.append(_row(task, arm, "mean", f"{solved} of {len(runs)}", *_run_cells(task, runs)))
    return "\n".join(lines) + "\n"


def _run_cells(task: str, runs: Sequence[Result]) -> list[str]:
    solved = [run for run in runs if run.solved]
    spent = _mean(run.interactions for run in solved)
    return [
        _or_dash(spent, ",.0f"),
        _or_dash(spent / PAPER.get(task, math.nan), ".1%"),
        _or_dash(_mean(run.wall_s for run in solved), ".0f"),
        _or_dash(_mean(run.updates for run in solved), ",.0f"),
        _or_dash(_mean(run.length for run in solved), ".0f"),
        _or_dash(_mean(run.success for run in runs), ".0%"),
        _or_dash(_mean(run.perturbed for run in runs), ".0%"),
        _or_dash(_mean(run.own_share for run in runs), ".1%"),
    ]


def _mean(values: Iterable[float]) -> float:
    """The mean of those that are known; nan if there are none."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def _or_dash(value: float, form: str) -> str:
    return "-" if math.isnan(value) else f"{value:{form}}"


def _per_task(found: Mapping[str, Mapping[str, Sequence[Result]]]) -> Iterator[str]:
    yield from _head(PER_TASK)
    for task in sorted({task for tasks in found.values() for task in tasks}):
        for arm, tasks in found.items():
            if task in tasks:
                yield _row(task, arm, *_cells(tasks[task]))


def _cells(runs: Sequence[Result]) -> list[str]:
    solved = [run.solved for run in runs]
    spent, cap = [run.interactions for run in runs], caps({"": runs})[""]
    interval = clopper_pearson(sum(solved), len(runs))
    median = kaplan_meier_median(spent, solved)
    mean = restricted_mean(spent, solved, cap, np.random.default_rng(SEED))
    return [
        f"{sum(solved)}/{len(runs)}",
        f"{interval.low:.0%} to {interval.high:.0%}",
        f"{sum(run.converged for run in runs)}/{len(runs)}",
        f"over {cap:,}" if median is None else f"{median:,.0f}",
        _with_interval(mean, ",.0f") if any(solved) else "-",
        f"{cap:,}",
        f"{np.mean([run.score for run in runs]):.2f}",
        _or_dash(_mean(run.success for run in runs), ".0%"),
        _or_dash(_mean(run.perturbed for run in runs), ".0%"),
        f"{np.mean([run.wall_s for run in runs]):.0f}",
    ]


def _overall(experiment: Experiment, found: Mapping[str, Mapping[str, Sequence[Result]]]) -> Iterator[str]:
    """Arms over tasks, each compared with the first arm on the tasks that both have."""
    first = experiment.arms[0].name
    yield from _head([title.format(first=first) for title in OVERALL])
    compared = _compared(first, found)
    for arm, tasks in found.items():
        rng = np.random.default_rng(SEED)
        middle, gap = interquartile_mean(scores(tasks), rng), optimality_gap(scores(tasks), rng)
        cells = ["-", "-", "-"]
        if arm in compared:
            each = compared[arm]
            cells = [_with_interval(each.probability, ".2f"), f"{each.adjusted:.3f}", each.verdict]
        yield _row(arm, ", ".join(sorted(tasks)), _with_interval(middle, ".2f"), _with_interval(gap, ".2f"), *cells)


def _compared(first: str, found: Mapping[str, Mapping[str, Sequence[Result]]]) -> dict[str, Comparison]:
    """The first arm against every other that has the same tasks."""
    if first not in found:
        return {}
    same = {arm: tasks for arm, tasks in found.items() if arm != first and tasks.keys() == found[first].keys()}
    if not same:
        return {}
    negative = {arm: {task: -runs for task, runs in times(tasks).items()} for arm, tasks in same.items()}
    ours = {task: -runs for task, runs in times(found[first]).items()}
    return compare(ours, negative, np.random.default_rng(SEED))


def _ratios(experiment: Experiment, found: Mapping[str, Mapping[str, Sequence[Result]]]) -> Iterator[str]:
    """Medians of every arm against the first, paired by seed."""
    first = experiment.arms[0].name
    if first not in found:
        return
    yield from _head([title.format(first=first) for title in RATIOS])
    for arm, tasks in found.items():
        pairs = {task: _paired(runs, found[first].get(task, ())) for task, runs in tasks.items()}
        pairs = {task: pair for task, pair in pairs.items() if pair[0]}
        if arm == first or not pairs:
            continue
        theirs, ours = ({task: pair[side] for task, pair in pairs.items()} for side in (0, 1))
        ratio = ratio_of_medians(times(theirs), times(ours), caps(ours), np.random.default_rng(SEED))
        interval = f"{ratio.interval.low:.2f} to {ratio.interval.high:.2f}"
        yield _row(arm, ", ".join(sorted(pairs)), _bounds(ratio.ratio), interval)


def _paired(runs: Sequence[Result], others: Sequence[Result]) -> tuple[list[Result], list[Result]]:
    """The runs of seeds that both have."""
    by_seed = {run.seed: run for run in others}
    both = [run for run in runs if run.seed in by_seed]
    return both, [by_seed[run.seed] for run in both]


def _bounds(bounds: Bounds) -> str:
    if bounds.at_least == bounds.at_most:
        return f"{bounds.at_least:.2f}"
    if np.isinf(bounds.at_most):
        return f"at least {bounds.at_least:.2f}"
    return f"{bounds.at_least:.2f} to {bounds.at_most:.2f}"


def _with_interval(estimate: Estimate, form: str) -> str:
    return f"{estimate.value:{form}} ({estimate.interval.low:{form}} to {estimate.interval.high:{form}})"


def _head(titles: Sequence[str]) -> Iterator[str]:
    yield _row(*titles)
    yield "|---" * len(titles) + "|"


def _row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"
