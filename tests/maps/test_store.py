# SPDX-License-Identifier: Apache-2.0
"""A store keeps every observation once, every release whole, and knows what changed; a writer may be killed at any moment."""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.observation_file import write_observations
from manyeyes.maps.elements.observation_limits import LIMITS
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.attributes import to_hex_ids
from manyeyes.maps.store.map_diff import apply_delta, compute_delta, compute_home_tiles, transfer_ids
from manyeyes.maps.store.object_store import StoreError, hold_lock
from manyeyes.maps.store.observation_log import read_active
from manyeyes.maps.store.store import MapStore, compute_watermark

pytest.importorskip("pyarrow", reason="the map extra is not installed")
pytest.importorskip("shapely", reason="the map extra is not installed")

FRAME = MapFrame(48.137, 11.575)
MARK = compute_watermark((), np.zeros(0, np.int64))


def _observation(k: int, x: float | None = None) -> Observation:
    line = MapElements.of([np.array([[0.0, 1.0], [20.0, 1.0]])], DIVIDER)
    view = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
    pose = np.array([40.0 * k if x is None else x, 5.0 * k, 0.0])
    return Observation(f"agent{k}", "pass", k, pose, np.diag((0.5, 0.5, 1e-4)), view, line)


def _lines(*ys: float, x: float = 0.0) -> VectorMap:
    return VectorMap.of(
        MapElements.of([np.stack((np.arange(x, x + 31), np.full(31, y)), 1) for y in ys], DIVIDER), FRAME
    )


def test_the_log_stores_each_observation_once_and_round_trips(tmp_path):
    store = MapStore.create(tmp_path / "s", FRAME)
    many = [_observation(k) for k in range(300)]
    with store.open_for_writing() as log:
        assert log.append(many[:200]) == (200, 0)
        assert log.append(many[150:]) == (100, 50)
        assert log.append(many[:10]) == (0, 10)
        standing = log.active_observations()
    assert len(list((tmp_path / "s/log").iterdir())) == 2
    assert standing.ids == tuple(sorted(o.id for o in many))
    rows = np.flatnonzero(standing.xy[:, 0] > 7000)
    got = read_active(store.objects, standing, rows)
    want = sorted((o for o in many if o.pose[0] > 7000), key=lambda o: o.id)
    assert [o.id for o in got] == [o.id for o in want] and len(want) == 124
    assert standing.radius_m[0] == pytest.approx(np.hypot(30, 15))


def test_a_retracted_observation_counts_no_more_and_does_not_come_back(tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    many = [_observation(k) for k in range(5)]
    with store.open_for_writing() as log:
        log.append(many)
        log.retract([many[2].id], "asked for by its driver")
        assert log.append([many[2]]) == (0, 1)
        assert set(log.active_observations().ids) == {o.id for o in many} - {many[2].id}
        with pytest.raises(StoreError, match=r"no observation 00+"):
            log.retract(["00" * 16], "unknown")


def test_observations_are_found_by_the_start_of_an_id_and_by_agent_and_pass(tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    many = [_observation(k) for k in range(40)]
    with store.open_for_writing() as log:
        log.append(many)
        one = many[7]
        assert log.find([one.id]) == log.find([one.id[:9], one.id[:10].upper()]) == (one.id,)
        assert log.find(agent="agent7") == log.find(agent="agent7", pass_id="pass") == (one.id,)
        assert log.find(pass_id="pass") == tuple(sorted(o.id for o in many))
        digit = one.id[0]
        count = sum(o.id[0] == digit for o in many)
        cases: tuple[tuple[dict[str, Any], str], ...] = (
            ({"ids": [digit]}, rf"{count} observations have an id that starts with {digit}; give more digits"),
            ({"ids": ["0" * 33]}, r"32 hexadecimal digits"),
            ({"ids": [""]}, r"32 hexadecimal digits"),
            ({"agent": "agnt7"}, r"agent 'agnt7'; did you mean 'agent\d*7'"),
            ({"agent": "agent7", "pass_id": "?"}, r"pass '\?'; there are 1 others"),
        )
        for words, text in cases:
            with pytest.raises(StoreError, match=text):
                log.find(**words)


def test_retraction_returns_count_and_appends_once(tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    many = [_observation(k) for k in range(5)]
    with store.open_for_writing() as log:
        log.append(many)
        assert log.retract([many[0].id, many[1].id], "test") == 2
        entries = store.objects.list("log")
        assert log.retract([many[0].id], "again") == 0 and store.objects.list("log") == entries
        assert log.retract([many[0].id, many[2].id], "more") == 1
        assert len(log.active_observations()) == 2


def test_other_limits_make_the_index_again_and_rows_outside_are_quarantined(tmp_path, monkeypatch):
    store = MapStore.create(tmp_path, FRAME)
    many = [_observation(k) for k in range(300)]
    far = [o for o in many if o.pose[0] > 10_000.0]
    with store.open_for_writing() as log:
        log.append(many)
        before = log.active_observations()
        log.retract([many[0].id], "test")
    narrow = replace(LIMITS, max_position_m=10_000.0)
    for module in ("elements.observation", "store.observation_log"):
        monkeypatch.setattr(f"manyeyes.maps.{module}.LIMITS", narrow)
    with MapStore(tmp_path).open_for_writing() as log:
        assert len(log.rejected) == len(log.index.list_rejected()) == len(far) == 49
        assert set(log.active_observations().ids) == {o.id for o in many} - {o.id for o in (*far, many[0])}
        rows = np.arange(len(log.active_observations()))
        assert len(read_active(log.objects, log.active_observations(), rows)) == len(rows)
        assert log.find(agent=far[0].agent) == (far[0].id,) and log.retract([far[0].id], "far") == 1
    with MapStore(tmp_path).open_for_writing() as log:
        assert log.rejected == () and len(log.index.list_rejected()) == len(far)
    monkeypatch.undo()
    with MapStore(tmp_path).open_for_writing() as log:
        assert set(log.active_observations().ids) == {o.id for o in many} - {far[0].id, many[0].id}
        assert log.index.list_rejected() == []
    assert len(before) == 300


def test_ingest_rejects_invalid_entries_with_a_reason_and_keeps_the_rest(tmp_path):
    good = [_observation(k) for k in range(4)]
    (tmp_path / "in").mkdir()
    write_observations(tmp_path / "in/a.parquet", good, FRAME)
    write_observations(tmp_path / "in/b.parquet", [_observation(9)], MapFrame(10.0, 10.0))
    (tmp_path / "in/c.parquet").write_bytes((tmp_path / "in/a.parquet").read_bytes()[:500])
    store = MapStore.create(tmp_path / "s", FRAME)
    with store.open_for_writing() as log:
        done = log.ingest(tmp_path / "in")
        rows = log.index.list_rejected()
    assert (done.num_added, len(done.rejected)) == (4, 2)
    reasons = {Path(file).name: reason for file, _, _, reason in rows}
    assert "origin" in reasons["b.parquet"] and "whole Parquet file" in reasons["c.parquet"]


def test_the_index_is_made_again_from_the_log(tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    with store.open_for_writing() as log:
        log.append([_observation(k) for k in range(5)])
        log.retract([_observation(3).id], "test")
        before = log.active_observations()
    for path in tmp_path.glob("catalogue.sqlite*"):
        path.unlink()
    with MapStore(tmp_path).open_for_writing() as log:
        after = log.active_observations()
    assert after.ids == before.ids and len(after) == 4
    np.testing.assert_array_equal(after.xy, before.xy)
    np.testing.assert_array_equal(after.row_group, before.row_group)


def test_release_round_trip_keeps_watermark(two_lanes, tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    first = VectorMap.cat([two_lanes(), two_lanes(1000.0, -700.0)])
    mark = compute_watermark(["ab" * 16], np.array([7]))
    manifest = store.publish(first, "union", "tau=1", mark)
    assert (manifest.number, manifest.parent, manifest.elements, manifest.watermark) == (1, 0, 10, mark)
    assert (manifest.algorithm, manifest.settings) == ("union", "tau=1")
    assert [(t.x, t.y, t.elements) for t in manifest.tiles] == [(0, -1, 2), (0, 0, 3), (3, -3, 5)]
    assert MapStore(tmp_path).manifest() == manifest
    got = store.read()
    assert got.quantised_hash() == first.quantised_hash() == manifest.content
    # Neighbours in another tile are still known, as relations are stored by id.
    assert {tuple(p) for p in got.topology.right.tolist()} and len(got.topology.right) == len(first.topology.right)
    near = store.read(area=(900.0, -800.0, 1100.0, -600.0))
    assert sorted(to_hex_ids(near.id)) == sorted(to_hex_ids(first.id[5:]))


def test_equal_tiles_are_stored_once_for_all_releases(two_lanes, tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    far = two_lanes(1000.0, -700.0)
    store.publish(VectorMap.cat([two_lanes(), far]), "a", "", MARK)
    count = len(list((tmp_path / "tiles").rglob("*.parquet")))
    one, two = store.manifest(), store.publish(VectorMap.cat([two_lanes(y=0.3), far]), "a", "", MARK)
    assert one.tiles[-1] == two.tiles[-1]
    assert {t.x for t in two.tiles if t not in one.tiles} == {0}
    assert len(list((tmp_path / "tiles").rglob("*.parquet"))) > count
    assert store.read(1).quantised_hash() == one.content != two.content == store.read().quantised_hash()


def test_a_delta_turns_the_parent_into_the_release_and_counts_by_tile(tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    store.publish(_lines(10, 20, 30), "a", "", MARK)
    store.publish(VectorMap.cat([_lines(10, 20.5), _lines(300, x=600.0)]), "a", "", MARK)
    delta = store.delta(2)
    # The line that moved by half a metre keeps its id; the one at 30 m is gone; one is new, two tiles on.
    before, after = store.read(1), store.read(2)
    assert len(delta.added) == len(delta.modified) == len(delta.deleted) == 1
    assert delta.modified[0] in to_hex_ids(before.id)
    assert delta.by_tile() == [((0, 0), 0, 1, 1), ((2, 1), 1, 0, 0)]
    made = apply_delta(before, delta)
    assert made.quantised_hash() == after.quantised_hash() and to_hex_ids(made.id) == to_hex_ids(after.id)
    assert len(store.delta(1).added) == 3


def test_ids_go_to_the_largest_overlap_and_only_once():
    before, after = _lines(10, 20), _lines(10.4, 10.8, 20.2)
    got = transfer_ids(after, before)
    assert to_hex_ids(got.id)[2] == to_hex_ids(before.id)[1]
    inherited = [name for name in to_hex_ids(got.id)[:2] if name == to_hex_ids(before.id)[0]]
    assert len(inherited) == 1
    other_kind = replace(before, elements=replace(before.elements, kind=np.array([1, 1])))
    assert to_hex_ids(transfer_ids(after, other_kind).id) == to_hex_ids(after.id)
    assert len(compute_delta(after, after).changed) == 0


def test_an_element_is_stored_in_the_tile_of_its_lesser_end(two_lanes):
    m = _lines(10, x=250.0)
    back = replace(m, elements=m.elements.with_points(m.elements.points[::-1]))
    assert compute_home_tiles(m).tolist() == compute_home_tiles(back).tolist() == [[0, 0]]
    assert compute_home_tiles(two_lanes(250.0, 0.0)).tolist()[3] == [1, -1]


def test_damage_of_the_log_is_named_and_rows_that_are_not_asked_for_are_no_matter(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as parquet

    store, seen = MapStore.create(tmp_path / "s", FRAME), [_observation(k) for k in range(4)]
    with store.open_for_writing() as log:
        log.append(seen)
        active = log.active_observations()
    (path,) = (tmp_path / "s/log").glob("*.parquet")
    whole = parquet.read_table(path)
    ids = whole["id"].to_pylist()
    poses = [x + 1.0 if name == active.ids[0] else x for name, x in zip(ids, whole["x"].to_pylist())]
    parquet.write_table(whole.set_column(whole.column_names.index("x"), "x", pa.array(poses)), path)
    assert [o.id for o in read_active(store.objects, active, np.arange(1, 4))] == list(active.ids[1:])
    with pytest.raises(StoreError, match=rf"observation with id {active.ids[0]}.*Restore the file"):
        read_active(store.objects, active, np.arange(4))
    parquet.write_table(whole.drop_columns(["id"]), path)
    with pytest.raises(StoreError, match=r"whole segment of the log; .*id.*Restore it"):
        read_active(store.objects, active, np.arange(4))


def test_damage_is_named(two_lanes, tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    with pytest.raises(StoreError, match="no release yet"):
        store.manifest()
    store.publish(two_lanes(), "a", "", MARK)
    with pytest.raises(StoreError, match="no release 3; there are 1"):
        store.read(3)
    with pytest.raises(StoreError, match="choose another folder"):
        MapStore.create(tmp_path, MapFrame(1.0, 1.0))
    with pytest.raises(StoreError, match=r"store\.json"):
        MapStore(tmp_path / "nowhere")
    path = next((tmp_path / "tiles").rglob("*.lines.parquet"))
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(StoreError, match="missing or damaged"):
        store.read()
    for version in (99,):
        file = tmp_path / "releases/000001.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), "version": version}))
        with pytest.raises(StoreError, match="version 99"):
            store.manifest()


def test_two_writers_do_not_meet(tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    with hold_lock(tmp_path / "lock"), pytest.raises(StoreError, match="another program"), store.open_for_writing():
        pass
    with store.open_for_writing():
        pass


@pytest.mark.slow
def test_a_writer_killed_at_any_moment_leaves_a_whole_release_and_a_whole_log():
    step, timed = 8, 2
    script = Path(__file__).with_name("killed_writer.py")
    # In memory where that can be had: a kill, unlike a loss of power, does not ask what has reached the disk.
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as folder:
        command = [sys.executable, str(script), folder, str(step), str(timed)]
        report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    killed = [case for case in report["cases"] if case["killed"]]
    assert len(killed) >= 8
    assert report["want"]["release"] == 2 and report["want"]["unfinished"] == []
    releases, seconds = set(), set()
    for case in report["cases"]:
        seen = json.loads(case["seen"])
        assert seen["whole"] and seen["first"] and seen["second"] in (0, 40), case
        releases.add(seen["release"])
        seconds.add(seen["second"])
        # The next writer completes the work, and no trace of the killed one remains.
        assert json.loads(case["end"]) == report["want"], case
    assert seconds == {0, 40} and 1 in releases
