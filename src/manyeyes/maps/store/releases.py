# SPDX-License-Identifier: Apache-2.0
"""Releases of a map in an object store: immutable tiles named by their content, then one manifest that names them.

The manifest is created last, under the number of the release, and can be created once. So a reader sees the release before or this
one, on a store that cannot rename, and of two writers of one number the second is refused. A tile that did not change is not
written again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.geoparquet import bytes_to_map, map_to_bytes
from manyeyes.maps.store.map_diff import (
    MapDelta,
    compute_delta,
    compute_home_tiles,
    read_delta,
    transfer_ids,
    write_delta,
)
from manyeyes.maps.store.object_store import ObjectNotFoundError, ObjectStore, StoreError
from manyeyes.maps.store.observation_log import TILE_M

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
    """One tile of a release: column, row, elements, names of its two objects below ``tiles``, and their BLAKE2b-128 hashes."""

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
        return bytes_to_map(self._tile_files(manifest, tiles)) if tiles else VectorMap.empty(self.frame)

    def _tile_files(self, manifest: Manifest, tiles: list[TileEntry]) -> Iterator[tuple[str, bytes]]:
        """Yield name and bytes of the objects of tiles."""
        for tile in tiles:
            for name, digest in zip(tile.files, tile.hashes):
                place = f"{self.objects.location}/tiles/{name}"
                try:
                    data = self.objects.get(f"tiles/{name}")
                except ObjectNotFoundError:
                    data = b""
                if hash_bytes(data) != digest:
                    raise StoreError(
                        f"{place}: missing or damaged in release {manifest.number}; restore it from a copy."
                    )
                yield place, data

    def write(self, fused: VectorMap, algorithm: str, settings: str, watermark: Watermark) -> Manifest:
        """Write the objects of the next release; it is there once :meth:`commit` has created its manifest."""
        numbers = self.numbers()
        parent = numbers[-1] if numbers else 0
        before = self.read(parent) if parent else VectorMap.empty(self.frame)
        known = self.manifest(parent).tiles if parent else ()
        fused, number = transfer_ids(fused, before), parent + 1
        tiles = self._write_tiles(fused, {name for tile in known for name in tile.files})
        write_delta(compute_delta(before, fused), self.objects, _delta_folder(number))
        return Manifest(
            number=number,
            parent=parent,
            content=fused.quantised_hash(),
            elements=len(fused),
            algorithm=algorithm,
            settings=settings,
            settings_hash=hash_bytes(settings.encode()),
            watermark=watermark,
            tiles=tiles,
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

    def _write_tiles(self, fused: VectorMap, known: set[str]) -> tuple[TileEntry, ...]:
        """Write the objects of every tile that are not known; entries by column and row."""
        keys = compute_home_tiles(fused)
        entries = []
        by_id = np.lexsort(fused.id.T[::-1])
        for x, y in np.unique(keys, axis=0).tolist() if len(keys) else []:
            rows = by_id[(keys[by_id] == (x, y)).all(1)]
            files, hashes = [], []
            for kind, data in zip(_KINDS, map_to_bytes(fused, rows)):
                hashes.append(hash_bytes(data))
                files.append(f"{x}_{y}/{hashes[-1]}.{kind}.parquet")
                if files[-1] not in known:
                    self.objects.put_new(f"tiles/{files[-1]}", data)
            entries.append(TileEntry(x, y, len(rows), (files[0], files[1]), (hashes[0], hashes[1])))
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
            TileEntry(t["x"], t["y"], t["elements"], tuple(t["files"]), tuple(t["hashes"])) for t in content["tiles"]
        )
        names = ("number", "parent", "content", "elements", "algorithm", "settings", "settings_hash")
        return Manifest(**{n: content[n] for n in names}, watermark=Watermark(**content["watermark"]), tiles=tiles)
    except (KeyError, TypeError) as error:
        raise StoreError(f"{place}: expected the manifest of a release; {type(error).__name__} {error}.") from None


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
