# SPDX-License-Identifier: Apache-2.0
"""Releases of a map in an object store: immutable tiles named by their content, then one manifest that names them.

The manifest is created last, under the number of the release, and can be created once. So a reader sees the release before or this
one, on a store that cannot rename, and of two writers of one number the second is refused. A tile that did not change is not
written again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import ContentSum, VectorMap
from manyeyes.maps.formats.geoparquet import bytes_to_map, map_to_bytes
from manyeyes.maps.store.map_diff import (
    MapDelta,
    compute_delta,
    compute_home_tiles,
    read_delta,
    transfer_ids,
    write_delta,
    write_delta_parts,
)
from manyeyes.maps.store.object_store import ObjectNotFoundError, ObjectStore, StoreError
from manyeyes.maps.store.observation_log import TILE_M
from manyeyes.maps.store.region_assembly import Bounds

Ints = NDArray[np.int64]

STORE_VERSION = 1
_KINDS = ("lines", "crossings")


@dataclass(frozen=True)
class Watermark:
    """Which observations a map was made of: how many, a hash of their sorted ids, the latest time among them (-1: none)."""

    observations: int
    digest: str
    latest_ns: int


@dataclass(frozen=True)
class TileEntry:
    """One tile of a release: column, row, elements, names of its two objects below ``tiles``, and their BLAKE2b-128 hashes.

    bounds: box of its elements, metres; None in releases of earlier versions of this program.
    """

    x: int
    y: int
    elements: int
    files: tuple[str, str]
    hashes: tuple[str, str]
    bounds: Bounds | None = None


@dataclass(frozen=True)
class ReleasePart:
    """What was written of a release: its tiles, the sum of their elements, and the name of the part of the delta ("": none)."""

    tiles: tuple[TileEntry, ...]
    content: ContentSum
    delta: str


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


@dataclass(frozen=True)
class ReleaseStore:
    """The releases in a store; pickles, so that a worker writes the tiles. frame: of their coordinates."""

    objects: ObjectStore
    frame: MapFrame

    def numbers(self) -> tuple[int, ...]:
        """Return numbers of all releases, ascending."""
        names = (key.rpartition("/")[2] for key in self.objects.list("releases"))
        return tuple(sorted(int(name[:-5]) for name in names if name.endswith(".json")))

    def manifest(self, number: int | None = None) -> Manifest:
        """Return the manifest of a release, the last one if no number is given."""
        known = self.numbers()
        if not known:
            raise StoreError(f"{self.objects.location}: no release yet; fuse and publish one first.")
        number = known[-1] if number is None else number
        if number not in known:
            raise StoreError(f"{self.objects.location}: no release {number}; there are {', '.join(map(str, known))}.")
        return _read_manifest(self.objects, _manifest_key(number))

    def read(self, number: int | None = None, area: tuple[float, float, float, float] | None = None) -> VectorMap:
        """Return the map of a release, the last one if no number is given, elements by ascending id.

        area: only elements of tiles that it touches (x0, y0, x1, y1, metres): those that start there.
        """
        manifest = self.manifest(number)
        tiles = [tile for tile in manifest.tiles if area is None or _touches(tile, area)]
        return self.read_tiles(manifest.number, tiles)

    def _tile_files(self, number: int, tiles: Sequence[TileEntry]) -> Iterator[tuple[str, bytes]]:
        """Yield name and bytes of the objects of tiles."""
        for tile in tiles:
            for name, digest in zip(tile.files, tile.hashes):
                place = f"{self.objects.location}/tiles/{name}"
                try:
                    data = self.objects.get(f"tiles/{name}")
                except ObjectNotFoundError:
                    data = b""
                if hash_bytes(data) != digest:
                    raise StoreError(f"{place}: missing or damaged in release {number}; restore it from a copy.")
                yield place, data

    def write(self, fused: VectorMap, algorithm: str, settings: str, watermark: Watermark) -> Manifest:
        """Write the objects of the next release; it is there once :meth:`commit` has created its manifest."""
        parent, known = self.parent()
        before = self.read(parent) if parent else VectorMap.empty(self.frame)
        after, number = transfer_ids(fused, before), parent + 1
        part = self.write_part("all", number, before, after, np.arange(len(after)), np.arange(len(before)), known)
        return self.finish([part], number, algorithm, settings, watermark)

    def parent(self) -> tuple[int, tuple[TileEntry, ...]]:
        """Return the number of the last release and its tiles; 0 and none before the first."""
        numbers = self.numbers()
        return (numbers[-1], self.manifest(numbers[-1]).tiles) if numbers else (0, ())

    def read_tiles(self, number: int, tiles: Sequence[TileEntry]) -> VectorMap:
        """Return the elements of some tiles of a release."""
        return bytes_to_map(self._tile_files(number, tiles)) if tiles else VectorMap.empty(self.frame)

    def write_part(
        self,
        name: str,
        number: int,
        before: VectorMap,
        after: VectorMap,
        own: Ints,
        former: Ints,
        known: Sequence[TileEntry],
    ) -> ReleasePart:
        """Write the tiles and the delta of a part of a release.

        own: the part's rows of ``after``, which has their relations. former: rows of ``before`` that stood in its tiles. known:
        tiles of the release before; equal ones are not written again.
        """
        tiles = self._write_tiles(after, own, {name for tile in known for name in tile.files})
        delta = compute_delta(before, after, own, former)
        changes = bool(len(delta.changed) or delta.deleted)
        if changes:
            write_delta(delta, self.objects, _delta_folder(number), name)
        return ReleasePart(tiles, ContentSum.of(after.take(own)), name if changes else "")

    def finish(
        self, parts: Sequence[ReleasePart], number: int, algorithm: str, settings: str, watermark: Watermark
    ) -> Manifest:
        """Return the manifest of a release whose parts are written."""
        write_delta_parts([part.delta for part in parts if part.delta], self.objects, _delta_folder(number))
        content = sum((part.content for part in parts), ContentSum())
        return Manifest(
            number=number,
            parent=number - 1,
            content=content.hexdigest(),
            elements=content.count,
            algorithm=algorithm,
            settings=settings,
            settings_hash=hash_bytes(settings.encode()),
            watermark=watermark,
            tiles=tuple(sorted((tile for part in parts for tile in part.tiles), key=lambda tile: (tile.x, tile.y))),
        )

    def commit(self, manifest: Manifest) -> None:
        """Create the manifest: from now on readers see the release."""
        text = json.dumps({"format": "manyeyes.release", "version": STORE_VERSION, **asdict(manifest)}, indent=1)
        if not self.objects.put_new(_manifest_key(manifest.number), text.encode()):
            raise StoreError(
                f"{self.objects.location}: another program published release {manifest.number} meanwhile; run again."
            )

    def delta(self, number: int) -> MapDelta:
        """What release ``number`` changed, against its parent."""
        self.manifest(number)
        return read_delta(self.objects, _delta_folder(number))

    def collect_garbage(self) -> list[str]:
        """Delete objects of tiles and deltas that no release names, as a killed writer leaves them; their keys."""
        numbers = self.numbers()
        named = {f"tiles/{name}" for n in numbers for tile in self.manifest(n).tiles for name in tile.files}
        folders = {_delta_folder(number) for number in numbers}
        left = [key for key in self.objects.list("tiles") if key not in named]
        left += [key for key in self.objects.list("deltas") if key.rpartition("/")[0] not in folders]
        self.objects.delete(left)
        return sorted(left)

    def _write_tiles(self, fused: VectorMap, own: Ints, known: set[str]) -> tuple[TileEntry, ...]:
        """Write the objects of every tile of the rows that are not known; entries by column and row."""
        own = own[np.lexsort(fused.id[own].T[::-1])]
        keys, bounds = compute_home_tiles(fused)[own], fused.elements.bounds()
        entries = []
        for x, y in np.unique(keys, axis=0).tolist() if len(keys) else []:
            rows = own[(keys == (x, y)).all(1)]
            files, hashes = [], []
            for kind, data in zip(_KINDS, map_to_bytes(fused, rows)):
                hashes.append(hash_bytes(data))
                files.append(f"{x}_{y}/{hashes[-1]}.{kind}.parquet")
                if files[-1] not in known:
                    self.objects.put_new(f"tiles/{files[-1]}", data)
            low, high = bounds[rows, :2].min(0).tolist(), bounds[rows, 2:].max(0).tolist()
            box = (low[0], low[1], high[0], high[1])
            entries.append(TileEntry(x, y, len(rows), (files[0], files[1]), (hashes[0], hashes[1]), box))
        return tuple(entries)


def _manifest_key(number: int) -> str:
    return f"releases/{number:06d}.json"


def _delta_folder(number: int) -> str:
    return f"deltas/{number:06d}"


def _read_manifest(objects: ObjectStore, key: str) -> Manifest:
    content, place = read_json(objects, key, "the manifest of a release"), f"{objects.location}/{key}"
    if content.get("version", 0) > STORE_VERSION:
        raise StoreError(
            f"{place}: version {content['version']}, but this program knows up to {STORE_VERSION}; update it."
        )
    try:
        tiles = tuple(
            TileEntry(t["x"], t["y"], t["elements"], tuple(t["files"]), tuple(t["hashes"]), _to_bounds(t.get("bounds")))
            for t in content["tiles"]
        )
        names = ("number", "parent", "content", "elements", "algorithm", "settings", "settings_hash")
        return Manifest(**{n: content[n] for n in names}, watermark=Watermark(**content["watermark"]), tiles=tiles)
    except (KeyError, TypeError) as error:
        raise StoreError(f"{place}: expected the manifest of a release; {type(error).__name__} {error}.") from None


def _to_bounds(stored: list[float] | None) -> Bounds | None:
    return None if stored is None else (stored[0], stored[1], stored[2], stored[3])


def read_json(objects: ObjectStore, key: str, expected: str) -> dict[str, Any]:
    """Return the JSON object under a key; expected: what it is, for the text of an error."""
    place = f"{objects.location}/{key}"
    try:
        content = json.loads(objects.get(key))
    except (ObjectNotFoundError, OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise StoreError(
            f"{place}: expected {expected}; {reason}. Create one, or restore the file from a copy."
        ) from None
    if not isinstance(content, dict):
        raise StoreError(f"{place}: expected {expected}; got a {type(content).__name__}.")
    return content


def hash_bytes(data: bytes) -> str:
    """Return BLAKE2b-128 in hexadecimal."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def _touches(tile: TileEntry, area: tuple[float, float, float, float]) -> bool:
    x0, y0 = tile.x * TILE_M, tile.y * TILE_M
    return x0 <= area[2] and area[0] < x0 + TILE_M and y0 <= area[3] and area[1] < y0 + TILE_M
