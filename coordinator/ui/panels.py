"""The dashboard's panels: header, last evaluation with curves, events.

Each function draws one part of a ``DashboardState`` into a given size in terminal cells.
"""

from __future__ import annotations

import math
from pathlib import Path

from rich.console import Group, RenderableType
from rich.text import Text

from coordinator.ui.tables import dist, last_path
from coordinator.ui.text import bar, clip, count, curve, duration, line, percent, rate, spaced
from t4nmtd_dist.runs.report import percent_text, policy_text, solved_text
from t4nmtd_dist.wire.messages import DashboardState, EvaluationRow

PHASE_STYLE = {
    "starting": "bold cyan",
    "training": "bold cyan",
    "solved": "bold green",
    "budget spent": "bold red",
    "stopped": "bold magenta",
}
RUNNING = ("starting", "training")
CHART_LABEL = 14


def steps_per_s(state: DashboardState) -> float:
    """Current interactions per second; the run's average if no learner reports any."""
    now = sum(row.rates.get("interactions", 0.0) for row in state.learners)
    if now > 0 or state.elapsed_s <= 0:
        return now
    return state.interactions / state.elapsed_s


def budget_left_s(state: DashboardState) -> float | None:
    """Seconds until the budget is spent; None without a budget, a rate or a live run."""
    speed = steps_per_s(state)
    if state.phase not in RUNNING or state.max_interactions <= 0 or not speed > 0:
        return None
    return max(0, state.max_interactions - state.interactions) / speed


def header(state: DashboardState, width: int, with_formula: bool, lacks: int = 0) -> RenderableType:
    """Status, budget and consecutive successes, one line each, and optionally the formula.

    Up to ``lacks`` more lines list what is missing.
    """
    lines: list[RenderableType] = [_status_line(state), _budget_line(state, width), _solved_line(state)]
    if with_formula:
        until = " (until the end of the episode)" if state.acceptance == "end" else ""
        lines.append(line(f"formula{until} {state.formula}", "dim"))
    return Group(*lines, *missing(state, lacks))


def missing(state: DashboardState, rows: int) -> list[Text]:
    """What is missing and the commands that start it, in at most ``rows`` lines."""
    lines = [line(lack.text, "bold yellow" if lack.needed else "dim") for lack in state.missing]
    if len(lines) <= rows:
        return lines
    return [*lines[: rows - 1], line(f"and {len(lines) - rows + 1} more", "dim")] if rows > 0 else []


def _status_line(state: DashboardState) -> Text:
    updates = sum(row.rates.get("gradient_steps", 0.0) for row in state.learners)
    return spaced(
        (state.phase, PHASE_STYLE[state.phase]),
        (f"elapsed {duration(state.elapsed_s)}", "bold"),
        (f"{rate(steps_per_s(state))} steps/s", ""),
        (f"{rate(updates)} updates/s", ""),
        (f"seed {state.seed}", ""),
        (state.run_dir, "dim"),
    )


def _budget_line(state: DashboardState, width: int) -> Text:
    if state.max_interactions <= 0:
        return spaced((f"interactions {count(state.interactions)}", "bold"), ("no limit", "dim"))
    used = state.interactions / state.max_interactions
    left_s = budget_left_s(state)
    text = spaced(
        (f"interactions {count(state.interactions)} of {count(state.max_interactions)}", "bold"),
        (f"{percent(max(0.0, 1 - used))} left", ""),
        (f"at most {duration(left_s)} more" if left_s is not None else "", ""),
    )
    text.append("  ")
    text.append_text(bar(used, max(0, min(40, width - text.cell_len)), "cyan"))
    return text


def row_so_far(state: DashboardState) -> str:
    """Consecutive successes, such as 2/5 in a row, and the threshold if not 100 %."""
    needed = "" if state.success_needed == 1 else f" at {percent_text(state.success_needed)}"
    return f"{state.solved_in_a_row}/{state.solved_needed} in a row{needed}"


def success(row: EvaluationRow) -> str:
    """An evaluation's success rate, and its mode if it is not greedy."""
    return percent(row.success_rate) + (" sampled" if row.actions == "sampled" else "")


def result(state: DashboardState) -> str:
    """The result so far: when the task was solved, and the best policy."""
    told = []
    if state.solved_at is not None:
        told.append(solved_text(state.solved_at, state.interactions, state.solved_needed))
    if state.policy is not None:
        best = state.policy
        told.append(policy_text(best.success_rate, best.actions, best.interactions, Path(state.run_dir)))
    return "; ".join(told)


def _solved_line(state: DashboardState) -> Text:
    last = state.evaluations[-1] if state.evaluations else None
    done, needed = state.solved_in_a_row, state.solved_needed
    dots = "●" * done + "○" * (needed - done) if 0 <= done <= needed <= 10 else ""
    return spaced(
        (f"solved {row_so_far(state)}", "bold"),
        (dots, "green"),
        (f"success {success(last)}" if last else "no evaluation yet", ""),
        (f"evaluation {last.job} at {count(last.interactions)} interactions" if last else "", ""),
    )


def path_text(state: DashboardState, width: int) -> Text:
    """The last evaluation's path, such as q0 → q3 → q7 (accepting), shortened to fit."""
    path = last_path(state)
    names = [(f"q{q}", _state_style(state, q)) for q in path]
    end = path[-1] if path else None
    mark = "accepting" if end in state.accepting else "error" if end in state.error else "not accepted"
    room = width - len(mark) - 3
    while len(names) > 3 and sum(len(name) + 3 for name, _ in names) - 3 > room:
        names = [names[0], ("…", "dim"), *names[3 if names[1][0] == "…" else 2 :]]
    text = Text(" → ", style="", no_wrap=True, overflow="ellipsis").join([Text(*name) for name in names])
    return text.append(f" ({mark})", _state_style(state, end)) if path else line("path unknown", "dim")


def _state_style(state: DashboardState, q: int | None) -> str:
    return "bold green" if q in state.accepting else "bold red" if q in state.error else "cyan"


def _distance_line(state: DashboardState, width: int) -> Text:
    path = last_path(state)
    reached = [d for d in (dist(state, q) for q in path) if d is not None]
    first = dist(state, path[0]) if path else None
    if not reached or first is None:
        return line("best dist unknown", "dim")
    text = line(f"best dist {min(reached):g} of {first:g} ")
    share = 1.0 if min(reached) <= 0 else 1 - min(reached) / first if first > 0 else 0.0
    text.append_text(bar(share, max(0, min(24, width - text.cell_len)), "green"))
    return text


def evaluation(state: DashboardState, width: int, height: int) -> RenderableType:
    """Path and distance of the last evaluation, then curves of success and length over all."""
    if not state.evaluations:
        return line("no evaluation yet", "dim")
    last = state.evaluations[-1]
    chart = min(8, max(1, (height - 3) // 2))
    gap = [line()] if height >= 2 * chart + 4 else []
    lengths = [row.mean_length for row in state.evaluations]
    longest = max((v for v in lengths if math.isfinite(v)), default=0.0)
    result = f"length {last.mean_length:.1f} ± {last.std_length:.1f}  return {last.mean_return:.1f}"
    rates = [row.success_rate for row in state.evaluations]
    return Group(
        path_text(state, width),
        _distance_line(state, width),
        *_chart(("success", percent(last.success_rate), "to 100%"), rates, width, chart, 1.0, "green"),
        *gap,
        *_chart(("length", f"{last.mean_length:.1f}", f"to {longest:.1f}"), lengths, width, chart, longest, "cyan"),
        line(result),
    )


def _chart(
    labels: tuple[str, str, str], values: list[float], width: int, height: int, top: float, style: str
) -> list[Text]:
    """A curve with name, newest value and scale on the left, if they fit."""
    name, newest, scale = labels
    notes = [f"{name} {newest}"] if height == 1 else [name, newest] if height == 2 else [name, newest, scale]
    rows = curve(values, width - CHART_LABEL, height, top)
    notes += [""] * (height - len(notes))
    return [
        line(clip(note, CHART_LABEL - 1).ljust(CHART_LABEL)).append(row, style)
        for note, row in zip(notes, rows, strict=True)
    ]


def events(state: DashboardState, rows: int) -> RenderableType:
    """The last events, newest at the bottom."""
    newest = state.events[-rows:] if rows > 0 else []
    if not newest:
        return line("nothing yet", "dim")
    return Group(*(spaced((duration(e.elapsed_s), "cyan"), (e.text, "")) for e in newest))
