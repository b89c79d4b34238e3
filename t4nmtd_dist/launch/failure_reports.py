"""Reports failed processes on the terminal and in the event log."""

from __future__ import annotations

import sys
from contextlib import suppress

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.status_client import send_notice
from t4nmtd_dist.wire.zmq_types import new_context

TIMEOUT_S = 2.0


class FailureReports:
    """Forwards reports of failed processes.

    Args:
        keys: this client's, if the coordinator has keys.
        held: print only at the end, because a live dashboard uses the terminal.

    Attributes:
        control: the coordinator's endpoint; "" until it listens.
    """

    def __init__(self, keys: ClientKeys | None, *, held: bool) -> None:
        self.control = ""
        self._keys, self._held = keys, held
        self._texts: list[str] = []

    def __call__(self, text: str, urgent: bool) -> None:
        """Report now: to the event log, and if urgent to the terminal."""
        if urgent:
            self._texts.append(text)
        if not self._held:
            self._print()
        if self.control:
            context = new_context()
            with suppress(ConfigError):  # a bad endpoint is reported elsewhere
                send_notice(context, self.control, self._keys, text, TIMEOUT_S)
            context.term()

    def release(self) -> None:
        """Print held reports; from now on only print, because the coordinator is about to exit."""
        self.control, self._held = "", False
        self._print()

    def _print(self) -> None:
        for text in self._texts:
            print(f"t4nmtd: {text}", file=sys.stderr, flush=True)
        self._texts.clear()
