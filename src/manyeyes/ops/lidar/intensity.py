# SPDX-License-Identifier: Apache-2.0
"""Intensity laws: how a LiDAR maps reflectivity and range of a return to the number that it stores.

Recordings differ in this law more than in anything else. CARLA attenuates by range alone; real sensors measure reflectivity, with a
gain, a curve and a quantisation of their own, or store a constant. Reflectivity here is that of the material times the loss by
incidence, in [0, 1], as the simulator computes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import ConfigError, PointCloud
from manyeyes.ops.keyed_random import keyed_generator, keyed_uniform

ATTENUATION_PER_M = 0.004
"""CARLA's attenuation: intensity falls by exp(-0.004 r), r in metres; clouds of OPV2V and V2XSet carry it."""
MAX_BEAM_GAIN_CHANGE = 0.2
"""Maximum deviation of a beam's gain from 1."""
BEAM_STEP_RAD = 0.007
"""Returns whose elevations differ by less share a gain of the per-beam law; about the spacing of 64 beams."""

IntensityKind = Literal[
    "material", "carla", "constant", "zero", "low-gain-8bit", "gain-gamma", "per-beam-gain", "shuffled", "noise"
]
INTENSITY_KINDS: tuple[IntensityKind, ...] = get_args(IntensityKind)


@dataclass(frozen=True)
class IntensityLaw:
    """One law, with its constants.

    Attributes:
        kind: material: reflectivity times attenuation. carla: attenuation alone. constant: floor. zero: 0. low-gain-8bit: material
            times gain, rounded to multiples of 1 / 255. gain-gamma: floor + gain * material ** gamma, at most 1.
            per-beam-gain: material times a gain of the beam. shuffled: material, permuted among the returns. noise: uniform draws.
        gain: factor of the material intensity.
        gamma: exponent of the material intensity.
        floor: lowest intensity.
    """

    kind: IntensityKind = "material"
    gain: float = 1.0
    gamma: float = 1.0
    floor: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in INTENSITY_KINDS:
            raise ConfigError(f"No intensity law {self.kind!r}; choose one of {', '.join(INTENSITY_KINDS)}.")
        if not (self.gain >= 0 and self.gamma > 0 and 0 <= self.floor <= 1):
            raise ConfigError(f"IntensityLaw needs gain >= 0, gamma > 0 and floor in [0, 1]; got {self}.")


INTENSITY_LAWS: dict[str, IntensityLaw] = {
    "material": IntensityLaw(),
    "carla": IntensityLaw("carla"),
    "constant": IntensityLaw("constant", floor=0.3),
    "zero": IntensityLaw("zero"),
    "low-gain-8bit": IntensityLaw("low-gain-8bit", gain=0.03),
    "gain-gamma": IntensityLaw("gain-gamma", gain=0.8, gamma=0.5, floor=0.05),
    "per-beam-gain": IntensityLaw("per-beam-gain"),
    "shuffled": IntensityLaw("shuffled"),
    "noise": IntensityLaw("noise"),
}
"""Laws by name, with the constants that evaluation uses. low-gain-8bit: as in Argoverse 2, whose vehicles have 2 to 3 of 255."""


def compute_intensity(
    law: IntensityLaw, reflectivity: Tensor, range_m: Tensor, elevation_rad: Tensor, key: tuple[int | str, ...] = ()
) -> Tensor:
    """Compute the stored intensity of returns.

    Args:
        law: the sensor's law.
        reflectivity: (N,) of material and incidence, in [0, 1].
        range_m: (N,) from the sensor.
        elevation_rad: (N,) of the beam, by which the per-beam law distinguishes beams.
        key: of random draws; equal keys give equal gains of beams, permutations and noise.

    Returns:
        (N,) float32 in [0, 1].
    """
    # In float64, rounded at the end: in float32, exponentials and powers of torch differ in the last bit between processors, and
    # recordings would too.
    attenuation = torch.exp(-ATTENUATION_PER_M * range_m.double())
    material = reflectivity * attenuation
    if law.kind == "material":
        stored = material
    elif law.kind == "carla":
        stored = attenuation
    elif law.kind in ("constant", "zero"):
        stored = torch.full_like(material, law.floor if law.kind == "constant" else 0.0)
    elif law.kind == "low-gain-8bit":
        stored = (material * law.gain * 255).round() / 255
    elif law.kind == "gain-gamma":
        stored = law.floor + law.gain * material.clamp_min(0) ** law.gamma
    elif law.kind == "per-beam-gain":
        stored = material * _beam_gains(elevation_rad, key)
    elif law.kind == "shuffled":
        order = torch.from_numpy(keyed_generator("shuffled-intensity", *key).permutation(len(material)))
        stored = material[order.to(material.device)]
    else:
        draws = keyed_generator("noise-intensity", *key).random(len(material), np.float32)
        stored = torch.from_numpy(draws).to(material.device)
    return stored.clamp(0.0, 1.0).to(torch.float32)


def _beam_gains(elevation_rad: Tensor, key: tuple[int | str, ...]) -> Tensor:
    """Draw a gain (N,) for each interval of elevations."""
    count = int(np.pi / BEAM_STEP_RAD) + 1
    row = ((elevation_rad + np.pi / 2) / BEAM_STEP_RAD).long().clamp(0, count - 1)
    gains = 1 + MAX_BEAM_GAIN_CHANGE * (2 * keyed_uniform((count,), "beam-gains", *key) - 1)
    return gains.to(elevation_rad)[row]


def change_intensity_law(
    points: PointCloud, law: IntensityLaw, sensor_height_m: float, key: tuple[int | str, ...] = ()
) -> PointCloud:
    """Return the cloud as a sensor of this law stores it.

    Args:
        points: in the agent's frame, whose sensor is sensor_height_m above the origin; with material intensity, not quantised.
        law: the new law.
        sensor_height_m: height of the sensor above the origin.
        key: of random draws (:func:`compute_intensity`).
    """
    if law.kind == "material":
        return points
    x, y, z = points.xyz.unbind(1)
    ground_range = torch.hypot(x, y)
    range_m = torch.hypot(ground_range, z - sensor_height_m)
    reflectivity = points.intensity * torch.exp(ATTENUATION_PER_M * range_m.double())
    elevation = torch.atan2(z - sensor_height_m, ground_range)
    return PointCloud(points.xyz, compute_intensity(law, reflectivity, range_m, elevation, key), points.time_s)
