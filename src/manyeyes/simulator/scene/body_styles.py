# SPDX-License-Identifier: Apache-2.0
"""Bodies of the styles in :data:`~manyeyes.simulator.scene.vehicle_market.WORLD_MARKET`: five to twelve boxes each.

At most three parts of a body are axles, which is what cameras draw wheels of; further wheels are part of the chassis.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.simulator.scene.vehicle_market import VehicleMarket
from manyeyes.simulator.scene.vehicle_shapes import (
    BODYWORK,
    CABIN,
    CARGO,
    CHASSIS,
    GLASS,
    TARPAULIN,
    WINDSCREEN,
    Part,
    VehicleShape,
    axle,
    make_shape,
    make_vehicle_shape,
)

Array = NDArray[np.float64]


def make_market_shape(
    market: VehicleMarket, label: str, size: tuple[float, float, float], seed: int, id: int
) -> VehicleShape:
    """Return the body of one vehicle of a market by its label and size (l, w, h); the style that fits, drawn by (seed, id)."""
    style = market.style_of(label, size, seed, id)
    return make_vehicle_shape(label, size, seed, id) if style == label else make_styled_shape(style, size, seed, id)


def make_styled_shape(style: str, size: tuple[float, float, float], seed: int, id: int) -> VehicleShape:
    """Return the body of one vehicle of a style and size (l, w, h); proportions and paint vary with (seed, id)."""
    if style not in _STYLES:
        raise ConfigError(f"No body of style '{style}'; choose one of {', '.join(_STYLES)}.")
    return make_shape(_STYLES[style], size, seed, id)


def _box(
    x: tuple[float, float], half_width: float, z: tuple[float, float], reflectivity: float, part: int = BODYWORK
) -> Part:
    return (x[0], -half_width, z[0]), (x[1], half_width, z[1]), reflectivity, part


def _cabin(rear: float, front: float, z: tuple[float, float], rake: tuple[float, float], paint: float) -> list[Part]:
    """Windows and roof in three steps. rear, front: x of the lowest; rake: how far the highest lies inside, behind and ahead."""
    glazed, third = 0.5 * paint + 0.5 * GLASS, (z[1] - z[0]) / 3
    steps = []
    for k in range(3):
        f = k / 2
        x = rear + f * rake[0], front - f * rake[1]
        bright = paint if k == 2 else glazed
        steps.append(_box(x, 0.46 - 0.04 * f, (z[0] + k * third, z[0] + (k + 1) * third), bright, CABIN))
    return steps


def _passenger(
    paint: float, vary: Array, belt: float, nose: float, rear: float, boot: float, rake: tuple[float, float]
) -> list[Part]:
    """A car: lower body, bonnet, cabin in steps, boot and wheels. nose: length of the bonnet; rear: of what is behind the cabin."""
    sill, wheel = 0.14 + 0.02 * vary[0], 0.40 + 0.02 * vary[1]
    front, back = 0.5 - nose, -0.5 + rear
    parts = [
        _box((-0.5, 0.485), 0.5, (sill, belt - 0.14), paint),
        _box((0.47, 0.5), 0.42, (sill + 0.06, belt - 0.2), 0.6 * paint),
        _box((front, 0.46), 0.45, (belt - 0.14, belt - 0.03 + 0.02 * vary[2]), paint),
        *_cabin(back, front + 0.04, (belt - 0.14, 1.0), rake, paint),
        axle(0.31, 0.075, wheel),
        axle(-0.29, 0.075, wheel),
    ]
    if rear > 0.02:
        parts.append(_box((-0.49, back), 0.46, (belt - 0.14, boot), paint))
    return parts


def _kei(paint: float, vary: Array) -> list[Part]:
    return _passenger(paint, vary, 0.56, 0.14 + 0.03 * vary[3], 0.0, 0.5, (0.02, 0.10))


def _hatchback(paint: float, vary: Array) -> list[Part]:
    return _passenger(paint, vary, 0.60, 0.24 + 0.03 * vary[3], 0.01, 0.6, (0.10, 0.17 + 0.03 * vary[4]))


def _sedan(paint: float, vary: Array) -> list[Part]:
    return _passenger(
        paint, vary, 0.62 + 0.02 * vary[5], 0.28 + 0.03 * vary[3], 0.16 + 0.03 * vary[4], 0.68, (0.12, 0.17)
    )


def _estate(paint: float, vary: Array) -> list[Part]:
    return _passenger(paint, vary, 0.60, 0.27 + 0.03 * vary[3], 0.0, 0.6, (0.06, 0.16 + 0.02 * vary[4]))


def _suv(paint: float, vary: Array) -> list[Part]:
    return _passenger(
        paint, vary, 0.62 + 0.02 * vary[5], 0.24 + 0.03 * vary[3], 0.0, 0.6, (0.05 + 0.03 * vary[4], 0.12)
    )


def _minivan(paint: float, vary: Array) -> list[Part]:
    return _passenger(paint, vary, 0.56, 0.16 + 0.03 * vary[3], 0.0, 0.6, (0.03, 0.18))


def _pickup(paint: float, vary: Array) -> list[Part]:
    front, back = 0.24 + 0.02 * vary[0], -0.08 - 0.06 * vary[1]
    belt, floor = 0.60, 0.42
    return [
        _box((-0.5, 0.49), 0.48, (0.2, floor), paint),
        _box((front - 0.02, 0.47), 0.46, (floor, belt), paint),
        *_cabin(back, front, (floor, 1.0), (0.03, 0.10), paint),
        ((-0.5, -0.49, floor), (back, -0.43, belt), paint, BODYWORK),
        ((-0.5, 0.43, floor), (back, 0.49, belt), paint, BODYWORK),
        _box((-0.5, -0.47), 0.45, (floor, belt), paint),
        axle(0.32, 0.07, 0.42),
        axle(-0.30, 0.07, 0.42),
    ]


def _panel_van(paint: float, vary: Array) -> list[Part]:
    nose = 0.32 + 0.04 * vary[0]
    return [
        _box((-0.5, nose - 0.08), 0.5, (0.13, 1.0), paint),
        _box((nose - 0.08, nose), 0.49, (0.13, 0.92), paint, CABIN),
        _box((nose, nose + 0.08), 0.47, (0.13, 0.74), GLASS, WINDSCREEN),
        _box((nose + 0.08, 0.5), 0.47, (0.13, 0.50 + 0.05 * vary[1]), paint),
        axle(0.31, 0.06, 0.32),
        axle(-0.30, 0.06, 0.32),
    ]


def _box_truck(paint: float, vary: Array) -> list[Part]:
    cab = 0.27 + 0.04 * vary[0]
    return [
        _box((cab, 0.5), 0.48, (0.14, 0.68 + 0.08 * vary[1]), paint),
        _box((cab, 0.40), 0.44, (0.68 + 0.08 * vary[1], 0.85), paint),
        _box((-0.5, cab - 0.03), 0.5, (0.30, 1.0), TARPAULIN + 0.2 * vary[2], CARGO),
        _box((-0.47, cab), 0.30, (0.18, 0.30), 0.1, CHASSIS),
        axle(0.37, 0.055, 0.28),
        axle(-0.30, 0.07, 0.28),
    ]


def _flatbed(paint: float, vary: Array) -> list[Part]:
    cab = 0.24 + 0.04 * vary[0]
    load = 0.62 + 0.12 * vary[1]
    return [
        _box((cab, 0.5), 0.48, (0.14, 1.0), paint),
        _box((-0.5, cab - 0.03), 0.5, (0.36, 0.44), 0.3, CARGO),
        _box((-0.44 + 0.06 * vary[2], 0.05 + 0.08 * vary[3]), 0.40, (0.44, load), 0.4 + 0.2 * vary[4], CARGO),
        _box((cab - 0.05, cab - 0.03), 0.5, (0.44, 0.72), 0.3, CARGO),
        _box((-0.47, cab), 0.30, (0.20, 0.36), 0.1, CHASSIS),
        axle(0.36, 0.06, 0.36),
        axle(-0.28, 0.08, 0.36),
    ]


def _semi_trailer(paint: float, vary: Array) -> list[Part]:
    """A tractor and its trailer in line."""
    cab, gap = 0.37 + 0.015 * vary[0], 0.345
    return [
        _box((cab, 0.5), 0.49, (0.12, 0.82 + 0.1 * vary[1]), paint),
        _box((cab, cab + 0.06), 0.45, (0.82, 0.96), paint),
        _box((-0.5, gap), 0.5, (0.30, 1.0), TARPAULIN + 0.25 * vary[2], CARGO),
        _box((0.20, cab), 0.28, (0.14, 0.28), 0.1, CHASSIS),
        _box((-0.46, 0.10), 0.42, (0.18, 0.30), 0.1, CHASSIS),
        axle(0.43, 0.032, 0.26),
        axle(0.24, 0.045, 0.26),
        axle(-0.32, 0.12, 0.26),
    ]


def _minibus(paint: float, vary: Array) -> list[Part]:
    nose = 0.38 + 0.03 * vary[0]
    return [
        _box((-0.5, nose), 0.5, (0.13, 0.46), paint),
        _box((-0.495, nose - 0.02), 0.47, (0.46, 1.0), 0.5 * paint + 0.5 * GLASS, CABIN),
        _box((nose, 0.5), 0.47, (0.13, 0.45 + 0.04 * vary[1]), paint),
        _box((nose - 0.02, nose + 0.05), 0.44, (0.46, 0.80), GLASS, WINDSCREEN),
        axle(0.32, 0.055, 0.28),
        axle(-0.28, 0.06, 0.28),
    ]


def _bus(paint: float, vary: Array) -> list[Part]:
    floor, window = 0.10 + 0.02 * vary[0], 0.42 + 0.04 * vary[1]
    return [
        _box((-0.5, 0.5), 0.5, (floor, window), paint),
        _box((-0.498, 0.495), 0.49, (window, 0.90), 0.4 * paint + 0.6 * GLASS, CABIN),
        _box((-0.40, 0.35 + 0.05 * vary[2]), 0.44, (0.90, 1.0), paint),
        axle(0.28, 0.045, 0.25),
        axle(-0.27, 0.045, 0.25),
    ]


def _articulated_bus(paint: float, vary: Array) -> list[Part]:
    """Two sections in line and the bellows between them."""
    floor, window, joint = 0.10, 0.42 + 0.03 * vary[0], -0.06 + 0.03 * vary[1]
    glazed = 0.4 * paint + 0.6 * GLASS
    parts = []
    for x in ((-0.5, joint - 0.03), (joint + 0.03, 0.5)):
        parts += [
            _box(x, 0.5, (floor, window), paint),
            _box(x, 0.49, (window, 0.90), glazed, CABIN),
            _box((x[0] + 0.02, x[1] - 0.04), 0.44, (0.90, 1.0), paint),
        ]
    return [
        *parts,
        _box((joint - 0.03, joint + 0.03), 0.45, (floor + 0.04, 0.94), 0.08, CHASSIS),
        axle(0.36, 0.03, 0.26),
        axle(0.04, 0.03, 0.26),
        axle(-0.34, 0.03, 0.26),
    ]


_STYLES: dict[str, Callable[[float, Array], list[Part]]] = {
    "kei": _kei,
    "hatchback": _hatchback,
    "sedan": _sedan,
    "estate": _estate,
    "suv": _suv,
    "minivan": _minivan,
    "pickup": _pickup,
    "panel-van": _panel_van,
    "box-truck": _box_truck,
    "flatbed": _flatbed,
    "semi-trailer": _semi_trailer,
    "minibus": _minibus,
    "bus": _bus,
    "articulated-bus": _articulated_bus,
}
