"""Events that enter the coordinator's state machine, and actions that leave it."""

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
    """Somebody wants the run to end."""

    now: float
    reason: str


@dataclass(frozen=True)
class KeysChanged:
    """The list of clients was read anew: all public keys that are on it now."""

    now: float
    allowed: Set[str]


@dataclass(frozen=True)
class LogRequest:
    """Something about the sockets that is worth a line in the event log."""

    now: float
    text: str


Event = Received | Tick | Interrupted | KeysChanged | LogRequest


@dataclass(frozen=True)
class Send:
    """Send a message; ``answers`` is the number of the message it answers."""

    peer: bytes
    message: Message
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    answers: int = 0


@dataclass(frozen=True)
class LogEvent:
    """Something worth a line in the event log and on the dashboard."""

    elapsed_s: float
    text: str


@dataclass(frozen=True)
class RecordEvaluation:
    """An evaluation to be kept."""

    row: EvaluationRow


@dataclass(frozen=True)
class Finish:
    """The run is over."""

    outcome: Outcome
    reason: str


Action = Send | LogEvent | RecordEvaluation | Finish
