# SPDX-License-Identifier: Apache-2.0
"""How a crowd drives and errs, with named presets."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from manyeyes.datatypes import ConfigError

DAY_NS = 86_400_000_000_000


@dataclass(frozen=True)
class CrowdConfig:
    """Errors of map models and habits of a fleet. Lengths in metres, angles in radians, shares and rates in [0, 1].

    Looks: range_x, range_y bound the view in the agent's frame; an agent looks every spacing metres of a drive, and sends at
    most per_pass looks of one drive. points_per_element: of an observed element. model: what the observations say made them.
    Poses: pose_sigma, yaw_sigma are the claimed pose's errors, of which the share pass_share (of variance) is one error for the
    whole pass. The claimed covariance tells the truth about both, but of outliers and liars, who claim what honest ones claim.
    Elements: drop_out grows with distance (half to one and a half times); false_positive per true stretch in view; fragment
    splits a line in two; confusion says another class; point and point_per_m are noise of each point at and with distance; bow
    bends a line sideways; end shortens it; style_error says another style.
    Occlusion: occluders vehicles stand near on average, up to three.
    Fleet: outlier_share of agents have poses wrong by outlier_offset; malicious_share move what they saw of malicious_kinds by
    malicious_offset, each agent its own way (independent) or all the same way (colluding); stale_share see the world as it was
    at the start. pole_share of passes are surveyed roadside poles, which see pole_range.
    Time: passes begin every pass_interval_s; looks follow at 10 m/s.
    """

    range_x_m: tuple[float, float] = (-30.0, 30.0)
    range_y_m: tuple[float, float] = (-15.0, 15.0)
    spacing_m: tuple[float, float] = (30.0, 60.0)
    max_observations_per_drive: int = 4
    drives_per_agent: int = 1
    points_per_element: int = 20
    model: str = "simulated-local"
    pose_sigma_m: float = 0.4
    yaw_sigma_rad: float = math.radians(0.5)
    drive_error_fraction: float = 0.5
    miss_rate: float = 0.20
    false_positive_rate: float = 0.15
    fragment_rate: float = 0.25
    confusion_rate: float = 0.02
    point_sigma_m: float = 0.12
    point_sigma_per_m: float = 0.004
    lateral_bend_m: float = 0.15
    endpoint_truncation_m: float = 0.5
    style_error_rate: float = 0.15
    occluders: float = 1.0
    outlier_fraction: float = 0.05
    outlier_offset_m: tuple[float, float] = (2.0, 4.0)
    malicious_fraction: float = 0.0
    malicious_offset_m: tuple[float, float] = (1.0, 4.0)
    attack_mode: Literal["independent", "colluding"] = "independent"
    malicious_kinds: tuple[str, ...] = ("divider", "boundary", "crossing", "stop_line")
    outdated_fraction: float = 0.0
    infrastructure_fraction: float = 0.0
    infrastructure_range_m: float = 50.0
    recorded_drive_fraction: float = 0.25
    start_ns: int = 1_760_000_000_000_000_000
    drive_interval_s: float = 6 * 3600.0

    def __post_init__(self) -> None:
        for name in ("pass_share", "drop_out", "false_positive", "fragment", "confusion", "style_error"):
            self._require(0.0 <= getattr(self, name) <= 1.0, name, "a rate in [0, 1]")
        for name in ("outlier_share", "malicious_share", "stale_share", "pole_share", "log_share"):
            self._require(0.0 <= getattr(self, name) <= 1.0, name, "a share in [0, 1]")
        for name in ("pose_sigma", "yaw_sigma", "point", "point_per_m", "bow", "end", "pass_interval_s"):
            self._require(0.0 <= getattr(self, name) < math.inf, name, "a number of at least 0")
        for name in ("range_x", "range_y", "spacing", "outlier_offset", "malicious_offset"):
            low, high = getattr(self, name)
            self._require(low <= high, name, "(least, most)")
        self._require(self.range_x_m[0] < self.range_x_m[1], "range_x", "a view wider than 0")
        self._require(self.range_y_m[0] < self.range_y_m[1], "range_y", "a view wider than 0")
        self._require(self.spacing_m[0] > 0, "spacing", "more than 0")
        self._require(0.0 <= self.occluders <= 3.0, "occluders", "a mean in [0, 3]")
        self._require(self.max_observations_per_drive >= 1 and self.drives_per_agent >= 1, "per_pass", "1 or more")
        self._require(3 <= self.points_per_element <= 64, "points", "3 to 64")
        self._require(self.attack_mode in ("independent", "colluding"), "malicious", "independent or colluding")

    def _require(self, holds: bool, name: str, expected: str) -> None:
        if not holds:
            raise ConfigError(f"CrowdConfig.{name}: expected {expected}; got {getattr(self, name)!r}.")


_LOCAL = CrowdConfig()
# A second stage fed by tiles that ten looks made together: wider, fewer holes, no shadows of single vehicles.
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
        yaw_sigma=0.0,
        drop_out=0.0,
        false_positive=0.0,
        fragment=0.0,
        confusion=0.0,
        point=0.0,
        point_per_m=0.0,
        bow=0.0,
        end=0.0,
        style_error=0.0,
        occluders=0.0,
        outlier_share=0.0,
    ),
    "independent-liars": replace(_LOCAL, malicious_share=0.2),
    "colluding-liars": replace(_LOCAL, malicious_share=0.2, malicious="colluding"),
    "stale": replace(_LOCAL, stale_share=0.2),
    "with-poles": replace(_LOCAL, pole_share=0.1),
}


def crowd_config(name: str) -> CrowdConfig:
    """A preset by name; ConfigError lists the known ones."""
    if name not in CROWDS:
        raise ConfigError(f"Unknown crowd '{name}'; known: {', '.join(CROWDS)}.")
    return CROWDS[name]
