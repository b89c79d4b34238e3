"""Ranges of observations, and warnings about those that networks learn badly from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from t4nmtd_dist.environments.observations import MOST_ONE_HOT, MOST_VALUES, Part, Vector

FAR = 10.0
"""Numbers of about 1 learn best; so far from 0, the first layer's units are hardly ever between their ends."""
MOST_CELLS = 8
"""Whole numbers of one vector that may be rows and columns; more of them are something else."""
LARGEST_GRID = 1000
MEND = 'scale them to about -1 to 1, or set learner.normalise_observations = "on"'


class ObservationRange:
    """Range of every observation entry so far, and whether it was always whole."""

    def __init__(self, parts: Sequence[Part]) -> None:
        size = sum(part.size for part in parts)
        self._ends = np.cumsum([part.size for part in parts])
        self.parts = tuple(parts)
        self.lowest, self.highest = np.full(size, np.inf), np.full(size, -np.inf)
        self.whole = np.ones(size, np.bool_)

    def note(self, observation: Vector) -> None:
        """Add an observation, float32 [d]."""
        np.minimum(self.lowest, observation, out=self.lowest)
        np.maximum(self.highest, observation, out=self.highest)
        self.whole &= observation == np.floor(observation)

    def described(self) -> list[dict[str, Any]]:
        """Summary of every part, ready for JSON."""
        return [
            {
                "name": part.name,
                "size": part.size,
                "one_hot": part.one_hot,
                "seen": [float(self.lowest[numbers].min()), float(self.highest[numbers].max())],
            }
            for part, numbers in self._numbered()
        ]

    def warnings(self, *, normalised: bool) -> list[str]:
        """One line for each obstacle to learning, with its remedy.

        If learners normalise, only numbers that stand for categories are obstacles.
        """
        found: list[str] = []
        for part, numbers in self._numbered():
            if not part.one_hot:
                found += self._categories(part, numbers)
                box = isinstance(part.space, spaces.Box)
                found += self._bad_scale(part, numbers) if box and not normalised else []
        return found

    def _numbered(self) -> Iterator[tuple[Part, slice]]:
        for part, end in zip(self.parts, self._ends.tolist(), strict=True):
            yield part, slice(end - part.size, end)

    def _categories(self, part: Part, numbers: slice) -> Iterator[str]:
        if isinstance(part.space, spaces.MultiDiscrete):
            yield (
                f"{part.name} has {int(np.sum(part.space.nvec))} categories, too many for one-hot ({MOST_ONE_HOT}), so "
                "that they are learned from as numbers: observe fewer of them"
            )
            return
        lowest, highest = self.lowest[numbers], self.highest[numbers]
        spread = highest - lowest
        cells = np.flatnonzero(self.whole[numbers] & (spread > 1) & (spread <= LARGEST_GRID))
        if len(part.space.shape or ()) > 1 or not 0 < len(cells) <= MOST_CELLS:
            return
        low, high = _bounds(part, lowest, highest)
        names = ", ".join(f"{part.name}[{i}]" for i in cells)
        what = "looks like a raw cell number" if len(cells) == 1 else "look like raw cell numbers"
        ends = f"{low[cells].min():.0f}..{high[cells].max():.0f}"
        counts = [int(count) for count in high[cells] - low[cells] + 1]
        yield (
            f"{names} {what} (whole, {ends}): one-hot learns better, so observe spaces.MultiDiscrete({counts}) or "
            f"integers in a Box of at most {MOST_VALUES} values each; leave it if it is a quantity"
        )

    def _bad_scale(self, part: Part, numbers: slice) -> Iterator[str]:
        lowest, highest = self.lowest[numbers], self.highest[numbers]
        low, high = part.space.low.reshape(-1), part.space.high.reshape(-1)  # type: ignore[attr-defined]
        seen = f"seen: {lowest.min():g}..{highest.max():g}"
        unbounded = int((~np.isfinite(low) | ~np.isfinite(high)).sum())
        wide = np.isfinite(low) & np.isfinite(high) & ((low < -FAR) | (high > FAR))
        if unbounded:
            verb = "has" if unbounded == 1 else "have"
            yield f"{part.name}: {unbounded} of its {part.size} numbers {verb} no finite bounds; {seen}: {MEND}"
        elif wide.any():
            ends, verb = f"{low[wide].min():g}..{high[wide].max():g}", "has" if wide.sum() == 1 else "have"
            yield f"{part.name}: {wide.sum()} of its {part.size} numbers {verb} bounds of {ends}; {seen}: {MEND}"
        elif lowest.min() < -FAR or highest.max() > FAR:
            yield f"{part.name}: {seen}, beyond its bounds and far from 0: {MEND}"


def _bounds(
    part: Part, lowest: NDArray[np.float64], highest: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Declared bounds that look like a grid's, else observed ones, float64 [k] each."""
    low = part.space.low.reshape(-1).astype(np.float64)  # type: ignore[attr-defined]
    high = part.space.high.reshape(-1).astype(np.float64)  # type: ignore[attr-defined]
    grid = high - low <= LARGEST_GRID  # False if one of them is infinite
    return np.where(grid, low, lowest), np.where(grid, high, highest)
