"""Formats numbers, texts, bars and curves for the dashboard."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from rich.cells import cell_len, set_cell_size
from rich.text import Text

BLOCKS = " ▁▂▃▄▅▆▇█"
UNKNOWN = "-"


def clean(text: str) -> str:
    """The text with unprintable characters (escape codes, newlines) as spaces."""
    return text if text.isprintable() else "".join(c if c.isprintable() else " " for c in text)


def clip(text: str, width: int) -> str:
    """The cleaned text in at most ``width`` terminal cells, truncated with an ellipsis."""
    text = clean(text)
    if cell_len(text) <= width:
        return text
    return set_cell_size(text, width - 1) + "…" if width > 0 else ""


def line(text: str = "", style: str = "") -> Text:
    """A one-line ``Text`` without markup."""
    return Text(clean(text), style=style, no_wrap=True, overflow="ellipsis", end="\n")


def spaced(*parts: tuple[str, str]) -> Text:
    """One line of (text, style) parts, separated by two spaces; skips empty parts."""
    return Text("  ", no_wrap=True, overflow="ellipsis").join(
        [Text(clean(text), style=style) for text, style in parts if text]
    )


def count(number: int) -> str:
    """A whole number with thousands separators."""
    return f"{number:,}"


def rate(per_second: float) -> str:
    """A rate in at most seven cells below ten million."""
    if not math.isfinite(per_second):
        return UNKNOWN
    return f"{per_second:,.1f}" if 0 < abs(per_second) < 10 else f"{per_second:,.0f}"


def percent(share: float | None) -> str:
    """A share in 0..1 as a percentage; a dash if unknown or not finite."""
    return UNKNOWN if share is None or not math.isfinite(share) else f"{100 * share:.0f}%"


def duration(seconds: float | None) -> str:
    """Seconds as ``h:mm:ss``; days from one hundred hours."""
    if seconds is None or not math.isfinite(seconds):
        return UNKNOWN
    whole = max(0, int(seconds))
    if whole >= 360_000:
        return f"{whole // 86_400:,} days"
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def value(number: float) -> str:
    """A Q-table value in about four cells."""
    if not math.isfinite(number):
        return str(number)
    size = abs(number)
    if size >= 99_999.5:
        return f"{number:.0e}"
    return f"{number:.0f}" if size >= 99.95 else f"{number:.1f}"


def bar(share: float | None, width: int, style: str) -> Text:
    """A bar of ``width`` cells, filled to ``share`` (0..1); empty if unknown."""
    known = share is not None and math.isfinite(share)
    filled = round(width * min(max(share or 0.0, 0.0), 1.0)) if known else 0
    return Text.assemble(("━" * filled, style), ("─" * (width - filled), "dim"))


def resample(values: Sequence[float], width: int) -> list[float]:
    """At most ``width`` numbers: each repeated up to three times if they fit, else bucket means.

    Means skip non-finite numbers; a bucket without finite numbers is NaN.
    """
    n = len(values)
    if n == 0 or width <= 0:
        return []
    if n <= width:
        return [v for v in values for _ in range(min(3, width // n))]
    edges = [i * n // width for i in range(width + 1)]
    return [_finite_mean(values[a:b]) for a, b in pairwise(edges)]


def _finite_mean(values: Sequence[float]) -> float:
    known = [v for v in values if math.isfinite(v)]
    return sum(v / len(known) for v in known) if known else math.nan


def curve(values: Sequence[float], width: int, height: int, top: float) -> list[str]:
    """A bar chart in block characters from 0 to ``top``: ``height`` lines of at most ``width`` cells.

    Every finite value shows at least the lowest block, so zeros differ from gaps; one line is a sparkline.
    """
    eighths = [_eighths(v, top, 8 * height) for v in resample(values, width)]
    rows = range(height - 1, -1, -1)
    return ["".join(BLOCKS[min(max(e - 8 * row, 0), 8)] for e in eighths) for row in rows]


def _eighths(number: float, top: float, most: int) -> int:
    if not math.isfinite(number):
        return 0
    share = number / top if top > 0 else 0.0
    return max(1, round(most * min(max(share, 0.0), 1.0)))
