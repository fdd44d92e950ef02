# SPDX-License-Identifier: Apache-2.0
"""Pictures as files."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from manyeyes._io import atomic_write
from manyeyes.datatypes import MissingExtraError, RecordingError

MAX_PIXELS = 1 << 26
"""Maximum number of pixels of a picture: 67 million, 0.2 GB as RGB."""


def read_image(path: Path) -> Tensor:
    """Return (3, height, width) uint8, sRGB, of any format that Pillow knows; transparency is dropped."""
    image = _pillow()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's warning of large images; they are refused below
            file = image.open(path)
        with file:
            if file.width * file.height > MAX_PIXELS:
                raise ValueError(f"{file.width} x {file.height} pixels; at most {MAX_PIXELS:,} in all")
            pixels = np.asarray(file.convert("RGB"))
    except (OSError, ValueError, SyntaxError, image.DecompressionBombError) as error:
        raise RecordingError(
            f"{path}: expected a picture, found something else ({error}); copy the file again."
        ) from None
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1).contiguous()


def write_png(path: Path, rgb: Tensor) -> None:
    """Write (3, height, width) uint8; the same pixels give the same bytes."""
    image, data = _pillow(), io.BytesIO()
    image.fromarray(rgb.permute(1, 2, 0).contiguous().numpy()).save(data, "PNG")
    atomic_write(path, data.getbuffer(), durable=False)


def _pillow() -> ModuleType:
    try:
        import PIL.Image
    except ImportError as error:
        raise MissingExtraError("view", "Pictures of cameras") from error
    return PIL.Image
