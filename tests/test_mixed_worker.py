"""Workers with several sub-tasks: their learners value each other's states directly, those elsewhere over the wire."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import pytest
from small_sac import small_sac_task
from small_tasks import START, TO_PASSENGER_2, small_task, snapshot_after

from coordinator.endpoints import Access
from coordinator.run_settings import RunSettings
from coordinator.service import CoordinatorService, RunStorage
from coordinator.state import CoordinatorState
from t4nmtd_dist.agents.common.off_policy import OffPolicyLearner
from t4nmtd_dist.agents.common.peer_values import MixedPeers, PeerCritics
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.wire.peers.critic_client import QueryPeers
from t4nmtd_dist.wire.peers.replica import ReplicaPeers
from workers.options import Connection, WorkerOptions
from workers.worker import Worker

FREE_PORT = "tcp://127.0.0.1:*"
WAIT_S = 60.0
TOGETHER = (("p2", "g"), ("p1", "p3"))  # p2 hands over to g
APART = (("p2", "p1"), ("g", "p3"))


@contextmanager
def workers(hands: tuple[tuple[str, ...], ...], intervention: str, folder: Path) -> Iterator[list[Worker]]:
    """Workers of task 7; p2 often begins beside its passenger."""
    task = small_task(f"learner.intervention={intervention}", "learner.attempt_steps=6")
    state = CoordinatorState(task, RunSettings(seed=0, max_interactions=10**9, lease_s=1e6))
    state.records["p2"].buffer.add(START, snapshot_after(*TO_PASSENGER_2))
    with workers_of(state, hands, folder) as made:
        yield made


@contextmanager
def workers_of(state: CoordinatorState, hands: tuple[tuple[str, ...], ...], folder: Path) -> Iterator[list[Worker]]:
    """A coordinator in a thread, and workers whose turns the test takes."""
    service = CoordinatorService(state, RunStorage(folder / "run"), Access(FREE_PORT, FREE_PORT))
    thread = threading.Thread(target=service.serve, daemon=True)
    thread.start()
    made = [Worker(WorkerOptions(Connection(service.control, WAIT_S), "learner", hand, hand[0])) for hand in hands]
    try:
        yield made
    finally:
        service.interrupt("the test is over")
        for worker in made:
            worker._close()
        thread.join(WAIT_S)


def take_turns(made: list[Worker], holds: Callable[[], object]) -> None:
    """Let the workers take turns until something holds."""
    deadline = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < deadline
        for worker in made:
            worker._turn()


def until(made: list[Worker], holds: Callable[[PeerCritics], object]) -> PeerCritics:
    """Let the workers take turns until something holds of the peers of p2."""
    take_turns(made, lambda: "p2" in made[0]._peer_registry.peers and holds(made[0]._peer_registry.peers["p2"]))
    return made[0]._peer_registry.peers["p2"]


def answered_by(peers: PeerCritics, hands: tuple[tuple[str, ...], ...]) -> int:
    """Rows answered by this worker's learners if g is one of them, else by the others."""
    assert isinstance(peers, MixedPeers)
    return (peers.near if hands is TOGETHER else peers.far).counts.answered


@pytest.mark.slow
@pytest.mark.parametrize("intervention", ["query", "replica"])
@pytest.mark.parametrize("hands", [TOGETHER, APART], ids=["together", "apart"])
def test_learners_of_one_worker_are_asked_directly_and_others_over_the_wire(
    hands: tuple[tuple[str, ...], ...], intervention: str, tmp_path: Path
) -> None:
    with workers(hands, intervention, tmp_path) as made:
        peers = until(made, lambda peers: answered_by(peers, hands))
        assert isinstance(peers, MixedPeers)
        assert isinstance(peers.far, QueryPeers if intervention == "query" else ReplicaPeers)
        elsewhere = set(peers.far._connections.by_pid)
        assert elsewhere <= set(hands[1]), "there is no wire to learners of the same worker"
        counts = peers.counts
        assert counts.asked == counts.answered + counts.own_used


NEAR, FAR = (("g1", "g4"), ("g2", "g3")), (("g1", "g2"), ("g4", "g3"))  # g1 and g4 begin at the reset of task 6


@pytest.mark.slow
@pytest.mark.parametrize("hands", [NEAR, FAR], ids=["together", "apart"])
def test_learners_learn_from_peers_of_their_worker_directly_and_from_others_over_the_wire(
    hands: tuple[tuple[str, ...], ...], tmp_path: Path
) -> None:
    state = CoordinatorState(small_sac_task(name="task6"), RunSettings(seed=0, max_interactions=10**9, lease_s=1e6))

    def others() -> dict[str, ReplayBuffer]:
        """What g1 learns from, by pid, as far as there is any."""
        session = made[0]._sessions.get("g1")
        found = {} if session is None else cast(OffPolicyLearner, session.learner).batches.others
        return {pid: experience for pid, experience in found.items() if len(experience)}

    with workers_of(state, hands, tmp_path) as made:
        take_turns(made, lambda: "g4" in others() and state.records["g1"].total.peer_rows)
        copies, g4 = (
            made[0]._peer_registry.experience,
            next(w._sessions["g4"].learner for w in made if "g4" in w._sessions),
        )
        assert copies is not None
        assert set(copies._connections.by_pid) <= set(hands[1]), "there is no wire to learners of the same worker"
        assert (others()["g4"] is g4.replay_buffer) == (hands is NEAR)
        assert g4.replay_buffer is not None
        assert lived(others()["g4"]) <= lived(g4.replay_buffer)


def lived(experience: ReplayBuffer) -> set[bytes]:
    """All that was seen, each observation as bytes."""
    return {row.tobytes() for row in experience.observations[: len(experience)]}
