# SPDX-License-Identifier: Apache-2.0
"""The ground that a map's observations saw, beside the map: what is missing there is missing, elsewhere it is unknown.

Cells of one metre (:mod:`manyeyes.maps.fusion.coverage`) whose centre lies in a view and in none of its occluders, at prior
poses. A map without stored ground is taken to cover what lies within 10 m of its lines, as an imported map does.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_replace
from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import MapElements
from manyeyes.maps.elements.map_observation import compute_covered_ground
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.formats.geoparquet import MapFileError
from manyeyes.maps.formats.reframe import move_points
from manyeyes.maps.fusion.coverage import CELL_M, fill_rings, merge_runs

_shapely = partial(import_extra, "shapely", "map", "The ground that a map covers")

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FORMAT_VERSION = 1
ASSUMED_MARGIN_M = 10.0
_ROW, _OFFSET = 1 << 32, 1 << 31
# Cells of so many observations are merged at once.
_BATCH = 256


@dataclass(frozen=True, eq=False)
class ObservedGround:
    """Cells as runs (R, 3): row, first and last column, ascending, in a frame. is_assumed: not seen, but near the map's lines."""

    frame: MapFrame
    runs: Ints
    is_assumed: bool = False

    @classmethod
    def of_observations(cls, observations: Sequence[Observation], frame: MapFrame) -> ObservedGround:
        """Return the union of what each of the observations saw."""
        keys = np.zeros(0, np.int64)
        for start in range(0, len(observations), _BATCH):
            batch = [_keys_of_observation(o) for o in observations[start : start + _BATCH]]
            keys = np.unique(np.concatenate([keys, *batch]))
        return cls(frame, _to_runs(keys))

    @classmethod
    def around(cls, elements: MapElements, frame: MapFrame, margin_m: float = ASSUMED_MARGIN_M) -> ObservedGround:
        """Return the ground near elements, gaps up to twice the margin included."""
        shapely = _shapely()
        keys = [np.zeros(0, np.int64)]
        for piece in shapely.get_parts(compute_covered_ground(elements, margin_m)) if len(elements) else ():
            rings = [shapely.get_coordinates(ring)[:-1] for ring in (piece.exterior, *piece.interiors)]
            keys.append(_subtract(rings[0], rings[1:]))
        return cls(frame, _to_runs(np.unique(np.concatenate(keys))), is_assumed=True)

    @property
    def area_m2(self) -> float:
        """Area of all cells."""
        return float((self.runs[:, 2] - self.runs[:, 1] + 1).sum()) * CELL_M**2

    def covers(self, points: Floats, frame: MapFrame) -> NDArray[np.bool_]:
        """Return (N,) whether points (N, 2), metres in a frame, lie in a cell."""
        if not len(self.runs) or not len(points):
            return np.zeros(len(points), bool)
        xy = points if frame == self.frame else move_points(points, frame, self.frame)
        cell = np.floor(xy / CELL_M).astype(np.int64)
        first = self.runs[:, 0] * _ROW + self.runs[:, 1] + _OFFSET
        at = np.searchsorted(first, cell[:, 1] * _ROW + cell[:, 0] + _OFFSET, side="right") - 1
        run = self.runs[np.maximum(at, 0)]
        return (at >= 0) & (run[:, 0] == cell[:, 1]) & (cell[:, 0] <= run[:, 2])

    def write(self, path: Path) -> None:
        """Write the cells as a .npz file."""
        origin = np.array([self.frame.latitude, self.frame.longitude])
        with atomic_replace(path, keep_suffix=True) as temporary:
            np.savez_compressed(temporary, version=FORMAT_VERSION, origin=origin, runs=self.runs)

    @classmethod
    def read(cls, path: Path) -> ObservedGround:
        """Return the cells of a file that :meth:`write` wrote."""
        try:
            with np.load(path, allow_pickle=False) as content:
                version, origin, runs = int(content["version"]), content["origin"], content["runs"].astype(np.int64)
            if version > FORMAT_VERSION or runs.ndim != 2 or runs.shape[1] != 3:
                raise ValueError(f"version {version}, runs {runs.shape}")
            return cls(MapFrame(float(origin[0]), float(origin[1])), runs)
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
            reason = " ".join(str(error).split())
            raise MapFileError(
                f"{path}: expected the observed ground of a map; {reason}. Fuse the map again."
            ) from None


def _keys_of_observation(o: Observation) -> Ints:
    x, y, yaw = o.pose.tolist()
    back = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return _subtract(o.view @ back + (x, y), [o.occluders.ring(k) @ back + (x, y) for k in range(len(o.occluders))])


def _subtract(outline: Floats, holes: Sequence[Floats]) -> Ints:
    """Return keys of the cells inside an open ring and outside others, ascending."""
    keys = _keys([outline])
    return np.setdiff1d(keys, _keys(holes), assume_unique=False) if len(holes) else keys


def _keys(rings: Sequence[Floats]) -> Ints:
    """Return keys of the cells inside any of the rings, ascending."""
    offsets = np.concatenate(([0], np.cumsum([len(ring) for ring in rings]))).astype(np.int64)
    runs = fill_rings(np.ascontiguousarray(np.concatenate(rings), np.float64), offsets)
    count = runs[:, 2] - runs[:, 1] + 1
    within = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    return np.unique(np.repeat(runs[:, 0] * _ROW + runs[:, 1] + _OFFSET, count) + within)


def _to_runs(keys: Ints) -> Ints:
    """Return runs (R, 3) of ascending keys."""
    row, column = np.divmod(keys, _ROW)
    column -= _OFFSET
    return merge_runs(np.stack((row, column, column), 1))
