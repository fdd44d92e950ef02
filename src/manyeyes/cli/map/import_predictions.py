# SPDX-License-Identifier: Apache-2.0
"""Turns a result file of MapTR or StreamMapNet, with the poses of its samples, into observations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from manyeyes._bounds import Fraction, LatitudeDeg, LongitudeDeg, OffsetM, OutputFolder
from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class Options:
    """What is read, and what the file does not say."""

    results: tyro.conf.Positional[Path]
    """nuscmap_results.json of MapTR, or submission_vector.json of StreamMapNet; recognised by their layout."""
    poses: Path | None = None
    """A CSV with token, agent, pass_id, time_ns, x, y, yaw and, if known, sigma_x, sigma_y, sigma_yaw."""
    origin: tuple[LatitudeDeg, LongitudeDeg] | None = None
    """Latitude and longitude, degrees, of the point that is x = y = 0 of the CSV's poses."""
    nuscenes: Path | None = None
    """Instead of a CSV: the folder of nuScenes' tables (with sample_data.json)."""
    location: str = "boston-seaport"
    """Which of nuScenes' locations; a map has one frame."""
    axes: Literal["vehicle", "lidar"] = "vehicle"
    """Of the points: vehicle (x forward, y left) or lidar (x right, y forward: MapTR on nuScenes)."""
    range_x: tuple[OffsetM, OffsetM] = (-30.0, 30.0)
    """The model's view ahead of the vehicle, metres."""
    range_y: tuple[OffsetM, OffsetM] = (-15.0, 15.0)
    """The model's view to the left of the vehicle, metres."""
    min_score: Fraction = 0.1
    """Elements below this score are left out."""
    model: str = "imported"
    """What the observations say made them."""
    out: OutputFolder = Path("out/map/imported")
    """Folder for the observations; 'map fuse' takes it."""


def main(options: Options) -> None:
    """Convert result files of map models to observations."""
    from rich.console import Console

    from manyeyes.maps.elements.observation import MapFrame
    from manyeyes.maps.formats.model_results import (
        ModelResultOptions,
        read_model_results,
        read_nuscenes_poses,
        read_pose_csv,
    )
    from manyeyes.studies import provenance
    from manyeyes.studies.map_folder import MapFolder, report_rejected

    if (options.poses is None) == (options.nuscenes is None):
        raise ConfigError(
            "Result files hold no poses: give --poses CSV with --origin LATITUDE LONGITUDE, or --nuscenes FOLDER."
        )
    if options.poses is not None and options.origin is None:
        raise ConfigError("--poses needs --origin LATITUDE LONGITUDE, degrees: where x = y = 0 lies on the earth.")
    for name in ("range_x", "range_y"):
        low, high = getattr(options, name)
        if low >= high:
            raise ConfigError(
                f"--{name.replace('_', '-')} needs a smaller number, then a larger one; got {low:g} {high:g}."
            )
    console = Console()
    if options.poses is not None and options.origin is not None:
        poses = read_pose_csv(options.poses, MapFrame(*options.origin))
    else:
        assert options.nuscenes is not None
        poses = read_nuscenes_poses(options.nuscenes, options.location, options.axes)
    result_options = ModelResultOptions(
        options.axes, options.range_x, options.range_y, options.min_score, model=options.model
    )
    loaded = read_model_results(options.results, poses, result_options)
    report_rejected(loaded.rejected, console)
    if not loaded.observations:
        raise ConfigError(f"{options.results}: no sample could be used; the reasons stand above.")
    MapFolder(options.out).write_observations(loaded.observations, loaded.frame)
    elements = sum(len(o.elements) for o in loaded.observations)
    payload = {"observations": len(loaded.observations), "elements": elements, "rejected": len(loaded.rejected)}
    provenance.write_json(options.out / "import.json", payload, options, None)
    console.print(
        f"{len(loaded.observations)} observations of {elements} elements in {options.out}",
        highlight=False,
        soft_wrap=True,
    )
