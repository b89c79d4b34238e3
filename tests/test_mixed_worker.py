"""Workers with several sub-tasks: their learners value each other's states directly, those elsewhere over the wire."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from small_tasks import START, TO_PASSENGER_2, small_task, snapshot_after

from coordinator.doors import Access
from coordinator.service import CoordinatorService
from coordinator.state import CoordinatorState, RunSettings
from t4nmtd_dist.learners.peers import LocalPeers, MixedPeers, PeerCritics
from t4nmtd_dist.wire.critic_client import QueryPeers
from t4nmtd_dist.wire.replica import ReplicaPeers
from workers.worker import Worker, WorkerOptions

FREE_PORT = "tcp://127.0.0.1:*"
WAIT_S = 60.0
TOGETHER = (("p2", "g"), ("p1", "p3"))  # p2 hands over to g
APART = (("p2", "p1"), ("g", "p3"))


@contextmanager
def workers(hands: tuple[tuple[str, ...], ...], intervention: str, folder: Path) -> Iterator[list[Worker]]:
    """A coordinator in a thread, and workers whose turns the test takes; p2 often begins beside its passenger."""
    task = small_task(f"learner.intervention={intervention}", "learner.attempt_steps=6")
    state = CoordinatorState(task, RunSettings(seed=0, max_interactions=10**9, lease_s=1e6))
    state.records["p2"].buffer.add(START, snapshot_after(*TO_PASSENGER_2))
    service = CoordinatorService(state, folder / "run", Access(FREE_PORT, FREE_PORT))
    thread = threading.Thread(target=service.serve, daemon=True)
    thread.start()
    made = [Worker(WorkerOptions(service.control, "learner", hand, hand[0], WAIT_S)) for hand in hands]
    try:
        yield made
    finally:
        service.interrupt("the test is over")
        for worker in made:
            worker._close()
        thread.join(WAIT_S)


def until(made: list[Worker], holds: Callable[[PeerCritics], object]) -> PeerCritics:
    """Let the workers take turns until something holds of the peers of p2."""
    deadline = time.monotonic() + WAIT_S
    while True:
        assert time.monotonic() < deadline
        for worker in made:
            worker._turn()
        peers = made[0]._peers.get("p2")
        if peers is not None and holds(peers):
            return peers


def answered_by(peers: PeerCritics, hands: tuple[tuple[str, ...], ...]) -> int:
    """Rows answered by this worker's learners if g is one of them, else by the others."""
    assert isinstance(peers, MixedPeers)
    return (peers.near if hands is TOGETHER else peers.far).counts.answered


@pytest.mark.parametrize("intervention", ["query", "replica"])
@pytest.mark.parametrize("hands", [TOGETHER, APART], ids=["together", "apart"])
def test_learners_of_one_worker_are_asked_directly_and_others_over_the_wire(
    hands: tuple[tuple[str, ...], ...], intervention: str, tmp_path: Path
) -> None:
    with workers(hands, intervention, tmp_path) as made:
        peers = until(made, lambda peers: answered_by(peers, hands))
        assert isinstance(peers, MixedPeers)
        assert isinstance(peers.far, QueryPeers if intervention == "query" else ReplicaPeers)
        elsewhere = set(peers.far._connections.lines)
        assert elsewhere <= set(hands[1]), "there is no wire to learners of the same worker"
        counts = peers.counts
        assert counts.asked == counts.answered + counts.own_used


@pytest.mark.parametrize("hands", [TOGETHER, APART], ids=["together", "apart"])
def test_local_values_learners_elsewhere_with_the_own_critic(
    hands: tuple[tuple[str, ...], ...], tmp_path: Path
) -> None:
    with workers(hands, "local", tmp_path) as made:
        wanted = "own_used" if hands is APART else "answered"
        peers = until(made, lambda peers: getattr(peers.counts, wanted))
        assert isinstance(peers, LocalPeers)
        assert peers.counts.asked == peers.counts.answered + peers.counts.own_used
        assert made[0]._remote == {}
