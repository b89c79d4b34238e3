"""Requests between learners: critic values, weights, experience."""

from __future__ import annotations

from t4nmtd_dist.wire.fields import Count, Name, OptionalName, Version
from t4nmtd_dist.wire.messages.base import Message


class ValueRequest(Message, frozen=True, tag="value_request"):
    """Learner -> peer. arrays: ``observation`` float32 [k, d] and ``q`` int32 [k], the states after the DFA change."""

    pid: Name


class ValueReply(Message, frozen=True, tag="value_reply"):
    """Peer -> learner. arrays: ``value`` float32 [k] (PPO) or float32 [k, 2] (SAC: value and log-probability)."""

    version: Count


class WeightsRequest(Message, frozen=True, tag="weights_request"):
    """Learner -> peer: the networks that answer value requests, if newer than ``newer_than``; -1: any."""

    pid: Name
    newer_than: Version


class WeightsReply(Message, frozen=True, tag="weights_reply"):
    """Peer -> learner. arrays: ``weights.*`` of ``version``; none if it is not newer than requested."""

    version: Count


class ExperienceRequest(Message, frozen=True, tag="experience_request"):
    """Learner -> peer: the experience of learner ``pid`` from step number ``step`` on."""

    pid: Name
    step: Count


class ExperienceReply(Message, frozen=True, tag="experience_reply"):
    """Peer -> learner. arrays: ``experience.*`` [T, N, ...]: T steps of N environments, from step ``first`` on.

    ``first`` is above the requested step if the peer no longer keeps it, and below if the peer has not reached it.
    ``written`` is the number of steps made. ``origin`` names the buffer they count in; a restarted peer has a new one,
    even from a checkpoint.
    """

    first: Count
    written: Count
    origin: OptionalName = ""
