"""How ``t4nmtd train`` tells of workers that died: on its own terminal, and in the run's event log."""

from __future__ import annotations

import sys
from contextlib import suppress

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.status_client import give_notice
from t4nmtd_dist.wire.zmq_types import new_context

TIMEOUT_S = 2.0


class DeathNotices:
    """Passes on what is known of workers that died.

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

    def __call__(self, text: str, deserves_attention: bool) -> None:
        """Tell it at once: in the event log always, on the terminal if it deserves attention."""
        if deserves_attention:
            self._texts.append(text)
        if not self._held:
            self.print()
        if self.control:
            context = new_context()
            with suppress(ConfigError):  # of an endpoint that cannot be connected to, of which others tell
                give_notice(context, self.control, self._keys, text, TIMEOUT_S)
            context.term()

    def release(self) -> None:
        """Print what was held, and from now on all at once and nowhere else: the coordinator is about to end."""
        self.control, self._held = "", False
        self.print()

    def print(self) -> None:
        """Print what was not printed yet."""
        for text in self._texts:
            print(f"t4nmtd: {text}", file=sys.stderr, flush=True)
        self._texts.clear()
