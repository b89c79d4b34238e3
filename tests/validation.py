"""Lets both state machines check their invariants after every event, whoever handles it in a test's process."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import pytest

from coordinator.state import CoordinatorState
from workers.state import WorkerState

T = TypeVar("T")


def validate_after_every_event(patch: pytest.MonkeyPatch) -> None:
    """Wrap all methods that take events."""
    patch.setattr(CoordinatorState, "handle", _validated(CoordinatorState.handle))
    for method in (WorkerState.tick, WorkerState.forget, WorkerState.discount_blocked_time, WorkerState.receive):
        patch.setattr(WorkerState, method.__name__, _validated(method))


def _validated(method: Callable[..., T]) -> Callable[..., T]:
    @wraps(method)
    def checked(self: CoordinatorState | WorkerState, *args: Any, **kwargs: Any) -> T:
        result = method(self, *args, **kwargs)
        self.validate()
        return result

    return checked
