# SPDX-License-Identifier: Apache-2.0
"""The folder that 'map simulate' writes and other commands read: observations, truth in view, and the cut policy."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._io import parse_json, read_file
from manyeyes.datatypes import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.datatypes.map_element import MapElements
    from manyeyes.evaluation.maps.experiment import CutPolicy, FleetExperiment
    from manyeyes.maps.elements.observation import MapFrame, Observation
    from manyeyes.maps.elements.observation_file import LoadedObservations, RejectedRows
    from manyeyes.maps.elements.vector_map import VectorMap
    from manyeyes.maps.fusion.observed_ground import ObservedGround
    from manyeyes.maps.store.store import MapStore

ROWS_PER_FILE = 5000
LINES_FILE, CROSSINGS_FILE, GROUND_FILE = "lines.parquet", "crossings.parquet", "ground.npz"


@dataclass(frozen=True)
class MapFolder:
    """observations/*.parquet, truth (a map), cut.json (ground of junctions and area)."""

    path: Path

    def write(self, experiment: FleetExperiment) -> None:
        """A scene, each file whole or not at all."""
        self.write_observations(experiment.observations, experiment.place.frame)
        self.write_truth(experiment.truth, experiment.place.frame, experiment.cut_policy)

    def write_truth(self, truth: MapElements, frame: MapFrame, cut_policy: CutPolicy) -> None:
        """What maps are held against, and the cut that they get before."""
        import shapely

        from manyeyes._io import atomic_write
        from manyeyes.maps.elements.vector_map import VectorMap

        write_vector_map(VectorMap.of(truth, frame), self.path / "truth")
        content = {"junctions": shapely.to_wkt(cut_policy.junctions, 3), "area": cut_policy.area}
        atomic_write(self.path / "cut.json", (json.dumps(content) + "\n").encode())

    def write_observations(self, observations: Sequence[Observation], frame: MapFrame) -> None:
        """The observations, instead of those that were there."""
        from manyeyes.maps.elements.observation_file import write_observations

        folder = self.path / "observations"
        folder.mkdir(parents=True, exist_ok=True)
        for old in sorted(folder.glob("part-*.parquet")):
            old.unlink()
        for part, start in enumerate(range(0, len(observations), ROWS_PER_FILE)):
            write_observations(folder / f"part-{part:05d}.parquet", observations[start : start + ROWS_PER_FILE], frame)

    def read_cut_policy(self) -> CutPolicy | None:
        """Return the cut policy for maps before evaluation; None where the folder holds none."""
        import shapely

        from manyeyes.evaluation.maps.experiment import CutPolicy

        file = self.path / "cut.json"
        if not file.is_file():
            return None
        try:
            content = parse_json(read_file(file))
            x0, y0, x1, y1 = (float(v) for v in content["area"])
            return CutPolicy(shapely.from_wkt(content["junctions"]), (x0, y0, x1, y1))
        except (ValueError, KeyError, TypeError, shapely.errors.ShapelyError) as error:
            raise ConfigError(
                f"{file}: expected junctions (WKT) and area of four numbers; {error}. Simulate again."
            ) from error


def load_observations(path: Path, console: Console) -> LoadedObservations:
    """Return the observations of a file, a folder of files, or a simulated folder; rejected ones are printed, one line each."""
    from manyeyes.maps.elements.observation_file import find_observation_files, read_observations

    loaded = read_observations(find_observation_files(path))
    report_rejected(loaded.rejected, console)
    if not loaded.observations:
        raise ConfigError(f"{path} holds no usable observation; 'manyeyes map simulate' makes some.")
    return loaded


def print_none_published(num_published: int, num_elements: int, console: Console) -> None:
    """Print why a map with elements has none that is published, and the remedy; nothing otherwise."""
    if num_elements and not num_published:
        console.print(
            "No element is published: that takes detections with higher scores, by more agents, or by a trusted observation "
            "('manyeyes map import --trusted'). 'manyeyes map export --include-unpublished' writes candidates, too.",
            highlight=False,
            soft_wrap=True,
        )


def report_rejected(rejected: Sequence[RejectedRows], console: Console) -> None:
    """What could not be used, and why, one line each."""
    for rows in rejected:
        location = f"{rows.file} row {rows.row}" if rows.row >= 0 else rows.file
        count_note = f" ({rows.count} rows)" if rows.count > 1 else ""
        # Texts of a file may hold line ends and control sequences of terminals.
        text = "".join(c if c.isprintable() else "?" for c in f"rejected: {location}{count_note}: {rows.reason}")
        console.print(text, highlight=False, markup=False, soft_wrap=True)


def write_vector_map(vector_map: VectorMap, folder: Path) -> None:
    """A map as a folder of two GeoParquet files: GeoArrow columns hold lines or polygons, not both.

    They replace a former map without a moment at which lines of one map stand beside crossings of the other; the caller holds the
    folder's lock.
    """
    from manyeyes._io import UNFINISHED, atomic_rename, remove_unfinished
    from manyeyes.maps.formats.geoparquet import write_map

    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / LINES_FILE, folder / CROSSINGS_FILE]
    drafts = [file.with_name(f".{file.name}{UNFINISHED}") for file in files]
    try:
        write_map(vector_map, drafts[0], drafts[1])
        files[1].unlink(missing_ok=True)
        for draft, file in zip(drafts, files):
            atomic_rename(draft, file)
    finally:
        remove_unfinished(folder, below=False)


def open_store(location: Path | str) -> MapStore:
    """Open the store of maps in a folder or at a URL.

    Raises:
        StoreError: there is none, it is damaged, or it cannot be reached.
    """
    from manyeyes.maps.store.object_store import StoreError
    from manyeyes.maps.store.store import MapStore

    if not MapStore.exists(location):
        remedy = (
            "memory:// is of one process; take a folder or another store"
            if str(location).startswith("memory://")
            else f"check the address, or make one with 'manyeyes map fuse OBSERVATIONS --store {location}'"
        )
        raise StoreError(f"{location}: there is no store of maps (no store.json); {remedy}.")
    return MapStore(location)


def read_vector_map(place: Path | str) -> VectorMap:
    """Return the map at a place (:class:`~manyeyes.maps.store.map_place.MapPlace`): one way for all that read maps.

    It is the folder of a map that 'map fuse' wrote; or a store, in a folder or at a URL, of which the last release is meant, or
    release N of ``PLACE@N``.
    """
    from manyeyes.maps.formats.geoparquet import read_map
    from manyeyes.maps.store.map_place import MapPlace

    found = MapPlace.parse(place)
    folder = found.folder
    if folder is None or (folder / "store.json").is_file():
        return open_store(found.location).read(found.release)
    if found.release is not None:
        raise ConfigError(
            f"{found}: only a store has releases, and {found.location} is none; leave out @{found.release}."
        )
    files = [folder / LINES_FILE, folder / CROSSINGS_FILE]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise ConfigError(
            f"{folder}: expected a store, or a map's folder with {LINES_FILE} and {CROSSINGS_FILE}; {missing[0]} is missing. "
            "Make the map again with 'manyeyes map fuse'."
        )
    return read_map(*files)


def read_ground(place: Path | str, vector_map: VectorMap) -> ObservedGround:
    """Return what a map's observations saw: stored with it, of a store's log, or of the observations beside the map's folder.

    Without any of them, the ground near the map's own elements, ``is_assumed``.
    """
    from manyeyes.maps.fusion.observed_ground import ObservedGround
    from manyeyes.maps.store.map_place import MapPlace

    found = MapPlace.parse(place)
    folder = found.folder
    if folder is None or (folder / "store.json").is_file():
        store = open_store(found.location)
        return ObservedGround.of_observations(store.observations_of(found.release), store.frame)
    if (folder / GROUND_FILE).is_file():
        return ObservedGround.read(folder / GROUND_FILE)
    beside = folder.resolve().parent / "observations"
    if beside.is_dir() and any(beside.glob("*.parquet")):
        from manyeyes.maps.elements.observation_file import read_observations

        loaded = read_observations(beside)
        return ObservedGround.of_observations(loaded.observations, loaded.frame)
    return ObservedGround.around(vector_map.elements, vector_map.frame)
