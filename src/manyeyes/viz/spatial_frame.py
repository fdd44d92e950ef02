# SPDX-License-Identifier: Apache-2.0
"""What a viewer shows of one instant, in the world frame: agents, clouds, boxes by kind, messages, truth, numbers, events."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import Boxes, Transform
from manyeyes.ops.box_iou import pairwise_iou

Floats = NDArray[np.float64]
MATCH_IOU = 0.5
BOX_COLORS = {
    "found": (90, 200, 255),
    "matched": (60, 200, 90),
    "false": (235, 70, 60),
    "missed": (255, 160, 0),
    "truth": (170, 170, 170),
    "own": (60, 130, 255),
    "supported": (60, 200, 90),
    "corroborated": (150, 210, 60),
    "unchecked": (240, 200, 60),
    "disputed": (255, 140, 0),
    "refuted": (235, 70, 60),
}
"""Colours of boxes by kind, RGB."""


@dataclass(frozen=True)
class ShownAgent:
    """An agent. points: (N, 3) in its frame, intensity: (N,) from 0 to 1; both None where its cloud is not known.

    world_from_agent: the claimed pose. corrected: the pose after correction, None where it was not corrected. true_pose: None where
    it is not known, or is the claimed one.
    """

    agent_id: int
    world_from_agent: Transform
    points: NDArray[np.float32] | None = None
    intensity: NDArray[np.float32] | None = None
    corrected: Transform | None = None
    true_pose: Transform | None = None


@dataclass(frozen=True)
class ShownBoxes:
    """Boxes in the world, and the kind of each, a key of BOX_COLORS."""

    boxes: Boxes
    kinds: tuple[str, ...]


@dataclass(frozen=True)
class ShownLink:
    """A message from one agent to another: its bytes, its age (ms) at perception, and when it arrived (ns), if known."""

    sender: int
    receiver: int
    num_bytes: int
    age_ms: float
    arrival_ns: int | None = None


@dataclass(frozen=True)
class SpatialFrame:
    """One instant. capture_ns: of the ego's sweep. map_lines: (K, 2) polylines by kind of element; the same object where they did
    not change.

    numbers: by path of the plot, such as age_ms/3. events: lines of text.
    """

    index: int
    capture_ns: int
    agents: tuple[ShownAgent, ...]
    boxes: ShownBoxes
    truth: ShownBoxes | None = None
    links: tuple[ShownLink, ...] = ()
    map_lines: Mapping[str, tuple[Floats, ...]] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    events: tuple[str, ...] = ()


def mark_errors(boxes: Boxes, truth: Boxes, min_iou: float = MATCH_IOU) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the kinds of boxes (matched, false) and of true boxes (truth, missed): by falling score, each takes the true box of
    the largest IoU seen from above that is still free.
    """
    kinds, is_found = ["false"] * len(boxes.score), [False] * len(truth.score)
    iou = pairwise_iou(boxes.bev().double(), truth.bev().double()) if kinds and is_found else torch.zeros(0, 0)
    for row in boxes.score.argsort(descending=True, stable=True).tolist() if len(iou) else ():
        free = [k for k, found in enumerate(is_found) if not found and float(iou[row, k]) >= min_iou]
        if free:
            best = max(free, key=lambda k, row=row: float(iou[row, k]))
            kinds[row], is_found[best] = "matched", True
    return tuple(kinds), tuple("truth" if found else "missed" for found in is_found)
