"""Numbers, messages and compiled tasks are those that were recorded; ``oracle.py`` says what is compared and when."""

from __future__ import annotations

import msgspec
import oracle
import pytest
from wire_samples import ARRAYS, BODIES

from t4nmtd_dist.wire.codec import decode, encode
from t4nmtd_dist.wire.messages import KINDS


@pytest.mark.command
@pytest.mark.training
@pytest.mark.timeout(600)
@pytest.mark.parametrize("task", oracle.SHORTER)
def test_a_short_training_comes_to_the_recorded_numbers(task: str) -> None:
    recorded = oracle.load("serial.json")
    other = oracle.same_machine(recorded)
    if other and task not in oracle.SAME_EVERYWHERE:
        pytest.skip(
            f"numbers recorded on another kind of machine ({other}); tests/oracle.py says how to check them here"
        )
    compare = oracle.coarse_differences if other else oracle.differences
    found = compare(task, recorded["tasks"][task], oracle.run_task(task))
    assert not found, "\n" + "\n".join(found)


def test_every_learner_of_the_recorded_trainings_has_learnt() -> None:
    trainings = oracle.load("serial.json")["tasks"]
    assert list(trainings) == list(oracle.SHORTER)
    counts = {
        (task, pid): learner["gradient_steps"]
        for task, training in trainings.items()
        for pid, learner in training["summary"]["learners"].items()
    }
    assert min(counts.values()) > 10


@pytest.mark.parametrize("kind", KINDS)
def test_messages_have_the_recorded_bytes(kind: str) -> None:
    assert oracle.wire_frames(kind) == oracle.load("wire.json")[kind]


@pytest.mark.parametrize("kind", KINDS)
def test_recorded_messages_are_understood(kind: str) -> None:
    frames = [bytes.fromhex(frame) for frame in oracle.load("wire.json")[kind]["all fields"]]
    envelope = decode(frames)
    assert encode(envelope) == frames
    assert list(envelope.arrays) == list(ARRAYS.get(kind, {}))


def test_the_samples_have_every_kind_and_field() -> None:
    fields = {kind: [field.name for field in msgspec.structs.fields(of)] for kind, of in KINDS.items()}
    assert {kind: list(body) for kind, body in BODIES.items()} == fields
    assert set(oracle.load("wire.json")) == set(fields)


@pytest.mark.command
@pytest.mark.parametrize("task", oracle.TASKS)
def test_tasks_compile_to_what_was_recorded(task: str) -> None:
    found = oracle.inspect_json(task)
    assert found == (oracle.RECORDED / "inspect" / f"{task}.json").read_text(encoding="utf-8")


def test_a_changed_number_is_told_by_task_learner_and_part() -> None:
    recorded = oracle.load("serial.json")["tasks"]["task7"]
    changed = oracle.load("serial.json")["tasks"]["task7"]
    assert oracle.differences("task7", recorded, changed) == []
    learner = changed["learners"]["p1"]
    name = next(iter(learner["arrays"]))
    learner["arrays"][name] = "0"
    learner["counters"]["attempts"] = "1"
    told = oracle.differences("task7", recorded, changed)
    assert all(line.startswith("task7, p1: ") for line in told)
    assert len(told) == 3
    assert name in told[1]


def test_other_names_of_arrays_make_no_difference() -> None:
    recorded = oracle.load("serial.json")["tasks"]["task7"]
    renamed = oracle.load("serial.json")["tasks"]["task7"]
    for learner in renamed["learners"].values():
        learner["arrays"] = {f"new/{name}": digest for name, digest in learner["arrays"].items()}
    assert oracle.differences("task7", recorded, renamed) == []
