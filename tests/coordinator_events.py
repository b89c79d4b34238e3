"""Events for the coordinator's state machine, told as a conversation with workers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from small_tasks import small_task

from coordinator.events import Action, Received, Send, Tick
from coordinator.run_settings import RunSettings
from coordinator.state import CoordinatorState
from t4nmtd_dist.agents.weight_checks import NetworkSizes, expected_shapes
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Claim, Granted, LearnerStats, Message, Refused, Sync, SyncReply

Arrays = Mapping[str, NDArray[Any]]
T = TypeVar("T")


def of(kind: type[T], actions: list[Any]) -> list[T]:
    """The actions of one kind."""
    return [action for action in actions if isinstance(action, kind)]


def changes(*rows: tuple[int, int, int, float]) -> dict[str, NDArray[Any]]:
    """Progress arrays of (q, q' or -1, steps, reward)."""
    return {
        "progress.q": np.array([row[:3] for row in rows], np.int32).reshape(-1, 3),
        "progress.reward": np.array([row[3] for row in rows], np.float64),
    }


def starts(*rows: tuple[int, int]) -> dict[str, NDArray[Any]]:
    """Start states of (q, a number that stands for the snapshot)."""
    return {
        "starts.q": np.array([q for q, _ in rows], np.int32),
        "starts.state": np.array([[number, 0] for _, number in rows], np.int64),
    }


SIZES = NetworkSizes(observation=5, action=2)


def weights(fill: float = 1.0, *flags: str, sizes: NetworkSizes = SIZES) -> dict[str, NDArray[Any]]:
    """Arrays of a learner's weights that fit task 7 with these settings, all of one value."""
    task = small_task(*flags)
    shapes = expected_shapes(task.config, task.dfa.states, sizes)
    return {f"weights.{name}": np.full(shape, fill, np.float32) for name, shape in shapes.items()}


class Conversation:
    """A coordinator of task 7 (or another), and what workers say to it; every worker is its own connection."""

    def __init__(
        self,
        *flags: str,
        lease_s: float = 10.0,
        max_interactions: int = 10**9,
        task: CompiledTask | None = None,
    ) -> None:
        settings = RunSettings(seed=0, max_interactions=max_interactions, lease_s=lease_s)
        self.state = CoordinatorState(task or small_task(*flags), settings)
        self.now = 0.0

    def send(self, worker: str, message: Message, arrays: Arrays | None = None) -> list[Action]:
        return self.state.handle(Received(self.now, worker.encode(), Envelope(message, arrays or {}, worker, 5)))

    def tick(self) -> list[Action]:
        return self.state.handle(Tick(self.now))

    def answers(self, worker: str, message: Message, arrays: Arrays | None = None) -> list[Send]:
        """Everything sent back to the worker; every answer carries the number of its question."""
        actions = self.send(worker, message, arrays)
        sent = [action for action in actions if isinstance(action, Send) and action.peer == worker.encode()]
        assert all(action.answers == 5 for action in sent[:1])
        return sent

    def answer(self, worker: str, message: Message, arrays: Arrays | None = None) -> Message:
        return self.answers(worker, message, arrays)[0].message

    def claim_message(self, pid: str | None, worker: str) -> Claim:
        return Claim(role="learner", instance=worker, pid=pid, critic_endpoint=f"tcp://127.0.0.1:{9000 + len(worker)}")

    def claim(self, pid: str | None, worker: str = "w") -> Granted:
        granted = self.answer(worker, self.claim_message(pid, worker))
        assert isinstance(granted, Granted)
        return granted

    def claim_evaluator(self, worker: str) -> Granted:
        granted = self.answer(worker, Claim(role="evaluator", instance=worker))
        assert isinstance(granted, Granted)
        return granted

    def refused(self, pid: str | None, worker: str) -> Refused:
        refused = self.answer(worker, self.claim_message(pid, worker))
        assert isinstance(refused, Refused)
        return refused

    def sync_message(
        self,
        pid: str,
        worker: str,
        *,
        sequence: int = 1,
        epoch: int | None = None,
        version: int = 0,
        cursor: int = 0,
        stats: LearnerStats | None = None,
    ) -> Sync:
        """A Sync; without ``epoch`` under the newest lease."""
        if epoch is None:
            lease = self.state.leases.get(pid)
            assert lease is not None
            epoch = lease.epoch
        return Sync(
            pid=pid,
            epoch=epoch,
            sequence=sequence,
            version=version,
            start_cursor=cursor,
            stats=stats or LearnerStats(),
        )

    def sync_with_arrays(
        self, pid: str, worker: str, *, arrays: Arrays | None = None, **fields: Any
    ) -> tuple[SyncReply, Arrays]:
        sent = self.answers(worker, self.sync_message(pid, worker, **fields), arrays)[0]
        assert isinstance(sent.message, SyncReply), sent.message
        return sent.message, sent.arrays

    def sync(self, pid: str, worker: str, **fields: Any) -> SyncReply:
        return self.sync_with_arrays(pid, worker, **fields)[0]

    def fingerprint(self) -> Any:
        """All that progress may change."""
        buffers = {
            pid: [(cursor, q, state.tobytes()) for cursor, q, state in record.buffer.since(0, 10**6)]
            for pid, record in self.state.records.items()
        }
        return self.state.method.entries(), buffers, self.state.interactions
