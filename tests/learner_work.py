"""A learner under leases of a coordinator in the same process."""

from __future__ import annotations

from typing import Any

from coordinator_events import Conversation

from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.core.state_dict import copied, joined, split
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Granted
from workers.learner_session import LearnerSession

STEPS = 64  # of one iteration of a tiny learner


class Work:
    """The learner of p1 under leases of a coordinator in the same process."""

    def __init__(self, talk: Conversation | None = None) -> None:
        self.talk = talk or Conversation()
        self.peers = NoPeers()
        self.claim()

    def claim(self, state: Any = None) -> None:
        actions = self.talk.answers("w", self.talk.claim_message("p1", "w"))
        granted = actions[0].message
        assert isinstance(granted, Granted)
        self.granted, self.session = granted, LearnerSession(granted, actions[0].arrays)
        if state is not None:
            self.session.resume_from(state, granted, actions[0].arrays)

    def iterate(self, times: int) -> None:
        for _ in range(times):
            self.hear(self.learn_and_tell())

    def learn_and_tell(self, *, last: bool = False) -> Envelope:
        """One iteration, and the message about it."""
        assert self.session.iterate(self.peers)
        sync = self.session.last_sync() if last else self.session.next_sync(float("inf"), 0.0)
        assert sync is not None
        return sync

    def hear(self, sync: Envelope) -> None:
        for sent in self.talk.answers("w", sync.message, sync.arrays):
            self.session.take_reply(Envelope(sent.message, sent.arrays))

    def kept(self) -> Any:
        return joined(*split(copied(self.session.state_dict())))

    @property
    def counted(self) -> int:
        return self.talk.state.interactions
