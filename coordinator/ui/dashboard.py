"""The live dashboard: draws a ``DashboardState`` as a page or a plain line.

Drawing is pure: all times come from the state. Only ``LiveDashboard`` touches a terminal.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, cast

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.layout import Layout
from rich.live import Live
from rich.padding import Padding
from rich.panel import Panel
from rich.rule import Rule
from rich.segment import Segment
from rich.text import Text

from coordinator.ui import panels, tables
from coordinator.ui.terminal import NonBlockingFile
from coordinator.ui.text import clean, count, duration, line, percent
from t4nmtd_dist.wire.messages import DashboardState

SMALLEST = (60, 12)
ROOMY = (100, 28)
PAGE_EVERY_S = 0.25
PLAIN_EVERY_S = 10.0
LAST_WORDS_S = 1.0


@dataclass(frozen=True)
class _Page:
    """Draws its body on exactly ``width`` x ``height`` cells."""

    body: RenderableType
    width: int
    height: int

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width = min(self.width, options.max_width)
        lines = console.render_lines(self.body, options.update_dimensions(width, self.height))
        for row in Segment.set_shape(lines, width, self.height):
            yield from row
            yield Segment.line()


@dataclass(frozen=True)
class _Plan:
    """Heights of the sections in lines, with frames; 0 omits one."""

    framed: bool
    with_formula: bool
    lacks: int
    header: int
    learners: int
    middle: int
    events: int

    @property
    def frame(self) -> int:
        """Lines taken by a section's frame."""
        return 2 if self.framed else 1


def _plan(state: DashboardState, width: int, height: int) -> _Plan:
    framed = width >= ROOMY[0] and height >= ROOMY[1]
    frame = 2 if framed else 1
    with_formula = height - len(state.learners) >= 24
    lacks = min(len(state.missing), max(0, height - len(state.learners) - 10) // 3)
    header = frame + (4 if with_formula else 3) + lacks
    learners = min(len(state.learners) + 1 + frame, height - header)
    rest = height - header - learners
    least_events = frame + 2 if rest >= 11 else frame + 1 if rest >= 9 else 0
    known = len({cell.q for cell in state.q_table})
    wanted = max(known + 1, 5, min(15, rest // 2 - frame)) + frame
    middle = min(wanted, rest - max(least_events, rest // 7 if least_events else 0))
    if middle < frame + 2:
        return _Plan(framed, with_formula, lacks, header, height - header, 0, 0)
    return _Plan(framed, with_formula, lacks, header, learners, middle, rest - middle)


def _section(title: str, body: RenderableType, framed: bool) -> RenderableType:
    heading = line(title, "bold")
    if framed:
        return Panel(body, title=heading, title_align="left", border_style="cyan", padding=(0, 1))
    return Group(Rule(heading, align="left", style="cyan"), body)


def _middle(state: DashboardState, width: int, plan: _Plan) -> Layout:
    """The Q-table beside the last evaluation and the curves."""
    side = 4 if plan.framed else 1
    q_width = tables.q_width(state, max(20, width - 26 - 2 * side))
    right = width - q_width - side
    rows = plan.middle - plan.frame
    table = _section("Q by DFA state (* greedy)", tables.q_table(state, q_width, rows), plan.framed)
    evaluation = panels.evaluation(state, right - (4 if plan.framed else 0), rows)
    title = f"evaluation {state.evaluations[-1].job}" if state.evaluations else "evaluation"
    halves = Layout()
    halves.split_row(
        Layout(table if plan.framed else Padding(table, (0, 1, 0, 0)), size=width - right),
        Layout(_section(title, evaluation, plan.framed)),
    )
    return halves


def render(state: DashboardState, *, width: int, height: int) -> RenderableType:
    """The page for a terminal of ``width`` x ``height`` cells; below 60 x 12, the plain line."""
    if width < SMALLEST[0] or height < SMALLEST[1]:
        return _Page(Text(plain_line(state)), width, height)
    plan = _plan(state, width, height)
    inner = width - (4 if plan.framed else 0)
    name = f"{state.task}: {state.title}"
    header = panels.header(state, inner, plan.with_formula, plan.lacks)
    learners = tables.learners(state, inner, plan.learners - plan.frame - 1)
    events = panels.events(state, plan.events - plan.frame)
    page = Layout()
    page.split_column(
        Layout(_section(name, header, plan.framed), size=plan.header),
        *_sized(_section("learners", learners, plan.framed), plan.learners),
        *([Layout(_middle(state, width, plan), size=plan.middle)] if plan.middle > 0 else []),
        *_sized(_section("events", events, plan.framed), plan.events),
    )
    return _Page(page, width, height)


def _sized(section: RenderableType, height: int) -> list[Layout]:
    return [Layout(section, size=height)] if height > 0 else []


def summary(state: DashboardState, *, width: int) -> RenderableType:
    """What stays on screen after the run: header, learners, last evaluation and result."""
    rows = len(state.learners)
    return Group(
        _section(f"{state.task}: {state.title}", panels.header(state, width, True), False),
        _section("learners", tables.learners(state, width, rows), False),
        _section("evaluation", panels.evaluation(state, width, 5), False),
        *([Text(clean(told), overflow="fold")] if (told := panels.result(state)) else []),
        Text(f"run directory {clean(state.run_dir)}", overflow="fold"),
    )


def plain_line(state: DashboardState) -> str:
    """The state in one line without control codes, for logs and pipes."""
    budget = f"/{count(state.max_interactions)}" if state.max_interactions > 0 else ""
    success = panels.success(state.evaluations[-1]) if state.evaluations else "not evaluated"
    parts = [
        f"{duration(state.elapsed_s)} {state.task} {state.phase}",
        f"{count(state.interactions)}{budget} interactions",
        f"success {success}",
        panels.row_so_far(state),
        _result(state),
        " ".join(f"{row.pid}:{row.phase}:{percent(row.total.recent_success)}" for row in state.learners),
    ]
    lost = _lost(state)
    if lost:
        parts.append(f"LOST {', '.join(sorted(lost))}")
    parts += [lack.text for lack in state.missing]
    return clean(" | ".join(part for part in parts if part))


def _result(state: DashboardState) -> str:
    """The result of a finished run."""
    if state.solved_at is not None:
        return f"solved after {count(state.solved_at)}, {count(state.interactions)} in all"
    over = state.phase not in panels.RUNNING
    return f"best {panels.success(state.policy)}" if over and state.policy is not None else ""


def _lost(state: DashboardState) -> frozenset[str]:
    return frozenset(row.pid for row in state.learners if row.phase == "lost")


class LiveDashboard:
    """Shows states on a console; a terminal failure ends only the dashboard.

    Use as a context manager. On a terminal it draws on the alternate screen, at most four times a second, always
    restores the terminal, and prints a summary at the end. Otherwise it prints a line every ten seconds of the run, and
    at once when the phase changes or a learner is lost.

    Args:
        console: where to draw.
        plain: lines instead of pages; forced without a terminal or a Unicode encoding.
        clock: seconds, for the limit of four pages a second.
    """

    def __init__(self, console: Console, *, plain: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self._console = console
        self._plain = plain or not console.is_terminal or not console.encoding.lower().startswith("utf")
        self._clock = clock
        self._drawn_at = 0.0
        self._drawn: DashboardState | None = None
        self._latest: DashboardState | None = None
        self._file: NonBlockingFile | None = None
        self._live: Live | None = None

    def __enter__(self) -> LiveDashboard:
        self._wrapped = self._console.file
        self._file = NonBlockingFile(self._wrapped)
        self._console.file = cast(IO[str], self._file)
        if not self._plain:
            self._live = Live(
                console=self._console,
                screen=True,
                auto_refresh=False,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is None:
            return
        try:
            if self._live is not None:
                self._live.stop()
            self._print_end()
            self._file.drain(LAST_WORDS_S)
        finally:
            self._file.release()
            self._console.file = self._wrapped
            self._file = self._live = None

    def show(self, state: DashboardState) -> bool:
        """Draw a state if one is due.

        Returns:
            False outside the ``with`` block and after the terminal has failed, else True.
        """
        if self._file is None or self._file.broken:
            return False
        self._latest = state
        self._file.flush()
        if self._file.pending:
            return True
        if self._live is None:
            self._show_line(state)
        else:
            self._show_page(state, self._live)
        return not self._file.broken

    def _show_page(self, state: DashboardState, live: Live) -> None:
        now = self._clock()
        news = self._drawn is None or self._drawn.phase != state.phase
        if not news and now - self._drawn_at < PAGE_EVERY_S:
            return
        width, height = self._console.size
        self._drawn, self._drawn_at = state, now
        live.update(render(state, width=width, height=height), refresh=True)

    def _show_line(self, state: DashboardState) -> None:
        if self._drawn is None or _line_due(self._drawn, state):
            self._print_line(state)

    def _print_line(self, state: DashboardState) -> None:
        self._drawn = state
        self._console.print(Text(plain_line(state)), soft_wrap=True)

    def _print_end(self) -> None:
        if self._latest is None:
            return
        if not self._plain:
            self._console.print(summary(self._latest, width=self._console.width))
        elif self._latest != self._drawn:
            self._print_line(self._latest)


def _line_due(last: DashboardState, state: DashboardState) -> bool:
    """Whether to print another plain line after ``last``."""
    waited = state.elapsed_s - last.elapsed_s
    return state.phase != last.phase or bool(_lost(state) - _lost(last)) or not 0 <= waited < PLAIN_EVERY_S


def export_svg(state: DashboardState, path: Path | str, width: int, height: int) -> None:
    """Write a state's page as an SVG image of ``width`` x ``height`` cells.

    Raises:
        OSError: if the file cannot be written.
    """
    console = Console(
        record=True,
        file=io.StringIO(),
        width=width,
        height=height,
        force_terminal=True,
        color_system="truecolor",
        legacy_windows=False,
        no_color=False,
    )
    console.print(render(state, width=width, height=height), end="")
    svg = console.export_svg(title=f"t4nmtd train --task {clean(state.task)}")
    Path(path).write_text(svg.replace("<svg ", '<svg xml:space="preserve" ', 1), encoding="utf-8")
