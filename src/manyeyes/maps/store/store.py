# SPDX-License-Identifier: Apache-2.0
"""A folder that holds a map's whole life: the log of observations, releases of the fused map, and what changed between them.

::

    store.json                  format, version, frame
    log/                        segments of observations, retractions, quarantine (observation_log)
    catalogue.sqlite            index of the log (catalogue)
    tiles/X_Y/HASH.*.parquet    elements of a tile (formats.geoparquet, lossless), named by content; releases share equal ones
    releases/000001.json        manifest of a release: tiles with hashes, parent, algorithm, settings, watermark of the log
    deltas/000001/              what changed since the parent (changes)
    work/                       results of steps of a fusion that is under way (tiles)

A manifest is written last and under its final name at once: a release is there whole or not at all, and readers need no lock.
Nothing that a release names is changed afterwards. Writers hold ``lock``.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_rename, atomic_write, remove_unfinished
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.geoparquet import read_map, write_map
from manyeyes.maps.fusion.fuse import MapFusionConfig
from manyeyes.maps.isolation import FailedObservationsError
from manyeyes.maps.store.executors import Executor
from manyeyes.maps.store.map_diff import (
    MapDelta,
    compute_delta,
    compute_home_tiles,
    read_delta,
    transfer_ids,
    write_delta,
)
from manyeyes.maps.store.observation_log import TILE_M, ObservationLog, StoreError, hold_lock
from manyeyes.maps.store.tiled_fusion import ALGORITHM, StepProgress, TiledFusionConfig, fuse_tiles

STORE_VERSION = 1


@dataclass(frozen=True)
class Watermark:
    """Which observations a map was made of: how many, a hash of their sorted ids, the latest time among them (-1: none)."""

    observations: int
    digest: str
    latest_ns: int


@dataclass(frozen=True)
class TileEntry:
    """One tile of a release: column, row, elements, names of its two files below ``tiles``, and their BLAKE2b-128 hashes."""

    x: int
    y: int
    elements: int
    files: tuple[str, str]
    hashes: tuple[str, str]


@dataclass(frozen=True)
class Manifest:
    """A release. number: from 1 on. content: the map's quantised hash. parent: number of the release before, 0 for none."""

    number: int
    parent: int
    content: str
    elements: int
    algorithm: str
    settings: str
    settings_hash: str
    watermark: Watermark
    tiles: tuple[TileEntry, ...]


class MapStore:
    """A store in a folder; :meth:`create` makes one, the constructor opens one that is there."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        content = _read_json(self.folder / "store.json", "a store of maps")
        if content.get("format") != "manyeyes.store":
            raise StoreError(
                f"{self.folder}/store.json: expected format 'manyeyes.store'; got {content.get('format')!r}."
            )
        if content["version"] > STORE_VERSION:
            raise StoreError(
                f"{self.folder}/store.json: version {content['version']}, but this program knows up to {STORE_VERSION}; "
                "update manyeyes."
            )
        self.frame = MapFrame(content["latitude"], content["longitude"])
        self.log = ObservationLog(self.folder / "log", self.frame)

    @classmethod
    def create(cls, folder: Path | str, frame: MapFrame) -> MapStore:
        """Return a new, empty store about an origin; a folder that holds one of the same frame is opened."""
        path = Path(folder) / "store.json"
        if not path.exists():
            content = {"format": "manyeyes.store", "version": STORE_VERSION, **asdict(frame)}
            atomic_write(path, json.dumps(content, indent=1).encode())
        store = cls(folder)
        if store.frame != frame:
            raise StoreError(
                f"{folder}: expected a store about {frame}; it is about {store.frame}: choose another folder."
            )
        return store

    @contextmanager
    def open_for_writing(self) -> Iterator[ObservationLog]:
        """Hold the store's lock and bring log and index together; gives the log to append to."""
        with hold_lock(self.folder / "lock"):
            self.log.recover()
            for name in ("tiles", "deltas", "releases"):
                (self.folder / name).mkdir(exist_ok=True)
                remove_unfinished(self.folder / name)
            yield self.log

    def releases(self) -> tuple[int, ...]:
        """Return numbers of all releases, ascending."""
        return tuple(sorted(int(path.stem) for path in (self.folder / "releases").glob("[0-9]*.json")))

    def manifest(self, number: int | None = None) -> Manifest:
        """Return the manifest of a release, the last one if no number is given."""
        known = self.releases()
        if not known:
            raise StoreError(f"{self.folder}: no release yet; fuse and publish one first.")
        number = known[-1] if number is None else number
        if number not in known:
            raise StoreError(f"{self.folder}: no release {number}; there are {', '.join(map(str, known))}.")
        return _read_manifest(self.folder / "releases" / f"{number:06d}.json")

    def read(self, number: int | None = None, area: tuple[float, float, float, float] | None = None) -> VectorMap:
        """Return the map of a release, the last one if no number is given, elements by ascending id.

        area: only elements of tiles that it touches (x0, y0, x1, y1, metres): those that start there.
        """
        manifest = self.manifest(number)
        tiles = [tile for tile in manifest.tiles if area is None or _touches(tile, area)]
        paths = []
        for tile in tiles:
            for name, digest in zip(tile.files, tile.hashes):
                path = self.folder / "tiles" / name
                if not path.exists() or _hash(path.read_bytes()) != digest:
                    raise StoreError(
                        f"{path}: missing or damaged in release {manifest.number}; restore it from a copy."
                    )
                paths.append(path)
        return read_map(*paths) if paths else VectorMap.empty(self.frame)

    def fuse(
        self,
        config: MapFusionConfig | None = None,
        tile_config: TiledFusionConfig | None = None,
        executor: Executor | None = None,
        progress: StepProgress | None = None,
    ) -> Manifest:
        """Fuse all observations that count and publish the map; steps done before a kill, or for a former release, are reused.

        Observations with which the fusion fails go to the quarantine, ``log.rejected``, and the rest is fused.
        """
        config, tile_config = config or MapFusionConfig(), tile_config or TiledFusionConfig()
        work = self.folder / "work"
        with self.open_for_writing() as log:
            work.mkdir(exist_ok=True)
            while True:
                active = log.active_observations()
                try:
                    fused = fuse_tiles(log.folder, active, self.frame, work, config, tile_config, executor, progress)
                    break
                except FailedObservationsError as error:
                    log.quarantine(error.failures)
            watermark = compute_watermark(active.ids, active.time_ns)
            return self._publish(fused, ALGORITHM, repr(config), watermark)

    def publish(self, fused: VectorMap, algorithm: str, settings: str, watermark: Watermark) -> Manifest:
        """Publish a map that was fused elsewhere."""
        with self.open_for_writing():
            return self._publish(fused, algorithm, settings, watermark)

    def delta(self, number: int) -> MapDelta:
        """What release ``number`` changed, against its parent."""
        self.manifest(number)
        return read_delta(self.folder / "deltas" / f"{number:06d}")

    def clear_work(self) -> None:
        """Delete kept results of steps; the next fusion does them all again."""
        with self.open_for_writing():
            shutil.rmtree(self.folder / "work", ignore_errors=True)

    def collect_garbage(self) -> list[Path]:
        """Delete files of tiles and deltas that no release names, as a killed writer leaves them."""
        with self.open_for_writing():
            numbers = self.releases()
            named = {name for n in numbers for tile in self.manifest(n).tiles for name in tile.files}
            left = [
                p
                for p in (self.folder / "tiles").rglob("*.parquet")
                if _relative_name(p, self.folder / "tiles") not in named
            ]
            for path in left:
                path.unlink()
            for folder in (self.folder / "deltas").iterdir():
                if int(folder.name) not in numbers:
                    left.append(folder)
                    shutil.rmtree(folder)
            return sorted(left)

    def _publish(self, fused: VectorMap, algorithm: str, settings: str, watermark: Watermark) -> Manifest:
        numbers = self.releases()
        parent = numbers[-1] if numbers else 0
        before = self.read(parent) if parent else VectorMap.empty(self.frame)
        fused = transfer_ids(fused, before)
        number = parent + 1
        tiles = self._write_tiles(fused)
        delta_folder = self.folder / "deltas" / f"{number:06d}"
        shutil.rmtree(delta_folder, ignore_errors=True)
        delta_folder.mkdir(parents=True)
        write_delta(compute_delta(before, fused), delta_folder)
        manifest = Manifest(
            number=number,
            parent=parent,
            content=fused.quantised_hash(),
            elements=len(fused),
            algorithm=algorithm,
            settings=settings,
            settings_hash=_hash(settings.encode()),
            watermark=watermark,
            tiles=tiles,
        )
        text = json.dumps({"format": "manyeyes.release", "version": STORE_VERSION, **asdict(manifest)}, indent=1)
        atomic_write(self.folder / "releases" / f"{number:06d}.json", text.encode())
        return manifest

    def _write_tiles(self, fused: VectorMap) -> tuple[TileEntry, ...]:
        """Write the files of every tile that are not there yet; entries by column and row."""
        keys = compute_home_tiles(fused)
        entries = []
        by_id = np.lexsort(fused.id.T[::-1])
        for x, y in np.unique(keys, axis=0).tolist() if len(keys) else []:
            rows = by_id[(keys[by_id] == (x, y)).all(1)]
            entries.append(self._write_tile(fused, rows, x, y))
        return tuple(entries)

    def _write_tile(self, fused: VectorMap, rows: NDArray[np.int64], x: int, y: int) -> TileEntry:
        folder = self.folder / "tiles" / f"{x}_{y}"
        folder.mkdir(parents=True, exist_ok=True)
        drafts = [folder / f".draft.{kind}.unfinished" for kind in ("lines", "crossings")]
        write_map(fused, drafts[0], drafts[1], rows)
        names, hashes = [], []
        for kind, draft in zip(("lines", "crossings"), drafts):
            digest = _hash(draft.read_bytes())
            path = folder / f"{digest}.{kind}.parquet"
            atomic_rename(draft, path)
            names.append(_relative_name(path, self.folder / "tiles"))
            hashes.append(digest)
        return TileEntry(x, y, len(rows), (names[0], names[1]), (hashes[0], hashes[1]))


def compute_watermark(ids: Sequence[str], times_ns: NDArray[np.int64]) -> Watermark:
    """Return the watermark of a set of observations."""
    latest = int(times_ns.max()) if len(times_ns) else -1
    return Watermark(len(ids), _hash("".join(sorted(ids)).encode()), latest)


def _read_manifest(path: Path) -> Manifest:
    content = _read_json(path, "the manifest of a release")
    if content.get("version", 0) > STORE_VERSION:
        raise StoreError(
            f"{path}: version {content['version']}, but this program knows up to {STORE_VERSION}; update it."
        )
    try:
        tiles = tuple(
            TileEntry(t["x"], t["y"], t["elements"], tuple(t["files"]), tuple(t["hashes"])) for t in content["tiles"]
        )
        names = ("number", "parent", "content", "elements", "algorithm", "settings", "settings_hash")
        return Manifest(**{n: content[n] for n in names}, watermark=Watermark(**content["watermark"]), tiles=tiles)
    except (KeyError, TypeError) as error:
        raise StoreError(f"{path}: expected the manifest of a release; {type(error).__name__} {error}.") from None


def _read_json(path: Path, expected: str) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise StoreError(
            f"{path}: expected {expected}; {reason}. Create one, or restore the file from a copy."
        ) from None
    if not isinstance(content, dict):
        raise StoreError(f"{path}: expected {expected}; got a {type(content).__name__}.")
    return content


def _touches(tile: TileEntry, area: tuple[float, float, float, float]) -> bool:
    x0, y0 = tile.x * TILE_M, tile.y * TILE_M
    return x0 <= area[2] and area[0] < x0 + TILE_M and y0 <= area[3] and area[1] < y0 + TILE_M


def _relative_name(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()


def _hash(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
