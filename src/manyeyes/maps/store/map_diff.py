# SPDX-License-Identifier: Apache-2.0
"""What changed between two maps: elements added, modified and deleted, tile by tile; and ids that outlive a change.

A fused element's id is a hash of its geometry, so that the map is a pure function of its observations. From release to release
an element keeps the id of the one that it continues: the same kind, and most of the shorter one's points within 1 m.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x2, njit
from manyeyes.datatypes import MissingExtraError
from manyeyes.maps.elements.vector_map import VectorMap, compute_element_digests
from manyeyes.maps.formats.attributes import to_hex_ids
from manyeyes.maps.formats.geoparquet import MapFileError, bytes_to_map, map_to_bytes
from manyeyes.maps.store.object_store import ObjectStore
from manyeyes.maps.store.observation_log import tile_indices

Ints = NDArray[np.int64]

_MATCH_RADIUS_M = 1.0
_MIN_FRACTION = 0.5
_FILES = ("lines.parquet", "crossings.parquet")
_VERSION = 2


@dataclass(frozen=True, eq=False)
class MapDelta:
    """From one map to another. changed: the elements that are new or other, as they are afterwards. added: (A,) ids of those that
    are new, in hexadecimal, ascending. deleted: ids that are no more, ascending, with deleted_tiles (D, 2), where they stood.
    """

    changed: VectorMap
    added: tuple[str, ...]
    deleted: tuple[str, ...]
    deleted_tiles: Ints

    @property
    def modified(self) -> tuple[str, ...]:
        """Ids of elements that are other than before, ascending."""
        return tuple(sorted(set(to_hex_ids(self.changed.id)) - set(self.added)))

    def by_tile(self) -> list[tuple[tuple[int, int], int, int, int]]:
        """Return (tile, added, modified, deleted) of every tile where anything changed, by tile."""
        new = set(self.added)
        tiles = [(int(x), int(y)) for x, y in compute_home_tiles(self.changed)]
        names = to_hex_ids(self.changed.id)
        add = Counter(t for t, name in zip(tiles, names) if name in new)
        change = Counter(t for t, name in zip(tiles, names) if name not in new)
        gone = Counter((int(x), int(y)) for x, y in self.deleted_tiles)
        return [(t, add[t], change[t], gone[t]) for t in sorted({*add, *change, *gone})]


def compute_home_tiles(vector_map: VectorMap) -> Ints:
    """Return (N, 2) the tile that each element is stored in: that of its canonical start, the lesser end or a ring's least
    point.
    """
    e = vector_map.elements
    if not len(e):
        return np.zeros((0, 2), np.int64)
    head, tail = e.points[e.offsets[:-1]], e.points[e.offsets[1:] - 1]
    later = (tail[:, 0] < head[:, 0]) | ((tail[:, 0] == head[:, 0]) & (tail[:, 1] < head[:, 1]))
    start = np.where(later[:, None], tail, head)
    for row in np.flatnonzero(e.closed).tolist():
        ring = e.polyline(row)
        start[row] = ring[np.lexsort((ring[:, 1], ring[:, 0]))[0]]
    return tile_indices(start)


def compute_delta(before: VectorMap, after: VectorMap, own: Ints | None = None, former: Ints | None = None) -> MapDelta:
    """What to add, modify and delete to come from one map to the other; equal to 1 cm, in one state, is unchanged.

    own: rows of ``after`` that count; former: rows of ``before`` that may be gone. By default all: a part of a map has its own
    rows, and around them what their ids are compared with.
    """
    own = np.arange(len(after)) if own is None else own
    former = np.arange(len(before)) if former is None else former
    old, new = to_hex_ids(before.id), to_hex_ids(after.id)
    old_digests = dict(zip(old, compute_element_digests(before.elements, before.state, 1.0).tolist()))
    new_digests = compute_element_digests(after.elements.take(own), after.state[own], 1.0).tolist()
    rows = [k for k, digest in zip(own.tolist(), new_digests) if old_digests.get(new[k]) != digest]
    kept = set(new)
    gone = sorted((old[k], k) for k in former.tolist() if old[k] not in kept)
    return MapDelta(
        changed=after.take(np.array(rows, np.int64)),
        added=tuple(sorted(new[k] for k in own.tolist() if new[k] not in old_digests)),
        deleted=tuple(name for name, _ in gone),
        deleted_tiles=compute_home_tiles(before)[np.array([k for _, k in gone], np.int64)],
    )


def apply_delta(before: VectorMap, delta: MapDelta) -> VectorMap:
    """Return the map after the delta, elements by ascending id; relations between changed and unchanged elements are left out."""
    drop = {*delta.deleted, *to_hex_ids(delta.changed.id)}
    kept = np.array([k for k, name in enumerate(to_hex_ids(before.id)) if name not in drop], np.int64)
    after = VectorMap.cat([before.take(kept), delta.changed])
    return after.take(np.lexsort(after.id.T[::-1]))


def write_delta(delta: MapDelta, objects: ObjectStore, folder: str, part: str) -> None:
    """Write the part of a delta: ``PART.lines.parquet`` and ``PART.crossings.parquet`` of what changed, then ``PART.json``."""
    for name, data in zip(_FILES, map_to_bytes(delta.changed)):
        objects.put(f"{folder}/{part}.{name}", data)
    tiles = [
        {"x": x, "y": y, "added": added, "modified": modified, "deleted": deleted}
        for (x, y), added, modified, deleted in delta.by_tile()
    ]
    gone = [{"id": name, "tile": tile} for name, tile in zip(delta.deleted, delta.deleted_tiles.tolist(), strict=True)]
    text = json.dumps({"added": list(delta.added), "deleted": gone, "tiles": tiles}, indent=1)
    objects.put(f"{folder}/{part}.json", text.encode())


def write_delta_parts(parts: Sequence[str], objects: ObjectStore, folder: str) -> None:
    """Write ``delta.json``, which names the parts of a delta; it is whole from then on."""
    objects.put(f"{folder}/delta.json", json.dumps({"version": _VERSION, "parts": list(parts)}, indent=1).encode())


def read_delta(objects: ObjectStore, folder: str) -> MapDelta:
    """Return a delta from its parts; of version 1, from its one part."""
    place = f"{objects.location}/{folder}"
    try:
        content = json.loads(objects.get(f"{folder}/delta.json"))
        prefixes = [""] if content["version"] == 1 else [f"{name}." for name in content["parts"]]
        parts = (
            [content] if content["version"] == 1 else [json.loads(objects.get(f"{folder}/{p}json")) for p in prefixes]
        )
        gone = sorted((one["id"], tuple(one["tile"])) for part in parts for one in part["deleted"])
        tiles = np.array([tile for _, tile in gone], np.int64).reshape(-1, 2)
        added = tuple(sorted(name for part in parts for name in part["added"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise MapFileError(f"{place}: expected the delta of a map; {type(error).__name__} {reason}.") from None
    files = [f"{prefix}{name}" for prefix in prefixes for name in _FILES]
    changed = bytes_to_map((f"{place}/{name}", objects.get(f"{folder}/{name}")) for name in files)
    return MapDelta(changed, added, tuple(name for name, _ in gone), tiles)


def transfer_ids(after: VectorMap, before: VectorMap) -> VectorMap:
    """Return the map with the ids of the elements of an earlier one that its own continue; the others keep theirs.

    A new element continues an old one if each is the best for the other: that of the same content, else the largest share of
    common points, then the smaller id. So what is decided depends on the elements around alone, and regions decide the same.
    """
    old, new = to_hex_ids(before.id), to_hex_ids(after.id)
    same = set(old) & set(new)
    rows_new = np.array([k for k, name in enumerate(new) if name not in same], np.int64)
    rows_old = np.array([k for k, name in enumerate(old) if name not in same], np.int64)
    ids = after.id.copy()
    best_new, best_old = dict[int, tuple[float, str, int]](), dict[int, tuple[float, str, int]]()
    for share, row, twin in _find_overlaps(after, rows_new, before, rows_old):
        best_old[row] = min(best_old.get(row, (1.0, "", -1)), (-share, old[twin], twin))
        best_new[twin] = min(best_new.get(twin, (1.0, "", -1)), (-share, new[row], row))
    for row, (_, _, twin) in best_old.items():
        if best_new[twin][2] == row:
            ids[row] = before.id[twin]
    return replace(after, id=ids)


def _find_overlaps(a: VectorMap, rows_a: Ints, b: VectorMap, rows_b: Ints) -> list[tuple[float, int, int]]:
    """Return (share, row of a, row of b) of elements of one kind that share at least half of the shorter one's points."""
    if not (len(rows_a) and len(rows_b)):
        return []
    try:
        import shapely
    except ImportError:
        raise MissingExtraError("map", "Comparing maps") from None
    one, other = a.elements.take(rows_a), b.elements.take(rows_b)
    boxes = shapely.box(*(one.bounds() + (-_MATCH_RADIUS_M, -_MATCH_RADIUS_M, _MATCH_RADIUS_M, _MATCH_RADIUS_M)).T)
    i, k = shapely.STRtree(shapely.box(*other.bounds().T)).query(boxes)
    same_kind = one.kind[i] == other.kind[k]
    i, k = i[same_kind], k[same_kind]
    length_a, length_b = one.lengths(), other.lengths()
    out = []
    for row, twin in zip(i.tolist(), k.tolist()):
        shorter, longer = (one, row), (other, twin)
        if length_a[row] > length_b[twin]:
            shorter, longer = longer, shorter
        line = longer[0].polyline(longer[1])
        line = np.concatenate((line, line[:1])) if longer[0].closed[longer[1]] else line
        share = float(_fraction_near(shorter[0].polyline(shorter[1]), np.ascontiguousarray(line), _MATCH_RADIUS_M))
        if share >= _MIN_FRACTION:
            out.append((share, int(rows_a[row]), int(rows_b[twin])))
    return out


@njit(cache=True)
def _fraction_near(points: F64x2, line: F64x2, radius: float) -> float:  # pragma: no cover - compiled
    """Return the share of points (K, 2) within reach metres of a polyline (M, 2)."""
    near = 0
    for k in range(len(points)):
        for m in range(len(line) - 1):
            dx, dy = line[m + 1, 0] - line[m, 0], line[m + 1, 1] - line[m, 1]
            px, py = points[k, 0] - line[m, 0], points[k, 1] - line[m, 1]
            square = dx * dx + dy * dy
            along = 0.0 if square == 0.0 else min(max((px * dx + py * dy) / square, 0.0), 1.0)
            if (px - along * dx) ** 2 + (py - along * dy) ** 2 <= radius * radius:
                near += 1
                break
    return near / len(points)
