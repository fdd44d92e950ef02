# SPDX-License-Identifier: Apache-2.0
"""Turns maps (Argoverse 2, Lanelet2, GeoPackage, ...) or a result file of MapTR or StreamMapNet into observations."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from manyeyes._bounds import AngleDeg, Fraction, LatitudeDeg, LengthM, LongitudeDeg, OffsetM, OutputFolder
from manyeyes.datatypes import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console

    from manyeyes.maps.elements.observation_file import LoadedObservations


@dataclass(frozen=True)
class MapOptions:
    """What a file of a map does not say; for maps alone."""

    crs: str | None = None
    """Coordinate system of a GeoPackage that states none, such as EPSG:25832."""
    pose_sigma: LengthM = 0.5
    """Standard deviation of each map's position as a whole, metres."""
    yaw_sigma_deg: AngleDeg = 0.1
    """Standard deviation of each map's heading as a whole, degrees."""
    score: Fraction | None = None
    """Confidence of every element, in place of those of the file (1 where it has none)."""
    sigma_m: LengthM | None = None
    """Lateral standard deviation of every point, metres, in place of those of the file (0.12 where it has none)."""
    trusted: bool = False
    """Surveyed maps: their positions are exact, and their elements weigh more."""
    date: str | None = None
    """When the maps were made, such as 2026-03-01; by default when each file was last changed, of a store its last observation."""


@dataclass(frozen=True)
class Options:
    """What is read, and what the file does not say."""

    sources: tyro.conf.Positional[tuple[str, ...]]
    """Sources: one map or more, of one region: an Argoverse 2 log or its map (.json), Lanelet2 (.osm), GeoPackage (.gpkg), GeoJSON,
    a folder of 'map fuse', or a store in a folder or at a URL. Or one result file: nuscmap_results.json of MapTR,
    submission_vector.json of StreamMapNet."""
    poses: Path | None = None
    """A CSV with token, agent, pass_id, time_ns, x, y, yaw and, if known, sigma_x, sigma_y, sigma_yaw."""
    origin: tuple[LatitudeDeg, LongitudeDeg] | None = None
    """Latitude and longitude, degrees, of x = y = 0: of the CSV's poses; of maps, by default near the middle of the first."""
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
    maps: MapOptions = field(default_factory=MapOptions)
    """What files of maps do not say."""
    out: OutputFolder = Path("out/map/imported")
    """Folder for the observations; 'map fuse' takes it."""


def main(options: Options) -> None:
    """Convert maps, or the result file of a map model, to observations."""
    from rich.console import Console

    from manyeyes.studies import provenance
    from manyeyes.studies.map_folder import MapFolder, report_rejected
    from manyeyes.studies.map_import import is_map

    console = Console()
    if not options.sources:
        raise ConfigError("Give one map or more, or a result file of a map model.")
    of_maps = [place for place in options.sources if is_map(place)]
    if not of_maps:
        loaded = _read_predictions(options)
    elif len(of_maps) < len(options.sources):
        other = next(place for place in options.sources if place not in of_maps)
        raise ConfigError(f"{other} is no map, but {of_maps[0]} is one: import maps and result files into two folders.")
    else:
        loaded = _read_maps(options)
    report_rejected(loaded.rejected, console)
    _report_left_out(loaded, console)
    if not loaded.observations:
        raise ConfigError(f"{options.sources[0]}: nothing could be used; the reasons stand above.")
    MapFolder(options.out).write_observations(loaded.observations, loaded.frame)
    elements = sum(len(o.elements) for o in loaded.observations)
    payload = {
        "observations": len(loaded.observations),
        "elements": elements,
        "rejected": len(loaded.rejected),
        "left_out": dict(loaded.left_out),
    }
    provenance.write_json(options.out / "import.json", payload, options, None)
    console.print(
        f"{len(loaded.observations)} observations of {elements} elements in {options.out}",
        highlight=False,
        soft_wrap=True,
    )


def _report_left_out(loaded: LoadedObservations, console: Console) -> None:
    """Print what the files hold and the observations do not, one line each."""
    for name, count in loaded.left_out.items():
        text = "".join(c if c.isprintable() else "?" for c in f"left out: {count} of {name}")
        console.print(text, highlight=False, markup=False, soft_wrap=True)


def _read_maps(options: Options) -> LoadedObservations:
    """Return the maps as observations of as many agents, in one frame."""
    import math
    from collections import Counter

    from manyeyes.maps.elements.map_observation import MapSource, make_map_observations
    from manyeyes.maps.elements.observation import MapFrame, Observation
    from manyeyes.maps.elements.observation_file import LoadedObservations
    from manyeyes.maps.store.map_place import MapPlace
    from manyeyes.studies.map_import import read_source_map

    if options.poses is not None or options.nuscenes is not None:
        raise ConfigError("A map holds its own place on earth; --poses and --nuscenes are for result files.")
    choice = options.maps
    frame: MapFrame | None = None if options.origin is None else MapFrame(*options.origin)
    observations: list[Observation] = []
    left_out: Counter[str] = Counter()
    names = _name_agents(options.sources)
    for place, name in zip(options.sources, names):
        source_map = read_source_map(place, frame, choice.crs)
        frame = source_map.frame
        _check_distance(place, source_map.elements.points)
        source = MapSource(
            agent=name,
            time_ns=_find_time(place, choice.date),
            sigma_m=choice.pose_sigma,
            sigma_yaw_rad=math.radians(choice.yaw_sigma_deg),
            score=choice.score,
            point_sigma_m=choice.sigma_m,
            trusted=choice.trusted,
        )
        observations += make_map_observations(source_map.elements, source)
        left_out.update({f"{MapPlace.parse(place).name}: {what}": count for what, count in source_map.left_out.items()})
    assert frame is not None
    return LoadedObservations(frame, tuple(observations), (), dict(left_out))


def _check_distance(place: str, points: NDArray[np.float64]) -> None:
    """ConfigError for a map of points (P, 2) beyond the limit of positions; metres from the frame's origin."""
    from manyeyes.maps.elements.observation_limits import LIMITS

    reach = float(abs(points).max(initial=0.0))
    if not reach <= LIMITS.max_position_m:
        raise ConfigError(
            f"{place}: lies {reach / 1e3:,.0f} km from the origin of the maps, at most {LIMITS.max_position_m / 1e3:,.0f} km are "
            "possible. Import maps of one region at a time, or name --origin LATITUDE LONGITUDE in it."
        )


def _name_agents(sources: tuple[str, ...]) -> list[str]:
    """Return a pseudonym for each map: its name, numbered where several have one."""
    from manyeyes.maps.store.map_place import MapPlace

    names = [Path(MapPlace.parse(place).name).stem[:200] or "map" for place in sources]
    return [name if names.count(name) == 1 else f"{name}-{k + 1}" for k, name in enumerate(names)]


def _find_time(text: str, date: str | None) -> int:
    """Return nanoseconds since 1970 of a date (UTC), else of the last observation of a store or the last change of a file."""
    from datetime import UTC, datetime

    from manyeyes.maps.store.map_place import MapPlace
    from manyeyes.studies.map_folder import open_store

    if date is None:
        place = MapPlace.parse(text)
        if place.folder is None or (place.folder / "store.json").is_file():
            return max(0, open_store(place.location).manifest(place.release).watermark.latest_ns)
        return place.folder.stat().st_mtime_ns
    try:
        moment = datetime.fromisoformat(date)
    except ValueError:
        raise ConfigError(f"--date: expected a date such as 2026-03-01; got {date[:40]}.") from None
    return int((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()) * 10**9


def _read_predictions(options: Options) -> LoadedObservations:
    """Return the samples of one result file as observations."""
    from manyeyes.maps.elements.observation import MapFrame
    from manyeyes.maps.formats.model_results import (
        ModelResultOptions,
        read_model_results,
        read_nuscenes_poses,
        read_pose_csv,
    )

    if len(options.sources) > 1:
        raise ConfigError(f"Result files of map models are imported one by one; got {len(options.sources)}.")
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
    if options.poses is not None and options.origin is not None:
        poses = read_pose_csv(options.poses, MapFrame(*options.origin))
    else:
        assert options.nuscenes is not None
        poses = read_nuscenes_poses(options.nuscenes, options.location, options.axes)
    result_options = ModelResultOptions(
        options.axes, options.range_x, options.range_y, options.min_score, model=options.model
    )
    (source,) = tuple[str, ...](options.sources)
    return read_model_results(Path(source), poses, result_options)
