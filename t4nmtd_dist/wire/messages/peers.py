"""What learners ask each other for: critic values, weights, experience."""

from __future__ import annotations

from t4nmtd_dist.wire.fields import Count, Name, OptionalName, Version
from t4nmtd_dist.wire.messages.base import Message


class ValueRequest(Message, frozen=True, tag="value_request"):
    """Learner -> peer. arrays: ``observation`` float32 [k, d] and ``q`` int32 [k], the states after the change."""

    pid: Name


class ValueReply(Message, frozen=True, tag="value_reply"):
    """Peer -> learner. arrays: ``value`` float32 [k] (PPO) or float32 [k, 2] (SAC: value and log-probability)."""

    version: Count


class WeightsRequest(Message, frozen=True, tag="weights_request"):
    """Learner -> peer: the networks that value requests are answered from, if newer than ``newer_than``; -1: any."""

    pid: Name
    newer_than: Version


class WeightsReply(Message, frozen=True, tag="weights_reply"):
    """Peer -> learner. arrays: ``weights.*`` of that version; none if it is not newer than what was named."""

    version: Count


class ExperienceRequest(Message, frozen=True, tag="experience_request"):
    """Learner -> peer: what the learner of ``pid`` has lived through, from its step number ``step`` on."""

    pid: Name
    step: Count


class ExperienceReply(Message, frozen=True, tag="experience_reply"):
    """Peer -> learner. arrays: ``experience.*`` [T, N, ...], T steps of N copies of the environment from ``first`` on.

    ``first`` is above what was asked for where the peer does not keep the steps before it any more, and below if it
    has not made as many; ``written`` is the number of steps that it has made. ``origin`` names the record that the
    numbers count in: after a peer has begun anew, be it from a checkpoint, there is another.
    """

    first: Count
    written: Count
    origin: OptionalName = ""
