# SPDX-License-Identifier: Apache-2.0
"""Bend straight roads of a training tile into curves: clouds, poses and map elements by one deformation of the ground.

Curves are rare on the maps of the training towns. The x axis of the tile becomes an arc of constant curvature within REACH_M of its
centre, and goes on straight beyond; distances from it are kept. Heights do not change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import AgentFrame, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.observed_area import replace_geometry
from manyeyes.ops.polyline import close_rings, resample_spaced

Floats = NDArray[np.float64]

REACH_M = 70.0
"""Length of the arc to each side of the centre of the tile."""
MIN_STRETCH = 0.3
"""What would be compressed more on the inner side of the arc is left out."""
SPACING_M = 2.0
"""Maximum length of an edge of an element before it is bent."""


@dataclass(frozen=True)
class Bend:
    """A deformation of the plane. curvature: of the x axis, 1/m, to the left where it is positive; not 0."""

    curvature: float

    def turn(self, x: Floats) -> Floats:
        """Return the heading (N,) of the bent axis at positions x (N,) along it, radians."""
        return self.curvature * np.clip(x, -REACH_M, REACH_M)

    def apply(self, xy: Floats) -> Floats:
        """Return bent positions (N, 2)."""
        along = np.clip(xy[:, 0], -REACH_M, REACH_M)
        angle, beyond = self.curvature * along, xy[:, 0] - along
        sine, cosine = np.sin(angle), np.cos(angle)
        x = sine / self.curvature + beyond * cosine - xy[:, 1] * sine
        y = (1.0 - cosine) / self.curvature + beyond * sine + xy[:, 1] * cosine
        return np.stack((x, y), 1)

    def keeps(self, xy: Floats) -> NDArray[np.bool_]:
        """Return whether positions (N, 2) are compressed to no less than MIN_STRETCH."""
        return (1.0 - self.curvature * xy[:, 1] >= MIN_STRETCH) | (np.abs(xy[:, 0]) > REACH_M)

    def bend_frame(self, frame: AgentFrame, tile_from_agent: Transform) -> AgentFrame:
        """Return the frame in the bent tile, which is its world; tile_from_agent: its true pose in the tile."""
        at = tile_from_agent.translation[:2].numpy()[None]
        x, y = self.apply(at)[0].tolist()
        turn = Transform.from_xyz_yaw(0.0, 0.0, 0.0, float(self.turn(at[:, 0])[0]))
        height = tile_from_agent.translation.new_tensor([x, y, float(tile_from_agent.translation[2])])
        placed = Transform(turn.rotation @ tile_from_agent.rotation, height)
        xyz = tile_from_agent.apply(frame.points.xyz.double())
        xy = xyz[:, :2].numpy()
        rows = torch.from_numpy(np.flatnonzero(self.keeps(xy)))
        bent = xyz[rows]
        bent[:, :2] = torch.from_numpy(self.apply(xy[rows.numpy()]))
        cloud = frame.points[rows]
        points = replace(cloud, xyz=placed.inverse().apply(bent).float())
        return replace(frame, points=points, world_from_agent=placed, odometry=None)

    def bend_elements(self, elements: MapElements) -> MapElements:
        """Return elements of the tile's frame, bent; lines are cut and rings left out where they are compressed too much."""
        points, offsets = resample_spaced(*close_rings(elements.points, elements.offsets, elements.closed), SPACING_M)
        bent, kept = self.apply(points), self.keeps(points)
        rows, parts = list[int](), list[Floats]()
        for row, (first, end) in enumerate(pairwise(offsets.tolist())):
            # A ring was closed for its last edge, and is stored open.
            line, whole = bent[first:end], kept[first:end]
            if elements.closed[row]:
                found = [line[:-1]] if whole.all() else []
            else:
                cuts = np.flatnonzero(np.diff(whole.astype(np.int8))) + 1
                found = [
                    part for part, ok in zip(np.split(line, cuts), np.split(whole, cuts)) if ok.all() and len(part) > 1
                ]
            rows += [row] * len(found)
            parts += found
        return replace_geometry(elements, rows, parts)


def find_near_elements(elements: MapElements, reach_m: float) -> MapElements:
    """Return the elements that come within reach_m of the origin, by their boxes."""
    bounds = elements.bounds()
    outside = np.maximum(np.maximum(bounds[:, :2], -bounds[:, 2:]), 0.0).max(1) if len(elements) else np.zeros(0)
    return elements.take(outside <= reach_m)
