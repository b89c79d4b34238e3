"""Imports torch and the environments in the background, once a lease is held."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from t4nmtd_dist.core.config import task_config
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.environments.trust import require_trust
from t4nmtd_dist.wire.messages import EvaluationPoll, Granted, LearnerStats, Role, Sync

if TYPE_CHECKING:
    from workers.evaluation_session import EvaluationSession
    from workers.learner_session import LearnerSession

HEAVY: dict[Role, tuple[str, ...]] = {
    "learner": ("workers.learner_session",),
    "evaluator": ("workers.evaluation_session",),
}


@dataclass(frozen=True)
class WaitingLease:
    """A lease held while its work is still being imported."""

    granted: Granted
    arrays: Mapping[str, NDArray[Any]]

    def first_message(self) -> Sync | EvaluationPoll:
        """Accept the lease, so that it is renewed from then on. Sequence 0 carries no progress."""
        granted = self.granted
        if granted.role == "evaluator":
            return EvaluationPoll(epoch=granted.epoch, busy=True)
        return Sync(
            pid=granted.pid,
            epoch=granted.epoch,
            sequence=0,
            version=granted.version,
            start_cursor=0,
            stats=LearnerStats(),
        )

    def learn(self, device: Device, tell: Callable[[str], None]) -> LearnerSession:
        """Create the lease's learner on a device; call once imported."""
        import torch

        from workers.learner_session import LearnerSession

        torch.set_num_threads(1)
        return LearnerSession(self.granted, self.arrays, device=device, tell=tell)

    def evaluate(self) -> EvaluationSession:
        """Create the lease's evaluator; call once imported."""
        import torch

        from workers.evaluation_session import EvaluationSession

        torch.set_num_threads(1)
        return EvaluationSession(self.granted)


def check_trust(granted: Granted, coordinator: str, *, given: bool) -> None:
    """Reject a task with untrusted environment code: without keys, anybody can coordinate.

    Raises:
        TrustError: if the code is not trusted.
        ConfigError: if the task cannot be read.
    """
    environment = task_config(granted.task, source="coordinator").environment
    source, otherwise = f"the coordinator at {coordinator}", ", or let coordinator and workers use --keys"
    require_trust(environment, source, given=given, ask=False, otherwise=otherwise)


class HeavyImports:
    """Imports in a thread, so that the worker stays responsive."""

    def __init__(self, role: Role) -> None:
        self._role: Role = role
        self._done: Future[None] | None = None

    def ready(self) -> bool:
        """Whether everything is imported; the first call starts it.

        Raises:
            ImportError: if a package is missing.
        """
        if self._done is None:
            self._done = ThreadPoolExecutor(1, "loader").submit(_load, HEAVY[self._role])
        if not self._done.done():
            return False
        self._done.result()
        return True


def _load(names: Sequence[str]) -> None:
    for name in names:
        importlib.import_module(name)
