# SPDX-License-Identifier: Apache-2.0
"""A release that is written region by region is that of the whole map: elements, ids, relations, tiles and delta."""

from __future__ import annotations

import json

import numpy as np
import pytest

from manyeyes.maps.elements.vector_map import ContentSum, VectorMap
from manyeyes.maps.formats.attributes import to_hex_ids
from manyeyes.maps.fusion.fuse import MapFusionConfig, fuse
from manyeyes.maps.fusion.polyline_linking import LinkConfig
from manyeyes.maps.store import region_assembly
from manyeyes.maps.store.executors import InlineExecutor
from manyeyes.maps.store.object_store import StoreError
from manyeyes.maps.store.store import MapStore
from manyeyes.maps.store.tiled_fusion import ALGORITHM, TiledFusionConfig
from manyeyes.simulator.fleet import load_place, simulate_crowd

pytest.importorskip("pyarrow", reason="the map extra is not installed")
pytest.importorskip("shapely", reason="the map extra is not installed")

# Blocks end at 40 m, 120 m and so on; regions of one tile meet in the middle of the crossroads.
CONFIG = MapFusionConfig(link=LinkConfig(block_m=80, block_halo_m=100.0))
TILES = TiledFusionConfig(90.0, 1)


@pytest.fixture(scope="module")
def crowd():
    return simulate_crowd(load_place("cross"), 20)


@pytest.fixture
def one_tile_regions(monkeypatch):
    monkeypatch.setattr(region_assembly, "REGION_TILES", 1)


def make_store(folder, crowd) -> MapStore:
    store = MapStore.create(folder, crowd.place.frame)
    with store.open_for_writing() as log:
        log.append(crowd.observations)
    return store


def publish_whole(store: MapStore, observations, watermark) -> None:
    store.publish(fuse(observations, CONFIG, store.frame), ALGORITHM, repr(CONFIG), watermark)


def retract(store: MapStore, ids) -> None:
    with store.open_for_writing() as log:
        log.retract(ids, "test")


@pytest.mark.slow
def test_regions_give_the_release_and_the_delta_of_the_whole_map(crowd, one_tile_regions, tmp_path):
    store, whole = make_store(tmp_path / "a", crowd), MapStore.create(tmp_path / "b", crowd.place.frame)
    seen = []
    first = store.fuse(CONFIG, TILES, InlineExecutor(), lambda *step: seen.append(step))
    publish_whole(whole, crowd.observations, first.watermark)
    assert first == whole.manifest() and len(first.tiles) == 4
    assert {name for name, done, total in seen if done == total} >= {"assemble", "publish"}
    gone = [o.id for o in crowd.observations[::3]]
    retract(store, gone)
    second = store.fuse(CONFIG, TILES, InlineExecutor(), lambda *step: seen.append(step))
    publish_whole(whole, [o for o in crowd.observations if o.id not in gone], second.watermark)
    assert ("ids", 4, 4) in seen
    # Tiles are equal byte by byte, with ids that outlive the change, relations and sources.
    assert second == whole.manifest() and second.content != first.content
    ours, theirs = store.delta(2), whole.delta(2)
    assert (ours.added, ours.modified, ours.deleted) == (theirs.added, theirs.modified, theirs.deleted)
    assert len(ours.modified) > 5 and ours.by_tile() == theirs.by_tile()
    assert set(to_hex_ids(store.read(2).id)) & set(to_hex_ids(store.read(1).id))
    topology = store.read().topology
    assert len(topology.successor) and len(topology.left)


@pytest.mark.slow
def test_a_region_without_observations_is_deleted_and_a_release_of_earlier_versions_continued(
    crowd, one_tile_regions, tmp_path
):
    store = make_store(tmp_path, crowd)
    first = store.fuse(CONFIG, TILES, InlineExecutor())
    # Manifests of earlier versions name no boxes of tiles, and their deltas have one part.
    path = tmp_path / "releases/000001.json"
    content = json.loads(path.read_text())
    for tile in content["tiles"]:
        del tile["bounds"]
    path.write_text(json.dumps(content))
    east = [o.id for o in crowd.observations if o.pose[0] > -60.0]
    retract(store, east)
    second = store.fuse(CONFIG, TILES, InlineExecutor())
    rest = [o for o in crowd.observations if o.id not in east]
    assert second.content == fuse(rest, CONFIG, store.frame).quantised_hash()
    assert {tile.x for tile in second.tiles} == {-1} and {tile.x for tile in first.tiles} == {-1, 0}
    delta = store.delta(2)
    assert {x for (x, _), _, _, deleted in delta.by_tile() if deleted} >= {0} and len(delta.modified)
    retract(store, [o.id for o in rest])
    third = store.fuse(CONFIG, TILES, InlineExecutor())
    assert third.elements == 0 and third.tiles == () and len(store.read()) == 0
    assert len(store.delta(3).deleted) == second.elements


def test_sums_of_parts_are_that_of_the_whole(two_lanes):
    whole = VectorMap.cat([two_lanes(), two_lanes(1000.0, -700.0)])
    parts = [whole.take(np.arange(len(whole)) % 3 == k) for k in range(3)]
    assert sum((ContentSum.of(part) for part in parts), ContentSum()).hexdigest() == whole.quantised_hash()
    assert ContentSum.of(whole.take(np.arange(len(whole) - 1))).hexdigest() != whole.quantised_hash()
    twice = VectorMap.cat([two_lanes(), two_lanes()])
    assert twice.quantised_hash() != two_lanes().quantised_hash()


def test_an_area_that_cannot_be_assembled_is_named_and_nothing_is_published(crowd, tmp_path, monkeypatch):
    store = make_store(tmp_path, crowd)

    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError("singular")

    with monkeypatch.context() as broken:
        broken.setattr(region_assembly, "assemble_elements", fail)
        with pytest.raises(StoreError, match=r"area \(-1024, -1024, 0, 0\) m, but .*LinAlgError: singular.*retract"):
            store.fuse(CONFIG, TILES, InlineExecutor())
    assert store.releases() == ()
    assert store.fuse(CONFIG, TILES, InlineExecutor()).number == 1
