# SPDX-License-Identifier: Apache-2.0
"""Textures at close range: road, paint and its wear, house fronts, vehicles. All colours are linear albedos.

Each function takes points of one kind of surface and the extent of a pixel there, so that detail finer than a pixel fades
to its mean instead of flickering. Sizes and colours are chosen after European towns.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from manyeyes.ops.raycast import HeightField
from manyeyes.simulator.sensors.fractal_noise import fractal_noise
from manyeyes.simulator.sensors.lidar import CROSSING, OFF_ROAD, PAINT, SIDEWALK
from manyeyes.simulator.sensors.materials import (
    BARK,
    FACADE,
    GLASS,
    GLAZED,
    HEDGE,
    LEAVES,
    PAINTWORK,
    PLATE,
    RUBBER,
    SIGNAL,
    TARPAULIN,
    WALL,
)

Real = NDArray[np.floating]
Points = NDArray[np.float64]

# Samples along a pixel that is long on the ground, and from which length they replace the close view.
_PIXEL_SAMPLES, _LONG_M = 7, 0.35
_WHITE = np.array([0.72, 0.72, 0.69], np.float32)
_GLASS = np.array([0.015, 0.018, 0.02], np.float32)


def smoothstep(
    low: float | NDArray[np.floating], high: float | NDArray[np.floating], value: NDArray[np.floating]
) -> Real:
    """0 below low, 1 above high, a cubic between; any shape."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return (t * t * (3 - 2 * t)).astype(np.float32)


def _lerp(one: Real, two: Real, weight: Real) -> Real:
    return one + weight[:, None] * (two - one)


def _resolvable_fraction(scale: float, width: Real) -> Real:
    """Return how much of a pattern of this scale is left in pixels of this width."""
    return 1 - smoothstep(0.5, 2.0, width / scale)


@dataclass(frozen=True, eq=False)
class GroundCover:
    """Shares of the ground at N points, (N,) each: off the road, sidewalk and paint; the rest is asphalt."""

    grass: Real
    walk: Real
    paint: Real


def ground_cover(field: HeightField, xy: Points, pixel_extent: Points) -> GroundCover:
    """What the raster has at points (N, 2), seen through pixels that reach over ``pixel_extent`` (N, 2), metres, about them.

    Close by, its cells are joined to smooth edges by a quadratic spline; far away, samples along the pixel are averaged.
    """
    near, far = _near_cover(field, xy), np.flatnonzero(np.hypot(pixel_extent[:, 0], pixel_extent[:, 1]) > _LONG_M)
    if len(far):
        fractions = np.zeros((3, len(far)), np.float32)
        for k in range(_PIXEL_SAMPLES):
            # Not evenly, for stripes are: steps of the golden ratio.
            at = xy[far] + ((k + (0.618 * k + 0.31) % 1) / _PIXEL_SAMPLES - 0.5) * pixel_extent[far]
            fractions += np.stack(_kinds(_classes(field, at))) / np.float32(_PIXEL_SAMPLES)
        near.grass[far], near.walk[far], near.paint[far] = fractions
    return near


def _classes(field: HeightField, xy: Points, row: int = 0, column: int = 0) -> NDArray[np.uint8]:
    """Return classes of the cells of points, so many rows and columns on; OFF_ROAD outside."""
    rows, columns = field.surface.shape
    j = np.floor((xy[:, 0] - field.x_min) / field.surface_cell).astype(np.int64) + column
    i = np.floor((xy[:, 1] - field.y_min) / field.surface_cell).astype(np.int64) + row
    inside = (i >= 0) & (i < rows) & (j >= 0) & (j < columns)
    return np.where(inside, field.surface[np.clip(i, 0, rows - 1), np.clip(j, 0, columns - 1)], OFF_ROAD)


def _kinds(classes: NDArray[np.uint8]) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    return classes == OFF_ROAD, classes == SIDEWALK, (classes == PAINT) | (classes == CROSSING)


def _near_cover(field: HeightField, xy: Points) -> GroundCover:
    u, v = (xy[:, 0] - field.x_min) / field.surface_cell, (xy[:, 1] - field.y_min) / field.surface_cell
    u, v = (u - np.floor(u) - 0.5).astype(np.float32), (v - np.floor(v) - 0.5).astype(np.float32)
    weight_x = (0.5 * (0.5 - u) ** 2, 0.75 - u * u, 0.5 * (0.5 + u) ** 2)
    weight_y = (0.5 * (0.5 - v) ** 2, 0.75 - v * v, 0.5 * (0.5 + v) ** 2)
    fractions = np.zeros((3, len(xy)), np.float32)
    for row in range(3):
        for column in range(3):
            kinds = _kinds(_classes(field, xy, row - 1, column - 1))
            fractions += np.stack(kinds) * (weight_y[row] * weight_x[column])
    # Lines are one cell wide: a spline of theirs peaks at 0.55 to 0.75.
    return GroundCover(fractions[0], fractions[1], smoothstep(0.32, 0.46, fractions[2]))


def ground_rgb(field: HeightField, xy: Points, pixel_extent: Points, wear: float, seed: int) -> Real:
    """Return (N, 3) of the ground at points (N, 2) seen through pixels that reach over ``pixel_extent`` (N, 2) metres."""
    width = np.hypot(pixel_extent[:, 0], pixel_extent[:, 1]).astype(np.float32)
    cover = ground_cover(field, xy, pixel_extent)
    broad, blotch = fractal_noise(xy, 9.0, seed), fractal_noise(xy, 1.6, seed + 1)
    grain = fractal_noise(xy, 0.12, seed + 2) * _resolvable_fraction(0.05, width)
    asphalt = _asphalt(xy, width, broad, blotch, grain, wear, seed)
    grass = _grass(xy, width, broad, blotch, grain, seed)
    walk = _sidewalk(xy, width, blotch, grain)
    close = width <= _LONG_M
    grass_fraction = np.where(close, smoothstep(0.35, 0.65, cover.grass), cover.grass)
    walk_fraction = np.where(close, smoothstep(0.35, 0.65, cover.walk), cover.walk)
    base = _lerp(_lerp(asphalt, walk, walk_fraction), grass, grass_fraction)
    kerb = np.clip(4 * cover.walk * (1 - cover.walk - cover.grass) * 1.6, 0, 1) * close
    base = _lerp(base, np.float32(0.40) * (1 + 0.1 * grain)[:, None] * np.ones(3, np.float32), kerb.astype(np.float32))
    worn = 0.75 * blotch + 0.55 * fractal_noise(xy, 0.35, seed + 3) * _resolvable_fraction(0.2, width) + 0.25 * grain
    left = (0.92 - 0.25 * wear) * smoothstep(-2.6 + 1.9 * wear, -1.2 + 1.9 * wear, worn)
    paint = _WHITE * (1 + 0.04 * grain - 0.10 * wear)[:, None]
    return _lerp(base, paint, cover.paint * left)


def _asphalt(xy: Points, width: Real, broad: Real, blotch: Real, grain: Real, wear: float, seed: int) -> Real:
    tone = 0.105 + 0.035 * ((seed % 97) / 97) + 0.008 * broad + 0.005 * blotch + 0.009 * grain
    patch = smoothstep(1.35, 1.45, fractal_noise(xy, 14.0, seed + 4)) * wear
    tone = tone * (1 - 0.32 * patch)
    crack = 1 - smoothstep(0.010, 0.03, np.abs(fractal_noise(xy, 5.0, seed + 5)))
    crack *= smoothstep(0.5, 0.9, fractal_noise(xy, 12.0, seed + 6)) * _resolvable_fraction(0.06, width) * wear
    tone = np.maximum(tone * (1 - 0.55 * crack), 0.02)
    return tone[:, None] * np.array([1.0, 1.0, 1.02], np.float32)


def _grass(xy: Points, width: Real, broad: Real, blotch: Real, grain: Real, seed: int) -> Real:
    dry = smoothstep(-0.6, 2.2, broad + 0.4 * blotch + (seed % 31) / 31 - 0.5)
    green, straw = np.array([0.075, 0.135, 0.030], np.float32), np.array([0.20, 0.18, 0.085], np.float32)
    blades = fractal_noise(xy, 0.5, seed + 7) * _resolvable_fraction(0.15, width)
    return (
        _lerp(np.broadcast_to(green, (len(xy), 3)), straw, dry)
        * np.clip(1 + 0.28 * grain + 0.16 * blades + 0.10 * blotch, 0.25, 2)[:, None]
    )


def _sidewalk(xy: Points, width: Real, blotch: Real, grain: Real) -> Real:
    slab = np.abs((xy / 0.6) % 1.0 - 0.5).max(1)
    joint = smoothstep(0.47, 0.49, slab) * _resolvable_fraction(0.10, width)
    tone = (0.30 + 0.018 * blotch + 0.030 * grain) * (1 - 0.35 * joint)
    return tone[:, None] * np.array([1.0, 0.985, 0.95], np.float32)


@dataclass(frozen=True, eq=False)
class SolidPoints:
    """N points on solids, as their texture needs them.

    local: (N, 3) metres in the primitive's frame; axis: (N,) 0 … 2, the face of a box it lies on, and side: (N,) its sign;
    half: (N, 3) of the primitive; width: (N,) metres of a pixel there. rgb, seed, anchor, size, axles: of the materials, per point.
    """

    local: Real
    axis: NDArray[np.int64]
    side: Real
    half: Real
    width: Real
    rgb: Real
    seed: Real
    anchor: Real
    size: Real
    axles: Real

    def __getitem__(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> SolidPoints:
        return SolidPoints(*(getattr(self, field.name)[index] for field in fields(self)))

    def face_coordinates(self) -> tuple[Real, Real]:
        """Return metres to the right along the face, and up from its lower edge (across, on a lid), (N,) each."""
        right = np.where(self.axis == 0, self.local[:, 1], self.local[:, 0])
        up = np.where(self.axis == 2, self.local[:, 1], self.local[:, 2] + self.half[:, 2])
        return right.astype(np.float32), up.astype(np.float32)


def solid_rgb(material: int, spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    """Albedo (N, 3) and gloss (N,), the share of a mirror's reflection, of points of one material."""
    painter = {
        FACADE: _facade, WALL: _wall, HEDGE: _foliage, LEAVES: _foliage, BARK: _bark, PLATE: _plate, SIGNAL: _signal,
        PAINTWORK: _paintwork, GLAZED: _shade_cabin, GLASS: _glass, TARPAULIN: _tarpaulin, RUBBER: _tyre,
    }.get(material, _plain)  # fmt: skip
    albedo, gloss = painter(spots, seed)
    return albedo.astype(np.float32), gloss.astype(np.float32)


def _plain(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    return spots.rgb, np.zeros(len(spots.rgb), np.float32)


def _within(value: Real, low: float | Real, high: float | Real, width: Real) -> Real:
    """1 between low and high, with edges as soft as the pixel is wide."""
    soft = np.maximum(width, 0.004)
    return np.clip((value - low) / soft + 0.5, 0, 1) * np.clip((high - value) / soft + 0.5, 0, 1)


def _draw(seed: Real, number: float) -> Real:
    """Return (N,) in [0, 1): other draws of one seed."""
    return ((seed * 917.13 + number * 0.754877) * 43.17 % 1.0).astype(np.float32)


def _cell_draw(one: Real, two: Real, seed: Real) -> Real:
    """Return (N,) in [0, 1) for whole numbers one and two."""
    return (np.abs(np.sin(one * 12.9898 + two * 78.233 + seed * 437.5)) * 4375.8545 % 1.0).astype(np.float32)


def _facade(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    """Return rows of windows with sills, a plinth, a cornice; shop windows below in every third house; gravel on the roof."""
    right, up = spots.face_coordinates()
    top = 2 * spots.half[:, 2]
    flat = np.stack((right + 37 * spots.seed, up), -1)
    rough = 0.05 * fractal_noise(flat, 2.5, seed + 8) + 0.04 * fractal_noise(
        flat, 0.3, seed + 9
    ) * _resolvable_fraction(0.1, spots.width)
    wall = spots.rgb * (1 + rough)[:, None]
    brick = (spots.rgb[:, 0] > 1.8 * spots.rgb[:, 2]).astype(np.float32)
    course = np.floor(up / 0.075)
    joint = np.maximum(
        _within(up % 0.075, 0, 0.012, spots.width),
        _within((right + 0.12 * (course % 2)) % 0.24, 0, 0.012, spots.width),
    )
    wall = _lerp(
        wall, np.float32(0.42) * np.ones_like(wall), 0.5 * brick * joint * _resolvable_fraction(0.05, spots.width)
    )
    storey, bay = 2.8 + 0.7 * _draw(spots.seed, 1), 1.9 + 1.6 * _draw(spots.seed, 2)
    length = 2 * np.where(spots.axis == 0, spots.half[:, 1], spots.half[:, 0])
    bay = length / np.maximum(np.round(length / bay), 1)
    column, floor = np.floor((right + length / 2) / bay), np.floor((up - 0.6) / storey)
    x, y = (right + length / 2) - column * bay, (up - 0.6) - floor * storey
    wide, tall = bay * (0.42 + 0.25 * _draw(spots.seed, 3)), storey * (0.48 + 0.14 * _draw(spots.seed, 4))
    shop = (floor == 0) & (_draw(spots.seed, 5) < 0.34)
    wide, tall = np.where(shop, 0.86 * bay, wide), np.where(shop, 0.72 * storey, tall)
    sill = np.where(shop, 0.05, 0.28) * storey
    whole = (up + 0.35 < top) & (floor >= 0) & (0.6 + (floor + 1) * storey < top + 0.3)
    window = (
        whole * _within(x, (bay - wide) / 2, (bay + wide) / 2, spots.width) * _within(y, sill, sill + tall, spots.width)
    )
    frame = 0.06
    pane = (
        _within(x, (bay - wide) / 2 + frame, (bay + wide) / 2 - frame, spots.width)
        * _within(y, sill + frame, sill + tall - frame, spots.width)
        * (1 - _within(np.abs(x - bay / 2), -1.0, 0.03, spots.width))
    )  # fmt: skip
    drawn = _cell_draw(column, floor + 31 * spots.axis + 57 * spots.side, spots.seed)
    curtain = (drawn > 0.6) * _within(y, sill + tall * (1.55 - drawn), 99.0, spots.width)
    inside = _lerp(
        np.broadcast_to(_GLASS, wall.shape), np.float32(0.30) * np.ones_like(wall), curtain.astype(np.float32)
    )
    light = (_draw(spots.seed, 6) < 0.6).astype(np.float32)[:, None]
    rim = 0.60 * light + 0.10 * (1 - light) + np.zeros_like(wall)
    colour = _lerp(wall, _lerp(rim, inside, pane), window)
    ledge = whole * _within(x, (bay - wide) / 2 - 0.08, (bay + wide) / 2 + 0.08, spots.width)
    ledge = ledge * _within(y, sill - 0.10, sill, spots.width) * ~shop
    colour = _lerp(colour, np.float32(0.5) * np.ones_like(wall), ledge)
    colour = _lerp(colour, np.float32(0.55) * wall, 1 - smoothstep(0.55, 0.62, up))
    colour = _lerp(colour, np.minimum(1.25 * wall, 0.8), _within(top - up, 0.0, 0.35, spots.width))
    lid = (spots.axis == 2).astype(np.float32)
    colour = _lerp(colour, np.float32(0.16) * (1 + rough)[:, None] * np.ones_like(wall), lid)
    return colour, (0.9 * window * pane * (1 - lid)).astype(np.float32)


def _wall(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    right, up = spots.face_coordinates()
    course = np.floor(up / 0.20)
    joint = np.maximum(
        _within(up % 0.20, 0, 0.015, spots.width), _within((right + 0.2 * (course % 2)) % 0.40, 0, 0.015, spots.width)
    )
    stain = fractal_noise(np.stack((right + 51 * spots.seed, up), -1), 1.2, seed + 10)
    tone = (
        (1 - 0.4 * joint * _resolvable_fraction(0.08, spots.width))
        * (1 + 0.10 * stain)
        * (0.75 + 0.25 * smoothstep(0.0, 0.5, up))
    )
    return spots.rgb * tone[:, None], np.zeros(len(up), np.float32)


def _foliage(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    """Leaves of many greens, darker within: what a ray meets deep in a crown lies in the shade of what is before it."""
    flat = spots.local[:, :2] + 0.7 * spots.local[:, 2:3] * np.array([1.0, -0.6], np.float32) + 29 * spots.seed[:, None]
    tone = (
        1
        + 0.22 * fractal_noise(flat, 0.8, seed + 11)
        + 0.22 * fractal_noise(flat, 0.16, seed + 12) * _resolvable_fraction(0.08, spots.width)
    )
    depth = np.sqrt(((spots.local / np.maximum(spots.half, 1e-3)) ** 2).sum(1))
    tone = tone * (0.55 + 0.45 * smoothstep(0.45, 1.0, depth))
    return spots.rgb * np.clip(tone, 0.2, 2)[:, None], np.zeros(len(tone), np.float32)


def _bark(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    around = np.arctan2(spots.local[:, 1], spots.local[:, 0])
    ridge = fractal_noise(np.stack((around * 0.8 + 9 * spots.seed, spots.local[:, 2] * 0.25), -1), 0.3, seed + 13)
    return spots.rgb * np.clip(1 + 0.35 * ridge, 0.3, 2)[:, None], np.zeros(len(around), np.float32)


def _plate(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    """Return a sign's front: a white disc or bar on the colour, or a coloured rim on white; grey behind."""
    del seed
    right, up = spots.face_coordinates()
    up = up - spots.half[:, 2]
    reach = np.hypot(right, up)
    disc = _within(reach, -1.0, 0.19, spots.width)
    bar = _within(np.abs(right), -1.0, 0.06, spots.width) * _within(np.abs(up), -1.0, 0.2, spots.width)
    white = np.where(_draw(spots.seed, 1) < 0.5, disc, bar)
    edge = np.maximum(np.abs(right), np.abs(up))
    white = np.maximum(white, _within(edge, 0.26, 0.285, spots.width))
    front = _lerp(spots.rgb, np.float32(0.8) * np.ones_like(spots.rgb), white.astype(np.float32))
    grey = np.float32(0.3) * np.ones_like(front)
    return np.where((spots.side > 0)[:, None], grey, front), np.full(len(up), 0.1, np.float32)


def _signal(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    """Three lamps that are not lit: the simulator's traffic lights are not asked."""
    del seed
    right, up = spots.face_coordinates()
    lamp = np.clip(np.floor(up / 0.3), 0, 2).astype(np.int64)
    colours = np.array([[0.02, 0.12, 0.06], [0.20, 0.12, 0.02], [0.20, 0.02, 0.02]], np.float32)
    disc = _within(np.hypot(right, up - 0.15 - 0.3 * lamp), -1.0, 0.1, spots.width) * (spots.axis != 2)
    return _lerp(spots.rgb, colours[lamp], disc.astype(np.float32)), (0.3 * disc).astype(np.float32)


def _at(spots: SolidPoints) -> tuple[Real, Real, Real]:
    """Where the points are in their vehicle: metres ahead of its middle, to the left of it, and above the road."""
    place = spots.local + spots.anchor
    return place[:, 0], place[:, 1], place[:, 2]


def _paintwork(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    """Lacquer with wheels, doors, lamps, plates and dark bumpers; windows where a van or a cab has them."""
    x, y, z = _at(spots)
    length, wide, high = spots.size.T
    flank, front, back = spots.axis == 1, (spots.axis == 0) & (spots.side > 0), (spots.axis == 0) & (spots.side < 0)
    soft = spots.width
    colour, gloss = spots.rgb.copy(), np.full(len(x), 0.8, np.float32)
    dirt = 0.06 * fractal_noise(np.stack((x + 31 * spots.seed, z + y), -1), 1.0, seed + 14)
    colour = colour * (1 + dirt)[:, None] * (0.8 + 0.2 * smoothstep(0.25, 0.6, z))[:, None]
    large = length > 5.15
    seam = sum(_within(np.abs(x - at * length), -1.0, 0.007, soft) for at in (0.17, -0.06, -0.27))
    colour = _lerp(
        colour, np.float32(0.25) * colour, (flank * np.clip(seam, 0, 1) * (z < 0.62 * high)).astype(np.float32)
    )
    # A high body is a van's, a cab's or a bus's: glass above the middle, where people sit.
    tall = high > 1.95
    cab = tall & (spots.size[:, 0] < 6.2) & (spots.half[:, 2] > 0.35 * high)
    panes = _within(x, 0.10 * length, 0.28 * length, soft) * flank * cab
    panes = panes + _within(np.abs(y), 0.03, 0.42 * wide, soft) * back * cab
    lorry = tall & (length >= 6.2) & (length < 10) & (spots.half[:, 2] < 0.42 * high)
    panes = panes + _within(length / 2 - x, 0.25, 1.3, soft) * flank * lorry
    panes = panes + _within(np.abs(y), -1.0, 0.43 * wide, soft) * front * lorry
    above = np.where(lorry, 0.46, 0.52)
    glass = np.clip(panes, 0, 1) * _within(z, above * high, np.where(lorry, 0.68, 0.86) * high, soft)
    colour = _lerp(colour, np.broadcast_to(_GLASS, colour.shape), glass.astype(np.float32))
    gloss = np.maximum(gloss, glass).astype(np.float32)
    low = np.where(large & tall, 0.75, 0.66)
    lamp = _within(np.abs(y), 0.29 * wide, 0.46 * wide, soft) * _within(z, low - 0.12, low + 0.05, soft)
    # A cab's back is not the lorry's.
    front, back = front & (x > 0.4 * length), back & (x < -0.4 * length)
    colour = _lerp(colour, np.array([0.85, 0.85, 0.80], np.float32), lamp * front)
    tail = _within(np.abs(y), 0.36 * wide, 0.47 * wide, soft) * _within(z, low - 0.10, low + 0.12, soft)
    colour = _lerp(colour, np.array([0.50, 0.015, 0.01], np.float32), tail * back)
    grille = _within(np.abs(y), -1.0, 0.22 * wide, soft) * _within(z, low - 0.16, low + 0.02, soft) * front
    colour = _lerp(colour, np.float32(0.03) * np.ones_like(colour), grille)
    bumper = np.maximum(_within(z, -1.0, 0.36, soft) * (front | back), _within(z, -1.0, 0.30, soft) * flank)
    colour = _lerp(colour, np.float32(0.045) * np.ones_like(colour), bumper.astype(np.float32))
    plate = _within(np.abs(y), -1.0, 0.26, soft) * _within(z, 0.38, 0.49, soft) * (front | back)
    colour = _lerp(colour, np.float32(0.7) * np.ones_like(colour), plate.astype(np.float32))
    gloss = gloss * (1 - np.clip(bumper + plate + grille, 0, 1))
    return _wheels(colour, gloss.astype(np.float32), spots, x, z, flank)


def _wheels(
    colour: Real, gloss: Real, spots: SolidPoints, x: Real, z: Real, flank: NDArray[np.bool_]
) -> tuple[Real, Real]:
    """Wheels in their arches on the flanks: a dark gap, the tyre, a bright rim with a dark hub."""
    radius = spots.axles[:, 3]
    for k in range(3):
        reach = np.hypot(np.clip(x - spots.axles[:, k], -9, 9), z - radius)
        soft = spots.width
        for size, tone in ((1.16, 0.008), (1.0, 0.022), (0.64, 0.30), (0.52, 0.09), (0.16, 0.25)):
            disc = (flank * _within(reach, -1.0, size * radius, soft)).astype(np.float32)
            colour, gloss = _lerp(colour, np.float32(tone) * np.ones_like(colour), disc), gloss * (1 - disc)
    return colour, gloss


def _tyre(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    """Return an axle's box: its wheels on the flanks, dark underneath the vehicle about them."""
    del seed
    x, _, z = _at(spots)
    return _wheels(0.4 * spots.rgb, np.zeros(len(x), np.float32), spots, x, z, spots.axis == 1)


def _shade_cabin(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    """Return a cabin: windows between pillars under a painted roof."""
    del seed
    x, y, z = _at(spots)
    length, _, high = spots.size.T
    soft = spots.width
    bus = length > 9
    top = spots.anchor[:, 2] + spots.half[:, 2]
    low = np.where(bus, spots.anchor[:, 2] - spots.half[:, 2] + 0.08, 0.60 * high)
    band = _within(z, low, top - np.where(bus, 0.12, 0.075), soft)
    first = spots.anchor[:, 0] - spots.half[:, 0]
    long = 2 * spots.half[:, 0]
    pitch = np.where(bus, 1.45, long / 2)
    pillar = np.where(bus, 0.05, 0.045)
    in_bay = (x - first) % pitch
    sides = (
        _within(in_bay, pillar, pitch - pillar, soft) * _within(x - first, 0.10, long - 0.12, soft) * (spots.axis == 1)
    )
    ends = _within(np.abs(y), -1.0, spots.half[:, 1] - 0.09, soft) * (spots.axis == 0)
    glass = (band * (sides + ends)).astype(np.float32)
    colour = _lerp(spots.rgb, np.broadcast_to(_GLASS, spots.rgb.shape), glass)
    return colour, np.maximum(0.8, glass).astype(np.float32)


def _glass(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    del seed
    return np.broadcast_to(_GLASS, spots.rgb.shape).astype(np.float32), np.ones(len(spots.rgb), np.float32)


def _tarpaulin(spots: SolidPoints, seed: int) -> tuple[Real, Real]:
    """Folds, a pale stripe of a haulier's name, red lamps low at the back."""
    x, y, z = _at(spots)
    right, _ = spots.face_coordinates()
    fold = 0.5 + 0.5 * np.cos(right * (2 * np.pi / 0.55))
    tone = (
        1
        - 0.10 * fold * _resolvable_fraction(0.3, spots.width)
        + 0.05 * fractal_noise(np.stack((right + 17 * spots.seed, z), -1), 1.5, seed + 15)
    )
    colour = spots.rgb * tone[:, None]
    stripe = _within(z / spots.size[:, 2], 0.62, 0.74, spots.width / spots.size[:, 2]) * (spots.axis != 2)
    stripe = stripe * (np.abs(right) < 0.6 * np.where(spots.axis == 1, spots.half[:, 0], spots.half[:, 1]))
    colour = _lerp(colour, np.float32(0.7) * np.ones_like(colour), stripe.astype(np.float32))
    lamp = _within(np.abs(y), 0.36 * spots.size[:, 1], 0.48 * spots.size[:, 1], spots.width)
    lamp = lamp * _within(z, 0.95, 1.15, spots.width) * ((spots.axis == 0) & (spots.side < 0))
    return _lerp(colour, np.array([0.5, 0.015, 0.01], np.float32), lamp.astype(np.float32)), np.full(
        len(x), 0.1, np.float32
    )
