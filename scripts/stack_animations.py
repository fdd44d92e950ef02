# SPDX-License-Identifier: Apache-2.0
"""Stack animations of 'manyeyes view' above each other, as in the README: frames of the same numbers together.

manyeyes view data/carla-towns-small --split test --detect no-fusion-temporal --frames 24 --width 640 --out out/alone.webp
manyeyes view data/carla-towns-small --split test --detect intermediate-temporal --frames 24 --width 640 --out out/fused.webp
python scripts/stack_animations.py out/alone.webp out/fused.webp docs/images/drive.webp
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image, ImageSequence

from manyeyes.viz.animation import save_animation, stack_images


def read_frames(path: Path) -> list[Image.Image]:
    """Return all frames of an animation in RGB."""
    with Image.open(path) as image:
        return [frame.convert("RGB") for frame in ImageSequence.Iterator(image)]


def main() -> None:
    """Stack the animations of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("animations", nargs="+", type=Path)
    parser.add_argument("out", type=Path)
    wanted = parser.parse_args()
    rows = zip(*map(read_frames, wanted.animations), strict=True)
    count = save_animation([stack_images(row) for row in rows], wanted.out, frame_ms=300)
    print(f"{wanted.out}: {count} frames, {wanted.out.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
