"""Replicates the experience of peers in other processes (docs/decisions/016)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.codec import Envelope, without_prefix
from t4nmtd_dist.wire.messages import ExperienceReply, ExperienceRequest, Peer
from t4nmtd_dist.wire.peers.peer_connections import PeerClient, arrived
from t4nmtd_dist.wire.rate_limited_log import Log
from t4nmtd_dist.wire.zmq_types import Context, Socket

if TYPE_CHECKING:
    from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer

ASK_EVERY_S = 0.25
ASK_FOR_REST_AFTER_S = 0.12  # peers answer ten times a second
ANSWER_WITHIN_S = 5.0
AFTER_MISFIT_S = 60.0


@dataclass
class _PeerConnection:
    """The connection to one peer.

    Attributes:
        origin: the peer's buffer; empty before the first answer.
        step: the next step to request.
        stored: the step after the last one stored; -1 for none.
        request: number of the pending request; 0 for none.
        ask_at: when to send the next request.
        misfit: whether an invalid answer was reported.
    """

    peer: Peer
    socket: Socket
    origin: str = ""
    step: int = 0
    stored: int = -1
    request: int = 0
    ask_at: float = 0.0
    misfit: bool = False


class PeerExperience(PeerClient[_PeerConnection]):
    """Pulls peers' new experience without blocking.

    Copies survive a peer's move or exit; a restarted peer sends everything again.

    Args:
        make: creates the replay buffer for one peer.
        symbols: number of DFA input symbols.
        keys: this worker's own, if the coordinator has keys.
        clock: monotonic, in seconds.
        tell: logs a connection's first invalid answer.

    Attributes:
        copies: replay buffers by pid, of peers that sent anything.
    """

    def __init__(
        self,
        context: Context,
        sender: str,
        make: Callable[[], ReplayBuffer],
        symbols: int,
        keys: ClientKeys | None = None,
        clock: Callable[[], float] = time.monotonic,
        tell: Log = lambda text: None,
    ) -> None:
        super().__init__(context, sender, keys, _PeerConnection, clock)
        self._make, self._symbols, self._tell = make, symbols, tell
        self.copies: dict[str, ReplayBuffer] = {}

    def pull(self) -> None:
        """Read what arrived and send due requests; partial answers are followed up sooner."""
        for pid, connection in self._connections.by_pid.items():
            for envelope in arrived(connection.socket):
                if envelope.id == connection.request:
                    connection.request = 0
                    self._take(pid, connection, envelope)
            if self._clock() >= connection.ask_at:
                self._ask(pid, connection)

    def _ask(self, pid: str, connection: _PeerConnection) -> None:
        connection.request = self._send(connection, ExperienceRequest(pid=pid, step=connection.step))
        connection.ask_at = self._clock() + (ANSWER_WITHIN_S if connection.request else ASK_EVERY_S)

    def _take(self, pid: str, connection: _PeerConnection, envelope: Envelope) -> None:
        """Store an answer, or report an invalid one and pause for a minute."""
        connection.ask_at = self._clock() + ASK_EVERY_S
        reply = envelope.message
        if not isinstance(reply, ExperienceReply):
            return
        if reply.origin != connection.origin:
            asked_of_another = connection.step > 0
            connection.origin, connection.step, connection.stored = reply.origin, 0, -1
            if asked_of_another:
                return
        room = self.copies.get(pid)
        if room is None:
            room = self._make()
        try:
            columns = checked_columns(without_prefix("experience.", envelope.arrays), room, self._symbols)
        except ProtocolError as error:
            if not connection.misfit:
                self._tell(f"dropping what {pid} at {connection.peer.endpoint} tells of its experience: {error}")
                connection.misfit = True
            connection.ask_at = self._clock() + AFTER_MISFIT_S
            return
        steps = len(columns["symbols"])
        if steps:
            room.extend(columns, follows=reply.first == connection.stored)
            self.copies[pid], connection.stored = room, reply.first + steps
        connection.step = max(reply.first + steps, reply.written - room.steps)
        if steps and connection.step < reply.written:
            connection.ask_at = self._clock() + ASK_FOR_REST_AFTER_S


def checked_columns(arrays: Mapping[str, NDArray[Any]], room: ReplayBuffer, symbols: int) -> dict[str, NDArray[Any]]:
    """Validate the columns of an answer.

    Args:
        arrays: of the message.
        room: the buffer to store them in.
        symbols: number of DFA input symbols.

    Raises:
        ProtocolError: if the columns, their shapes or dtypes differ from those of ``room``, or a value is not finite
            or not a valid symbol.
    """
    _, expected = room.since(room.written, 1)
    if set(arrays) != set(expected):
        raise ProtocolError(f"experience has columns {sorted(arrays)}, expected {sorted(expected)}")
    steps = len(arrays["symbols"]) if arrays["symbols"].ndim else 0
    for name, like in expected.items():
        array = arrays[name]
        if array.shape != (steps, *like.shape[1:]) or array.dtype != like.dtype:
            shape = (steps, *like.shape[1:])
            raise ProtocolError(f"{name} is {array.dtype} {array.shape}, expected {like.dtype} {shape}")
        if not np.isfinite(array).all():
            raise ProtocolError(f"{name} is expected to be finite")
    if steps and not (arrays["symbols"].min() >= 0 and arrays["symbols"].max() < symbols):
        raise ProtocolError(f"experience names a symbol outside 0..{symbols - 1}")
    return dict(arrays)
