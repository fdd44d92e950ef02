# SPDX-License-Identifier: Apache-2.0
"""Relief of a scene: hills, the crown of the roads, kerbs and uneven ground beside them, added to the heights of the map.

The relief is a function of the place alone, so that whatever stands on the ground takes its height from one raster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.raycast import HeightField
from manyeyes.simulator.scene.directions import direction
from manyeyes.simulator.scene.placement import PlacementGrid, distance_transform
from manyeyes.simulator.scene.vehicles import VehicleStates

Array = NDArray[np.float64]

_NUM_WAVES = 6
# Wheels stand at 0.3 lengths before and behind the middle, and 0.4 widths beside it.
_AXLE, _TRACK = 0.3, 0.4


@dataclass(frozen=True)
class TerrainSpec:
    """Relief of a scene; each range is drawn uniformly for a scene.

    grade: root mean square of the hills' slope. tilt: slope of the whole scene. wavelength_m: of the hills. cross_slope: of
    the road from its middle to its edges, over at most crown_reach_m. kerb_m: height of what is not carriageway above it.
    bank_m: height of the land from 4 m behind the pavement on. roughness_m: amplitude of uneven ground off the pavement.
    """

    grade: tuple[float, float] = (0.0, 0.03)
    tilt: tuple[float, float] = (0.0, 0.03)
    wavelength_m: tuple[float, float] = (120.0, 400.0)
    cross_slope: tuple[float, float] = (0.005, 0.03)
    crown_reach_m: float = 5.0
    kerb_m: tuple[float, float] = (0.0, 0.15)
    bank_m: tuple[float, float] = (-0.5, 0.9)
    roughness_m: tuple[float, float] = (0.0, 0.08)

    def __post_init__(self) -> None:
        if not (0 <= self.grade[0] <= self.grade[1] <= 0.1 and 0 <= self.tilt[0] <= self.tilt[1] <= 0.1):
            raise ConfigError(f"TerrainSpec needs slopes within 0 … 0.1 in order; got {self.grade} and {self.tilt}.")
        if self.wavelength_m[0] < 40.0 or self.wavelength_m[0] > self.wavelength_m[1]:
            raise ConfigError(f"TerrainSpec needs wavelengths of 40 m and more in order; got {self.wavelength_m}.")


@dataclass(frozen=True)
class _Waves:
    """Sum of plane waves: amplitude (W,) metres, wave vectors (W, 2) rad/m, phase (W,)."""

    amplitude: Array
    vector: Array
    phase: Array

    @classmethod
    def draw(cls, random: np.random.Generator, wavelength_m: tuple[float, float]) -> _Waves:
        """Waves in all directions whose slopes have the same size; their root mean square slope is 1."""
        length = np.exp(random.uniform(math.log(wavelength_m[0]), math.log(wavelength_m[1]), _NUM_WAVES))
        angle, number = random.uniform(0, 2 * np.pi, _NUM_WAVES), 2 * np.pi / length
        vector = np.stack((np.cos(angle), np.sin(angle)), -1) * number[:, None]
        return cls(math.sqrt(2 / _NUM_WAVES) / number, vector, random.uniform(0, 2 * np.pi, _NUM_WAVES))

    def at(self, x: Array, y: Array) -> Array:
        """Return heights (len(y), len(x)) on a lattice, metres."""
        total = np.zeros((len(y), len(x)))
        for a, (kx, ky), phase in zip(self.amplitude, self.vector, self.phase):
            wave = np.exp(1j * (ky * y + phase))[:, None] * np.exp(1j * kx * x)[None]
            total += a * wave.imag
        return total


def add_terrain(field: HeightField, spec: TerrainSpec, middle: Array, key: tuple[int | str, ...]) -> HeightField:
    """Return the ground with relief; the height at middle (2,) keeps the hills' zero."""
    random = keyed_generator(*key, "terrain")
    grade, tilt, heading = random.uniform(*spec.grade), random.uniform(*spec.tilt), random.uniform(0, 2 * np.pi)
    x = field.x_min + field.cell * np.arange(field.height.shape[1]) - middle[0]
    y = field.y_min + field.cell * np.arange(field.height.shape[0]) - middle[1]
    hills = _Waves.draw(random, spec.wavelength_m)
    relief = grade * (hills.at(x, y) - hills.at(np.zeros(1), np.zeros(1)))
    relief += tilt * (math.cos(heading) * x[None] + math.sin(heading) * y[:, None])
    relief += _cross_section(field, spec, random, x, y)
    return replace(field, height=(field.height + relief).astype(np.float32))


def _cross_section(field: HeightField, spec: TerrainSpec, random: np.random.Generator, x: Array, y: Array) -> Array:
    """Return crown, kerb, bank and roughness at the nodes, from the distance to the road's edge on either side of it."""
    cross, kerb, bank = random.uniform(*spec.cross_slope), random.uniform(*spec.kerb_m), random.uniform(*spec.bank_m)
    plot = PlacementGrid.of(field)
    inside_m = distance_transform(plot.distance_to_road_m > 0) * plot.cell
    crown = cross * np.minimum(inside_m, spec.crown_reach_m)
    step = kerb * np.clip(plot.distance_to_road_m / 0.5, 0, 1)
    away = np.clip((plot.distance_to_pavement_m - 0.5) / 3.5, 0, 1)
    away = away * away * (3 - 2 * away)
    profile = _at_nodes(crown + step + bank * away, field.height.shape)
    uneven = _Waves.draw(random, (4.0, 15.0)).at(x, y)
    uneven *= random.uniform(*spec.roughness_m) / max(float(np.abs(uneven).max()), 1e-9)
    return profile + uneven * _at_nodes(away, field.height.shape)


def _at_nodes(cells: Array, shape: tuple[int, ...]) -> Array:
    """Return means of the up to four cells around each node (rows, columns)."""
    padded = np.pad(cells, 1, mode="edge")
    nodes = (padded[:-1, :-1] + padded[:-1, 1:] + padded[1:, :-1] + padded[1:, 1:]) / 4
    grow = [(0, max(0, n - m)) for n, m in zip(shape, nodes.shape)]
    return np.pad(nodes, grow, mode="edge")[: shape[0], : shape[1]]


def height_at(field: HeightField, xy: Array) -> Array:
    """Return bilinear heights of the ground at points (..., 2), metres."""
    rows, columns = field.height.shape
    u = np.clip((xy[..., 0] - field.x_min) / field.cell, 0, columns - 1.001)
    v = np.clip((xy[..., 1] - field.y_min) / field.cell, 0, rows - 1.001)
    j, i = u.astype(np.int64), v.astype(np.int64)
    u, v, h = u - j, v - i, field.height.astype(np.float64)
    return (h[i, j] * (1 - u) + h[i, j + 1] * u) * (1 - v) + (h[i + 1, j] * (1 - u) + h[i + 1, j + 1] * u) * v


def wheel_points(states: VehicleStates) -> Array:
    """Return (N, 4, 2) where wheels stand: front left, front right, rear right, rear left."""
    unit = np.array([[_AXLE, _TRACK], [_AXLE, -_TRACK], [-_AXLE, -_TRACK], [-_AXLE, _TRACK]])
    local = unit * states.size[:, None, :2]
    c, s = np.cos(states.yaw)[:, None], np.sin(states.yaw)[:, None]
    turned = np.stack((local[..., 0] * c - local[..., 1] * s, local[..., 0] * s + local[..., 1] * c), -1)
    return turned + states.position[:, None, :2]


def stand_on_ground(states: VehicleStates, field: HeightField) -> VehicleStates:
    """Return the vehicles with the height, pitch and roll of the plane through their four wheels (least squares)."""
    if not len(states):
        return states
    wheel = height_at(field, wheel_points(states))
    ahead = (wheel[:, 0] + wheel[:, 1] - wheel[:, 2] - wheel[:, 3]) / 2
    left = (wheel[:, 0] + wheel[:, 3] - wheel[:, 1] - wheel[:, 2]) / 2
    pitch = -direction(ahead, 2 * _AXLE * states.size[:, 0])
    roll = direction(left, 2 * _TRACK * states.size[:, 1])
    position = np.concatenate((states.position[:, :2], wheel.mean(1, keepdims=True)), 1)
    return replace(states, position=position, pitch=pitch, roll=roll)
