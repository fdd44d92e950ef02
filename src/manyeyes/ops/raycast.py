# SPDX-License-Identifier: Apache-2.0
"""A spinning range sensor against boxes, cylinders, ellipsoids and a height field.

The image of a scan is (azimuths, beams). Every primitive is drawn into the azimuth and elevation interval that it can
cover, nearest first, against a depth buffer; the ground is walked once per azimuth, from the lowest beam upwards.
One thread: the caller runs scans in parallel, and the result does not depend on how many.
:func:`cast_rays_reference` is the slow twin: every ray against every primitive, with other formulas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F32x2, F64x1, F64x2, F64x3, I32x2, U8x1, U8x2, njit
from manyeyes.datatypes.errors import ShapeError
from manyeyes.ops._sort_kernels import argsort

BOX, CYLINDER, ELLIPSOID = 0, 1, 2
NOTHING, GROUND = -1, -2
_TWO_PI = 2 * math.pi
_MIX_A, _MIX_B, _MIX_C = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB

Array = NDArray[np.float64]


# Columns of an interval: azimuths and elevations in radians, and the least distance in metres.
_AZIMUTH_LOW, _AZIMUTH_HIGH, _ELEVATION_LOW, _ELEVATION_HIGH, _NEAREST = range(5)


class SolidArrays(NamedTuple):
    """The columns of :class:`Primitives` that compiled loops need."""

    kind: U8x1
    center: F64x2
    rotation: F64x3
    half: F64x2
    density: F64x1


class SensorPose(NamedTuple):
    """origin: (3,) metres, rotation: (3, 3) world_from_sensor."""

    origin: F64x1
    rotation: F64x2


class HeightRaster(NamedTuple):
    """height (rows, columns) metres at nodes ``x_min + column * cell``, ``y_min + row * cell``."""

    height: F32x2
    x_min: float
    y_min: float
    cell: float


class _SurfaceRaster(NamedTuple):
    """surface (rows, columns): classes of cells of edge cell, whose corner is at x_min, y_min."""

    surface: U8x2
    x_min: float
    y_min: float
    cell: float


class _Rays(NamedTuple):
    """Cosines and sines of the elevations (B,) and of the azimuths (A,)."""

    cos_elevation: F64x1
    sin_elevation: F64x1
    cos_azimuth: F64x1
    sin_azimuth: F64x1


class _ScanPattern(NamedTuple):
    """elevation: (B,) ascending, azimuth: (A,), radians, per_turn to a whole turn; max_range: metres."""

    elevation: F64x1
    azimuth: F64x1
    rays: _Rays
    per_turn: int
    max_range: float


class _ScanImage(NamedTuple):
    """The depth buffer, all (A, B): metres, index of the primitive, cosine of the incidence."""

    depth: F64x2
    owner: I32x2
    cosine: F64x2


@dataclass(frozen=True)
class Primitives:
    """N solids in the world frame.

    kind: (N,) uint8, BOX, CYLINDER (about its z axis, without lids) or ELLIPSOID. center: (N, 3) metres.
    rotation: (N, 3, 3) world_from_primitive. half: (N, 3) half sizes, metres. density: (N,) 1/m; 0 is opaque, otherwise a
    ray that runs a length s inside an ellipsoid returns with probability 1 - exp(-density s). instance: (N,) int64,
    whose body it is. reflectivity: (N,) in [0, 1].
    """

    kind: NDArray[np.uint8]
    center: Array
    rotation: Array
    half: Array
    density: Array
    instance: NDArray[np.int64]
    reflectivity: Array

    def __post_init__(self) -> None:
        n = self.kind.shape[0]
        shapes = {"center": (n, 3), "rotation": (n, 3, 3), "half": (n, 3)}
        for field in fields(self):
            got, wanted = getattr(self, field.name).shape, shapes.get(field.name, (n,))
            if got != wanted:
                raise ShapeError(f"Primitives.{field.name} needs shape {wanted}; got {got}.")

    def __len__(self) -> int:
        return self.kind.shape[0]

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> Primitives:
        return Primitives(*(getattr(self, f.name)[index] for f in fields(self)))

    @property
    def arrays(self) -> SolidArrays:
        """The columns for compiled loops."""
        return SolidArrays(self.kind, self.center, self.rotation, self.half, self.density)

    @classmethod
    def cat(cls, many: list[Primitives]) -> Primitives:
        """Return several sets as one; at least one set."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in many]) for f in fields(cls)))

    @classmethod
    def empty(cls) -> Primitives:
        """Return a set without any solid."""
        zero = np.zeros
        return cls(zero(0, np.uint8), zero((0, 3)), zero((0, 3, 3)), zero((0, 3)), zero(0), zero(0, np.int64), zero(0))


@dataclass(frozen=True)
class HeightField:
    """The ground: height (rows along y, columns along x) in metres at nodes ``x_min + column * cell``, bilinear between.

    surface: uint8 classes on cells of edge surface_cell whose corner is at x_min, y_min. Beyond the raster the border
    value goes on.
    """

    height: NDArray[np.float32]
    surface: NDArray[np.uint8]
    x_min: float
    y_min: float
    cell: float
    surface_cell: float

    @property
    def raster(self) -> HeightRaster:
        """The heights for compiled loops."""
        return HeightRaster(self.height, self.x_min, self.y_min, self.cell)


@dataclass(frozen=True)
class Hits:
    """What each ray met, all (azimuths, beams).

    range_m: float64, inf where nothing was met. primitive: int32 index, NOTHING or GROUND. cosine: float64 of the
    angle of incidence. surface: uint8 class of the ground, 0 elsewhere.
    """

    range_m: Array
    primitive: NDArray[np.int32]
    cosine: Array
    surface: NDArray[np.uint8]


@njit(cache=True)
def hash_uniform(seed: np.uint64, primitive: int, ray: int) -> float:
    """Return a number in (0, 1] from a counter: the same for a ray and a primitive in whatever order they are met
    (SplitMix64).
    """
    x = seed + np.uint64(_MIX_A) * np.uint64(primitive + 1) + np.uint64(_MIX_B) * np.uint64(ray + 1)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(_MIX_B)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(_MIX_C)
    x = x ^ (x >> np.uint64(31))
    return (float(x >> np.uint64(11)) + 1.0) / 9007199254740992.0


@njit(cache=True)
def _interval(o: F64x1, q: F64x2, half: F64x1, bounds: F64x1) -> None:
    """Azimuths and elevations (sensor frame) that an oriented box can cover, into bounds (5,): _AZIMUTH_LOW … _NEAREST.

    o: the sensor in the box's frame; q: box_from_sensor. A tilt between the two can only shrink the horizontal distance
    by the height times its sine, so the interval is never too small.
    """
    gap0, gap1, gap2 = max(abs(o[0]) - half[0], 0.0), max(abs(o[1]) - half[1], 0.0), max(abs(o[2]) - half[2], 0.0)
    bounds[_NEAREST] = math.sqrt(gap0 * gap0 + gap1 * gap1 + gap2 * gap2)
    upright = min(abs(q[2, 2]), 1.0)
    flat = math.hypot(gap0, gap1) * upright - (abs(o[2]) + half[2]) * math.sqrt(1.0 - upright * upright)
    bounds[_AZIMUTH_LOW], bounds[_AZIMUTH_HIGH] = -math.pi, math.pi
    bounds[_ELEVATION_LOW], bounds[_ELEVATION_HIGH] = -math.pi / 2, math.pi / 2
    if flat < 0.02:
        return
    middle_x = -(q[0, 0] * o[0] + q[1, 0] * o[1] + q[2, 0] * o[2])
    middle_y = -(q[0, 1] * o[0] + q[1, 1] * o[1] + q[2, 1] * o[2])
    middle = math.atan2(middle_y, middle_x)
    low, high, z_low, z_high, far = math.pi, -math.pi, 1e30, -1e30, 0.0
    for corner in range(8):
        c0 = (half[0] if corner & 1 else -half[0]) - o[0]
        c1 = (half[1] if corner & 2 else -half[1]) - o[1]
        c2 = (half[2] if corner & 4 else -half[2]) - o[2]
        x = q[0, 0] * c0 + q[1, 0] * c1 + q[2, 0] * c2
        y = q[0, 1] * c0 + q[1, 1] * c1 + q[2, 1] * c2
        z = q[0, 2] * c0 + q[1, 2] * c1 + q[2, 2] * c2
        turn = math.atan2(y, x) - middle
        turn -= _TWO_PI * math.floor((turn + math.pi) / _TWO_PI)
        low, high = min(low, turn), max(high, turn)
        z_low, z_high, far = min(z_low, z), max(z_high, z), max(far, math.hypot(x, y))
    bounds[_AZIMUTH_LOW], bounds[_AZIMUTH_HIGH] = middle + low, middle + high
    bounds[_ELEVATION_LOW] = math.atan2(z_low, flat if z_low < 0 else far)
    bounds[_ELEVATION_HIGH] = math.atan2(z_high, flat if z_high > 0 else far)


@njit(cache=True)
def hit_box(o: F64x1, half: F64x1, d0: float, d1: float, d2: float) -> tuple[float, float]:
    """Return the entry distance and cosine into a box from outside; (inf, 0) when missed. At most three faces count."""
    if abs(o[0]) > half[0] and o[0] * d0 < 0:
        t = ((half[0] if o[0] > 0 else -half[0]) - o[0]) / d0
        if abs(o[1] + t * d1) <= half[1] and abs(o[2] + t * d2) <= half[2]:
            return t, abs(d0)
    if abs(o[1]) > half[1] and o[1] * d1 < 0:
        t = ((half[1] if o[1] > 0 else -half[1]) - o[1]) / d1
        if abs(o[0] + t * d0) <= half[0] and abs(o[2] + t * d2) <= half[2]:
            return t, abs(d1)
    if abs(o[2]) > half[2] and o[2] * d2 < 0:
        t = ((half[2] if o[2] > 0 else -half[2]) - o[2]) / d2
        if abs(o[0] + t * d0) <= half[0] and abs(o[1] + t * d1) <= half[1]:
            return t, abs(d2)
    return math.inf, 0.0


@njit(cache=True)
def hit_cylinder(o: F64x1, half: F64x1, d0: float, d1: float, d2: float) -> tuple[float, float]:
    """Return the entry distance and cosine into the side of a cylinder of radius half[0]."""
    a, b = d0 * d0 + d1 * d1, o[0] * d0 + o[1] * d1
    c = o[0] * o[0] + o[1] * o[1] - half[0] * half[0]
    root = b * b - a * c
    if root < 0 or b >= 0 or c <= 0:
        return math.inf, 0.0
    t = (-b - math.sqrt(root)) / a
    if abs(o[2] + t * d2) > half[2]:
        return math.inf, 0.0
    return t, math.sqrt(root) / half[0]


@njit(cache=True)
def hit_ellipsoid(o: F64x1, half: F64x1, d0: float, d1: float, d2: float) -> tuple[float, float]:
    """Return entry and exit distance of an ellipsoid, (inf, inf) when missed; entry is 0 from within."""
    s0, s1, s2 = o[0] / half[0], o[1] / half[1], o[2] / half[2]
    e0, e1, e2 = d0 / half[0], d1 / half[1], d2 / half[2]
    a, b, c = e0 * e0 + e1 * e1 + e2 * e2, s0 * e0 + s1 * e1 + s2 * e2, s0 * s0 + s1 * s1 + s2 * s2 - 1.0
    root = b * b - a * c
    if root < 0:
        return math.inf, math.inf
    root = math.sqrt(root)
    enter, leave = (-b - root) / a, (-b + root) / a
    if leave <= 0:
        return math.inf, math.inf
    return max(enter, 0.0), leave


@njit(cache=True)
def _draw(
    index: int,
    solids: SolidArrays,
    o: F64x1,
    q: F64x2,
    bounds: F64x1,
    scan: _ScanPattern,
    seed: np.uint64,
    image: _ScanImage,
) -> None:
    """One primitive into its part of the image; o, q, bounds: as in :func:`_interval`."""
    kind, half, density = solids.kind[index], solids.half[index], solids.density[index]
    el, azimuth, (cos_el, sin_el, cos_az, sin_az), per_turn, _ = scan
    depth, owner, cosine = image
    first = azimuth[0]
    step = _TWO_PI / per_turn
    beam_lo = np.searchsorted(el, bounds[_ELEVATION_LOW] - 1e-9)
    beam_hi = np.searchsorted(el, bounds[_ELEVATION_HIGH] + 1e-9)
    if beam_hi <= beam_lo:
        return
    k_lo = math.ceil((bounds[_AZIMUTH_LOW] - first) / step - 1e-9)
    k_hi = min(math.floor((bounds[_AZIMUTH_HIGH] - first) / step + 1e-9), k_lo + per_turn - 1)
    beams = el.shape[0]
    for k in range(k_lo, k_hi + 1):
        a = k % per_turn
        if a >= azimuth.shape[0]:
            continue
        u0 = cos_az[a] * q[0, 0] + sin_az[a] * q[0, 1]
        u1 = cos_az[a] * q[1, 0] + sin_az[a] * q[1, 1]
        u2 = cos_az[a] * q[2, 0] + sin_az[a] * q[2, 1]
        for b in range(beam_lo, beam_hi):
            if depth[a, b] <= bounds[_NEAREST]:
                continue
            d0 = cos_el[b] * u0 + sin_el[b] * q[0, 2]
            d1 = cos_el[b] * u1 + sin_el[b] * q[1, 2]
            d2 = cos_el[b] * u2 + sin_el[b] * q[2, 2]
            if kind == BOX:
                t, face = hit_box(o, half, d0, d1, d2)
            elif kind == CYLINDER:
                t, face = hit_cylinder(o, half, d0, d1, d2)
            else:
                t, leave = hit_ellipsoid(o, half, d0, d1, d2)
                face = 0.7
                if density > 0 and t < math.inf:
                    t += -math.log(hash_uniform(seed, index, a * beams + b)) / density
                    if t >= leave:
                        t = math.inf
            if t < depth[a, b]:
                depth[a, b], owner[a, b], cosine[a, b] = t, index, face


@njit(cache=True)
def height_at(field: F32x2, x_min: float, y_min: float, cell: float, x: float, y: float) -> float:
    """Return the bilinear height; the border value goes on outside."""
    column = min(max((x - x_min) / cell, 0.0), field.shape[1] - 1.001)
    row = min(max((y - y_min) / cell, 0.0), field.shape[0] - 1.001)
    j, i = int(column), int(row)
    u, v = column - j, row - i
    return (field[i, j] * (1 - u) + field[i, j + 1] * u) * (1 - v) + (
        field[i + 1, j] * (1 - u) + field[i + 1, j + 1] * u
    ) * v


@njit(cache=True)
def _walk_ground(terrain: HeightRaster, pose: SensorPose, rays: _Rays, max_range: float, image: _ScanImage) -> None:
    """The height field, per azimuth from the lowest beam up: a higher beam is still above ground where a lower one was.

    Steps are 0.4 m or 1 % of the range, then false position inside the step that crosses.
    """
    cos_el, sin_el, cos_az, sin_az = rays
    (field, x_min, y_min, cell), (origin, rotation), (depth, owner, cosine) = terrain, pose, image
    for a in range(depth.shape[0]):
        free = 0.3
        h0 = cos_az[a] * rotation[0, 0] + sin_az[a] * rotation[0, 1]
        h1 = cos_az[a] * rotation[1, 0] + sin_az[a] * rotation[1, 1]
        h2 = cos_az[a] * rotation[2, 0] + sin_az[a] * rotation[2, 1]
        for b in range(depth.shape[1]):
            d0 = cos_el[b] * h0 + sin_el[b] * rotation[0, 2]
            d1 = cos_el[b] * h1 + sin_el[b] * rotation[1, 2]
            d2 = cos_el[b] * h2 + sin_el[b] * rotation[2, 2]
            limit = min(depth[a, b], max_range)
            t, above = free, 1.0
            before_t, before = free, -1.0
            while t < limit:
                above = (
                    origin[2] + t * d2 - height_at(field, x_min, y_min, cell, origin[0] + t * d0, origin[1] + t * d1)
                )
                if above <= 0:
                    break
                before_t, before = t, above
                t += max(0.4, 0.01 * t)
            if t >= limit and limit > before_t:
                t = limit
                above = (
                    origin[2] + t * d2 - height_at(field, x_min, y_min, cell, origin[0] + t * d0, origin[1] + t * d1)
                )
            if above > 0 or before <= 0:
                free = max(free, before_t)
                continue
            low, high, f_low, f_high = before_t, t, before, above
            for _ in range(4):
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
            free = max(free, before_t)
            if t < depth[a, b] and t <= max_range:
                x, y = origin[0] + t * d0, origin[1] + t * d1
                here = height_at(field, x_min, y_min, cell, x, y)
                gx = (height_at(field, x_min, y_min, cell, x + cell, y) - here) / cell
                gy = (height_at(field, x_min, y_min, cell, x, y + cell) - here) / cell
                depth[a, b], owner[a, b] = t, GROUND
                cosine[a, b] = abs(d2 - gx * d0 - gy * d1) / math.sqrt(1 + gx * gx + gy * gy)


@njit(cache=True)
def _cast(solids: SolidArrays, pose: SensorPose, scan: _ScanPattern, seed: np.uint64, image: _ScanImage) -> None:
    """All primitives, nearest first."""
    center, rotation, half = solids.center, solids.rotation, solids.half
    origin, sensor = pose
    n = center.shape[0]
    o, q, bounds, near = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 5)), np.empty(n)
    for i in range(n):
        for r in range(3):
            o[i, r] = 0.0
            for c in range(3):
                o[i, r] += rotation[i, c, r] * (origin[c] - center[i, c])
                q[i, r, c] = (
                    rotation[i, 0, r] * sensor[0, c]
                    + rotation[i, 1, r] * sensor[1, c]
                    + rotation[i, 2, r] * sensor[2, c]
                )
        _interval(o[i], q[i], half[i], bounds[i])
        near[i] = bounds[i, _NEAREST]
    for i in argsort(near):
        if near[i] > scan.max_range:
            break
        _draw(int(i), solids, o[i], q[i], bounds[i], scan, seed, image)


@njit(cache=True)
def _finish(
    pose: SensorPose, rays: _Rays, max_range: float, ground: _SurfaceRaster, image: _ScanImage, surface: U8x2
) -> None:
    """Cut at the range and read the class of the ground under each ground return."""
    cos_el, sin_el, cos_az, sin_az = rays
    (surface_map, x_min, y_min, cell), (origin, rotation), (depth, owner, _) = ground, pose, image
    rows, columns = surface_map.shape
    for a in range(depth.shape[0]):
        for b in range(depth.shape[1]):
            t = depth[a, b]
            if t > max_range:
                depth[a, b], owner[a, b] = math.inf, NOTHING
            elif owner[a, b] == GROUND:
                x = cos_el[b] * cos_az[a] * t
                y = cos_el[b] * sin_az[a] * t
                z = sin_el[b] * t
                wx = origin[0] + rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
                wy = origin[1] + rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
                j, i = math.floor((wx - x_min) / cell), math.floor((wy - y_min) / cell)
                if 0 <= i < rows and 0 <= j < columns:
                    surface[a, b] = surface_map[i, j]


def cast_rays(
    primitives: Primitives,
    ground: HeightField,
    pose: SensorPose,
    elevation: Array,
    azimuth: Array,
    per_turn: int,
    max_range: float,
    seed: int = 0,
) -> Hits:
    """Return one scan. elevation: (B,) ascending, radians.

    azimuth: (A,) radians, counter-clockwise, equally spaced by 2 pi / per_turn. seed decides where rays end in foliage.
    """
    shape = (azimuth.shape[0], elevation.shape[0])
    depth, owner = np.full(shape, np.inf), np.full(shape, NOTHING, np.int32)
    cosine, surface = np.zeros(shape), np.zeros(shape, np.uint8)
    rays = _Rays(np.cos(elevation), np.sin(elevation), np.cos(azimuth), np.sin(azimuth))
    image = _ScanImage(depth, owner, cosine)
    scan = _ScanPattern(elevation, azimuth, rays, per_turn, max_range)
    _cast(primitives.arrays, pose, scan, np.uint64(seed % 2**64), image)
    _walk_ground(ground.raster, pose, rays, max_range, image)
    surfaces = _SurfaceRaster(ground.surface, ground.x_min, ground.y_min, ground.surface_cell)
    _finish(pose, rays, max_range, surfaces, image, surface)
    return Hits(depth, owner, cosine, surface)


def cast_rays_reference(
    primitives: Primitives,
    ground: HeightField,
    pose: SensorPose,
    elevation: Array,
    azimuth: Array,
    per_turn: int,
    max_range: float,
    seed: int = 0,
) -> Hits:
    """Return the slow twin of :func:`cast_rays`: every ray against every primitive by slabs and quadrics; the ground in 2 cm
    steps.
    """
    del per_turn
    origin, rotation = pose
    ce, se = np.cos(elevation)[None], np.sin(elevation)[None]
    sensor = np.stack([ce * np.cos(azimuth)[:, None], ce * np.sin(azimuth)[:, None], se + 0 * azimuth[:, None]], -1)
    ray = sensor @ rotation.T
    depth, owner = np.full(ray.shape[:2], np.inf), np.full(ray.shape[:2], NOTHING, np.int32)
    cosine, surface = np.zeros(ray.shape[:2]), np.zeros(ray.shape[:2], np.uint8)
    number = np.arange(depth.size).reshape(depth.shape)
    for i in range(len(primitives)):
        o, d = primitives.rotation[i].T @ (origin - primitives.center[i]), ray @ primitives.rotation[i]
        t, leave, face = reference_hit(int(primitives.kind[i]), o, d, primitives.half[i])
        if primitives.density[i] > 0:
            draw = np.array([hash_uniform(np.uint64(seed % 2**64), i, int(k)) for k in number.ravel()]).reshape(
                depth.shape
            )
            inside = t - np.log(draw) / primitives.density[i]
            t = np.where(inside < leave, inside, np.inf)
        closer = t < depth
        depth[closer], owner[closer], cosine[closer] = t[closer], i, face[closer]
    for index in np.ndindex(*depth.shape):
        t = np.arange(0.3, min(float(depth[index]), max_range), 0.02)
        path = origin + t[:, None] * ray[index]
        below = np.flatnonzero(path[:, 2] <= reference_height(ground, path[:, 0], path[:, 1]))
        if below.size:
            depth[index], owner[index] = t[below[0]], GROUND
            column, row = np.floor((path[below[0], :2] - (ground.x_min, ground.y_min)) / ground.surface_cell).astype(
                int
            )
            if 0 <= row < ground.surface.shape[0] and 0 <= column < ground.surface.shape[1]:
                surface[index] = ground.surface[row, column]
    owner[depth > max_range], depth[depth > max_range] = NOTHING, np.inf
    return Hits(depth, owner, cosine, surface)


def reference_height(ground: HeightField, x: Array, y: Array) -> Array:
    """Return bilinear heights at points, any shape; the border value goes on outside."""
    rows, columns = ground.height.shape
    u = np.clip((x - ground.x_min) / ground.cell, 0, columns - 1.001)
    v = np.clip((y - ground.y_min) / ground.cell, 0, rows - 1.001)
    j, i = u.astype(int), v.astype(int)
    weight = ((1 - u + j) * (1 - v + i), (u - j) * (1 - v + i), (1 - u + j) * (v - i), (u - j) * (v - i))
    corner = ((i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1))
    return sum(w * ground.height[c] for w, c in zip(weight, corner))  # pyright: ignore[reportReturnType]


def reference_hit(kind: int, o: Array, d: Array, half: Array) -> tuple[Array, Array, Array]:
    """Return the entry distance, exit distance and cosine of rays o + t d (d: (..., 3)) into one primitive in its own frame."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if kind == BOX:
            one, two = (-half - o) / d, (half - o) / d
            enter, leave = np.minimum(one, two), np.maximum(one, two)
            t, axis = enter.max(-1), enter.argmax(-1)
            hit = (t <= leave.min(-1)) & (t > 0)
            face = np.abs(np.take_along_axis(d, axis[..., None], -1)[..., 0])
            return np.where(hit, t, np.inf), leave.min(-1), face
        scale = np.array([half[0], half[0], np.inf]) if kind == CYLINDER else half
        s, e = o / scale, d / scale
        a, b, c = (e * e).sum(-1), (s * e).sum(-1), s @ s - 1
        root = b * b - a * c
        t, leave = (-b - np.sqrt(root)) / a, (-b + np.sqrt(root)) / a
        if kind == CYLINDER:
            hit = (root >= 0) & (t > 0) & (np.abs(o[2] + t * d[..., 2]) <= half[2]) & (c > 0)
            normal = (o + t[..., None] * d)[..., :2] / half[0]
            return np.where(hit, t, np.inf), leave, np.abs((normal * d[..., :2]).sum(-1))
        hit = (root >= 0) & (leave > 0)
        return np.where(hit, np.maximum(t, 0), np.inf), leave, np.full(t.shape, 0.7)
