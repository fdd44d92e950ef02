# SPDX-License-Identifier: Apache-2.0
"""Write a release region by region, on the workers of an engine: assemble elements, settle their ids, write tiles and delta.

A worker reads what lies around its region: linked stations, elements of neighbours, tiles of the release before. The process that
drives them holds names, boxes, and the tiles that the manifest names; no process holds the map.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.elements.vector_map import RETIRED, VectorMap
from manyeyes.maps.fusion.block_linking import LinkedStations, find_block_area, list_blocks
from manyeyes.maps.fusion.fuse import relate_elements
from manyeyes.maps.isolation import CONTENT_ERRORS, describe_error
from manyeyes.maps.store.executors import ExecutorSession
from manyeyes.maps.store.map_diff import compute_home_tiles, transfer_ids
from manyeyes.maps.store.object_store import StoreError
from manyeyes.maps.store.region_assembly import (
    RING_REACH_M,
    Bounds,
    Place,
    RegionMap,
    assemble_region,
    find_bounds,
    find_region,
    find_region_area,
    list_regions,
    take_near,
    touches,
    unite,
    widen,
)
from manyeyes.maps.store.releases import Manifest, ReleasePart, ReleaseStore, TileEntry, Watermark
from manyeyes.maps.store.tiled_fusion import ALGORITHM, WORK, FusionJob, StepProgress, load_result, put_results

Floats = NDArray[np.float64]

OVERLAP_M, RELATED_M = 2.0, 16.0
"""Elements that are farther apart do not continue each other; have no relations."""
EVERYWHERE: Bounds = (-np.inf, -np.inf, np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class BlockTable:
    """The blocks with linked stations: places (B, 2) int64, and the keys of the results."""

    places: NDArray[np.int64]
    keys: tuple[str, ...]

    def find(self, place: Place) -> str | None:
        """Return the key of a block, None where there is none."""
        rows = np.flatnonzero((self.places == place).all(1))
        return self.keys[rows[0]] if len(rows) else None


@dataclass(frozen=True, eq=False)
class RegionIds:
    """The ids (N, 16) uint8 of the elements of a region in the release."""

    ids: NDArray[np.uint8]


@dataclass(frozen=True)
class StoredRegion:
    """The elements of a region: keys of their RegionMap and, once they are settled, of their RegionIds; their box."""

    region: Place
    elements: str
    bounds: Bounds
    ids: str = ""

    def load(self, job: FusionJob) -> VectorMap:
        """Load the elements, with their settled ids."""
        found = load_result(job, self.elements, RegionMap).elements
        return replace(found, id=load_result(job, self.ids, RegionIds).ids) if self.ids else found


@dataclass(frozen=True)
class RegionJob:
    """What all regions of a release share. parent: number of the release before, 0: none; blocks: key of the table of blocks."""

    fusion: FusionJob
    published: ReleaseStore
    parent: int
    blocks: str


@dataclass(frozen=True)
class RegionTask:
    """One step of one region.

    box: of what is and of what was there, with a margin. keys: of the linked stations of the blocks around it. own: its elements,
    and near: those of regions around it; tiles: of the release before, around it.
    """

    job: RegionJob
    region: Place
    box: Bounds = EVERYWHERE
    keys: tuple[tuple[Place, str], ...] = ()
    own: StoredRegion | None = None
    near: tuple[StoredRegion, ...] = ()
    tiles: tuple[TileEntry, ...] = ()

    @property
    def name(self) -> str:
        """The name of the region in keys."""
        return f"{self.region[0]}_{self.region[1]}"

    def load_own(self) -> VectorMap:
        """Load the elements of the region."""
        return VectorMap.empty(self.job.published.frame) if self.own is None else self.own.load(self.job.fusion)

    def load_around(self, own: VectorMap, box: Bounds) -> VectorMap:
        """Return the elements of the region, and then those of others that touch a box."""
        others = (one.load(self.job.fusion) for one in self.near if touches(one.bounds, box))
        return VectorMap.cat([own, *(take_near(other, box) for other in others)])

    def load_before(self, box: Bounds) -> VectorMap:
        """Load the elements of the release before that touch a box."""
        tiles = [tile for tile in self.tiles if touches(_bounds_of(tile), box)]
        return take_near(self.job.published.read_tiles(self.job.parent, tiles), box)


def write_release(
    job: FusionJob,
    published: ReleaseStore,
    blocks: Sequence[str],
    watermark: Watermark,
    session: ExecutorSession,
    progress: StepProgress | None = None,
) -> Manifest:
    """Write the objects of the next release; it is there once ``published.commit`` has created its manifest.

    blocks: keys of the linked stations of all blocks.
    """
    parent, tiles = published.parent()
    places = {_find_block(key): key for key in blocks}
    table = BlockTable(np.array(list(places), np.int64).reshape(-1, 2), tuple(places.values()))
    (stored,) = put_results(job.work, f"{WORK}/blocks", {"table": table}, "")
    release = _Release(RegionJob(job, published, parent, stored), places, tiles, session, progress)
    regions = release.assemble()
    if parent:
        regions = release.settle(regions)
    parts = release.publish(regions)
    return published.finish(parts, parent + 1, ALGORITHM, repr(job.config), watermark)


@dataclass(frozen=True, eq=False)
class _Release:
    """The steps of a release. places: keys of linked stations by block; tiles: of the release before."""

    job: RegionJob
    places: Mapping[Place, str]
    tiles: tuple[TileEntry, ...]
    session: ExecutorSession
    progress: StepProgress | None

    def assemble(self) -> dict[Place, StoredRegion]:
        """Assemble the elements of all regions; regions without any are left out."""
        link = self.job.fusion.config.link
        regions = list_regions([find_block_area(place, link) for place in self.places])

        def tasks() -> Iterator[RegionTask]:
            for region in regions:
                near = list_blocks([widen(find_region_area(region), RING_REACH_M)], link)
                keys = tuple((block, self.places[block]) for block in near if block in self.places)
                yield RegionTask(self.job, region, keys=keys)

        found = dict[Place, StoredRegion]()
        for done, (_, one) in enumerate(self.session.run(_assemble, tasks()), 1):
            if one is not None:
                found[one.region] = one
            self._report("assemble", done, len(regions))
        return dict(sorted(found.items()))

    def settle(self, regions: Mapping[Place, StoredRegion]) -> dict[Place, StoredRegion]:
        """Settle the ids of all elements."""
        around = _Neighbours(tuple(regions.values()), self.tiles)

        def tasks() -> Iterator[RegionTask]:
            for region, own in regions.items():
                box = around.find_box(region, own)
                near, tiles = around.find(region, box)
                # Whether a neighbour continues an old element depends on what touches that one, and so on once.
                wide = unite(box, *(one.bounds for one in near), *map(_bounds_of, tiles))
                near, tiles = around.find(region, widen(wide, OVERLAP_M))
                yield RegionTask(self.job, region, box, (), own, near, tiles)

        found = dict[Place, StoredRegion]()
        for done, (_, one) in enumerate(self.session.run(_settle, tasks()), 1):
            found[one.region] = one
            self._report("ids", done, len(regions))
        return dict(sorted(found.items()))

    def publish(self, regions: Mapping[Place, StoredRegion]) -> list[ReleasePart]:
        """Write the tiles and the deltas of all regions, and of those where elements were."""
        around = _Neighbours(tuple(regions.values()), self.tiles)
        places = sorted(regions.keys() | set(around.homes))

        def tasks() -> Iterator[RegionTask]:
            for region in places:
                own = regions.get(region)
                box = around.find_box(region, own)
                yield RegionTask(self.job, region, box, (), own, *around.find(region, widen(box, RELATED_M)))

        found = dict[int, ReleasePart]()
        for done, (index, part) in enumerate(self.session.run(_publish, tasks()), 1):
            found[index] = part
            self._report("publish", done, len(places))
        return [found[index] for index in range(len(found))]

    def _report(self, name: str, done: int, total: int) -> None:
        if self.progress is not None:
            self.progress(name, done, total)


class _Neighbours:
    """The regions and the tiles of the release before, by boxes. homes: rows of the tiles of each region."""

    def __init__(self, regions: tuple[StoredRegion, ...], tiles: tuple[TileEntry, ...]) -> None:
        self._regions, self._tiles = regions, tiles
        self._boxes = np.array([one.bounds for one in regions]).reshape(-1, 4)
        self._tile_boxes = np.array([_bounds_of(tile) for tile in tiles]).reshape(-1, 4)
        self.homes = dict[Place, list[int]]()
        for row, (x, y) in enumerate(find_region(np.array([(t.x, t.y) for t in tiles]).reshape(-1, 2)).tolist()):
            self.homes.setdefault((x, y), []).append(row)

    def find_box(self, region: Place, own: StoredRegion | None) -> Bounds:
        """Return the box of what is and of what was in a region, with a margin."""
        boxes = [_bounds_of(self._tiles[row]) for row in self.homes.get(region, ())]
        return widen(unite(*boxes, *([] if own is None else [own.bounds])), OVERLAP_M)

    def find(self, region: Place, box: Bounds) -> tuple[tuple[StoredRegion, ...], tuple[TileEntry, ...]]:
        """Return the other regions and the tiles that touch a box."""
        near = (self._regions[row] for row in _touching(self._boxes, box))
        tiles = tuple(self._tiles[row] for row in _touching(self._tile_boxes, box))
        return tuple(one for one in near if one.region != region), tiles


def _assemble(task: RegionTask) -> StoredRegion | None:
    """Assemble the elements of a region and store them; None without any."""
    job, config = task.job.fusion, task.job.fusion.config
    keys, table = dict(task.keys), list[BlockTable]()
    around = set(list_blocks([widen(find_region_area(task.region), RING_REACH_M)], config.link))

    def load(block: Place) -> LinkedStations | None:
        key = keys.get(block)
        if block not in around:
            # A line that leads far out of the region, which is rare.
            if not table:
                table.append(load_result(job, task.job.blocks, BlockTable))
            key = table[0].find(block)
        return None if key is None else load_result(job, key, LinkedStations)

    try:
        found = assemble_region(task.region, load, config, task.job.published.frame)
    except CONTENT_ERRORS as error:
        area = ", ".join(f"{side:g}" for side in find_region_area(task.region))
        raise StoreError(
            f"{job.work.location}: expected lines in the area ({area}) m, but {describe_error(error)} Report it with this line, or "
            "retract the observations of that area."
        ) from error
    if not len(found.elements):
        return None
    (key,) = put_results(job.work, f"{WORK}/region/{task.name}", {"elements": found}, "")
    return StoredRegion(task.region, key, found.bounds)


def _settle(task: RegionTask) -> StoredRegion:
    """Settle the ids of the elements of a region: those of the elements before that they continue."""
    assert task.own is not None
    own = task.load_own()
    before, after = task.load_before(task.box), task.load_around(own, task.box)
    boxes = (task.box, widen(find_bounds(after), OVERLAP_M), widen(find_bounds(before), OVERLAP_M))
    before, after = task.load_before(unite(*boxes[:2])), task.load_around(own, unite(boxes[0], boxes[2]))
    ids = transfer_ids(after, before).id[: len(own)]
    job = task.job.fusion
    (key,) = put_results(job.work, f"{WORK}/ids/{task.name}", {"ids": RegionIds(ids)}, "")
    return replace(task.own, ids=key)


def _publish(task: RegionTask) -> ReleasePart:
    """Write the tiles of a region and its part of the delta."""
    before = task.load_before(task.box)
    after = relate_elements(_order(task.load_around(task.load_own(), widen(task.box, RELATED_M))))
    own, former = (_find_home_rows(one, task.region) for one in (after, before))
    number = task.job.parent + 1
    return task.job.published.write_part(task.name, number, before, after, own, former, task.tiles)


def _find_home_rows(vector_map: VectorMap, region: Place) -> NDArray[np.int64]:
    return np.flatnonzero((find_region(compute_home_tiles(vector_map)) == region).all(1))


def _order(vector_map: VectorMap) -> VectorMap:
    """Return the elements in the order of a map fused in one piece: lines, retired ones, crossings; each by their first point."""
    elements = vector_map.elements
    start = elements.points[elements.offsets[:-1]] if len(elements) else np.zeros((0, 2))
    is_retired = (vector_map.state == RETIRED) & ~elements.closed
    return vector_map.take(np.lexsort((start[:, 1], start[:, 0], is_retired, elements.closed)))


def _find_block(key: str) -> Place:
    """Return the block of a key of linked stations: the name of its folder."""
    x, y = key.split("/")[-2].split("_")
    return int(x), int(y)


def _bounds_of(tile: TileEntry) -> Bounds:
    return EVERYWHERE if tile.bounds is None else tile.bounds


def _touching(boxes: Floats, box: Bounds) -> list[int]:
    """Return the rows of the boxes (N, 4) that touch a box."""
    near = (boxes[:, 0] <= box[2]) & (box[0] <= boxes[:, 2]) & (boxes[:, 1] <= box[3]) & (box[1] <= boxes[:, 3])
    return np.flatnonzero(near).tolist()
