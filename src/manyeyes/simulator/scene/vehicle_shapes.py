# SPDX-License-Identifier: Apache-2.0
"""Shapes of vehicles: three to six boxes each, all within the vehicle's own box."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import VEHICLE_LABELS, ConfigError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.raycast import BOX, Primitives

Array = NDArray[np.float64]

BODYWORK, CABIN, WINDSCREEN, TYRE, CARGO, CHASSIS = range(6)
RUBBER, GLASS, TARPAULIN = 0.06, 0.12, 0.45

# A part is (low corner, high corner, reflectivity, what it is) in fractions of length, width (-0.5 … 0.5) and height (0 … 1).
Part = tuple[tuple[float, float, float], tuple[float, float, float], float, int]


@dataclass(frozen=True)
class VehicleShape:
    """Boxes in the vehicle's frame (x forward, y left, origin on the road under its middle).

    center and half: (P, 3) metres; reflectivity: (P,); part: (P,) uint8, BODYWORK … CHASSIS (a CABIN has windows all around).
    """

    center: Array
    half: Array
    reflectivity: Array
    part: NDArray[np.uint8]


def make_vehicle_shape(kind: str, size: tuple[float, float, float], seed: int, id: int) -> VehicleShape:
    """Return the body of one vehicle of a kind in VEHICLE_LABELS and size (l, w, h); proportions and paint vary with (seed, id)."""
    if kind not in VEHICLE_LABELS:
        raise ConfigError(f"No body for a vehicle of kind '{kind}'; choose one of {', '.join(VEHICLE_LABELS)}.")
    return make_shape({"car": _car, "van": _van, "truck": _truck, "bus": _bus}[kind], size, seed, id)


def make_shape(
    parts_of: Callable[[float, Array], list[Part]], size: tuple[float, float, float], seed: int, id: int
) -> VehicleShape:
    """Return the body of one vehicle. parts_of: from the paint's reflectivity and six values in -1 … 1, its parts."""
    random = keyed_generator(seed, "body", id)
    paint = float(random.choice([0.12, 0.3, 0.5, 0.7, 0.85])) * float(random.uniform(0.85, 1.1))
    vary = random.uniform(-1, 1, 6)
    parts = parts_of(paint, vary)
    low, high = np.array([p[0] for p in parts]), np.array([p[1] for p in parts])
    scale = np.array(size)
    bright, part = np.array([min(p[2], 0.95) for p in parts]), np.array([p[3] for p in parts], np.uint8)
    return VehicleShape((low + high) / 2 * scale, (high - low) / 2 * scale, bright, part)


def axle(x: float, half_length: float, top: float) -> Part:
    """Return the wheels of an axle as one box."""
    return (x - half_length, -0.48, 0.0), (x + half_length, 0.48, top), RUBBER, TYRE


def _car(paint: float, vary: Array) -> list[Part]:
    sill, hood = 0.17 + 0.02 * vary[0], 0.56 + 0.03 * vary[1]
    front, back = 0.16 + 0.04 * vary[2], -0.30 - 0.08 * vary[3]
    boot = min(hood + 0.06 + 0.04 * vary[4], 0.7)
    return [
        ((-0.5, -0.5, sill), (0.5, 0.5, hood - 0.12), paint, BODYWORK),
        ((front, -0.46, hood - 0.12), (0.47, 0.46, hood), paint, BODYWORK),
        ((back, -0.43, hood - 0.12), (front, 0.43, 1.0), 0.5 * paint + 0.5 * GLASS, CABIN),
        ((-0.49, -0.46, hood - 0.12), (back, 0.46, boot), paint, BODYWORK),
        axle(0.31, 0.07, 0.42),
        axle(-0.29, 0.07, 0.42),
    ]


def _van(paint: float, vary: Array) -> list[Part]:
    nose = 0.30 + 0.05 * vary[0]
    return [
        ((-0.5, -0.5, 0.14), (nose, 0.5, 1.0), paint, BODYWORK),
        ((nose, -0.48, 0.14), (0.5, 0.48, 0.55 + 0.05 * vary[1]), paint, BODYWORK),
        ((nose, -0.45, 0.5), (nose + 0.09, 0.45, 0.86), GLASS, WINDSCREEN),
        axle(0.31, 0.06, 0.32),
        axle(-0.30, 0.06, 0.32),
    ]


def _truck(paint: float, vary: Array) -> list[Part]:
    cab = 0.27 + 0.04 * vary[0]
    return [
        ((cab, -0.48, 0.14), (0.5, 0.48, 0.72 + 0.08 * vary[1]), paint, BODYWORK),
        ((-0.5, -0.5, 0.30), (cab - 0.03, 0.5, 1.0), TARPAULIN + 0.2 * vary[2], CARGO),
        ((-0.47, -0.30, 0.18), (cab, 0.30, 0.30), 0.1, CHASSIS),
        axle(0.37, 0.055, 0.28),
        axle(-0.28, 0.055, 0.28),
        axle(-0.40, 0.055, 0.28),
    ]


def _bus(paint: float, vary: Array) -> list[Part]:
    floor, window = 0.10 + 0.02 * vary[0], 0.42 + 0.04 * vary[1]
    return [
        ((-0.5, -0.5, floor), (0.5, 0.5, window), paint, BODYWORK),
        ((-0.498, -0.49, window), (0.495, 0.49, 0.90), 0.4 * paint + 0.6 * GLASS, CABIN),
        ((-0.40, -0.44, 0.90), (0.35 + 0.05 * vary[2], 0.44, 1.0), paint, BODYWORK),
        axle(0.28, 0.045, 0.25),
        axle(-0.27, 0.045, 0.25),
    ]


def rotation_from_yaw_pitch(yaw: Array, pitch: Array, roll: Array | None = None) -> Array:
    """Return (N, 3, 3) world_from_vehicle: Rz(yaw) Ry(pitch) Rx(roll) as Transform.from_rpy has it: uphill is negative.

    roll: None for vehicles without one.
    """
    c, s, cp, sp, zero = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.zeros_like(yaw)
    rows = ((c * cp, -s, c * sp), (s * cp, c, s * sp), (-sp, zero, cp))
    rotation = np.stack([np.stack(row, -1) for row in rows], -2)
    if roll is None or not roll.any():
        return rotation
    cr, sr, one = np.cos(roll), np.sin(roll), np.ones_like(roll)
    rows = ((one, zero, zero), (zero, cr, -sr), (zero, sr, cr))
    return rotation @ np.stack([np.stack(row, -1) for row in rows], -2)


def place_vehicle_shapes(
    shapes: list[VehicleShape],
    position: Array,
    yaw: Array,
    pitch: Array,
    ids: NDArray[np.int64],
    roll: Array | None = None,
) -> Primitives:
    """Return bodies at positions (N, 3) on the road as solids in the world; instance is the vehicle's id."""
    if not shapes:
        return Primitives.empty()
    counts = np.array([len(b.center) for b in shapes])
    which = np.repeat(np.arange(len(shapes)), counts)
    rotation = rotation_from_yaw_pitch(yaw, pitch, roll)[which]
    local = np.concatenate([b.center for b in shapes])
    center = position[which] + (rotation @ local[..., None])[..., 0]
    return Primitives(
        np.full(len(which), BOX, np.uint8),
        center,
        rotation,
        np.concatenate([b.half for b in shapes]),
        np.zeros(len(which)),
        ids[which],
        np.concatenate([b.reflectivity for b in shapes]),
    )


def box_centers(position: Array, yaw: Array, pitch: Array, height: Array, roll: Array | None = None) -> Array:
    """Return (N, 3) centres of vehicles' boxes: half a height above the road, along the vehicle's own upright axis."""
    return position + rotation_from_yaw_pitch(yaw, pitch, roll)[:, :, 2] * (height / 2)[:, None]
