"""All messages of the protocol as typed Structs (docs/protocol.md).

Arrays follow as raw frames, by name (``wire.codec``); docstrings list them after "arrays:". Every field that clients
and peers send is bounded (``wire.fields``).
"""

from __future__ import annotations

from t4nmtd_dist.wire.messages.base import Message
from t4nmtd_dist.wire.messages.evaluations import (
    LONGEST_PATH,
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    EvaluationRow,
)
from t4nmtd_dist.wire.messages.learning import Peer, Sync, SyncReply
from t4nmtd_dist.wire.messages.leases import Claim, Goodbye, Granted, Refused, Release, Role
from t4nmtd_dist.wire.messages.peers import (
    ExperienceReply,
    ExperienceRequest,
    ValueReply,
    ValueRequest,
    WeightsReply,
    WeightsRequest,
)
from t4nmtd_dist.wire.messages.reports import (
    DashboardState,
    EventLine,
    Failure,
    LearnerRow,
    Missing,
    Notice,
    QCell,
    RunPhase,
    Status,
    StatusRequest,
)
from t4nmtd_dist.wire.messages.statistics import Intervention, LearnerPhase, LearnerStats

__all__ = [
    "KINDS",
    "LONGEST_PATH",
    "PROTOCOL_VERSION",
    "Claim",
    "DashboardState",
    "EvaluationJob",
    "EvaluationPoll",
    "EvaluationReport",
    "EvaluationRow",
    "EventLine",
    "ExperienceReply",
    "ExperienceRequest",
    "Failure",
    "Goodbye",
    "Granted",
    "Intervention",
    "LearnerPhase",
    "LearnerRow",
    "LearnerStats",
    "Message",
    "Missing",
    "Notice",
    "Peer",
    "QCell",
    "Refused",
    "Release",
    "Role",
    "RunPhase",
    "Status",
    "StatusRequest",
    "Sync",
    "SyncReply",
    "ValueReply",
    "ValueRequest",
    "WeightsReply",
    "WeightsRequest",
]

PROTOCOL_VERSION = 4

KINDS: dict[str, type[Message]] = {
    str(kind.__struct_config__.tag): kind
    for kind in (
        Claim,
        Granted,
        Refused,
        Sync,
        SyncReply,
        Release,
        EvaluationPoll,
        EvaluationJob,
        EvaluationReport,
        Goodbye,
        StatusRequest,
        Status,
        Notice,
        Failure,
        ValueRequest,
        ValueReply,
        WeightsRequest,
        WeightsReply,
        ExperienceRequest,
        ExperienceReply,
        DashboardState,
    )
}
