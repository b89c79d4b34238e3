"""Several sub-tasks in one worker: how they are divided (`t4nmtd train --workers N`), and that they call each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_sac import PIDS
from small_tasks import small_learner

from t4nmtd_dist.agents.common.peer_values import LocalPeers, Questions
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.launch.program import assign_pids


@given(st.integers(1, 30).flatmap(lambda count: st.tuples(st.just(count), st.integers(1, count))))
def test_sub_tasks_are_divided_evenly_and_each_once(sizes: tuple[int, int]) -> None:
    count, workers = sizes
    pids = [f"p{number}" for number in range(count)]
    assigned = assign_pids(pids, workers)
    assert len(assigned) == workers
    assert sorted(pid for held in assigned.values() for pid in held) == sorted(pids)
    assert {len(held) for held in assigned.values()} <= {count // workers, -(-count // workers)}


def test_by_default_every_sub_task_has_a_worker() -> None:
    assert assign_pids(["g", "~p1"], None) == {"g": ["g"], "not-p1": ["~p1"]}


@pytest.mark.parametrize("workers", [1, 2, None])
def test_the_name_of_a_process_is_one_that_a_file_can_have(workers: int | None, tmp_path: Path) -> None:
    assigned = assign_pids([f"{'proposition' * 20}{number}" for number in range(16)], workers)
    assert len(assigned) == (workers or 16)
    for name in assigned:
        (tmp_path / f"{name}.log").touch()


@pytest.mark.parametrize(
    ("pids", "workers"),
    [
        (["a", "a&b", "b"], 2),
        (["evaluator", "coordinator", "g"], None),
        (["a", "a&b", "b", "worker-1"], 3),
        (["a", "a&b", "b", "worker-2"], 2),
    ],
)
def test_processes_whose_names_would_collide_lose_no_sub_task(pids: list[str], workers: int | None) -> None:
    assigned = assign_pids(pids, workers)
    assert sorted(pid for held in assigned.values() for pid in held) == sorted(pids)
    assert not {"evaluator", "coordinator"} & assigned.keys()


@pytest.mark.parametrize("workers", [-1, 0, 5])
def test_a_number_of_workers_that_cannot_be_is_refused(workers: int) -> None:
    with pytest.raises(ConfigError, match=f"--workers {workers}: expected 1 to 4"):
        assign_pids(PIDS, workers)


def test_peers_in_one_worker_are_called_directly() -> None:
    learners = {pid: small_learner(pid) for pid in ("g", "p1")}
    critics = {pid: learner.critic_values for pid, learner in learners.items()}
    peers, pids = LocalPeers(critics), ("g", "p1", "p9") * 3
    size = learners["g"].rollout.observations.shape[1]
    observations = np.random.default_rng(0).normal(size=(9, size)).astype(np.float32)
    peers.ask(1, Questions(np.arange(9), pids, observations, np.zeros(9, np.int32)))
    peers.ask(2, Questions(np.array([4]), ("g",), observations[:1], np.zeros(1, np.int32)))
    found = peers.gather(1)
    assert sorted(found.rows.tolist()) == [row for row, pid in enumerate(pids) if pid != "p9"]
    for row, value in zip(found.rows, found.values, strict=True):
        expected = critics[pids[row]](observations[row : row + 1], np.zeros(1, np.int32))[0]
        assert value == pytest.approx(expected, abs=1e-6)
    assert (peers.counts.asked, peers.counts.answered, peers.counts.own_used) == (10, 6, 3)
    del critics["g"]  # its lease is over
    assert len(peers.gather(2).rows) == 0
    assert (peers.counts.answered, peers.counts.own_used) == (6, 4)
