"""Bad numbers and unexpected exceptions: the coordinator says so, and the training goes on."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from coordinator_events import Conversation, changes
from hypothesis import given, settings
from hypothesis import strategies as st
from small_tasks import small_task
from test_sockets import DEADLINE_S, FREE_PORT, Running, answer, tell

from coordinator.checkpointing import StateCheckpointing, resume_state
from coordinator.endpoints import Access
from coordinator.run_logger import RunLogger
from coordinator.run_settings import RunSettings
from coordinator.service import CoordinatorService, RunStorage
from coordinator.snapshot import dashboard_state, status, summary
from coordinator.state import CoordinatorState
from coordinator.ui.viewer import watch
from t4nmtd_dist.core.errors import ProtocolError, RunError
from t4nmtd_dist.wire.codec import Envelope, decode, encode
from t4nmtd_dist.wire.fields import LARGEST_AMOUNT, LARGEST_COUNT
from t4nmtd_dist.wire.messages import (
    Claim,
    DashboardState,
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    Failure,
    Granted,
    Intervention,
    LearnerStats,
    Refused,
    Release,
    StatusRequest,
    SyncReply,
)
from t4nmtd_dist.wire.sockets import receive, subscribe
from t4nmtd_dist.wire.zmq_types import Context

LARGEST = LearnerStats(
    phase="training",
    interactions=LARGEST_COUNT,
    gradient_steps=LARGEST_COUNT,
    attempts=LARGEST_COUNT,
    successes=LARGEST_COUNT,
    peer_rows=LARGEST_COUNT,
    processor_s=LARGEST_AMOUNT,
    recent_success=float("nan"),
    episode_steps=float("inf"),
    entropy=-float("inf"),
    value_loss=1e308,
    intervention=Intervention(asked=LARGEST_COUNT, answered=LARGEST_COUNT, lag_total=LARGEST_COUNT),
)


@pytest.fixture
def running(tmp_path: Path, context: Context, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    monkeypatch.setattr("coordinator.service.FAREWELL_S", 0.0)
    monkeypatch.setattr("coordinator.service.LONGEST_FAREWELL_S", 0.3)  # nobody here says a last word
    state = CoordinatorState(small_task(), RunSettings(seed=0, max_interactions=10**9))
    service = CoordinatorService(state, RunStorage(tmp_path / "run", tensorboard="auto"), Access(FREE_PORT, FREE_PORT))

    def serve() -> None:
        with suppress(RunError):  # of a result that a broken part keeps from being written
            service.serve()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield Running(service, thread, context)
    service.interrupt("the test is over")
    thread.join(DEADLINE_S)
    assert not thread.is_alive(), "the coordinator did not end within the deadline"


def can_be_shown_and_kept(state: CoordinatorState, folder: Path) -> None:
    """Everything that is made of the state can be: pages, status, summary, checkpoints, and a resume from them."""
    for shown in (dashboard_state(state), status(state, 1.0)):
        assert decode(encode(Envelope(shown))).message == shown
    json.dumps(summary(state), allow_nan=False)
    keeper = StateCheckpointing(state, folder, 300.0, print)
    keeper.turn()
    keeper.finish()
    again = CoordinatorState(state.task, state.settings)
    resume_state(again, folder, print)
    assert again.interactions == state.interactions
    assert (
        dashboard_state(again).learners[0].total.interactions == dashboard_state(state).learners[0].total.interactions
    )


def test_the_largest_counts_add_up_over_epochs_and_survive_a_resume(tmp_path: Path) -> None:
    talk = Conversation(max_interactions=2**62)
    for _ in range(3):
        talk.claim("p1", "w")
        talk.sync("p1", "w", stats=LARGEST, sequence=LARGEST_COUNT)
        can_be_shown_and_kept(talk.state, tmp_path)
    assert talk.state.records["p1"].total.attempts == LARGEST_COUNT


def test_figures_that_are_not_finite_are_left_out_and_the_counts_kept() -> None:
    talk = Conversation(max_interactions=2**62)
    talk.claim("p1", "w")
    talk.sync("p1", "w", stats=LARGEST)
    told = talk.state.records["p1"].current
    assert (told.recent_success, told.episode_steps, told.entropy, told.value_loss) == (None, None, None, 1e308)
    assert told.attempts == LARGEST_COUNT


BAD_PROGRESS: dict[str, dict[str, np.ndarray]] = {
    "states as unsigned numbers": {"progress.q": np.zeros((1, 3), np.uint64), "progress.reward": np.zeros(1)},
    "long numbers of steps": {"progress.q": np.full((1, 3), 2**40, np.int64), "progress.reward": np.zeros(1)},
    "states as fractions": {"progress.q": np.zeros((1, 3), np.float32), "progress.reward": np.zeros(1)},
    "rewards as whole numbers": {"progress.q": np.zeros((1, 3), np.int32), "progress.reward": np.zeros(1, np.int64)},
    "rewards beyond reason": {"progress.q": np.zeros((1, 3), np.int32), "progress.reward": np.full(1, 1e300)},
    "too many starts": {"starts.q": np.zeros(999, np.int32), "starts.state": np.zeros((999, 1))},
    "a start of no dimension": {"starts.q": np.zeros((), np.int32), "starts.state": np.zeros(())},
    "starts too large": {"starts.q": np.zeros(1, np.int32), "starts.state": np.zeros((1, 9 << 20), np.uint8)},
}


@pytest.mark.parametrize("arrays", BAD_PROGRESS.values(), ids=BAD_PROGRESS.keys())
def test_progress_out_of_range_is_refused_and_changes_nothing(arrays: dict[str, np.ndarray]) -> None:
    talk = Conversation()
    talk.claim("p1", "w")
    before = talk.fingerprint()
    assert isinstance(talk.answer("w", talk.sync_message("p1", "w"), arrays), Failure)
    assert talk.fingerprint() == before


BAD_REPORTS: dict[str, dict[str, Any]] = {
    "a path beyond the automaton": {"dfa_path": [0, 6]},
    "episodes beyond the horizon": {"mean_length": 1e9},
    "no episodes": {"episodes": 0},
}


@pytest.mark.parametrize("fields", BAD_REPORTS.values(), ids=BAD_REPORTS.keys())
def test_an_evaluation_that_cannot_be_is_refused(fields: dict[str, Any]) -> None:
    talk = Conversation("evaluation.every=1")
    epoch = talk.claim_evaluator("e").epoch
    good = {"success_rate": 1.0, "mean_length": 9.0, "std_length": 0.0, "mean_return": 1.0, "episodes": 1}
    report = EvaluationReport(**{"epoch": epoch, "job": 1, "dfa_path": [0, 5], **good, **fields})
    assert isinstance(talk.answer("e", report), Failure)
    assert talk.state.evaluations.history == []


numbers = st.integers(-(2**63), 2**64 - 1) | st.sampled_from([0, 1, 2**53, 2**53 + 1, 2**63 - 1, 2**64 - 1])
figures = st.floats() | st.none()


@settings(max_examples=150, deadline=None)
@given(
    stats=st.fixed_dictionaries(
        dict.fromkeys(("interactions", "gradient_steps", "attempts", "successes", "peer_rows"), numbers)
        | dict.fromkeys(("recent_success", "episode_steps", "entropy", "value_loss"), figures)
        | {"processor_s": st.floats(), "phase": st.sampled_from(["waiting", "training", "free", "lost"])}
    ),
    counters=st.fixed_dictionaries(dict.fromkeys(("sequence", "version", "start_cursor"), numbers)),
    rows=st.lists(st.tuples(st.integers(-2, 6), st.integers(-2, 6), st.integers(-1, 9), st.floats()), max_size=3),
)
def test_whatever_a_holder_reports_can_be_shown(stats: Any, counters: Any, rows: Any) -> None:
    talk = Conversation(max_interactions=2**62)
    epoch = talk.claim("p1", "w").epoch
    body = {"pid": "p1", "epoch": epoch, "stats": stats, **counters}
    frame = msgpack.packb({"v": 1, "kind": "sync", "sender": "w", "id": 5, "body": body, "arrays": []})
    try:
        message = decode([frame]).message
    except ProtocolError:
        return
    assert isinstance(talk.answer("w", message, changes(*rows)), SyncReply | Failure)
    shown = dashboard_state(talk.state)
    assert decode(encode(Envelope(shown))).message == shown
    json.dumps(summary(talk.state), allow_nan=False)


# Exceptions in a running coordinator


class BrokenError(Exception):
    """What nobody expects."""


def raises(*_: object, **__: object) -> None:
    raise BrokenError("by the test")


def mishaps(running: Running) -> list[str]:
    return [line.text for line in list(running.service.state.events) if "unexpected BrokenError" in line.text]


PARTS = {
    "coordinator.service.dashboard_state": "publishing the state",
    "coordinator.run_logger.RunLogger.metrics": "recording metrics",
    "coordinator.run_logger.RunLogger.record": "recording",
    "coordinator.checkpointing.StateCheckpointing.turn": "keeping a checkpoint",
    "coordinator.leasing.Leasing.report_lost": "following Tick",
}


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_an_exception_in_a_part_is_told_once_and_survived(
    part: str, running: Running, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(part, raises)
    socket, granted = running.claim("p1")
    soon(lambda: mishaps(running))
    for _ in range(5):
        tell(socket, StatusRequest())
        answer(socket)
    assert isinstance(running.claim("p2")[1], Granted)
    (line,) = mishaps(running)
    assert PARTS[part] in line
    assert "by the test" in line
    assert capfd.readouterr().err.count("Traceback") == 1
    assert granted.pid == "p1"


def soon(holds: Callable[[], object]) -> None:
    """Wait until something holds."""
    pause, left = threading.Event(), DEADLINE_S
    while not holds():
        pause.wait(0.02)
        left -= 0.02
        assert left > 0, "not within the deadline"


def test_a_message_that_breaks_the_coordinator_is_answered_and_others_are_heard(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coordinator.leasing.Leasing.release", raises)
    socket, granted = running.claim("p1")
    tell(socket, Release(pid="p1", epoch=granted.epoch))
    failure = answer(socket)
    assert isinstance(failure, Failure)
    assert "its log says why" in failure.text
    assert isinstance(running.claim("p2")[1], Granted)
    soon(lambda: any("taking Release of test" in line for line in mishaps(running)))


def test_a_page_that_cannot_be_drawn_ends_no_dashboard(
    running: Running, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    drawn: list[int] = []

    def fails_first(self: object, state: DashboardState) -> bool:
        drawn.append(1)
        if len(drawn) < 3:
            raise BrokenError("by the test")
        return True

    monkeypatch.setattr("coordinator.ui.dashboard.LiveDashboard.show", fails_first)
    last = watch(running.context, running.service.publish, keep_going=lambda: len(drawn) < 5)
    assert last is not None
    assert capfd.readouterr().err.count("BrokenError: by the test") == 1


def test_a_recorder_that_fails_at_the_end_leaves_a_checkpoint(
    tmp_path: Path, context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coordinator.service.FAREWELL_S", 0.0)
    monkeypatch.setattr("coordinator.service.LONGEST_FAREWELL_S", 0.3)  # nobody here says a last word
    monkeypatch.setattr(RunLogger, "close", raises)
    state = CoordinatorState(small_task(), RunSettings(seed=0, max_interactions=10**9))
    service = CoordinatorService(state, RunStorage(tmp_path / "run"), Access(FREE_PORT, FREE_PORT))
    service.interrupt("at once")
    with pytest.raises(RunError, match=r"the result could not be written; .* --resume .*run"):
        service.serve()
    assert state.outcome == "stopped"
    assert list((tmp_path / "run" / "checkpoints" / "coordinator").iterdir())


def test_a_claim_with_a_name_that_would_deceive_a_terminal_is_refused(running: Running) -> None:
    socket = running.worker()
    tell(socket, Claim(role="learner", instance="\x1b[2J\u202e", pid="p1"))
    failure = answer(socket)
    assert isinstance(failure, Failure)
    assert "control" in failure.text
    assert failure.text.isprintable()
    late = subscribe(running.context, running.service.publish)
    envelope = receive(late, DEADLINE_S)
    assert envelope is not None


def test_a_failure_quotes_a_stranger_in_few_printable_words(running: Running) -> None:
    socket = running.worker()
    tell(socket, StatusRequest())
    answer(socket)
    header = {"v": 1, "kind": "claim", "sender": "", "id": 0, "arrays": []}
    socket.send_multipart([msgpack.packb({**header, "body": {"role": "\x1b" * 50_000, "x\n" * 9000: 1}})])
    failure = answer(socket)
    assert isinstance(failure, Failure)
    assert len(failure.text) <= 500
    assert failure.text.isprintable()


def test_a_refused_claim_names_the_pid_in_few_printable_words() -> None:
    talk = Conversation()
    refused = talk.refused("ü" * 900, "w")
    assert isinstance(refused, Refused)
    assert not isinstance(talk.answer("e", EvaluationPoll(epoch=2**53)), EvaluationJob)
