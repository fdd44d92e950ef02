# SPDX-License-Identifier: Apache-2.0
"""Sun, sky, clouds and haze of a scene, drawn by a seed; how light becomes a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.sensors.fractal_noise import fractal_noise

Array = NDArray[np.float64]
Colour = NDArray[np.floating]

_ZENITH, _HORIZON, _OVERCAST = (
    np.array(c, np.float32) for c in ((0.16, 0.32, 0.75), (0.66, 0.76, 0.88), (0.70, 0.73, 0.76))
)
_SUN_HIGH, _SUN_LOW = np.array([1.0, 0.95, 0.86], np.float32), np.array([1.0, 0.72, 0.45], np.float32)


@dataclass(frozen=True, eq=False)
class Light:
    """sun: (3,) unit vector towards it. sun_rgb, zenith_rgb, horizon_rgb: (3,) float32 linear, in units of exposure.

    cloud: share of the sky, 0 … 1. haze: 1/m. wear: of the road and its paint, 0 … 1. seed: of clouds and textures.
    """

    sun: Array
    sun_rgb: Colour
    zenith_rgb: Colour
    horizon_rgb: Colour
    cloud: float
    haze: float
    wear: float
    seed: int

    def ambient(self, normal: NDArray[np.floating]) -> Colour:
        """Light from sky and ground on faces of normals (N, 3): hemispheres above and below, mixed by how steep the face is."""
        up = (0.5 + 0.5 * normal[:, 2:3]).astype(np.float32)
        sky = 0.45 * self.zenith_rgb + 0.55 * self.horizon_rgb
        ground = 0.16 * (sky + self.sun_rgb * np.float32(self.sun[2]))
        return up * sky + (1 - up) * ground

    def clear_sky_radiance(self, direction: NDArray[np.floating]) -> Colour:
        """Radiance from unit directions (N, 3), without clouds and without what stands on the horizon."""
        up = np.clip(direction[:, 2:3], 0, 1)
        glow = np.clip(dot(direction, self.sun), 0, 1)[:, None] ** 24
        blue = 1 - (1 - up) ** 3.2
        return self.horizon_rgb * (1 - blue) + self.zenith_rgb * blue + (0.35 * (1 - self.cloud)) * glow * self.sun_rgb

    def sky_radiance(self, direction: NDArray[np.floating]) -> Colour:
        """What is seen beyond everything: sky with clouds, and hazy woods and roofs along the horizon."""
        up = np.maximum(direction[:, 2], 0.02)
        flat = direction[:, :2] / (up + 0.12)[:, None]
        puff = 0.8 * fractal_noise(flat, 1.1, self.seed) + 0.4 * fractal_noise(flat, 0.4, self.seed + 1)
        cover = _smoothstep(1.0 - 2.6 * self.cloud, 2.2 - 2.2 * self.cloud, puff) * _smoothstep(
            0.0, 0.12, direction[:, 2]
        )
        bright = 0.55 * self.horizon_rgb + 0.30 * self.sun_rgb + 0.12 * np.float32(1.0)
        white = bright * (0.92 - 0.12 * np.clip(puff, 0, 2))[:, None]
        colour = self.clear_sky_radiance(direction)
        colour = colour + (cover * 0.9)[:, None] * (white - colour)
        turn = np.arctan2(direction[:, 1], direction[:, 0])
        around = np.stack((np.cos(turn), np.sin(turn)), -1)
        woods = (
            0.022
            + 0.008 * fractal_noise(around, 0.25, self.seed + 2)
            + 0.003 * fractal_noise(around, 0.02, self.seed + 3)
        )
        roofs = np.floor(turn * 40 / math.pi)
        roofs = 0.012 + 0.055 * ((np.sin(roofs * 127.1 + self.seed % 89) * 43758.5) % 1.0) ** 3
        rise = direction[:, 2] / np.hypot(direction[:, 0], direction[:, 1])
        grey = 0.62 * self.horizon_rgb + 0.38 * 0.12
        green = 0.55 * self.horizon_rgb + 0.45 * np.array([0.07, 0.11, 0.06], np.float32)
        colour = np.where((rise < roofs)[:, None], grey, colour)
        return np.where((rise < woods)[:, None], green, colour).astype(np.float32)

    def apply_haze(self, radiance: Colour, distance: NDArray[np.floating]) -> Colour:
        """Radiance (N, 3) after so many metres (N,) of haze."""
        clear = np.exp(-self.haze * distance)[:, None].astype(np.float32)
        return radiance * clear + self.horizon_rgb * (1 - clear)


def draw_light(*key: int | str) -> Light:
    """Daylight between clear and overcast, the sun 18 to 62 degrees up, worn or fresh paint; chosen ranges."""
    random = keyed_generator(*key, "light")
    azimuth, elevation = random.uniform(-math.pi, math.pi), math.radians(random.uniform(18, 62))
    cloud = float(random.choice([0.15, 0.3, 0.45, 0.6, 0.95]) * random.uniform(0.8, 1.0))
    sun = np.array(
        [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    high = np.float32(min(1.0, math.sin(elevation) / 0.6))
    veil = np.float32(max(0.0, (cloud - 0.6) / 0.4))
    sun_rgb = 2.6 * (1 - 0.93 * veil) * (high * _SUN_HIGH + (1 - high) * _SUN_LOW)
    zenith = (1 - veil) * _ZENITH + veil * _OVERCAST * np.float32(0.85)
    horizon = (1 - veil) * _HORIZON + veil * _OVERCAST
    haze, wear = float(random.uniform(0.0008, 0.0035)), float(random.uniform(0.05, 0.95))
    return Light(sun, sun_rgb, zenith, horizon, cloud, haze, wear, int(random.integers(2**31)))


def tone_map(radiance: Colour) -> NDArray[np.floating]:
    """Linear radiance to sRGB values in [0, 1]: a film's curve, then gamma. Source: Narkowicz, ACES filmic tone curve, 2015."""
    x = np.maximum(radiance, 0) * np.float32(0.6)
    toned = (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14)
    return np.clip(toned, 0, 1).astype(np.float32) ** np.float32(1 / 2.2)


def dot(vectors: NDArray[np.floating], axis: Array) -> NDArray[np.floating]:
    """Return (N,) products of vectors (N, 3) with one: no matrix product, for its last bit can depend on the number of
    threads.
    """
    x, y, z = axis.astype(np.float32)
    return (vectors[:, 0] * x + vectors[:, 1] * y + vectors[:, 2] * z).astype(np.float32)


def _smoothstep(low: float, high: float, value: NDArray[np.floating]) -> NDArray[np.floating]:
    """0 below low, 1 above high, a cubic between."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)
