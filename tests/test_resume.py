"""A run that was stopped goes on: bit for bit in one process, and honest in what it counts everywhere."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from coordinator_events import Conversation, changes, starts, weights
from learner_work import STEPS, Work
from small_sac import AT_G1, TO_G2, car_at, small_sac_task
from small_tasks import START, TO_PASSENGER_2, small_task, snapshot_after

from coordinator.checkpointing import resume_state
from coordinator.events import Interrupted
from coordinator.run_settings import RunSettings
from coordinator.saved_state import load_saved_state, raise_counts, saved_counts, saved_state
from coordinator.snapshot import summary
from t4nmtd_dist.agents.registry import build_learner
from t4nmtd_dist.core.state_dict import copied, joined, split
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.runs.checkpoints import newest_checkpoint, write_checkpoint
from t4nmtd_dist.runs.counts import read_counts, write_counts
from t4nmtd_dist.runs.resuming import new_identity, write_identity
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import (
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    Goodbye,
    LearnerStats,
    Refused,
    Release,
    SyncReply,
)
from workers.checkpointing import LearnerCheckpoints

EVALUATED = ("evaluation.every=60", "evaluation.episodes=2", "environment.horizon=20", "learner.attempt_steps=12")
SAC = ("sac.relabel_share=0.5", "sac.success_share=0.25", "sac.updates_per_step=0.3", 'learner.hand_over="changes"')


def task_of(kind: str) -> CompiledTask:
    if kind == "ppo":
        return small_task(*EVALUATED)
    if kind == "sac":
        return small_sac_task(*EVALUATED, *SAC)
    return small_sac_task(*EVALUATED, *SAC, name=kind)


def begun(kind: str, *, budget: int = 10**9, clock: float = 0.0) -> SerialRun:
    return SerialRun(task_of(kind), RunSettings(3, budget, lease_s=float("inf")), lambda: clock)


def with_starts(run: SerialRun, kind: str) -> SerialRun:
    """Start states that hand over soon, so that peers are asked."""
    if kind == "ppo":
        run.sessions["p2"].buffer.add(START, snapshot_after(*TO_PASSENGER_2))
    if kind == "sac":
        run.sessions["g1"].buffer.add(0, AT_G1)
        run.sessions["g2"].buffer.add(TO_G2 - 1, car_at(0.75, 0.75))
    return run


def told(run: SerialRun) -> dict[str, Any]:
    """All that a run comes to: weights by name as bytes, counters, evaluations, Q, start states."""
    report = summary(run.coordinator)
    for name in ("wall_s", "outcome"):
        report.pop(name)
    learned = {f"{pid}/{k}": v for pid, s in run.sessions.items() for k, v in s.learner.weights().items()}
    rows = [
        (row.job, row.interactions, row.success_rate, row.mean_length, row.mean_return, row.dfa_path)
        for row in run.coordinator.evaluations.history
    ]
    buffers = {
        pid: [(cursor, q, state.tobytes()) for cursor, q, state in session.buffer.since(0, 10**6)]
        for pid, session in run.sessions.items()
    }
    return {
        "weights": {name: array.tobytes() for name, array in learned.items()},
        "report": report,
        "evaluations": rows,
        "q": run.coordinator.method.entries(),
        "buffers": buffers,
        "versions": {pid: session.learner.version for pid, session in run.sessions.items()},
    }


@cache
def uninterrupted(kind: str, rounds: int) -> dict[str, Any]:
    run = with_starts(begun(kind), kind)
    for _ in range(rounds):
        run.round()
    return told(run)


def through_files(run: SerialRun, folder: Path) -> Any:
    write_checkpoint(folder, {"run": 1}, run.state_dict())
    warnings: list[str] = []
    found = newest_checkpoint(folder, lambda about: about == {"run": 1}, warnings.append)
    assert found is not None
    assert warnings == []
    return found.state


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "before", "after"), [("ppo", 2, 2), ("ppo", 0, 1), ("sac", 6, 4), ("sac", 1, 2)])
def test_a_run_stopped_between_rounds_goes_on_as_if_nothing_had_been(
    kind: str, before: int, after: int, tmp_path: Path
) -> None:
    first = with_starts(begun(kind), kind)
    for _ in range(before):
        first.round()
    first.stop("enough")
    second = begun(kind, clock=777.0)
    second.load_state_dict(through_files(first, tmp_path))
    assert told(second) == told(first)
    for _ in range(after):
        second.round()
    expected = uninterrupted(kind, before + after)
    for part, value in told(second).items():
        assert value == expected[part], part


def test_the_sac_run_of_that_test_asks_peers_and_trains() -> None:
    report = uninterrupted("sac", 10)["report"]
    assert report["intervention"]["answered"] > 0
    assert report["gradient_steps"] > 0
    assert len(uninterrupted("sac", 10)["evaluations"]) > 1
    assert len(uninterrupted("ppo", 4)["evaluations"]) > 1
    assert uninterrupted("ppo", 4)["report"]["intervention"]["answered"] > 0


def test_a_budget_spent_in_mid_round_can_be_raised(tmp_path: Path) -> None:
    spent, expected = begun("ppo", budget=300), begun("ppo")
    list(spent.steps())
    assert spent.coordinator.outcome == "budget spent"
    going_on = begun("ppo")
    going_on.load_state_dict(through_files(spent, tmp_path))
    for _ in range(5):
        expected.round()
    while going_on.coordinator.interactions < expected.coordinator.interactions:
        going_on.round()
    assert told(going_on) == told(expected)


@pytest.mark.parametrize(
    ("kind", "flags"),
    [
        ("task3", ()),  # resets are drawn by the environment's own generator
        ("task1", ("environment.options.map=random",)),  # each pond has a generator of its own
        ("task8", ("ppo.num_envs=3", "ppo.rollout=8")),
    ],
)
def test_worlds_go_on_with_the_same_chance(kind: str, flags: tuple[str, ...]) -> None:
    def attempts() -> Any:
        task = small_sac_task(*flags, "environment.horizon=20", "learner.attempt_steps=5", name=kind)
        pid = next(pid for pid in task.decomposition.pids if pid in task.decomposition.available(task.dfa.initial))
        learner = build_learner(task, pid, InitialStateBuffer(10), task.method(), seed=4)
        assert learner.rollout.begin()
        return learner.rollout

    def course(going: Any) -> list[bytes]:
        rng = np.random.default_rng(0)
        seen = []
        for _ in range(12):
            count = len(going.q)
            actions = (
                rng.integers(6, size=count)
                if kind == "task8"
                else rng.uniform(-1, 1, (count, 6 if kind == "task3" else 2))
            )
            step = going.step(actions.astype(np.float32) if kind != "task8" else actions)
            seen += [step.next_observations.tobytes(), going.observations.tobytes(), step.symbols.tobytes()]
        return seen

    first, second = attempts(), attempts()
    course(first)
    second.load_state_dict(joined(*split(copied(first.state_dict()))))
    assert second.observations.tobytes() == first.observations.tobytes()
    assert course(second) == course(first)
    assert second.interactions == first.interactions


# The coordinator


def talked() -> Conversation:
    """A coordinator that has heard of all that it keeps."""
    talk = Conversation()
    talk.claim("p1")
    stats = LearnerStats(phase="training", interactions=100, attempts=7, successes=3, gradient_steps=11)
    learned = weights(3.0)
    arrays = {**changes((0, 1, 4, 2.5), (0, -1, 9, 0.0)), **starts((1, 17), (2, 18)), **learned}
    talk.sync("p1", "w", stats=stats, version=5, arrays=arrays)
    evaluator = talk.claim_evaluator("e")
    talk.now = 40.0
    talk.sync("p1", "w", sequence=2, stats=msgspec.structs.replace(stats, interactions=9000), version=6, arrays=learned)
    job = talk.answer("e", EvaluationPoll(epoch=evaluator.epoch))
    assert isinstance(job, EvaluationJob)
    talk.send("e", report(evaluator.epoch, job.job, 1.0))
    return talk


def report(epoch: int, job: int, rate: float) -> EvaluationReport:
    return EvaluationReport(
        epoch=epoch,
        job=job,
        success_rate=rate,
        mean_length=9.0,
        std_length=0.0,
        mean_return=1.0,
        episodes=2,
        dfa_path=[0],
    )


def resumed(talk: Conversation, folder: Path) -> Conversation:
    """A fresh coordinator that has loaded what the other has written."""
    write_checkpoint(folder, {}, saved_state(talk.state))
    found = newest_checkpoint(folder, lambda about: True, pytest.fail)
    assert found is not None
    fresh = Conversation()
    load_saved_state(fresh.state, found.state)
    return fresh


def test_a_resumed_coordinator_knows_all_that_the_first_knew(tmp_path: Path) -> None:
    talk = talked()
    fresh = resumed(talk, tmp_path)
    assert fresh.fingerprint() == talk.fingerprint()
    assert fresh.state.rng.random() == talk.state.rng.random()
    ours, theirs = fresh.state.records["p1"], talk.state.records["p1"]
    assert (ours.version, ours.total) == (theirs.version, theirs.total)
    assert {f"weights.{name}": array.tolist() for name, array in ours.weights.items()} == {
        name: array.tolist() for name, array in weights(3.0).items()
    }
    assert fresh.state.evaluations.history == talk.state.evaluations.history != []
    assert fresh.state.evaluations.in_a_row == 1
    assert fresh.state.elapsed_s == 40.0
    assert list(fresh.state.events) == list(talk.state.events)
    fresh.tick()
    fresh.now = 2.5
    fresh.tick()
    assert fresh.state.elapsed_s == 42.5


def test_leases_of_before_are_over_and_new_ones_count_on(tmp_path: Path) -> None:
    fresh = resumed(talked(), tmp_path)
    refused = fresh.answer("w", fresh.sync_message("p1", "w", epoch=1, sequence=3))
    assert isinstance(refused, Refused)
    assert not refused.final
    granted = fresh.claim("p1")
    assert (granted.epoch, granted.version) == (2, 6)
    fresh.sync("p1", "w", sequence=1, stats=LearnerStats(interactions=30))
    assert fresh.state.interactions == 9030


def test_what_was_spent_after_the_checkpoint_counts_and_a_row_of_successes_begins_anew(tmp_path: Path) -> None:
    talk = talked()
    fresh = resumed(talk, tmp_path)
    talk.sync("p1", "w", sequence=3, stats=LearnerStats(interactions=9500))
    talk.claim("p1", "w")
    raise_counts(fresh.state, json.loads(json.dumps(saved_counts(talk.state))))
    assert fresh.state.interactions == 9500
    assert fresh.claim("p1").epoch == 3
    assert fresh.state.evaluations.in_a_row == 1
    later = saved_counts(talk.state) | {"evaluated": 2, "elapsed_s": 55.0}
    raise_counts(fresh.state, later)
    assert fresh.state.evaluations.in_a_row == 0
    assert fresh.state.elapsed_s == 55.0


def test_older_counts_take_nothing_away(tmp_path: Path) -> None:
    talk = talked()
    older = saved_counts(talk.state)
    talk.sync("p1", "w", sequence=3, stats=LearnerStats(interactions=9500))
    fresh = resumed(talk, tmp_path)
    raise_counts(fresh.state, older)
    assert fresh.state.interactions == 9500


def test_what_learners_did_until_they_heard_of_the_end_counts_once() -> None:
    talk = talked()
    talk.state.handle(Interrupted(talk.now, "SIGTERM"))
    last = talk.sync_message("p1", "w", sequence=3, stats=LearnerStats(interactions=9100))
    for _ in range(2):
        answers = [sent.message for sent in talk.answers("w", last)]
        assert [type(answer) for answer in answers] == [SyncReply, Goodbye]
    assert talk.state.interactions == 9100
    talk.answers("w", Release(pid="p1", epoch=1))
    assert not talk.state.leases.live("p1", talk.now)
    stale = talk.sync_message("p1", "other", epoch=1, sequence=4, stats=LearnerStats(interactions=9999))
    assert [type(sent.message) for sent in talk.answers("other", stale)] == [Goodbye]
    assert talk.state.interactions == 9100


def test_the_clock_stands_still_after_the_end() -> None:
    talk = talked()
    talk.state.handle(Interrupted(talk.now, "SIGTERM"))
    talk.now = 44.0
    talk.tick()
    assert talk.state.elapsed_s == 40.0


# Learners under leases


def test_a_killed_learner_goes_on_and_counts_only_what_it_does_then() -> None:
    work = Work()
    work.iterate(3)
    state = work.kept()
    work.iterate(2)
    work.claim(state)
    assert work.session.learner.rollout.interactions == 3 * STEPS
    assert work.session.learner.version == 5  # the coordinator's weights are newer
    work.iterate(1)
    assert work.counted == 6 * STEPS
    assert work.session.learner.version == 6
    assert work.talk.state.records["p1"].version == 6


def test_processor_time_is_told_on_after_a_kill() -> None:
    work = Work()
    work.session.processor_s = 600.0
    work.iterate(1)
    work.claim(work.kept())
    for spent in (2.0, 5.0):
        work.session.processor_s = spent
        work.iterate(1)
        assert work.talk.state.learners_s == 600.0 + spent


def test_runs_that_share_a_folder_keep_their_checkpoints(tmp_path: Path) -> None:
    told: list[str] = []

    def kept(run_id: str, *, times: int = 0) -> tuple[LearnerCheckpoints, Work]:
        work, checkpoints = Work(), LearnerCheckpoints(tmp_path, 300.0, told.append)
        work.session.run_id = run_id
        checkpoints.resume(work.session, msgspec.structs.replace(work.granted, run_id=run_id), {})
        for _ in range(times):
            work.iterate(1)
            checkpoints.write_last([work.session])
        return checkpoints, work

    kept("a", times=2)
    checkpoints, work = kept("b", times=4)
    assert kept("a")[1].session.learner.rollout.interactions == 2 * STEPS
    assert kept("b")[1].session.learner.rollout.interactions == 4 * STEPS
    checkpoints.delete([work.session])
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert kept("a")[1].session.learner.rollout.interactions == 2 * STEPS


def test_a_run_directory_holds_the_checkpoints_of_its_own_run_alone(tmp_path: Path) -> None:
    identity, work = new_identity(serial=False), Work()
    write_identity(tmp_path, identity)
    checkpoints = LearnerCheckpoints(tmp_path / "checkpoints", 300.0, print)
    for run_id in (identity.run_id, "another"):
        work.session.run_id = run_id
        checkpoints.write_last([work.session])
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.glob("checkpoints/**/p1")} == {
        "checkpoints/p1",
        "checkpoints/another/p1",
    }


def test_a_checkpoint_newer_than_the_coordinators_weights_is_told_to_it() -> None:
    work = Work()
    work.iterate(2)
    older = saved_state(work.talk.state)
    work.iterate(2)
    state, learned = work.kept(), work.session.learner.weights()
    work.talk = Conversation()
    load_saved_state(work.talk.state, older)
    work.claim(state)
    assert work.session.learner.version == 4
    work.hear(work.session.last_sync())
    record = work.talk.state.records["p1"]
    assert record.version == 4
    assert all(record.weights[name].tobytes() == array.tobytes() for name, array in learned.items())


@pytest.mark.parametrize("heard", [True, False])
def test_the_last_steps_before_a_stop_count_once_whether_the_coordinator_hears_of_them_or_not(heard: bool) -> None:
    work = Work()
    work.iterate(2)
    work.session.iterate(work.peers)
    last = work.session.last_sync()
    if heard:
        work.hear(last)
    assert work.session.is_answered == heard
    work.claim(work.kept())
    work.iterate(1)
    assert work.counted == 4 * STEPS


def test_an_answer_to_another_learner_of_the_same_worker_is_left_alone() -> None:
    work = Work()
    work.iterate(1)
    work.session.last_sync()
    held = len(work.session.buffer)
    own = SyncReply("p1", work.session.epoch, 2, 0, work.talk.state.method.entries(), {})
    others = msgspec.structs.replace(own, pid="p2", accepted_sequence=99, start_cursor=50)
    work.session.take_reply(Envelope(others, {"starts.q": np.zeros(1, np.int32), "starts.state": np.zeros((1, 4))}))
    assert not work.session.is_answered
    assert len(work.session.buffer) == held
    work.session.take_reply(Envelope(own, {}))
    assert work.session.is_answered


@pytest.mark.parametrize("same_run", [True, False])
def test_a_learner_outlives_its_coordinator_and_tells_a_resumed_one_only_what_is_new(same_run: bool) -> None:
    work = Work()
    work.iterate(3)
    before = work.talk
    work.talk = Conversation()
    if same_run:
        load_saved_state(work.talk.state, saved_state(before.state))
    granted = work.talk.claim("p1")
    work.session.renew(granted if same_run else msgspec.structs.replace(granted, run_id="another"))
    work.iterate(1)
    assert work.counted == 4 * STEPS  # a new run is told everything


def test_a_learner_is_of_no_use_to_a_coordinator_that_trains_something_else() -> None:
    work = Work()
    again = Conversation().claim("p1")
    assert work.session.can_go_on_under(again)
    assert work.session.can_go_on_under(msgspec.structs.replace(again, run_id="another"))
    for changed in ({"seed": 1}, {"task": {**again.task, "formula": "F(g)"}}, {"rho": [0.0]}):
        assert not work.session.can_go_on_under(msgspec.structs.replace(again, run_id="another", **changed))


def test_the_coordinator_goes_on_from_counts_alone_if_there_is_no_checkpoint_yet(tmp_path: Path) -> None:
    talk = talked()
    write_counts(tmp_path, {"run_id": "", **saved_counts(talk.state)})
    fresh = Conversation()
    assert "no checkpoint" in resume_state(fresh.state, tmp_path, pytest.fail)
    assert fresh.state.interactions == 9000
    write_counts(tmp_path, {"run_id": "another", **saved_counts(talk.state)})
    other = Conversation()
    resume_state(other.state, tmp_path, pytest.fail)
    assert other.state.interactions == 0
    assert read_counts(tmp_path / "nowhere") is None
