# SPDX-License-Identifier: Apache-2.0
"""Metres to pixels: points splatted by numpy, lines and text drawn by Pillow at twice the size and shrunk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from manyeyes.datatypes import MissingExtraError

if TYPE_CHECKING:
    from PIL.Image import Image

Colour = tuple[int, int, int]
SUPERSAMPLE = 2


def import_pillow() -> Any:
    """Return the Pillow package with its drawing modules, or the error that names the extra."""
    try:
        import PIL.Image
        import PIL.ImageDraw
        import PIL.ImageFont
    except ImportError as error:
        raise MissingExtraError("view", "Drawing pictures") from error
    return PIL


@lru_cache(maxsize=16)
def load_font(size: int) -> Any:
    """Pillow's own typeface; it has Latin letters and the middle dot, no arrows."""
    return import_pillow().ImageFont.load_default(size)


@dataclass(frozen=True)
class Viewport:
    """A window over the ground: x right, y up, in the metres of one frame, drawn width pixels wide.

    top_margin and bottom_margin: pixels of margin above and below the window, for text.
    """

    x_min: float
    y_min: float
    x_max: float
    y_max: float
    width: int = 1280
    top_margin: int = 0
    bottom_margin: int = 0

    @property
    def scale(self) -> float:
        """Pixels per metre of the canvas."""
        return self.width / (self.x_max - self.x_min)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the whole image, pixels."""
        return self.width, self.top_margin + round((self.y_max - self.y_min) * self.scale) + self.bottom_margin

    def to_pixels(self, xy: np.ndarray) -> np.ndarray:
        """Image coordinates (..., 2), column and row from the upper left corner, of points (..., 2) in metres."""
        column = (xy[..., 0] - self.x_min) * self.scale
        row = self.top_margin + (self.y_max - xy[..., 1]) * self.scale
        return np.stack((column, row), -1)


def draw_points(
    viewport: Viewport, layers: Sequence[tuple[np.ndarray, np.ndarray, Colour]], background: Colour
) -> np.ndarray:
    """Return an image (H, W, 3) uint8 of points: each layer is xy (N, 2), ink (N,) and a colour.

    Ink adds up in a pixel and saturates; where layers meet, their colours mix by ink.
    """
    width, height = viewport.size
    cells, inks, colours = [], [], []
    for xy, ink, colour in layers:
        at = np.floor(viewport.to_pixels(xy)).astype(np.int64)
        inside = (
            (at[:, 0] >= 0)
            & (at[:, 0] < width)
            & (at[:, 1] >= viewport.top_margin)
            & (at[:, 1] < height - viewport.bottom_margin)
        )
        cells.append(at[inside, 1] * width + at[inside, 0])
        inks.append(ink[inside])
        colours.append(np.broadcast_to(np.asarray(colour, float), (len(inks[-1]), 3)))
    image = np.empty((width * height, 3), np.uint8)
    image[:] = background
    if not cells:
        return image.reshape(height, width, 3)
    amount, colour_of = np.concatenate(inks), np.concatenate(colours)
    touched, place = np.unique(np.concatenate(cells), return_inverse=True)
    total = np.bincount(place, amount, len(touched))[:, None]
    mixed = np.stack([np.bincount(place, amount * colour_of[:, k], len(touched)) for k in range(3)], 1)
    cover = 1 - np.exp(-total)
    image[touched] = (mixed / np.maximum(total, 1e-12) * cover + np.asarray(background, float) * (1 - cover)).round()
    return image.reshape(height, width, 3)


class Pen:
    """Draws on an image at SUPERSAMPLE times its size, so that lines are smooth; coordinates are final pixels."""

    def __init__(self, image: np.ndarray) -> None:
        pil = import_pillow()
        height, width = image.shape[:2]
        small = pil.Image.fromarray(image)
        self._big = small.resize((width * SUPERSAMPLE, height * SUPERSAMPLE), pil.Image.Resampling.NEAREST)
        self._draw = pil.ImageDraw.Draw(self._big)

    def line(self, points: np.ndarray, colour: Colour, width: float = 1.0, closed: bool = False) -> None:
        """A polyline through points (N, 2)."""
        path = [tuple(p) for p in np.asarray(points) * SUPERSAMPLE]
        if closed:
            path += path[:2]
        self._draw.line(path, fill=colour, width=max(1, round(width * SUPERSAMPLE)), joint="curve")

    def dashed(self, points: np.ndarray, colour: Colour, width: float = 1.0, dash: float = 6.0) -> None:
        """A closed polyline of dashes and gaps of equal length, pixels."""
        corners = np.asarray(points, float)
        for a, b in zip(corners, np.roll(corners, -1, 0)):
            steps = max(1, round(float(np.hypot(*(b - a))) / (2 * dash)))
            for k in range(steps):
                self.line(np.stack((a + (b - a) * k / steps, a + (b - a) * (k + 0.5) / steps)), colour, width)

    def polygon(self, points: np.ndarray, fill: Colour | None, edge: Colour | None = None, width: float = 1.0) -> None:
        """A filled shape (N, 2) with a smooth edge."""
        if fill is not None:
            self._draw.polygon([tuple(p) for p in np.asarray(points) * SUPERSAMPLE], fill=fill)
        if edge is not None:
            self.line(points, edge, width, closed=True)

    def disc(self, centre: np.ndarray, radius: float, fill: Colour, edge: Colour, width: float = 1.0) -> None:
        """Draw a filled circle in metres."""
        low, high = (np.asarray(centre) - radius) * SUPERSAMPLE, (np.asarray(centre) + radius) * SUPERSAMPLE
        self._draw.ellipse([*low, *high], fill=fill, outline=edge, width=round(width * SUPERSAMPLE))

    def text(
        self, at: tuple[float, float], text: str, colour: Colour, size: int = 13, anchor: str = "la", halo: bool = False
    ) -> None:
        """One line of text; anchor as in Pillow (``la``: its upper left corner). A halo keeps it legible on points."""
        place = (at[0] * SUPERSAMPLE, at[1] * SUPERSAMPLE)
        edge = {"stroke_width": SUPERSAMPLE + 1, "stroke_fill": (255, 255, 255)} if halo else {}
        self._draw.text(place, text, fill=colour, font=load_font(size * SUPERSAMPLE), anchor=anchor, **edge)

    def width(self, text: str, size: int = 13) -> float:
        """Return how wide a line of text will be, pixels."""
        return self._draw.textlength(text, font=load_font(size * SUPERSAMPLE)) / SUPERSAMPLE

    def finish(self) -> Image:
        """Return the image at its final size."""
        return self._big.reduce(SUPERSAMPLE)
