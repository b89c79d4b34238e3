"""The dashboard: readable pages at every width, plain lines without a terminal, and never in the way."""

import io
import os
import pty
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from coordinator.ui import dashboard
from coordinator.ui.dashboard import LiveDashboard, export_svg, plain_line, render
from coordinator.ui.tables import q_rows
from coordinator.ui.terminal import NonBlockingFile
from coordinator.ui.text import curve, duration, resample
from t4nmtd_dist.wire.messages import (
    DashboardState,
    EvaluationRow,
    EventLine,
    Intervention,
    LearnerRow,
    LearnerStats,
    Missing,
    QCell,
)
from t4nmtd_dist.wire.statistics import views

SIZES = [(80, 24), (100, 30), (160, 50)]
PIDS = ("p1", "p2", "p3", "g", "red", "blue", "yellow", "~p1")
PHASES = ("training", "waiting", "free", "lost")


def learner(index: int) -> LearnerRow:
    return LearnerRow(
        pid=PIDS[index],
        phase=PHASES[index % 4],  # type: ignore[arg-type]
        worker=f"worker-{index}",
        epoch=1,
        version=12,
        starts_waiting=9,
        heartbeat_age_s=0.3 if index else None,
        total=LearnerStats(
            interactions=1000 * (index + 1),
            gradient_steps=400,
            attempts=77,
            recent_success=0.5 if index else None,
            intervention=Intervention(asked=200, answered=150, late=3, own_used=50, lag_total=300),
        ),
        rates={"interactions": 250.0, "gradient_steps": 40.0},
    )


def evaluation(job: int, path: list[int]) -> EvaluationRow:
    return EvaluationRow(
        job=job,
        interactions=5000 * job,
        elapsed_s=10.0 * job,
        success_rate=0.85,
        mean_length=31.4,
        std_length=2.5,
        mean_return=95.0,
        dfa_path=path,
    )


def make_state(learners: int = 4, **changes: Any) -> DashboardState:
    state = DashboardState(
        task="task7",
        title="One passenger [red]of three[/red]",
        formula="F(p1 & X(p1 & g))",
        run_dir="runs/task7/latest",
        seed=3,
        phase="training",
        elapsed_s=754.0,
        interactions=600_000,
        max_interactions=1_500_000,
        dfa_states=8,
        accepting=[7],
        error=[6],
        dist=[3.0, 2.0, 2.0, 1.0, 1.0, 1.0, None, 0.0],
        solved_in_a_row=2,
        solved_needed=5,
        learners=[learner(i) for i in range(learners)],
        q_table=[
            QCell(q=0, pid="p1", value=12.34, greedy=False),
            QCell(q=0, pid="g", value=56.78, greedy=True),
        ],
        evaluations=[evaluation(1, [0, 2]), evaluation(2, [0, 0, 3, 3, 7])],
        events=[
            EventLine(elapsed_s=1.0, text="learner [g] joined"),
            EventLine(elapsed_s=65.0, text="newest"),
        ],
    )
    return msgspec.structs.replace(state, **changes)


def printed(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def drawn(state: DashboardState, width: int, height: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width, height=height, color_system=None, no_color=True)
    console.print(render(state, width=width, height=height), end="")
    return printed(console).split("\n")[:-1]


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("learners", [4, 8])
def test_page_fills_its_room_exactly_and_shows_every_part(width: int, height: int, learners: int) -> None:
    lines = drawn(make_state(learners), width, height)
    assert len(lines) == height
    assert {cell_len(row) for row in lines} == {width}
    page = "\n".join(lines)
    for text in (
        "task7: One passenger [red]of three[/red]",
        "training",
        "0:12:34",
        "600,000 of 1,500,000",
        "60% left",
        "2/5",
        "q0 → q3 → q7 (accepting)",
        "best dist 0 of 3",
        "56.8*",
        "success",
        "length",
        "newest",
    ):
        assert text in page, text


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("learners", [4, 5, 6, 7, 8])
def test_every_learner_has_a_row(width: int, height: int, learners: int) -> None:
    lines = drawn(make_state(learners), width, height)
    for row in make_state(learners).learners:
        phase = rf"(^|│ ){re.escape(row.pid)} +{row.phase} .*{row.total.interactions:,}"
        assert any(re.search(phase, text) for text in lines), row.pid


def test_learner_row_tells_peer_answers_own_values_lag_and_heartbeat() -> None:
    row = next(text for text in drawn(make_state(), 100, 30) if re.match(r"│ p2 ", text))
    assert "━━━───" in row
    assert re.search(r"50% +75% +25% +2\.0 +9 +0\.3 s", row)
    headings = next(text for text in drawn(make_state(), 180, 50) if " pid " in text)
    assert [view.heading for _, view in views() if view.format and view.heading not in headings] == []


def test_learners_without_room_are_counted() -> None:
    state = msgspec.structs.replace(
        make_state(), learners=[msgspec.structs.replace(learner(0), pid=f"x{i}") for i in range(40)]
    )
    lines = drawn(state, 80, 24)
    assert len(lines) == 24
    shown = sum(bool(re.match(r"x\d+ ", row)) for row in lines)
    assert f"and {40 - shown} more learners" in "\n".join(lines)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_missing_values_are_drawn_as_unknown(width: int, height: int) -> None:
    empty = make_state(evaluations=[], q_table=[], events=[], dist=[], max_interactions=0, elapsed_s=0.0)
    page = "\n".join(drawn(empty, width, height))
    assert "no limit" in page
    assert "no evaluation yet" in page
    assert "no DFA state change seen yet" in page
    assert "never" in page
    assert "left" not in page


def test_remaining_time_follows_the_learners_rates() -> None:
    assert "at most 0:15:00 more" in "\n".join(drawn(make_state(), 100, 30))
    assert "more" not in "\n".join(drawn(make_state(phase="solved"), 100, 30))


def test_larger_terminal_shows_more_events() -> None:
    events = [EventLine(elapsed_s=i, text=f"event-{i:02d}") for i in range(40)]
    counts = ["\n".join(drawn(make_state(events=events), *size)).count("event-") for size in SIZES]
    assert counts[0] < counts[1] < counts[2]


def test_large_q_table_keeps_the_states_of_the_last_path_and_counts_the_rest() -> None:
    cells = [QCell(q=q, pid=p, value=1.0, greedy=False) for q in range(26) for p in PIDS if q != 25 or p == "g"]
    state = make_state(8, q_table=cells, evaluations=[evaluation(1, [0, 25])], dist=[1.0] * 26)
    rows, left_out = q_rows(state, 5)
    assert rows == [0, 1, 2, 3, 25]
    assert left_out == 21
    page = "\n".join(drawn(state, 100, 30))
    shown = len(re.findall(r"│ q\d+ +1 ", page))
    assert shown >= 4
    assert f"left out: {26 - shown} states" in page


def test_long_path_keeps_its_start_and_end() -> None:
    state = make_state(evaluations=[evaluation(1, list(range(26)))], accepting=[25], dist=[1.0] * 26)
    assert re.search(r"q0 → … → .*q24 → q25 \(accepting\)", "\n".join(drawn(state, 100, 30)))


@pytest.mark.parametrize("phase", ["starting", "training", "solved", "budget spent", "stopped"])
def test_colours_are_legible_on_dark_and_light_ground(phase: str) -> None:
    console = Console(file=io.StringIO(), width=100, height=30, force_terminal=True, color_system="standard")
    console.print(render(make_state(8, phase=phase), width=100, height=30))
    text = printed(console)
    codes = {int(c) for found in re.findall(r"\x1b\[([\d;]*)m", text) for c in found.split(";") if c}
    assert codes <= {0, 1, 2, 31, 32, 34, 35, 36}
    assert 32 in codes


TEXTS = st.text(max_size=40)
FLOATS = st.floats()
INTS = st.integers(-(2**40), 2**40)
Q = st.integers(-2, 30)
EVALUATIONS = st.builds(
    EvaluationRow,
    job=INTS,
    interactions=INTS,
    elapsed_s=FLOATS,
    success_rate=FLOATS,
    mean_length=FLOATS,
    std_length=FLOATS,
    mean_return=FLOATS,
    dfa_path=st.lists(Q, max_size=12),
)
LEARNERS = st.builds(
    LearnerRow,
    pid=TEXTS,
    phase=st.sampled_from(PHASES),
    worker=TEXTS,
    epoch=INTS,
    version=INTS,
    starts_waiting=INTS,
    heartbeat_age_s=st.none() | FLOATS,
    total=st.builds(
        LearnerStats,
        interactions=INTS,
        gradient_steps=INTS,
        attempts=INTS,
        recent_success=st.none() | FLOATS,
        intervention=st.builds(Intervention, asked=INTS, answered=INTS, late=INTS, own_used=INTS, lag_total=INTS),
    ),
    rates=st.dictionaries(st.sampled_from(["interactions", "gradient_steps"]), FLOATS),
)
STATES = st.builds(
    DashboardState,
    task=TEXTS,
    title=TEXTS,
    formula=TEXTS,
    run_dir=TEXTS,
    seed=INTS,
    phase=st.sampled_from(["starting", "training", "solved", "budget spent", "stopped"]),
    elapsed_s=FLOATS,
    interactions=INTS,
    max_interactions=st.just(0) | INTS,
    dfa_states=st.integers(1, 26),
    accepting=st.lists(Q, max_size=3),
    error=st.lists(Q, max_size=3),
    dist=st.lists(st.none() | FLOATS, max_size=26),
    solved_in_a_row=INTS | st.integers(0, 5),
    solved_needed=INTS | st.integers(0, 10),
    learners=st.lists(LEARNERS, max_size=10),
    q_table=st.lists(st.builds(QCell, q=Q, pid=TEXTS, value=FLOATS, greedy=st.booleans()), max_size=20),
    evaluations=st.lists(EVALUATIONS, max_size=8),
    events=st.lists(st.builds(EventLine, elapsed_s=FLOATS, text=TEXTS), max_size=8),
    missing=st.lists(st.builds(Missing, what=TEXTS, command=TEXTS, needed=st.booleans()), max_size=12),
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(STATES, st.integers(1, 170), st.integers(1, 55))
def test_any_state_fits_any_terminal(state: DashboardState, width: int, height: int) -> None:
    lines = drawn(state, width, height)
    assert len(lines) == height
    assert all(cell_len(row) == width for row in lines)
    assert plain_line(state).isprintable()
    assert dashboard.summary(state, width=width)


@given(st.lists(FLOATS, max_size=50), st.integers(0, 40), st.integers(1, 6), FLOATS)
def test_curves_stay_within_their_room(values: list[float], width: int, height: int, top: float) -> None:
    rows = curve(values, width, height, top)
    assert len(rows) == height
    assert all(len(row) <= width for row in rows)


def test_curve_shows_zero_lowest_and_top_highest() -> None:
    assert curve([0.0, 0.5, 1.0], 3, 1, 1.0) == ["▁▄█"]
    assert curve([0.0, 1.0], 2, 2, 1.0) == [" █", "▁█"]
    assert resample([1.0, 3.0, 5.0, 7.0], 2) == [2.0, 6.0]
    assert duration(3 * 3600 + 62.9) == "3:01:02"


def test_plain_line_names_the_lost_and_has_no_control_codes() -> None:
    text = plain_line(make_state(task="ta\x1b[31msk\n7"))
    assert "\x1b" not in text
    assert "\n" not in text
    for part in ("0:12:34", "600,000/1,500,000", "success 85%", "2/5 in a row", "p2:waiting:50%", "LOST g"):
        assert part in text
    assert "LOST" not in plain_line(make_state(2))
    assert "not evaluated" in plain_line(make_state(evaluations=[], max_interactions=0))


def lacks(count: int) -> list[Missing]:
    needed = [Missing(what=f"h{n}", command=f"t4nmtd-worker --pid p{n}") for n in range(1, count)]
    return [*needed, Missing(what="evaluator", command="t4nmtd-worker --evaluate", needed=False)]


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_page_names_what_is_missing_and_the_command_that_brings_it(width: int, height: int) -> None:
    page = "\n".join(drawn(make_state(missing=lacks(3)), width, height))
    for number in (1, 2):
        assert f"missing h{number}: t4nmtd-worker --pid p{number} " in page
    assert "t4nmtd-worker --evaluate" in page
    assert "missing" not in "\n".join(drawn(make_state(), width, height))
    crowded = "\n".join(drawn(make_state(missing=lacks(40)), width, height))
    shown = crowded.count("missing h")
    assert shown >= 2
    assert f"and {40 - shown} more" in crowded


def test_the_plain_line_names_what_is_missing_and_the_command_that_brings_it() -> None:
    text = plain_line(make_state(missing=lacks(3)))
    assert "missing h1: t4nmtd-worker --pid p1 | missing h2: t4nmtd-worker --pid p2 | no evaluator" in text
    assert "t4nmtd-worker --evaluate" in text


def test_escape_codes_in_texts_never_reach_the_terminal() -> None:
    state = make_state(title="\x1b]0;gotcha\x07", events=[EventLine(elapsed_s=0.0, text="a\x1b[2Jb\nc")])
    assert "\x1b" not in "\n".join(drawn(state, 100, 30))


def terminal() -> Console:
    return Console(file=io.StringIO(), width=100, height=30, force_terminal=True, legacy_windows=False)


def test_plain_dashboard_prints_every_ten_seconds_and_on_news() -> None:
    console = Console(file=io.StringIO(), width=40)
    healthy = make_state(2)
    with LiveDashboard(console, plain=True) as board:
        for elapsed in (0.0, 1.0, 9.9, 10.0, 12.0):
            assert board.show(msgspec.structs.replace(healthy, elapsed_s=elapsed))
        board.show(make_state(4, elapsed_s=13.0))
        board.show(make_state(4, elapsed_s=14.0))
        board.show(make_state(2, elapsed_s=15.0))
        board.show(make_state(2, elapsed_s=16.0, phase="solved"))
    lines = printed(console).splitlines()
    assert [row.split()[0] for row in lines] == ["0:00:00", "0:00:10", "0:00:13", "0:00:16"]
    assert "LOST g" in lines[2]
    assert "\x1b" not in printed(console)


def test_plain_dashboard_ends_with_the_last_state() -> None:
    console = Console(file=io.StringIO(), width=40)
    with LiveDashboard(console, plain=True) as board:
        board.show(make_state(elapsed_s=0.0))
        board.show(make_state(elapsed_s=5.0))
    assert printed(console).splitlines()[-1].startswith("0:00:05")


def test_console_that_is_no_terminal_gets_lines() -> None:
    console = Console(file=io.StringIO(), width=100)
    with LiveDashboard(console, plain=False) as board:
        board.show(make_state())
    assert printed(console).splitlines() == [plain_line(make_state())]


def fail_while_shown(console: Console) -> None:
    with LiveDashboard(console, plain=False) as board:
        board.show(make_state())
        raise RuntimeError("the run failed")


def test_terminal_is_given_back_and_keeps_a_summary_when_the_run_fails() -> None:
    console = terminal()
    with pytest.raises(RuntimeError, match="the run failed"):
        fail_while_shown(console)
    page, _, after = printed(console).partition("\x1b[?1049l")
    assert page.startswith("\x1b[?1049h")
    assert "56.8*" in page
    assert "56.8*" not in after
    assert "run directory runs/task7/latest" in after


def test_dashboard_shows_nothing_outside_its_block() -> None:
    board = LiveDashboard(terminal(), plain=False)
    assert not board.show(make_state())


def test_pages_are_drawn_at_most_ten_times_a_second() -> None:
    now = 0.0

    def clock() -> float:
        return now

    console = terminal()
    file = console.file
    with LiveDashboard(console, plain=False, clock=clock) as board:
        for step in range(100):
            now = step / 100
            board.show(make_state(title=f"frame-{step:02d}."))
        assert isinstance(file, io.StringIO)
        frames = re.findall(r"frame-\d\d\.", file.getvalue())
    assert 2 <= len(frames) <= 10
    assert "frame-99." in printed(console)


@pytest.mark.parametrize("plain", [True, False])
def test_broken_pipe_ends_the_dashboard_quietly(plain: bool, capfd: pytest.CaptureFixture[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as file:
        console = Console(file=file, width=100, height=30, force_terminal=True)
        with LiveDashboard(console, plain=plain) as board:
            assert not board.show(make_state())
            assert not board.show(make_state(phase="solved"))
    assert capfd.readouterr() == ("", "")


def test_closed_file_ends_the_dashboard_quietly() -> None:
    console = terminal()
    file = console.file
    with LiveDashboard(console, plain=False) as board:
        assert board.show(make_state())
        file.close()
        assert not board.show(make_state(phase="solved"))


def on_pseudo_terminal(use: Callable[[int, Console], None]) -> None:
    reader, slave = pty.openpty()
    try:
        with os.fdopen(slave, "w") as file:
            use(reader, Console(file=file, width=100, height=30, force_terminal=True))
    finally:
        os.close(reader)


def test_terminal_that_stops_reading_delays_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coordinator.ui.terminal.FLUSH_WAIT_S", 0.0)
    monkeypatch.setattr(dashboard, "LAST_WORDS_S", 0.0)
    ticks = iter(range(1000))

    def use(reader: int, console: Console) -> None:
        with LiveDashboard(console, plain=False, clock=lambda: float(next(ticks))) as board:
            for step in range(40):
                assert board.show(make_state(elapsed_s=float(step)))
            assert isinstance(console.file, NonBlockingFile)
            assert console.file.pending
            while console.file.pending:
                os.read(reader, 65536)
                console.file.flush()
            assert board.show(make_state(phase="solved"))

    on_pseudo_terminal(use)


def test_terminal_that_vanishes_ends_the_dashboard_quietly() -> None:
    def use(reader: int, console: Console) -> None:
        with LiveDashboard(console, plain=False, clock=iter(range(9)).__next__) as board:
            assert board.show(make_state())
            spare, other = pty.openpty()
            os.dup2(spare, reader)  # closes the terminal's last master
            os.close(spare)
            os.close(other)
            assert not board.show(make_state(phase="solved"))

    on_pseudo_terminal(use)


def test_ascii_console_gets_lines() -> None:
    raw = io.BytesIO()
    file = io.TextIOWrapper(raw, encoding="ascii")
    with LiveDashboard(Console(file=file, width=100, force_terminal=True), plain=False) as board:
        assert board.show(make_state(task="tâche"))
    assert raw.getvalue().startswith(b"0:12:34 t?che training")


def test_svg_is_written_with_the_page_in_it(tmp_path: Path) -> None:
    export_svg(make_state(), tmp_path / "board.svg", 100, 30)
    svg = (tmp_path / "board.svg").read_text(encoding="utf-8")
    assert svg.startswith("<svg ")
    assert "[red]of&#160;three[/red]" in svg
    assert "t4nmtd" in svg
