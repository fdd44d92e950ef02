# SPDX-License-Identifier: Apache-2.0
"""Picture of a relative pose: boxes of two agents in the ego's frame, before and after correction, and the matched pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseEstimate, PosePrior
from manyeyes.viz.birds_eye import AGENT_COLOURS, BACKGROUND, FAINT, FOUND, INK
from manyeyes.viz.canvas import Colour, Pen, Viewport

if TYPE_CHECKING:
    from PIL.Image import Image

Floats = NDArray[np.float64]

_HEADER_HEIGHT = 34


def draw_pose_pair(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, estimate: PoseEstimate, width: int = 900
) -> Image:
    """Return a picture in the ego's frame: its boxes dark, the other's blue at the estimated pose and dashed at the prior, if any.

    Lines join the pairs of the estimate.
    """
    placed = None if estimate.pose is None else other.transform(estimate.pose)
    shown = [ego.xy] + ([] if placed is None else [placed.xy])
    low, high = np.concatenate(shown).min(0) - 8.0, np.concatenate(shown).max(0) + 8.0
    viewport = Viewport(low[0], low[1], high[0], high[1], width, _HEADER_HEIGHT)
    columns, rows = viewport.size
    pen = Pen(np.full((rows, columns, 3), BACKGROUND, np.uint8))
    if prior is not None:
        for outline in _outlines(other.transform(prior.pose)):
            pen.dashed(viewport.to_pixels(outline), FAINT, 1.0, 3.0)
    _draw_boxes(pen, viewport, ego, AGENT_COLOURS[0])
    if placed is not None:
        _draw_boxes(pen, viewport, placed, AGENT_COLOURS[1])
        for i, k in estimate.pairs:
            pen.line(viewport.to_pixels(np.stack((ego.xy[i], placed.xy[k]))), FOUND, 2.0)
    pen.text(
        (10, 9), f"{estimate.status.value}: {estimate.inliers} pairs of {len(ego)} and {len(other)} boxes", INK, 14
    )
    return pen.finish()


def _draw_boxes(pen: Pen, viewport: Viewport, marks: Landmarks, colour: Colour) -> None:
    for outline in _outlines(marks):
        pen.line(viewport.to_pixels(outline), colour, 1.5, closed=True)


def _outlines(marks: Landmarks) -> Floats:
    """Return corners (N, 4, 2) of boxes."""
    half = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * marks.size[:, None] / 2
    c, s = np.cos(marks.yaw)[:, None], np.sin(marks.yaw)[:, None]
    x, y = half[..., 0], half[..., 1]
    return marks.xy[:, None] + np.stack((c * x - s * y, s * x + c * y), -1)
