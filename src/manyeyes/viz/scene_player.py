# SPDX-License-Identifier: Apache-2.0
"""What the player of a report shows: the frames of a drive from above, and what each method detected in them, as compact JSON.

Lengths are integers in centimetres, angles in milliradians, scores in thousandths. The points of an agent are the occupied cells of
a lattice over the view: sorted cell numbers, their differences as variable-length integers (7 bits a byte, the low ones first, the
top bit set where more follow), base64.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.strategies.names import form_of
from manyeyes.datatypes import Boxes

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CELL_M = 0.25
"""Edge of a drawn cell of points."""
MIN_SCORE = 0.1
"""Of the boxes of a page, and the lowest that its slider takes."""
MAX_POINT_BYTES = 2_500_000
"""Of the points of all frames of a page, as base64."""
MAX_FRAMES = 150
"""Frames of a page; of a longer drive every n-th is shown."""


@dataclass(frozen=True)
class PlayerAgent:
    """An agent at one instant, in the ego's frame. cells: sorted numbers of occupied cells, int64 (K,)."""

    agent_id: int
    name: str
    is_infrastructure: bool
    x: float
    y: float
    yaw: float
    cells: Ints


@dataclass(frozen=True)
class PlayerFrame:
    """One instant: agents, ego first, and the evaluated true boxes in the ego's frame.

    num_returns: (N, A) int64, the returns of each agent above the road inside each true box.
    """

    index: int
    time_s: float
    agents: tuple[PlayerAgent, ...]
    truth: Boxes
    num_returns: Ints


@dataclass(frozen=True)
class PlayerDetections:
    """Detections of one method at one instant, class by class, by falling score in each, as they are evaluated at IoU 0.5.

    truth_row: (D,) int64, the true box that each one matches, -1 for none. num_returns: (D, A) as those of true boxes. received:
    ids of the agents whose messages were fused. num_bytes: of all messages that were sent to the ego at this instant.
    """

    boxes: Boxes
    truth_row: Ints
    num_returns: Ints
    received: tuple[int, ...]
    num_bytes: int


@dataclass(frozen=True)
class PlayerMethod:
    """A method over the drive: one entry a frame.

    min_score: of its drawn boxes. needs_messages: whether it fuses messages. air_ms: mean time from sending to the arrival of the
    last packet of a fused message; None where nothing was fused.
    """

    name: str
    title: str
    min_score: float
    needs_messages: bool
    frames: tuple[PlayerDetections, ...]
    air_ms: float | None = None


@dataclass(frozen=True)
class ScenePlayer:
    """Frames of a drive and methods over them. view: x_min, y_min, x_max, y_max of the evaluated range, metres in the ego's frame.

    period_s: between two frames. num_skipped: evaluated frames that are left out.
    """

    view: tuple[float, float, float, float]
    period_s: float
    frames: tuple[PlayerFrame, ...]
    methods: tuple[PlayerMethod, ...]
    first_frame: int = 0
    num_skipped: int = 0

    def find_alone(self, method: PlayerMethod) -> int:
        """Return the row of the method without messages that another is compared with, -1 for none and for those without messages.

        It is the one of the same form, with or without memory; where none is, the first one.
        """
        alone = [row for row, other in enumerate(self.methods) if not other.needs_messages]
        if not method.needs_messages or not alone:
            return -1
        form = form_of(method.name)
        return next((row for row in alone if form_of(self.methods[row].name) == form), alone[0])


def find_cells(xy: Floats, view: tuple[float, float, float, float]) -> Ints:
    """Return the sorted numbers of the cells of a view that points (P, 2), metres, lie in; row by row from the lower left."""
    x_min, y_min, x_max, y_max = view
    columns, rows = math.ceil((x_max - x_min) / CELL_M), math.ceil((y_max - y_min) / CELL_M)
    at = np.floor((xy - (x_min, y_min)) / CELL_M).astype(np.int64)
    inside = (at >= 0).all(1) & (at < (columns, rows)).all(1)
    return np.unique(at[inside, 1] * columns + at[inside, 0])


def encode_cells(cells: Ints) -> str:
    """Return sorted cell numbers as base64 of the differences."""
    left = np.diff(cells, prepend=0)
    bytes_of = []
    while len(left):
        bytes_of.append(left)
        left = left >> 7
        if not left.any():
            break
    if not bytes_of:
        return ""
    table = np.stack([part & 127 for part in bytes_of], 1)
    lengths = np.maximum(1, np.stack([part > 0 for part in bytes_of], 1).sum(1))
    place = np.arange(table.shape[1])
    table |= np.where(place < lengths[:, None] - 1, 128, 0)
    return base64.b64encode(table[place < lengths[:, None]].astype(np.uint8).tobytes()).decode()


def decode_cells(text: str) -> Ints:
    """Return the cell numbers of :func:`encode_cells`; the page has the same in JavaScript."""
    cells, value, shift, last = [], 0, 0, 0
    for byte in base64.b64decode(text):
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            last += value
            cells.append(last)
            value = shift = 0
    return np.array(cells, dtype=np.int64)


def to_json(player: ScenePlayer) -> dict[str, Any]:
    """Return the player as values for JSON; points are thinned where they would be too many bytes."""
    points = _encode_points(player.frames)
    return {
        "view": player.view,
        "cell": CELL_M,
        "period": player.period_s,
        "first": player.first_frame,
        "frames": [_frame(frame, cells) for frame, cells in zip(player.frames, points)],
        "methods": [
            {
                "name": method.name,
                "title": method.title,
                "score": round(method.min_score, 3),
                "alone": player.find_alone(method),
                "frames": [_detections(d) for d in method.frames],
            }
            for method in player.methods
        ],
    }


def _encode_points(frames: Sequence[PlayerFrame]) -> list[list[str]]:
    """Encode the points of all agents; every k-th cell where all would be more than MAX_POINT_BYTES."""
    step = 1
    while True:
        texts = [[encode_cells(agent.cells[::step]) for agent in frame.agents] for frame in frames]
        size = sum(len(text) for row in texts for text in row)
        if size <= MAX_POINT_BYTES:
            return texts
        step = max(step + 1, math.ceil(step * size / MAX_POINT_BYTES))


def _frame(frame: PlayerFrame, cells: list[str]) -> dict[str, Any]:
    agents = [
        [
            agent.agent_id,
            agent.name,
            int(agent.is_infrastructure),
            *_integers([agent.x, agent.y], 100),
            _milli(agent.yaw),
        ]
        for agent in frame.agents
    ]
    truth = [[*box, *returns] for box, returns in zip(_box_rows(frame.truth), frame.num_returns.tolist())]
    return {"index": frame.index, "time": round(frame.time_s, 2), "agents": agents, "cells": cells, "truth": truth}


def _detections(detections: PlayerDetections) -> dict[str, Any]:
    columns = zip(
        _box_rows(detections.boxes),
        (1000 * detections.boxes.score.double()).round().long().tolist(),
        detections.truth_row.tolist(),
        detections.num_returns.tolist(),
    )
    boxes = [[*box, score, row, *returns] for box, score, row, returns in columns]
    return {"boxes": boxes, "received": list(detections.received), "bytes": detections.num_bytes}


def _box_rows(boxes: Boxes) -> list[list[int]]:
    """Return x, y, length, width, yaw of each box as integers."""
    return [[*_integers(row[:4], 100), _milli(row[4])] for row in boxes.bev().tolist()]


def _integers(values: Sequence[float], scale: float) -> list[int]:
    return [round(value * scale) for value in values]


def _milli(angle: float) -> int:
    return round(1000 * math.remainder(angle, 2 * math.pi))
