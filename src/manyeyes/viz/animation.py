# SPDX-License-Identifier: Apache-2.0
"""Pictures of successive instants as one animated GIF or WebP."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._io import atomic_replace
from manyeyes.datatypes import ConfigError
from manyeyes.viz.canvas import import_pillow

if TYPE_CHECKING:
    from PIL.Image import Image

FORMATS = {".gif": "GIF", ".webp": "WEBP"}


def stack_images(images: Sequence[Image]) -> Image:
    """Return several pictures of one width above each other."""
    out = import_pillow().Image.new("RGB", (images[0].width, sum(i.height for i in images)), "white")
    top = 0
    for image in images:
        out.paste(image, (0, top))
        top += image.height
    return out


def save_animation(images: Iterable[Image], path: Path, frame_ms: int = 200) -> int:
    """Write images as a looping animation; returns the number of frames. The suffix selects the format."""
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise ConfigError(f"An animation is one of {', '.join(FORMATS)}; got {path.name}.")
    frames = _quantise_to_one_palette(images) if kind == "GIF" else list(images)
    if not frames:
        raise ConfigError(f"{path.name}: an animation needs at least one picture; got none.")
    quality = {"method": 0, "quality": 80} if kind == "WEBP" else {"optimize": False}
    with atomic_replace(path, durable=False) as temporary:
        frames[0].save(temporary, kind, save_all=True, append_images=frames[1:], duration=frame_ms, loop=0, **quality)
    return len(frames)


def _quantise_to_one_palette(images: Iterable[Image]) -> list[Image]:
    """Quantise all images to the palette of the first, so that colours are constant over frames."""
    pil = import_pillow()
    palette, out = None, []
    for image in images:
        if palette is None:
            palette = image.quantize(128, method=pil.Image.Quantize.MAXCOVERAGE)
        out.append(image.quantize(palette=palette, dither=pil.Image.Dither.NONE))
    return out
