"""Start positions of Waterworld's balls: the paper's two maps, and random maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.checks import checked_choice

SIDE = 30
BALLS_PER_COLOUR = 3

_PAPER_18 = (
    "(2,27)(21,6)(22,7)(23,0)(22,25)(23,21)(21,29)(1,27)(1,29)(23,8)(22,6)(27,8)(6,2)(22,4)(10,22)(29,3)(8,2)(2,4)",
    "(-1,0)(1,0)(0,-1)(2,0)(1,1)(1,0)(-1,-2)(-2,-2)(-1,-2)(-1,1)(2,-1)(2,-1)(1,-1)(-1,1)(0,1)(1,0)(0,1)(1,-1)",
)
_PAPER_24 = (
    "(18,3)(1,17)(19,19)(28,1)(2,11)(5,6)(10,6)(19,14)(22,13)(19,10)(21,17)(18,8)(19,17)(3,24)(13,16)(12,2)"
    "(13,14)(29,21)(10,10)(25,28)(8,5)(19,9)(12,6)(30,23)",
    "(-1,-2)(-2,0)(3,-1)(0,2)(3,3)(1,-2)(-1,-3)(2,0)(-3,3)(-1,3)(-1,-2)(-3,-2)(-1,3)(-1,2)(1,-3)(0,-2)"
    "(-2,0)(-3,2)(0,2)(1,-2)(0,1)(-2,3)(1,3)(0,2)",
)


@dataclass(frozen=True)
class Palette:
    """A Waterworld's colours and the limits of its maps.

    Attributes:
        colours: names in ball order, three balls each; also the propositions.
        top_speed: maximum ball speed along an axis, in units per step.
        paper_map: positions and velocities of the paper's map, each as text "(x,y)(x,y)...".
    """

    colours: tuple[str, ...]
    top_speed: int
    paper_map: tuple[str, str]

    @property
    def balls(self) -> int:
        """Number of balls."""
        return len(self.colours) * BALLS_PER_COLOUR


_PALETTES = {
    6: Palette(("red", "green", "blue", "black", "white", "grey"), 2, _PAPER_18),
    8: Palette(("red", "blue", "green", "pink", "black", "white", "grey", "yellow"), 3, _PAPER_24),
}


def palette_of(colours: int) -> Palette:
    """The palette of task 1 (``colours=6``) or task 2 (``colours=8``).

    Raises:
        ValueError: for any other number of colours.
    """
    checked_choice("colours", colours, tuple(_PALETTES))
    return _PALETTES[colours]


def checked_map(choice: object) -> int | str:
    """Validate the constructor keyword ``map``.

    Raises:
        ValueError: if it is not "paper", "random" or an integer of at least 0.
    """
    if choice in ("paper", "random") and isinstance(choice, str):
        return choice
    if type(choice) is int and choice >= 0:
        return choice
    raise ValueError(f"map must be 'paper', 'random' or a seed (an integer of at least 0), got {choice!r}")


def paper_map(palette: Palette) -> NDArray[np.float64]:
    """The paper's map: shape (balls, 4) with rows x, y, vx, vy."""
    return np.concatenate([_pairs(text) for text in palette.paper_map], axis=1)


def random_map(palette: Palette, generator: np.random.Generator) -> NDArray[np.float64]:
    """A map with uniform integer positions and velocities: shape (balls, 4)."""
    shape = (palette.balls, 2)
    positions = generator.integers(0, SIDE, shape, endpoint=True)
    velocities = generator.integers(-palette.top_speed, palette.top_speed, shape, endpoint=True)
    return np.concatenate([positions, velocities], axis=1).astype(np.float64)


def starting_balls(palette: Palette, choice: int | str, generator: np.random.Generator) -> NDArray[np.float64]:
    """The balls at a reset: shape (balls, 4).

    ``choice`` is the keyword ``map``; only "random" draws from ``generator``.
    """
    if choice == "paper":
        return paper_map(palette)
    if isinstance(choice, int):
        generator = np.random.default_rng(choice)
    return random_map(palette, generator)


def _pairs(text: str) -> NDArray[np.float64]:
    numbers = text.strip("()").replace(")(", ",").split(",")
    return np.array(numbers, dtype=np.float64).reshape(-1, 2)
