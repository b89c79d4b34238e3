"""Events into the coordinator's state machine, and actions out of it."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from typing import Any, Literal

from numpy.typing import NDArray

from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import EvaluationRow, Message

Outcome = Literal["solved", "budget spent", "stopped"]


@dataclass(frozen=True)
class Received:
    """A message from a peer; ``now`` in seconds of the coordinator's monotonic clock, ``key`` the sender's, if any."""

    now: float
    peer: bytes
    envelope: Envelope
    key: str = ""


@dataclass(frozen=True)
class Tick:
    """Time has passed."""

    now: float


@dataclass(frozen=True)
class Interrupted:
    """A request to end the run."""

    now: float
    reason: str


@dataclass(frozen=True)
class KeysChanged:
    """The allow list changed; ``allowed`` holds all its public keys."""

    now: float
    allowed: Set[str]


@dataclass(frozen=True)
class LogRequest:
    """A line for the event log about sockets or storage."""

    now: float
    text: str


Event = Received | Tick | Interrupted | KeysChanged | LogRequest


@dataclass(frozen=True)
class Send:
    """Send a message; ``answers`` is the number of the request."""

    peer: bytes
    message: Message
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    answers: int = 0


@dataclass(frozen=True)
class LogEvent:
    """A line for the event log and the dashboard."""

    elapsed_s: float
    text: str


@dataclass(frozen=True)
class RecordEvaluation:
    """Store an evaluation."""

    row: EvaluationRow


@dataclass(frozen=True)
class Finish:
    """The run is over."""

    outcome: Outcome
    reason: str


Action = Send | LogEvent | RecordEvaluation | Finish
