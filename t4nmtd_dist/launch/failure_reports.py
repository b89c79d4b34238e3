"""Reports of failed processes go to the terminal, and to the run's event log through its coordinator."""

from __future__ import annotations

import sys
from contextlib import suppress

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.status_client import send_notice
from t4nmtd_dist.wire.zmq_types import new_context

TIMEOUT_S = 2.0


class FailureReports:
    """Passes on what is known of processes that failed.

    Args:
        keys: of a coordinator that has keys.
        held: print only at the end, for a live dashboard has the terminal until then.

    Attributes:
        control: the coordinator's endpoint; "" until it listens.
    """

    def __init__(self, keys: ClientKeys | None, *, held: bool) -> None:
        self.control = ""
        self._keys, self._held = keys, held
        self._texts: list[str] = []

    def __call__(self, text: str, urgent: bool) -> None:
        """Report at once: to the event log always, to the terminal if it is urgent."""
        if urgent:
            self._texts.append(text)
        if not self._held:
            self._print()
        if self.control:
            context = new_context()
            with suppress(ConfigError):  # an endpoint that cannot be connected to is reported elsewhere
                send_notice(context, self.control, self._keys, text, TIMEOUT_S)
            context.term()

    def release(self) -> None:
        """Print what was held, and from now on print at once only: the coordinator is about to end."""
        self.control, self._held = "", False
        self._print()

    def _print(self) -> None:
        for text in self._texts:
            print(f"t4nmtd: {text}", file=sys.stderr, flush=True)
        self._texts.clear()
