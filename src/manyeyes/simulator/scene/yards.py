# SPDX-License-Identifier: Apache-2.0
"""Houses with rooms behind their openings, and yards: fences, hedges, bushes, sheds and what lies about in them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.raycast import BOX, CYLINDER, ELLIPSOID, Primitives
from manyeyes.simulator.scene.placement import PlacementGrid, SolidList, draw_places, find_places

Array = NDArray[np.float64]

_WALL_M = 0.25


@dataclass(frozen=True)
class YardSpec:
    """Numbers at most, within radius_m of the middle; those without a free place are left out.

    houses: with openings, each with a yard of setback_m before it. hedges, fences: lines of up to 12 m along the pavement.
    bushes: up to 5 m long. sheds, pieces: what stands in the open behind the pavement.
    """

    houses: int = 9
    hedges: int = 14
    fences: int = 12
    bushes: int = 40
    sheds: int = 8
    pieces: int = 36
    setback_m: tuple[float, float] = (0.5, 7.0)
    radius_m: float = 75.0


@dataclass(frozen=True)
class _Frame:
    """Axes of a house: x from the road into the plot, y along the front, z up; origin (3,) on the ground."""

    heap: SolidList
    origin: tuple[float, float, float]
    yaw: float
    reflectivity: float

    def box(
        self, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], bright: float | None = None
    ) -> None:
        """Add a box by its extent along each axis, metres."""
        u, v, w = ((a[0] + a[1]) / 2 for a in (x, y, z))
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        center = self.origin[0] + u * c - v * s, self.origin[1] + u * s + v * c, self.origin[2] + w
        half = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2, (z[1] - z[0]) / 2
        self.heap.add(BOX, center, half, self.yaw, reflectivity=self.reflectivity if bright is None else bright)


def place_yards(plot: PlacementGrid, spec: YardSpec, middle: Array, key: tuple[int | str, ...]) -> Primitives:
    """Return houses and what stands in yards around middle (2,) metres; their places are taken from the plot."""
    random, heap = keyed_generator(*key, "yards"), SolidList([])
    _houses(heap, plot, spec, middle, random)
    for count, make in ((spec.hedges, _hedge), (spec.fences, _fence)):
        for xy in _places(plot, spec, middle, random, count, (0.3, 2.5)):
            _, away = plot.pavement_clearance(xy)
            half, yaw = (0.45, float(random.uniform(1.5, 6.0))), math.atan2(away[1], away[0])
            if plot.occupy_if_free(xy, half, yaw, 0.25, 0.8):
                make(heap, plot, xy, (half[1], yaw + math.pi / 2), random)
    for xy in _places(plot, spec, middle, random, spec.sheds, (2.0, 16.0)):
        half, yaw = (float(random.uniform(0.8, 1.8)), float(random.uniform(0.8, 1.8))), float(random.uniform(0, 6.3))
        if plot.occupy_if_free(xy, half, yaw, 0.5, 1.0):
            height, z = float(random.uniform(1.8, 2.6)), float(plot.height(xy))
            heap.add(BOX, (xy[0], xy[1], z + height / 2 - 0.1), (*half, height / 2 + 0.1), yaw, reflectivity=0.3)
    for xy in _places(plot, spec, middle, random, spec.bushes, (0.4, 16.0)):
        _bush(heap, plot, xy, random)
    for xy in _places(plot, spec, middle, random, spec.pieces, (0.8, 14.0)):
        _piece(heap, plot, xy, random)
    return heap.solids()


def _places(
    plot: PlacementGrid,
    spec: YardSpec,
    middle: Array,
    random: np.random.Generator,
    count: int,
    band: tuple[float, float],
) -> Array:
    if count <= 0:
        return np.zeros((0, 2))
    places = find_places(plot, middle, spec.radius_m, *band, plot.distance_to_pavement_m)
    return draw_places(random, places, count, middle, 90.0)[:count]


def _houses(heap: SolidList, plot: PlacementGrid, spec: YardSpec, middle: Array, random: np.random.Generator) -> None:
    count = 0
    for xy in _places(plot, spec, middle, random, 4 * spec.houses, spec.setback_m):
        if count >= spec.houses:
            return
        _, away = plot.pavement_clearance(xy)
        depth, width = float(random.uniform(6.0, 11.0)), float(random.uniform(6.0, 14.0))
        center, yaw = xy + away * depth / 2, math.atan2(away[1], away[0])
        if plot.occupy_if_free(center, (depth / 2, width / 2), yaw, 0.4, 1.0):
            count += 1
            base = float(plot.height(plot.footprint(center, (depth / 2, width / 2), yaw)).min())
            frame = _Frame(heap, (xy[0], xy[1], base), yaw, float(random.uniform(0.2, 0.6)))
            _house(frame, depth, width, float(random.uniform(3.0, 9.0)), random)


def _house(frame: _Frame, depth: float, width: float, height: float, random: np.random.Generator) -> None:
    """Walls and roof; openings of the front's ground floor show a room with furniture, and a wall behind it most times."""
    low, half = -0.5, width / 2
    side = half - _WALL_M
    frame.box((depth - _WALL_M, depth), (-half, half), (low, height))
    frame.box((0, depth - _WALL_M), (side, half), (low, height))
    frame.box((0, depth - _WALL_M), (-half, -side), (low, height))
    frame.box((0, depth), (-half, half), (height, height + 0.3))
    room = float(random.uniform(2.5, depth - 1.0)) if random.random() < 0.7 else depth - _WALL_M
    if room < depth - _WALL_M:
        frame.box((room, room + 0.15), (-side, side), (low, min(height, 3.0)), 0.5)
    if height > 3.5:
        frame.box((0, depth), (-side, side), (2.9, 3.1), 0.4)
    _front(frame, side, half, height, random)
    for _ in range(int(random.integers(2, 6))):
        x, y = float(random.uniform(0.6, room - 0.6)), float(random.uniform(-side + 0.6, side - 0.6))
        a, b, c = random.uniform(0.2, 0.5), random.uniform(0.2, 0.9), random.uniform(0.4, 1.9)
        y = float(np.clip(y, -side + b, side - b))
        frame.box((x - a, x + a), (y - b, y + b), (-0.1, c), float(random.uniform(0.1, 0.6)))


def _front(frame: _Frame, side: float, half: float, height: float, random: np.random.Generator) -> None:
    """Piers between openings, lintels over them and sills under most."""
    num_openings = int(random.integers(2, max(3, round(half / 1.3)) + 1))
    pitch = 2 * half / num_openings
    sill, lintel = float(random.choice([0.0, 0.5, 0.9])), float(random.uniform(2.0, 2.6))
    share = float(random.uniform(0.35, 0.75))
    edge = -half
    for k in range(num_openings):
        middle = -half + (k + 0.5) * pitch
        frame.box((0, _WALL_M), (edge, middle - share * pitch / 2), (-0.5, lintel))
        edge = middle + share * pitch / 2
    frame.box((0, _WALL_M), (edge, half), (-0.5, lintel))
    frame.box((0, _WALL_M), (-half, half), (lintel, height))
    if sill > 0:
        frame.box((0, _WALL_M), (-side, side), (-0.5, sill))


def _hedge(
    heap: SolidList, plot: PlacementGrid, xy: Array, line: tuple[float, float], random: np.random.Generator
) -> None:
    """Leaves that rays enter a little. line: half its length in metres, and its yaw."""
    half, yaw = line
    height, bright = float(random.uniform(0.7, 2.2)), float(random.uniform(0.2, 0.45))
    count = max(2, round(half / 0.7))
    step = (2 * half - 0.2) / count
    for k in range(count):
        at = xy + (k + 0.5 - count / 2) * step * np.array([math.cos(yaw), math.sin(yaw)])
        z, tall = float(plot.height(at)), height * float(random.uniform(0.9, 1.1))
        size = (0.6 * step, float(random.uniform(0.35, 0.45)), 0.6 * tall)
        center = (at[0], at[1], z + tall - size[2])
        heap.add(ELLIPSOID, center, size, yaw, float(random.uniform(3.0, 9.0)), reflectivity=bright)


def _fence(
    heap: SolidList, plot: PlacementGrid, xy: Array, line: tuple[float, float], random: np.random.Generator
) -> None:
    """Posts with rails to see through, or boards. line: half its length in metres, and its yaw."""
    half, yaw = line
    height, bright = float(random.uniform(0.8, 2.0)), float(random.uniform(0.2, 0.5))
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    z = float(plot.height(xy))
    if random.random() < 0.4:
        heap.add(BOX, (xy[0], xy[1], z + height / 2 - 0.15), (half, 0.04, height / 2 + 0.15), yaw, reflectivity=bright)
        return
    count = max(2, round(half))
    for at in xy + np.linspace(-half + 0.05, half - 0.05, count)[:, None] * ahead:
        foot = float(plot.height(at))
        post = (at[0], at[1], foot + height / 2 - 0.15)
        heap.add(CYLINDER, post, (0.05, 0.05, height / 2 + 0.15), reflectivity=bright)
    for level in np.linspace(0.3, height - 0.1, int(random.integers(2, 5))):
        heap.add(BOX, (xy[0], xy[1], z + level), (half, 0.03, 0.05), yaw, reflectivity=bright)


def _bush(heap: SolidList, plot: PlacementGrid, xy: Array, random: np.random.Generator) -> None:
    """One to three clouds of leaves in line, up to the size of a car."""
    half = float(random.uniform(0.4, 2.4)), float(random.uniform(0.4, 1.1))
    yaw, tall = float(random.uniform(0, math.pi)), float(random.uniform(0.6, 2.0))
    if not plot.occupy_if_free(xy, half, yaw, 0.3, 0.8):
        return
    bright, density = float(random.uniform(0.2, 0.5)), float(random.uniform(1.5, 6.0))
    count = max(1, round(half[0] / half[1]))
    for k in range(min(count, 3)):
        wide = half[0] / min(count, 3)
        at = xy + (2 * k + 1 - min(count, 3)) * wide * np.array([math.cos(yaw), math.sin(yaw)])
        size = wide, half[1], 0.55 * tall * float(random.uniform(0.85, 1.0))
        center = (at[0], at[1], float(plot.height(at)) + tall - size[2])
        heap.add(ELLIPSOID, center, size, yaw, density, reflectivity=bright)


def _piece(heap: SolidList, plot: PlacementGrid, xy: Array, random: np.random.Generator) -> None:
    """A crate, a heap or a trunk: up to 3 m long, lower than a man."""
    half = float(random.uniform(0.2, 1.5)), float(random.uniform(0.2, 0.8))
    yaw, tall = float(random.uniform(0, math.pi)), float(random.uniform(0.3, 1.6))
    if not plot.occupy_if_free(xy, half, yaw, 0.3, 0.8):
        return
    z, bright = float(plot.height(xy)), float(random.uniform(0.1, 0.6))
    if random.random() < 0.6:
        heap.add(BOX, (xy[0], xy[1], z + tall / 2 - 0.1), (*half, tall / 2 + 0.1), yaw, reflectivity=bright)
    else:
        heap.add(ELLIPSOID, (xy[0], xy[1], z + 0.1), (*half, tall), yaw, reflectivity=bright)
