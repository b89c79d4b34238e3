"""One lease on one sub-task: the learner, its copies of buffer and Q-table, and its reports.

Does no network I/O: it creates and processes messages that others send and receive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.actors import make_actor
from t4nmtd_dist.agents.common.peer_values import InterventionCounts, PeerCritics
from t4nmtd_dist.agents.registry import build_learner, subtask_seed
from t4nmtd_dist.agents.weight_checks import check_alike
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import task_config
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.core.errors import PolicyError, ProtocolError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.wire.codec import Envelope, without_prefix
from t4nmtd_dist.wire.messages import Granted, Intervention, LearnerStats, Peer, Sync, SyncReply
from t4nmtd_dist.wire.progress import newest_starts, pack_progress, unpack_starts
from workers.report_ledger import ReportLedger

RESEND_S = 2.0
STARTS_PER_SYNC = 64


def compiled_from(granted: Granted) -> CompiledTask:
    """The task as compiled by the coordinator."""
    return CompiledTask(
        task_config(granted.task, source="coordinator"),
        DFA.from_json(granted.dfa),
        Decomposition.from_json(granted.decomposition),
        {},
        np.array(granted.rho),
    )


class LearnerSession:
    """A learner working under a lease.

    Args:
        arrays: weights granted with it, if the sub-task was trained before.
        device: device of the learner's networks.
        tell: logs unusable weights or start states.
    """

    def __init__(
        self,
        granted: Granted,
        arrays: Mapping[str, NDArray[Any]],
        *,
        device: Device = "cpu",
        tell: Callable[[str], None] = print,
    ) -> None:
        task = compiled_from(granted)
        self.pid, self.epoch = granted.pid, granted.epoch
        self.buffer = task.start_buffer()
        self.method = task.method()
        seed = subtask_seed(granted.seed, granted.pid, granted.epoch)
        self.learner = build_learner(task, granted.pid, self.buffer, self.method, seed=seed, device=device)
        self.peers: dict[str, Peer] = {}
        self._settings = task.config.learner
        self.intervention = self._settings.intervention
        self._dfa_states, self.symbols = task.dfa.delta.shape
        self.processor_s = 0.0  # updated by the caller
        self._tell = tell
        self.learner.rollout.report_to(self._say)
        self._take_weights(granted, arrays)
        self.run_id = granted.run_id
        self._trained_for = training_of(granted)
        self._training = False
        self._counts = InterventionCounts()
        self._begin_lease(LearnerStats(), sent_version=granted.version)

    def _say(self, text: str) -> None:
        self._tell(f"{self.pid}: {text}")

    def _take_weights(self, granted: Granted, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load granted weights; if unusable, only adopt their version."""
        weights = without_prefix("weights.", arrays)
        if not weights:
            return
        try:
            check_alike(weights, self.learner.weights())
            self.learner.load(weights, granted.version)
        except (PolicyError, ProtocolError) as error:
            self._say(f"learning goes on without the weights of version {granted.version}: {error}")
            self.learner.version = granted.version

    def _begin_lease(self, reported_before: LearnerStats, *, sent_version: int) -> None:
        self._ledger = ReportLedger(reported_before)
        self._start_cursor = 0
        self._sent_version = sent_version
        self._outstanding: Envelope | None = None
        self._sent_at = -np.inf

    def can_go_on_under(self, granted: Granted) -> bool:
        """Whether this learner is useful under a lease of this pid."""
        return granted.run_id == self.run_id or training_of(granted) == self._trained_for

    def renew(self, granted: Granted) -> None:
        """Continue with everything learned so far under a new lease, after a coordinator restart.

        A coordinator that resumed the run knows earlier reports; a new run gets all counts again.
        """
        before = self._ledger.newest or self._ledger.before if granted.run_id == self.run_id else LearnerStats()
        self.run_id, self.epoch = granted.run_id, granted.epoch
        self._begin_lease(before, sent_version=0)

    def resume_from(self, state: State, granted: Granted, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore a checkpoint of this run under a new lease; keeps the granted weights if newer.

        Counts reported under an earlier lease are not reported again. The counts of intervention and CPU time, which
        the learner does not keep, restart at 0.

        Raises:
            RunError, PolicyError: if the checkpoint belongs to another kind of learner.
        """
        self._load(state)
        if granted.version > self.learner.version:
            self._take_weights(granted, arrays)
        self.learner.rollout.take_progress()
        self._counts = InterventionCounts()
        told = msgspec.convert(state["lease"]["told"], LearnerStats)
        self._ledger.before = msgspec.structs.replace(told, intervention=Intervention(), processor_s=self.processor_s)

    def state_dict(self) -> State:
        """The state for a checkpoint; arrays may be views, see ``Learner.state_dict``."""
        return {
            "learner": self.learner.state_dict(),
            "buffer": self.buffer.state_dict(),
            "q_table": self.method.entries(),
            "counts": asdict(self._counts),
            "lease": {
                "sequence": self._ledger.sequence,
                "start_cursor": self._start_cursor,
                "sent_version": self._sent_version,
                "told": msgspec.to_builtins(self._ledger.counted(self._all_counts())),
                "told_before": msgspec.to_builtins(self._ledger.before),
            },
        }

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict`` under the same lease, in one process with the coordinator (``--serial``)."""
        self._load(state)
        lease = state["lease"]
        self._ledger.sequence, self._start_cursor = lease["sequence"], lease["start_cursor"]
        self._sent_version = lease["sent_version"]
        self._ledger.before = msgspec.convert(lease["told_before"], LearnerStats)
        self._counts = InterventionCounts(**state["counts"])

    def _load(self, state: State) -> None:
        self.learner.load_state_dict(state["learner"])
        self.buffer.load_state_dict(state["buffer"])
        self.method.load((q, pid, value) for q, pid, value in state["q_table"])

    def iterate(self, peers: PeerCritics) -> bool:
        """Run one rollout and its updates; False without a start state, or if not scheduled."""
        scheduled = self.method.schedule()
        self._training = (scheduled is None or self.pid in scheduled) and self._act(peers)
        self._counts = peers.counts
        return self._training

    def _act(self, peers: PeerCritics) -> bool:
        """Learn from some steps, or show what the policy is worth as it is."""
        if self.method.learns(self.pid):
            return self.learner.iterate(peers)
        return self.learner.rehearse(make_actor(self._settings, self.learner.weights()))

    def next_sync(self, now: float, interval_s: float) -> Envelope | None:
        """The message due now, if any: new progress, or a repeat of an unanswered message."""
        if self._outstanding is not None:
            if now < self._sent_at + RESEND_S:
                return None
            self._sent_at = now
            return self._outstanding
        if now < self._sent_at + interval_s:
            return None
        self._outstanding = self._sync()
        self._sent_at = now
        return self._outstanding

    def last_sync(self) -> Envelope:
        """A final message with everything not yet reported."""
        self._outstanding = self._sync(last=True)
        return self._outstanding

    @property
    def is_answered(self) -> bool:
        """Whether the coordinator has answered the last message."""
        return self._outstanding is None

    @property
    def all_reported(self) -> bool:
        """Whether the newest message covers all work, answered or not."""
        done, newest = (self.learner.rollout.interactions, self.learner.gradient_steps), self._ledger.newest
        return newest is not None and (newest.interactions, newest.gradient_steps) == done

    @property
    def newest_message(self) -> tuple[int, int]:
        """Epoch and number of the newest message."""
        return self.epoch, self._ledger.sequence

    def has_answer_to(self, message: tuple[int, int]) -> bool:
        """Whether the coordinator has answered ``message`` or a later one of this lease."""
        epoch, sequence = message
        return epoch == self.epoch and sequence <= self._ledger.answered

    def _sync(self, *, last: bool = False) -> Envelope:
        stats = self._ledger.report(self._all_counts(), last=last)
        progress = self.learner.rollout.take_progress()
        arrays = pack_progress(progress.changes, newest_starts(progress.starts, STARTS_PER_SYNC))
        if self.learner.version > self._sent_version:
            self._sent_version = self.learner.version
            arrays |= {f"weights.{name}": array for name, array in self.learner.weights().items()}
        message = Sync(
            pid=self.pid,
            epoch=self.epoch,
            sequence=self._ledger.sequence,
            version=self.learner.version,
            start_cursor=self._start_cursor,
            stats=stats,
        )
        return Envelope(message, arrays)

    def _all_counts(self) -> LearnerStats:
        rollout, attempts = self.learner.rollout, self.learner.rollout.statistics
        entropy, value_loss = self.learner.losses()
        return LearnerStats(
            phase="training" if self._training else "waiting",
            interactions=rollout.interactions,
            gradient_steps=self.learner.gradient_steps,
            attempts=attempts.attempts,
            successes=attempts.successes,
            recent_success=attempts.recent_success,
            episode_steps=attempts.recent_length,
            entropy=entropy,
            value_loss=value_loss,
            peer_rows=self.learner.peer_rows,
            processor_s=self.processor_s,
            intervention=Intervention(**asdict(self._counts)),
            **vars(attempts.endings),
        )

    def take_reply(self, envelope: Envelope) -> None:
        """Process a reply: start states, Q-table, peers; ignores replies to other sub-tasks or epochs.

        Raises:
            ProtocolError: if its start states cannot be read.
        """
        reply = envelope.message
        if not isinstance(reply, SyncReply) or (reply.pid, reply.epoch) != (self.pid, self.epoch):
            return
        self._ledger.take_answer(reply.accepted_sequence)
        if reply.accepted_sequence >= self._ledger.sequence:
            self._outstanding = None
        if reply.start_cursor > self._start_cursor:
            self._start_cursor = reply.start_cursor
            for q, state in unpack_starts(envelope.arrays, self._dfa_states):
                self.buffer.add(q, state)
        self._load_plan(reply)
        self.peers = reply.peers

    def _load_plan(self, reply: SyncReply) -> None:
        """The newest of the upper level; attempts not told yet count no more if they were of the other kind."""
        learned = self.method.learns(self.pid)
        self.method.load(reply.q_table)
        if self.method.learns(self.pid) != learned:
            self.learner.rollout.take_progress()


def training_of(granted: Granted) -> tuple[object, ...]:
    """What determines the training: task with settings, automaton, sub-tasks, potentials, seed."""
    return granted.task, granted.dfa, granted.decomposition, granted.rho, granted.seed
