# SPDX-License-Identifier: Apache-2.0
"""What 'map simulate' leaves behind and the other verbs find: observations, truth in view, and where maps are cut."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes.datatypes import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.datatypes.map_element import MapElements
    from manyeyes.evaluation.maps.experiment import Cut, Scene
    from manyeyes.maps.elements.observation import Frame, Observation
    from manyeyes.maps.elements.observation_file import Quarantined, Reading
    from manyeyes.maps.elements.vector_map import VectorMap

ROWS_A_FILE = 5000
LINES, CROSSINGS = "lines.parquet", "crossings.parquet"


@dataclass(frozen=True)
class MapFolder:
    """observations/*.parquet, truth (a map), cut.json (ground of junctions and area)."""

    path: Path

    def write(self, scene: Scene) -> None:
        """A scene, each file whole or not at all."""
        self.write_observations(scene.observations, scene.place.frame)
        self.write_truth(scene.truth, scene.place.frame, scene.cut)

    def write_truth(self, truth: MapElements, frame: Frame, cut: Cut) -> None:
        """What maps are held against, and the cut that they get before."""
        import shapely

        from manyeyes._io import atomic_write
        from manyeyes.maps.elements.vector_map import VectorMap

        write_vector_map(VectorMap.of(truth, frame), self.path / "truth")
        said = {"junctions": shapely.to_wkt(cut.junctions, 3), "area": cut.area}
        atomic_write(self.path / "cut.json", (json.dumps(said) + "\n").encode())

    def write_observations(self, observations: Sequence[Observation], frame: Frame) -> None:
        """The observations, instead of those that were there."""
        from manyeyes.maps.elements.observation_file import write_observations

        held = self.path / "observations"
        held.mkdir(parents=True, exist_ok=True)
        for old in sorted(held.glob("part-*.parquet")):
            old.unlink()
        for part, start in enumerate(range(0, len(observations), ROWS_A_FILE)):
            write_observations(held / f"part-{part:05d}.parquet", observations[start : start + ROWS_A_FILE], frame)

    def cut(self) -> Cut | None:
        """The cut that maps get before they are judged; None where the folder says none."""
        import shapely

        from manyeyes.evaluation.maps.experiment import Cut

        file = self.path / "cut.json"
        if not file.is_file():
            return None
        try:
            held = json.loads(file.read_text(encoding="utf-8"))
            x0, y0, x1, y1 = (float(v) for v in held["area"])
            return Cut(shapely.from_wkt(held["junctions"]), (x0, y0, x1, y1))
        except (ValueError, KeyError, TypeError, shapely.errors.ShapelyError) as error:
            raise ConfigError(
                f"{file}: expected junctions (WKT) and area of four numbers; {error}. Simulate again."
            ) from error


def observation_files(path: Path) -> Path:
    """Where observations lie: the folder of that name in a folder that has one, else the path itself."""
    return path / "observations" if (path / "observations").is_dir() else path


def observations_in(path: Path, console: Console) -> Reading:
    """The observations of a file, a folder of files, or a simulated folder; what was put aside is said, one line each."""
    from manyeyes.maps.elements.observation_file import read_observations

    reading = read_observations(observation_files(path))
    say_put_aside(reading.quarantined, console)
    if not reading.observations:
        raise ConfigError(f"{path} holds no usable observation; 'manyeyes map simulate' makes some.")
    return reading


def say_put_aside(quarantined: Sequence[Quarantined], console: Console) -> None:
    """What could not be used, and why, one line each."""
    for bad in quarantined:
        where = f"{bad.file} row {bad.row}" if bad.row >= 0 else bad.file
        many = f" ({bad.count} rows)" if bad.count > 1 else ""
        console.print(f"put aside: {where}{many}: {bad.reason}", highlight=False, markup=False, soft_wrap=True)


def write_vector_map(made: VectorMap, folder: Path) -> None:
    """A map as a folder of two GeoParquet files: GeoArrow columns hold lines or polygons, not both."""
    from manyeyes.maps.formats.geoparquet import write_map

    folder.mkdir(parents=True, exist_ok=True)
    write_map(made, folder / LINES, folder / CROSSINGS)


def read_vector_map(folder: Path) -> VectorMap:
    """The map of a folder that 'map fuse' wrote: a map's own, or a store, whose last release is meant."""
    from manyeyes.maps.formats.geoparquet import read_map

    if (folder / "store.json").is_file():
        from manyeyes.maps.store.store import MapStore

        return MapStore(folder).read()

    files = [folder / LINES, folder / CROSSINGS]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise ConfigError(
            f"{folder}: expected a store, or a map's folder with {LINES} and {CROSSINGS}; {missing[0]} is missing."
        )
    return read_map(*files)
