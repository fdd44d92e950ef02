# SPDX-License-Identifier: Apache-2.0
"""Configuration of a fleet and of its map models' errors, with named presets."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from manyeyes.datatypes import ConfigError

DAY_NS = 86_400_000_000_000


@dataclass(frozen=True)
class CrowdConfig:
    """Observation noise of map models, and the behaviour of a fleet.

    Lengths are in metres, angles in radians, fractions and rates in [0, 1]; pairs are (min, max). range_x_m, range_y_m: the view in
    the agent's frame. spacing_m: distance between two observations of a drive. model: name of the map model in the observations.
    """

    range_x_m: tuple[float, float] = (-30.0, 30.0)
    range_y_m: tuple[float, float] = (-15.0, 15.0)
    spacing_m: tuple[float, float] = (30.0, 60.0)
    # At most so many observations of one drive are sent.
    max_observations_per_drive: int = 4
    drives_per_agent: int = 1
    points_per_element: int = 20
    model: str = "simulated-local"
    # Errors of the prior pose; its covariance states them correctly, except for outliers and malicious agents.
    pose_sigma_m: float = 0.4
    yaw_sigma_rad: float = math.radians(0.5)
    # Fraction of the pose variance that is one common error of the whole drive.
    drive_error_fraction: float = 0.5
    # Mean rate; it grows with the distance, from half of this to one and a half times.
    miss_rate: float = 0.20
    # False elements per true stretch in view.
    false_positive_rate: float = 0.15
    # A line is split in two.
    fragment_rate: float = 0.25
    # An element has another class.
    confusion_rate: float = 0.02
    # Noise of each point, at zero distance and per metre of distance.
    point_sigma_m: float = 0.12
    point_sigma_per_m: float = 0.004
    # Lines are bent sideways and shortened at their ends; both are standard deviations.
    lateral_bend_m: float = 0.15
    endpoint_truncation_m: float = 0.5
    # A divider has another style.
    style_error_rate: float = 0.15
    # Mean number of nearby vehicles that occlude, at most 3.
    occluders: float = 1.0
    # Agents whose poses are wrong by outlier_offset_m.
    outlier_fraction: float = 0.05
    outlier_offset_m: tuple[float, float] = (2.0, 4.0)
    # Agents that displace observed elements of malicious_kinds by malicious_offset_m.
    malicious_fraction: float = 0.0
    malicious_offset_m: tuple[float, float] = (1.0, 4.0)
    # Displacements: drawn per agent, or the same for all malicious agents.
    attack_mode: Literal["independent", "colluding"] = "independent"
    malicious_kinds: tuple[str, ...] = ("divider", "boundary", "crossing", "stop_line")
    # Agents that observe the initial map, whatever has changed since.
    outdated_fraction: float = 0.0
    # Drives that are surveyed roadside units with exact poses, and how far they see.
    infrastructure_fraction: float = 0.0
    infrastructure_range_m: float = 50.0
    # Drives along recorded trajectories, where the place has any.
    recorded_drive_fraction: float = 0.25
    start_ns: int = 1_760_000_000_000_000_000
    # Time between the starts of two drives; vehicles move at 10 m/s.
    drive_interval_s: float = 6 * 3600.0

    def __post_init__(self) -> None:
        for name in (
            "drive_error_fraction",
            "miss_rate",
            "false_positive_rate",
            "fragment_rate",
            "confusion_rate",
            "style_error_rate",
        ):
            self._require(0.0 <= getattr(self, name) <= 1.0, name, "a rate in [0, 1]")
        for name in (
            "outlier_fraction",
            "malicious_fraction",
            "outdated_fraction",
            "infrastructure_fraction",
            "recorded_drive_fraction",
        ):
            self._require(0.0 <= getattr(self, name) <= 1.0, name, "a fraction in [0, 1]")
        for name in (
            "pose_sigma_m",
            "yaw_sigma_rad",
            "point_sigma_m",
            "point_sigma_per_m",
            "lateral_bend_m",
            "endpoint_truncation_m",
            "drive_interval_s",
        ):
            self._require(0.0 <= getattr(self, name) < math.inf, name, "a number of at least 0")
        for name in ("range_x_m", "range_y_m", "spacing_m", "outlier_offset_m", "malicious_offset_m"):
            low, high = getattr(self, name)
            self._require(low <= high, name, "(min, max)")
        self._require(self.range_x_m[0] < self.range_x_m[1], "range_x_m", "a view wider than 0")
        self._require(self.range_y_m[0] < self.range_y_m[1], "range_y_m", "a view wider than 0")
        self._require(self.spacing_m[0] > 0, "spacing_m", "more than 0")
        self._require(0.0 <= self.occluders <= 3.0, "occluders", "a mean in [0, 3]")
        self._require(
            self.max_observations_per_drive >= 1 and self.drives_per_agent >= 1,
            "max_observations_per_drive",
            "1 or more",
        )
        self._require(3 <= self.points_per_element <= 64, "points_per_element", "3 to 64")
        self._require(self.attack_mode in ("independent", "colluding"), "attack_mode", "independent or colluding")

    def _require(self, holds: bool, name: str, expected: str) -> None:
        if not holds:
            raise ConfigError(f"CrowdConfig.{name}: expected {expected}; got {getattr(self, name)!r}.")


_LOCAL = CrowdConfig()
# Tiles fused from ten observations each: wider, fewer misses, no occlusion by single vehicles.
_SEMI_GLOBAL = CrowdConfig(
    range_x_m=(-60.0, 60.0),
    range_y_m=(-30.0, 30.0),
    spacing_m=(60.0, 120.0),
    points_per_element=40,
    model="simulated-semi-global",
    miss_rate=0.12,
    false_positive_rate=0.10,
    fragment_rate=0.20,
    occluders=0.0,
)

CROWDS: dict[str, CrowdConfig] = {
    "local": _LOCAL,
    "semi-global": _SEMI_GLOBAL,
    "perfect": replace(
        _LOCAL,
        model="simulated-perfect",
        pose_sigma_m=0.0,
        yaw_sigma_rad=0.0,
        miss_rate=0.0,
        false_positive_rate=0.0,
        fragment_rate=0.0,
        confusion_rate=0.0,
        point_sigma_m=0.0,
        point_sigma_per_m=0.0,
        lateral_bend_m=0.0,
        endpoint_truncation_m=0.0,
        style_error_rate=0.0,
        occluders=0.0,
        outlier_fraction=0.0,
    ),
    "independent-malicious": replace(_LOCAL, malicious_fraction=0.2),
    "colluding-malicious": replace(_LOCAL, malicious_fraction=0.2, attack_mode="colluding"),
    "outdated": replace(_LOCAL, outdated_fraction=0.2),
    "with-infrastructure": replace(_LOCAL, infrastructure_fraction=0.1),
}


def crowd_config(name: str) -> CrowdConfig:
    """Return the preset of that name; ConfigError lists the known names."""
    if name not in CROWDS:
        raise ConfigError(f"Unknown crowd '{name}'; known: {', '.join(CROWDS)}.")
    return CROWDS[name]
