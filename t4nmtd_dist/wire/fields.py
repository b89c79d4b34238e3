"""Bounded types of message fields."""

from __future__ import annotations

import re
from typing import Annotated

from msgspec import Meta

LARGEST_COUNT = 2**53  # the largest integer that JSON and float64 hold exactly
LARGEST_AMOUNT = 1e12
LONGEST_NAME = 1000  # sub-tasks are named by their literals
LONGEST_TEXT = 500

# Control, format (bidirectional marks, zero-width characters) and line-separating characters: Cc, Cf, Zl, Zp.
HIDDEN = (
    "\x00-\x1f\x7f-\x9f\xad\u0600-\u0605\u061c\u06dd\u070f\u0890\u0891\u08e2\u180e\u200b-\u200f\u2028-\u202e"
    "\u2060-\u2064\u2066-\u206f\ufeff\ufff9-\ufffb\U000110bd\U000110cd\U00013430-\U0001343f\U0001bca0-\U0001bca3"
    "\U0001d173-\U0001d17a\U000e0001\U000e0020-\U000e007f"
)
PRINTABLE = f"^[^{HIDDEN}]*\\Z"

Count = Annotated[int, Meta(ge=0, le=LARGEST_COUNT)]
"""A number of things, or of a thing among them."""

Version = Annotated[int, Meta(ge=-1, le=LARGEST_COUNT)]
"""A version of weights; -1 where none is known."""

StateNumber = Annotated[int, Meta(ge=0, le=2**31 - 1)]
"""A state of the automaton."""

Amount = Annotated[float, Meta(ge=0.0, le=LARGEST_AMOUNT)]
"""Seconds, steps and the like: finite and not negative."""

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
"""A share of a whole."""

Finite = Annotated[float, Meta(ge=-LARGEST_AMOUNT, le=LARGEST_AMOUNT)]
"""Any number, but finite."""

Name = Annotated[str, Meta(min_length=1, max_length=LONGEST_NAME, pattern=PRINTABLE)]
"""A name of a process or of a sub-task: printable characters only."""

OptionalName = Annotated[str, Meta(max_length=LONGEST_NAME, pattern=PRINTABLE)]
"""As ``Name``, or empty."""

Address = Annotated[str, Meta(max_length=300, pattern=PRINTABLE)]
"""An endpoint, or nothing."""


def shortened(text: str) -> str:
    """A text for display that may quote untrusted input: no hidden characters, at most ``LONGEST_TEXT``."""
    cleaned = "".join(c if c.isprintable() else "?" for c in text[: LONGEST_TEXT + 1])
    return cleaned if len(cleaned) <= LONGEST_TEXT else cleaned[: LONGEST_TEXT - 3] + "..."


def explained(error: Exception) -> str:
    """The validation message of msgspec without the pattern of ``PRINTABLE``."""
    return shortened(
        re.sub(r"matching regex '.*'", "without control, format or line-separating characters", str(error))
    )
