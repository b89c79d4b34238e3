"""Filters notices for the event log: printable, short, and limited in number."""

from __future__ import annotations

LINES_PER_NOTICE = 6
LONGEST_LINE = 300
MOST_LINES = 1000


class NoticeFilter:
    """Shortens the notices of one run."""

    def __init__(self) -> None:
        self._left = MOST_LINES

    def lines(self, text: str) -> list[str]:
        """The lines of a notice to log: its first, and the last of the rest."""
        given = [line for line in map(_clean, text[: 100 * LONGEST_LINE].splitlines()) if line]
        kept = given[:1] + given[1:][1 - LINES_PER_NOTICE :]
        kept = kept[: self._left]
        self._left -= len(kept)
        return kept


def _clean(line: str) -> str:
    """A line without unprintable characters, truncated."""
    shown = "".join(character if character.isprintable() else " " for character in line[: 2 * LONGEST_LINE]).strip()
    return shown if len(shown) <= LONGEST_LINE else shown[: LONGEST_LINE - 1] + "…"
