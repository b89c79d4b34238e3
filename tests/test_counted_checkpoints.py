"""A learner's checkpoints hold nothing that was never counted, and tell nothing twice."""

from __future__ import annotations

from pathlib import Path

import pytest
from learner_work import STEPS, Work

from workers.checkpointing import LearnerCheckpoints


@pytest.mark.parametrize("heard", [0, 1, 2])
def test_of_two_unanswered_messages_those_count_again_that_were_not_heard(heard: int) -> None:
    work = Work()
    work.iterate(2)
    syncs = [work.learn_and_tell(), work.learn_and_tell(last=True)]
    for sync in syncs[:heard]:
        work.hear(sync)
    work.claim(work.kept())
    work.iterate(1)
    assert work.counted == 5 * STEPS


def numbers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("**/p1/0*"))


def keeping(folder: Path, work: Work) -> LearnerCheckpoints:
    """Checkpoints of a learner whose next one is always due."""
    checkpoints = LearnerCheckpoints(folder, 0.0, print)
    checkpoints.resume(work.session, work.granted, {})
    return checkpoints


def test_a_killed_learner_has_no_checkpoint_of_steps_that_were_never_counted(tmp_path: Path) -> None:
    work = Work()
    checkpoints = keeping(tmp_path, work)
    unheard = work.learn_and_tell()
    for _ in range(2):
        checkpoints.write_due([work.session])
        work.session.iterate(work.peers)  # it learns on
    checkpoints.delete([])  # waits for what is being written
    assert numbers(tmp_path) == []
    work.hear(unheard)
    checkpoints.write_due([work.session])
    checkpoints.delete([])
    assert numbers(tmp_path) == ["000001"]
    work.claim()
    keeping(tmp_path, work)  # of a new worker, after a kill -9
    assert work.session.learner.rollout.interactions == STEPS
    work.iterate(1)
    assert work.counted == 2 * STEPS


def test_a_checkpoint_does_not_wait_for_ever_for_a_coordinator_that_is_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workers.checkpointing.UNANSWERED_S", 0.0)
    work = Work()
    checkpoints = keeping(tmp_path, work)
    work.learn_and_tell()
    for _ in range(2):
        checkpoints.write_due([work.session])
    checkpoints.delete([])
    assert numbers(tmp_path) == ["000001"]


def test_a_held_checkpoint_of_a_learner_that_has_ended_is_not_written(tmp_path: Path) -> None:
    work = Work()
    checkpoints = keeping(tmp_path, work)
    sync = work.learn_and_tell()
    checkpoints.write_due([work.session])
    work.hear(sync)
    checkpoints.write_due([])
    checkpoints.delete([])
    assert numbers(tmp_path) == []
