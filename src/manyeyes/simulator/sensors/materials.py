# SPDX-License-Identifier: Apache-2.0
"""What the solids of a scene are made of, for cameras: a range sensor needs no more than their shape and reflectivity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.raycast import BOX, CYLINDER, Primitives
from manyeyes.simulator.scene.vehicle_shapes import BODYWORK, CABIN, CARGO, CHASSIS, TYRE, WINDSCREEN, VehicleShape
from manyeyes.simulator.scene.vehicles import VehicleStates

FACADE, WALL, HEDGE, METAL, BARK, LEAVES, PLATE, SIGNAL = range(8)
PAINTWORK, GLAZED, GLASS, RUBBER, TARPAULIN, STEEL = range(8, 14)

_OF_PART = {BODYWORK: PAINTWORK, CABIN: GLAZED, WINDSCREEN: GLASS, TYRE: RUBBER, CARGO: TARPAULIN, CHASSIS: STEEL}

# Albedos, linear light. Chosen: plaster, sandstone, brick and concrete; lacquers by how much near infrared they return.
_PLASTER = ((0.62, 0.58, 0.48), (0.55, 0.50, 0.42), (0.38, 0.17, 0.11), (0.30, 0.15, 0.11), (0.45, 0.45, 0.44),
            (0.66, 0.52, 0.33), (0.50, 0.53, 0.56), (0.33, 0.30, 0.27))  # fmt: skip
_DARK = ((0.02, 0.02, 0.025), (0.02, 0.03, 0.10), (0.05, 0.055, 0.06), (0.10, 0.015, 0.02), (0.02, 0.06, 0.04))
_MIDDLE = ((0.35, 0.36, 0.37), (0.18, 0.19, 0.20), (0.38, 0.03, 0.03), (0.05, 0.13, 0.36), (0.30, 0.27, 0.22))
_BRIGHT = ((0.72, 0.72, 0.71), (0.60, 0.61, 0.62), (0.75, 0.73, 0.66), (0.62, 0.42, 0.05), (0.70, 0.70, 0.72))
_PLATES = ((0.03, 0.10, 0.45), (0.60, 0.04, 0.04), (0.75, 0.55, 0.03), (0.75, 0.75, 0.75))
_COVERS = ((0.60, 0.60, 0.58), (0.08, 0.16, 0.35), (0.40, 0.07, 0.06), (0.10, 0.28, 0.16), (0.62, 0.50, 0.15))


@dataclass(frozen=True, eq=False)
class Materials:
    """Of N primitives, in their order.

    material: (N,) uint8, FACADE … STEEL. rgb: (N, 3) float32 albedo. seed: (N,) float32 in [0, 1), one of each object.
    anchor: (N, 3) metres, the primitive's centre in its object's frame, and size: (N, 3) that object's length, width and
    height (of what is not a vehicle: zero, and twice its half). axles: (N, 4) metres, up to three x of axles in the object's
    frame (inf: none) and the radius of their wheels.
    """

    material: NDArray[np.uint8]
    rgb: NDArray[np.float32]
    seed: NDArray[np.float32]
    anchor: NDArray[np.float32]
    size: NDArray[np.float32]
    axles: NDArray[np.float32]

    @classmethod
    def cat(cls, many: list[Materials]) -> Materials:
        """Return several sets as one; at least one set."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in many]) for f in fields(cls)))


def make_static_materials(solids: Primitives, seed: int) -> Materials:
    """Materials of roadside objects, by the shapes that simulator/scene/roadside_objects.py builds."""
    n, half = len(solids), solids.half
    material = np.full(n, LEAVES, np.uint8)
    round_ = solids.kind == CYLINDER
    material[round_] = np.where(solids.reflectivity[round_] < 0.3, BARK, METAL)
    box = solids.kind == BOX
    thin = np.minimum(half[:, 0], half[:, 1])
    material[box] = FACADE
    material[box & (thin < 0.5)] = HEDGE
    material[box & (thin < 0.2)] = WALL
    small = box & (half.max(1) < 0.5)
    material[small] = np.where(solids.reflectivity[small] > 0.5, PLATE, SIGNAL)
    random = keyed_generator(seed, "look")
    unit = random.random((n, 5))
    rgb = np.zeros((n, 3))
    shade = 0.85 + 0.3 * unit[:, 1:2]
    for code, palette in ((FACADE, _PLASTER), (WALL, _PLASTER[2:6]), (PLATE, _PLATES)):
        rgb[material == code] = (np.array(palette)[(unit[:, 0] * len(palette)).astype(int)] * shade)[material == code]
    plain = {
        HEDGE: (0.05, 0.10, 0.03),
        METAL: (0.22, 0.23, 0.24),
        BARK: (0.11, 0.08, 0.055),
        SIGNAL: (0.02, 0.02, 0.02),
    }
    for code, colour in plain.items():
        rgb[material == code] = (colour * shade)[material == code]
    autumn = np.clip(unit[:, 2:3] * 1.6 - 0.9, 0, 1)
    leaf = (1 - autumn) * np.array([0.075, 0.14, 0.035]) + autumn * np.array([0.22, 0.15, 0.03])
    rgb[material == LEAVES] = (leaf * shade)[material == LEAVES]
    return Materials(
        material, rgb.astype(np.float32), unit[:, 4].astype(np.float32), np.zeros((n, 3), np.float32),
        (2 * half).astype(np.float32), np.full((n, 4), np.inf, np.float32),
    )  # fmt: skip


def make_vehicle_materials(states: VehicleStates, shapes: Mapping[int, VehicleShape], seed: int) -> Materials:
    """Of the vehicles' solids, in the order of bodies.place_bodies; colours vary with (seed, id)."""
    parts = [_one_vehicle(shapes[id], size, seed, id) for id, size in zip(states.id.tolist(), states.size)]
    nothing = np.zeros((0, 3), np.float32)
    none = Materials(np.zeros(0, np.uint8), nothing, nothing[:, 0], nothing, nothing, np.zeros((0, 4), np.float32))
    return Materials.cat([none, *parts])


def _one_vehicle(shape: VehicleShape, size: NDArray[np.float64], seed: int, id: int) -> Materials:
    n = len(shape.part)
    random = keyed_generator(seed, "look", id)
    lacquer = float(shape.reflectivity[0])
    palette = _DARK if lacquer < 0.25 else _MIDDLE if lacquer < 0.6 else _BRIGHT
    paint, cover = palette[int(random.integers(len(palette)))], _COVERS[int(random.integers(len(_COVERS)))]
    material = np.array([_OF_PART[part] for part in shape.part.tolist()], np.uint8)
    rgb = np.tile(np.array(paint, np.float32), (n, 1))
    rgb[material == RUBBER], rgb[material == STEEL], rgb[material == TARPAULIN] = 0.02, 0.04, cover
    axles = np.full(4, np.inf, np.float32)
    tyres = np.flatnonzero(shape.part == TYRE)
    axles[: len(tyres)] = shape.center[tyres, 0]
    axles[3] = shape.half[tyres[0], 2] if len(tyres) else 0.0
    return Materials(
        material, rgb, np.full(n, random.random(), np.float32), shape.center.astype(np.float32),
        np.tile(size.astype(np.float32), (n, 1)), np.tile(axles, (n, 1)),
    )  # fmt: skip
