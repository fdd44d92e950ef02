# SPDX-License-Identifier: Apache-2.0
"""Which vehicles drive and park in a scene, and how large they are: body styles with ranges of sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import VEHICLE_LABELS, ConfigError
from manyeyes.ops.keyed_random import keyed_generator

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BodyStyle:
    """One style of body: its label in VEHICLE_LABELS, its shares of driving and parked vehicles, and its size.

    low, high: length, width and height in metres.
    """

    name: str
    label: str
    driving_fraction: float
    parked_fraction: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        if self.label not in VEHICLE_LABELS or not all(a <= b for a, b in zip(self.low, self.high)):
            raise ConfigError(f"BodyStyle needs a label in {', '.join(VEHICLE_LABELS)} and low <= high; got {self}.")


@dataclass(frozen=True)
class VehicleMarket:
    """Styles on the roads of a scene; the fractions of each kind of use add up to 1."""

    name: str
    styles: tuple[BodyStyle, ...]

    def __post_init__(self) -> None:
        for use in ("driving_fraction", "parked_fraction"):
            total = sum(getattr(style, use) for style in self.styles)
            if abs(total - 1) > 1e-9:
                raise ConfigError(f"VehicleMarket '{self.name}' needs values of {use} that add up to 1; got {total}.")

    def style_of(self, label: str, size: tuple[float, float, float], seed: int, id: int) -> str:
        """Return the style of one vehicle by its label and size; drawn by (seed, id) where several styles have that size."""
        fits = [
            style
            for style in self.styles
            if style.label == label and all(a - 1e-6 <= s <= b + 1e-6 for a, s, b in zip(style.low, size, style.high))
        ]
        if not fits:
            raise ConfigError(f"No style of market '{self.name}' for a {label} of size {size}.")
        weight = np.array([style.driving_fraction + style.parked_fraction for style in fits])
        return fits[int(keyed_generator(seed, "style", id).choice(len(fits), p=weight / weight.sum()))].name


# What drives in European cities; one style a label.
CLASSIC_MARKET = VehicleMarket(
    "classic",
    (
        BodyStyle("car", "car", 0.78, 0.86, (3.6, 1.7, 1.35), (5.1, 2.0, 1.8)),
        BodyStyle("van", "van", 0.10, 0.12, (5.2, 1.95, 2.0), (6.0, 2.05, 2.6)),
        BodyStyle("truck", "truck", 0.07, 0.02, (6.5, 2.3, 2.8), (10.0, 2.55, 3.6)),
        BodyStyle("bus", "bus", 0.05, 0.0, (10.0, 2.5, 3.0), (12.5, 2.55, 3.3)),
    ),
)

# Chosen: outer sizes of production vehicles from Japan's kei class to North America's pickups and articulated buses.
WORLD_MARKET = VehicleMarket(
    "world",
    (
        BodyStyle("kei", "car", 0.06, 0.07, (3.3, 1.45, 1.45), (3.45, 1.5, 1.95)),
        BodyStyle("hatchback", "car", 0.17, 0.21, (3.5, 1.62, 1.42), (4.4, 1.83, 1.58)),
        BodyStyle("sedan", "car", 0.18, 0.19, (4.4, 1.75, 1.38), (5.2, 1.95, 1.54)),
        BodyStyle("estate", "car", 0.07, 0.08, (4.4, 1.75, 1.42), (5.0, 1.9, 1.6)),
        BodyStyle("suv", "car", 0.18, 0.20, (4.1, 1.78, 1.58), (5.2, 2.05, 1.95)),
        BodyStyle("minivan", "car", 0.04, 0.05, (4.3, 1.75, 1.65), (5.2, 2.0, 1.98)),
        BodyStyle("pickup", "car", 0.07, 0.07, (5.1, 1.85, 1.75), (6.3, 2.1, 2.05)),
        BodyStyle("panel-van", "van", 0.08, 0.08, (4.7, 1.9, 1.9), (6.9, 2.1, 2.8)),
        BodyStyle("box-truck", "truck", 0.04, 0.03, (6.0, 2.2, 2.8), (10.5, 2.55, 3.8)),
        BodyStyle("flatbed", "truck", 0.02, 0.01, (6.0, 2.2, 2.4), (9.5, 2.5, 2.8)),
        BodyStyle("semi-trailer", "truck", 0.02, 0.0, (13.5, 2.5, 3.5), (16.8, 2.6, 4.0)),
        BodyStyle("minibus", "bus", 0.02, 0.01, (6.0, 2.1, 2.5), (8.0, 2.3, 2.9)),
        BodyStyle("bus", "bus", 0.04, 0.0, (9.0, 2.45, 2.9), (13.0, 2.55, 3.4)),
        BodyStyle("articulated-bus", "bus", 0.01, 0.0, (17.5, 2.5, 3.0), (18.2, 2.55, 3.3)),
    ),
)


def draw_vehicles(
    random: np.random.Generator,
    count: int,
    market: VehicleMarket = CLASSIC_MARKET,
    use: Literal["driving", "parked"] = "driving",
    max_length_m: float = float("inf"),
) -> tuple[NDArray[np.int64], Array]:
    """Return kinds (N,), indices into VEHICLE_LABELS, and sizes (N, 3); long vehicles tend to be wide ones.

    max_length_m: only of styles whose shortest vehicle is shorter; lengths are cut there.
    """
    styles = market.styles
    fraction = np.array([getattr(style, f"{use}_fraction") for style in styles])
    low, high = np.array([style.low for style in styles]), np.array([style.high for style in styles])
    fraction = np.where(low[:, 0] < max_length_m, fraction, 0.0)
    style = random.choice(len(styles), count, p=fraction / fraction.sum()).astype(np.int64)
    unit = random.random((count, 3))
    unit[:, 1] = (unit[:, 0] + unit[:, 1]) / 2
    size = low[style] + unit * (high - low)[style]
    size[:, 0] = np.minimum(size[:, 0], max_length_m)
    return np.array([VEHICLE_LABELS.index(s.label) for s in styles], np.int64)[style], size


__all__ = ["CLASSIC_MARKET", "WORLD_MARKET", "BodyStyle", "VehicleMarket", "draw_vehicles"]
