"""Drawing for ``render_mode="rgb_array"`` with Pillow: shapes, text and the label band.

Shapes are drawn three times too large and scaled down for antialiasing. This module imports Pillow, and environments
import this module when they first render.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Colour = tuple[int, int, int]

# Okabe and Ito's colour-blind-safe palette, and greys.
ORANGE: Colour = (230, 159, 0)
SKY: Colour = (86, 180, 233)
GREEN: Colour = (0, 158, 115)
YELLOW: Colour = (240, 228, 66)
BLUE: Colour = (0, 114, 178)
VERMILION: Colour = (213, 94, 0)
PURPLE: Colour = (204, 121, 167)
BLACK: Colour = (0, 0, 0)
DARK: Colour = (51, 56, 64)
GREY: Colour = (150, 156, 163)
PALE: Colour = (233, 236, 239)
WHITE: Colour = (255, 255, 255)

LABEL_BAND_HEIGHT = 36
_OVERSAMPLING = 3


class Canvas:
    """An image in frame pixels; origin at the top left, y downwards."""

    def __init__(self, width: int, height: int, background: Colour = WHITE) -> None:
        self.width = width
        self.height = height
        self._image = Image.new("RGB", (width * _OVERSAMPLING, height * _OVERSAMPLING), background)
        self._draw = ImageDraw.Draw(self._image)

    def rectangle(
        self,
        corners: tuple[float, float, float, float],
        fill: Colour | None = None,
        outline: Colour | None = None,
        width: float = 1,
        radius: float = 0,
    ) -> None:
        """A rectangle (left, top, right, bottom), with rounded corners if ``radius`` > 0."""
        box = [value * _OVERSAMPLING for value in corners]
        self._draw.rounded_rectangle(
            box, radius * _OVERSAMPLING, fill, outline, round(width * _OVERSAMPLING) if outline else 0
        )

    def disc(
        self, x: float, y: float, radius: float, fill: Colour, outline: Colour | None = None, width: float = 1
    ) -> None:
        """A filled circle around (x, y)."""
        box = [(value + side) * _OVERSAMPLING for side in (-radius, radius) for value in (x, y)]
        self._draw.ellipse(box, fill, outline, round(width * _OVERSAMPLING) if outline else 0)

    def polygon(self, points: Sequence[tuple[float, float]], fill: Colour) -> None:
        """A filled polygon through ``points``."""
        self._draw.polygon([(x * _OVERSAMPLING, y * _OVERSAMPLING) for x, y in points], fill)

    def line(self, points: Sequence[tuple[float, float]], colour: Colour, width: float = 1) -> None:
        """A line through ``points``, ``width`` pixels wide."""
        scaled = [(x * _OVERSAMPLING, y * _OVERSAMPLING) for x, y in points]
        self._draw.line(scaled, colour, round(width * _OVERSAMPLING), joint="curve")

    def text(self, x: float, y: float, text: str, colour: Colour = DARK, size: float = 14) -> None:
        """Text centred on (x, y), ``size`` pixels high."""
        font = ImageFont.load_default(size * _OVERSAMPLING)
        self._draw.text((x * _OVERSAMPLING, y * _OVERSAMPLING), text, colour, font, anchor="mm")

    def label_band(self, propositions: Sequence[str], true: Collection[str], note: str = "") -> None:
        """The labels along the bottom, ``LABEL_BAND_HEIGHT`` high: true ones filled, false ones hollow.

        ``note`` is a word at the right end, such as "ended".
        """
        top = self.height - LABEL_BAND_HEIGHT
        middle = top + LABEL_BAND_HEIGHT / 2
        self.rectangle((0, top, self.width, self.height), fill=PALE)
        left = 6.0
        for name in propositions:
            right = left + 16 + 8 * len(name)
            holds = name in true
            self.rectangle(
                (left, middle - 11, right, middle + 11),
                fill=DARK if holds else WHITE,
                outline=DARK if holds else GREY,
                radius=6,
            )
            self.text((left + right) / 2, middle, name, WHITE if holds else GREY)
            left = right + 6
        if note:
            self.text(self.width - 8 - 4 * len(note), middle, note, VERMILION)

    def to_array(self) -> NDArray[np.uint8]:
        """The finished frame: uint8 (height, width, 3)."""
        smooth = self._image.resize((self.width, self.height), Image.Resampling.BOX)
        return np.array(smooth, dtype=np.uint8)
