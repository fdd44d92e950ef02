# SPDX-License-Identifier: Apache-2.0
"""A pinhole camera against the solids and the height field that a spinning range sensor meets (ops/raycast.py).

Every primitive is drawn into the rectangle of pixels that its box can cover, nearest first, against a depth buffer; the
ground is walked for the pixels that are left, from where the ray sinks below the highest ground. One thread.
:func:`cast_pinhole_reference` is the slow twin: every ray against every primitive, with other formulas.

A solid of positive density is foliage: space is cut into cubes of edge LEAF_M, each of which is a leaf with the probability
1 - exp(-density c) that the range sensor returns within its mean chord c = 2/3 LEAF_M (Cauchy: 4 V / S), so that what two
cameras see of one crown is the same crown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I32x2, njit
from manyeyes.ops.raycast import (
    BOX,
    CYLINDER,
    GROUND,
    NOTHING,
    HeightField,
    HeightRaster,
    Primitives,
    SensorPose,
    SolidArrays,
    height_at,
    hit_box,
    hit_cylinder,
    hit_ellipsoid,
    reference_height,
    reference_hit,
)

LEAF_M = 0.12
_CHORD_M = 2 / 3 * LEAF_M
_NEAR_M = 0.05
_A, _B, _C, _D = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0xD6E8FEB86659FD93

# Columns of a rectangle of pixels: from … to of columns and rows, and the least depth in metres.
_COLUMN_START, _COLUMN_END, _ROW_START, _ROW_END, _NEAREST = range(5)

Array = NDArray[np.float64]


class _Lens(NamedTuple):
    """Focal lengths and principal point of a pinhole camera, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


class PinholeCamera(NamedTuple):
    """intrinsic: (3, 3) pixels, and the size of the picture in pixels."""

    intrinsic: Array
    width: int
    height: int


@dataclass(frozen=True)
class PinholeHits:
    """What each pixel meets, all (height, width).

    depth_m: float64, along the optical axis, inf where nothing was met. primitive: int32 index, NOTHING or GROUND.
    """

    depth_m: Array
    primitive: NDArray[np.int32]


@njit(cache=True)
def lattice_hash(i: int, j: int, k: int, seed: int) -> float:
    """Return a number in [0, 1) of a point of the integer lattice (SplitMix64)."""
    x = np.uint64(seed) + np.uint64(i) * np.uint64(_A) + np.uint64(j) * np.uint64(_C) + np.uint64(k) * np.uint64(_D)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(_B)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(_C)
    x = x ^ (x >> np.uint64(31))
    return float(x >> np.uint64(11)) / 9007199254740992.0


@njit(cache=True)
def first_leaf(
    o: F64x1, d0: float, d1: float, d2: float, enter: float, leave: float, density: float, seed: int
) -> float:
    """Return the first t in enter … leave at which the ray o + t d is within a leaf's cube; inf where there is none.

    The cubes are walked one after the other. Source: Amanatides & Woo, Eurographics 1987.
    """
    chance = 1.0 - math.exp(-density * _CHORD_M)
    t = enter + 1e-9
    while t < leave:
        i = math.floor((o[0] + t * d0) / LEAF_M)
        j = math.floor((o[1] + t * d1) / LEAF_M)
        k = math.floor((o[2] + t * d2) / LEAF_M)
        if lattice_hash(i, j, k, seed) < chance:
            return t
        out = math.inf
        if d0 != 0:
            out = min(out, ((i + (d0 > 0)) * LEAF_M - o[0]) / d0)
        if d1 != 0:
            out = min(out, ((j + (d1 > 0)) * LEAF_M - o[1]) / d1)
        if d2 != 0:
            out = min(out, ((k + (d2 > 0)) * LEAF_M - o[2]) / d2)
        t = max(out, t) + 1e-6
    return math.inf


@njit(cache=True)
def intersect_primitive(
    kind: int, half: F64x1, density: float, o: F64x1, d0: float, d1: float, d2: float, seed: int
) -> float:
    """Return the t at which the ray o + t d, in a primitive's own frame, meets it from outside; inf where it does not."""
    if kind == BOX:
        t, _ = hit_box(o, half, d0, d1, d2)
    elif kind == CYLINDER:
        t, _ = hit_cylinder(o, half, d0, d1, d2)
    else:
        t, leave = hit_ellipsoid(o, half, d0, d1, d2)
        if density > 0 and t < math.inf:
            t = first_leaf(o, d0, d1, d2, t, leave, density, seed)
    return t


@njit(cache=True)
def intersect_ground(
    terrain: HeightRaster, highest: float, origin: F64x1, d0: float, d1: float, d2: float, limit: float
) -> float:
    """Return the t below limit at which the ray origin + t d first sinks under the height field; inf where it does not.

    Steps are 0.4 m or 2 % of the way, then false position inside the step that crosses.
    """
    field, x_min, y_min, cell = terrain
    length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    t = 0.0
    if origin[2] > highest:
        if d2 >= 0:
            return math.inf
        t = (highest - origin[2]) / d2 * (1 - 1e-9)
    before_t, before = (
        t,
        origin[2] + t * d2 - height_at(field, x_min, y_min, cell, origin[0] + t * d0, origin[1] + t * d1),
    )
    if before <= 0:
        return t if t > 0 and t < limit else math.inf
    while before_t < limit:
        t = before_t + max(0.4 / length, 0.02 * before_t)
        z = origin[2] + t * d2
        if d2 >= 0 and z > highest:
            return math.inf
        above = z - height_at(field, x_min, y_min, cell, origin[0] + t * d0, origin[1] + t * d1)
        if above <= 0:
            low, high, f_low, f_high = before_t, t, before, above
            for _ in range(6):
                t = low + (high - low) * f_low / (f_low - f_high)
                above = (
                    origin[2] + t * d2 - height_at(field, x_min, y_min, cell, origin[0] + t * d0, origin[1] + t * d1)
                )
                if abs(above) < 2e-4:
                    break
                if above > 0:
                    low, f_low = t, above
                else:
                    high, f_high = t, above
            return t if t < limit else math.inf
        before_t, before = t, above
    return math.inf


@njit(cache=True)
def _rectangle(o: F64x1, q: F64x2, half: F64x1, lens: _Lens, width: int, height: int, bounds: F64x1) -> None:
    """First and past-the-last column and row that an oriented box can cover, and its least depth; empty where it is behind.

    bounds: (5,), _COLUMN_START … _NEAREST, is filled.
    o: the camera in the box's frame; q: box_from_camera. Edges are cut at the near plane.
    """
    fx, fy, cx, cy = lens
    corner = np.empty((8, 3))
    nearest = math.inf
    for n in range(8):
        c0 = (half[0] if n & 1 else -half[0]) - o[0]
        c1 = (half[1] if n & 2 else -half[1]) - o[1]
        c2 = (half[2] if n & 4 else -half[2]) - o[2]
        for k in range(3):
            corner[n, k] = q[0, k] * c0 + q[1, k] * c1 + q[2, k] * c2
        nearest = min(nearest, corner[n, 2])
    u_low, u_high, v_low, v_high = math.inf, -math.inf, math.inf, -math.inf
    for n in range(8):
        for axis in range(3):
            m = n | (1 << axis)
            if m == n:
                continue
            a, b = corner[n], corner[m]
            if a[2] < _NEAR_M and b[2] < _NEAR_M:
                continue
            for end in range(2):
                one, two = (a, b) if end == 0 else (b, a)
                x, y, z = one[0], one[1], one[2]
                if z < _NEAR_M:
                    s = (_NEAR_M - z) / (two[2] - z)
                    x, y, z = x + s * (two[0] - x), y + s * (two[1] - y), _NEAR_M
                u, v = fx * x / z + cx, fy * y / z + cy
                u_low, u_high, v_low, v_high = min(u_low, u), max(u_high, u), min(v_low, v), max(v_high, v)
    bounds[_COLUMN_START] = max(0.0, math.floor(min(u_low, 1e9) - 0.5))
    bounds[_COLUMN_END] = min(float(width), math.ceil(max(u_high, -1e9) + 0.5))
    bounds[_ROW_START] = max(0.0, math.floor(min(v_low, 1e9) - 0.5))
    bounds[_ROW_END] = min(float(height), math.ceil(max(v_high, -1e9) + 0.5))
    bounds[_NEAREST] = nearest


@njit(cache=True)
def _cast(
    solids: SolidArrays,
    skip: Boolx1,
    pose: SensorPose,
    lens: _Lens,
    max_depth: float,
    seed: int,
    depth: F64x2,
    owner: I32x2,
) -> None:
    """All primitives, nearest first."""
    (kind, center, rotation, half, density), (origin, camera) = solids, pose
    fx, fy, cx, cy = lens
    rows, columns = depth.shape
    n = kind.shape[0]
    o, q, bounds, near = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 5)), np.empty(n)
    for i in range(n):
        for r in range(3):
            o[i, r] = 0.0
            for c in range(3):
                o[i, r] += rotation[i, c, r] * (origin[c] - center[i, c])
                q[i, r, c] = (
                    rotation[i, 0, r] * camera[0, c]
                    + rotation[i, 1, r] * camera[1, c]
                    + rotation[i, 2, r] * camera[2, c]
                )
        _rectangle(o[i], q[i], half[i], lens, columns, rows, bounds[i])
        near[i] = bounds[i, _NEAREST]
    for solid in np.argsort(near, kind="mergesort"):
        i = int(solid)
        if near[i] > max_depth:
            break
        if skip[i]:
            continue
        for row in range(int(bounds[i, _ROW_START]), int(bounds[i, _ROW_END])):
            y = (row + 0.5 - cy) / fy
            for column in range(int(bounds[i, _COLUMN_START]), int(bounds[i, _COLUMN_END])):
                if depth[row, column] <= near[i]:
                    continue
                x = (column + 0.5 - cx) / fx
                d0 = q[i, 0, 0] * x + q[i, 0, 1] * y + q[i, 0, 2]
                d1 = q[i, 1, 0] * x + q[i, 1, 1] * y + q[i, 1, 2]
                d2 = q[i, 2, 0] * x + q[i, 2, 1] * y + q[i, 2, 2]
                t = intersect_primitive(kind[i], half[i], density[i], o[i], d0, d1, d2, seed + i)
                if t < depth[row, column] and t <= max_depth:
                    depth[row, column], owner[row, column] = t, i


@njit(cache=True)
def _ground(
    terrain: HeightRaster, highest: float, pose: SensorPose, lens: _Lens, max_depth: float, depth: F64x2, owner: I32x2
) -> None:
    """The ground in every pixel where it is nearer than what stands there."""
    origin, camera = pose
    fx, fy, cx, cy = lens
    for row in range(depth.shape[0]):
        y = (row + 0.5 - cy) / fy
        for column in range(depth.shape[1]):
            x = (column + 0.5 - cx) / fx
            d0 = camera[0, 0] * x + camera[0, 1] * y + camera[0, 2]
            d1 = camera[1, 0] * x + camera[1, 1] * y + camera[1, 2]
            d2 = camera[2, 0] * x + camera[2, 1] * y + camera[2, 2]
            t = intersect_ground(terrain, highest, origin, d0, d1, d2, min(depth[row, column], max_depth))
            if t < depth[row, column]:
                depth[row, column], owner[row, column] = t, GROUND


def cast_pinhole(
    primitives: Primitives,
    ground: HeightField,
    pose: SensorPose,
    camera: PinholeCamera,
    max_depth: float,
    seed: int = 0,
    own: int = 0,
) -> PinholeHits:
    """Return one picture's depths. pose: of the camera (x right, y down, z ahead).

    own: the instance that is not met, 0 for none. seed decides where leaves are.
    """
    intrinsic, width, height = camera
    depth, owner = np.full((height, width), np.inf), np.full((height, width), NOTHING, np.int32)
    lens = _Lens(float(intrinsic[0, 0]), float(intrinsic[1, 1]), float(intrinsic[0, 2]), float(intrinsic[1, 2]))
    pose = SensorPose(*(np.ascontiguousarray(part, np.float64) for part in pose))
    _cast(primitives.arrays, _own(primitives, own), pose, lens, float(max_depth), seed, depth, owner)
    _ground(ground.raster, float(ground.height.max()), pose, lens, float(max_depth), depth, owner)
    return PinholeHits(depth, owner)


def _own(primitives: Primitives, own: int) -> NDArray[np.bool_]:
    return (primitives.instance == own) & (own != 0)


def cast_pinhole_reference(
    primitives: Primitives,
    ground: HeightField,
    pose: SensorPose,
    camera: PinholeCamera,
    max_depth: float,
    seed: int = 0,
    own: int = 0,
) -> PinholeHits:
    """Return the slow twin of :func:`cast_pinhole`: slabs and quadrics for every pixel, leaves and ground in small steps."""
    (origin, rotation), (intrinsic, width, height) = pose, camera
    v, u = np.mgrid[0:height, 0:width] + 0.5
    ray = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(intrinsic).T @ rotation.T
    depth, owner = np.full((height, width), np.inf), np.full((height, width), NOTHING, np.int32)
    for i in map(int, np.flatnonzero(~_own(primitives, own))):
        o, d = primitives.rotation[i].T @ (origin - primitives.center[i]), ray @ primitives.rotation[i]
        t, leave, _ = reference_hit(int(primitives.kind[i]), o, d, primitives.half[i])
        if primitives.density[i] > 0:
            chance = 1 - math.exp(-primitives.density[i] * _CHORD_M)
            for index in zip(*np.nonzero(np.isfinite(t))):
                steps = np.arange(float(t[index]), float(leave[index]), 0.001)
                cubes = np.floor((o + steps[:, None] * d[index]) / LEAF_M).astype(np.int64)
                entered = np.flatnonzero(np.append(True, (cubes[1:] != cubes[:-1]).any(1)))
                full = [k for k in entered if lattice_hash(cubes[k, 0], cubes[k, 1], cubes[k, 2], seed + i) < chance]
                t[index] = steps[full[0]] if full else np.inf
        closer = (t < depth) & (t <= max_depth)
        depth[closer], owner[closer] = t[closer], i
    for index in np.ndindex(height, width):
        t = np.arange(0.01, min(float(depth[index]), max_depth), 0.01)
        path = origin + t[:, None] * ray[index]
        below = np.flatnonzero(path[:, 2] <= reference_height(ground, path[:, 0], path[:, 1]))
        if below.size:
            depth[index], owner[index] = t[below[0]], GROUND
    return PinholeHits(depth, owner)
