# SPDX-License-Identifier: Apache-2.0
"""Commands read the map of a store at a URL as that of a store in a folder, by release, and their errors name URL and remedy."""

from __future__ import annotations

import json
import uuid
from pathlib import Path

import numpy as np
import pytest

from manyeyes.cli import main as cli
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.observation_file import read_observations
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.store.map_place import MapPlace
from manyeyes.maps.store.object_store import StoreError
from manyeyes.studies.map_folder import open_store, read_ground, read_vector_map, write_vector_map

pytest.importorskip("pyarrow", reason="the map extra is not installed")
pytest.importorskip("shapely", reason="the map extra is not installed")
pytest.importorskip("fsspec", reason="the cloud extra is not installed")

from manyeyes.maps.store.executors import InlineExecutor
from manyeyes.maps.store.store import MapStore

FRAME = MapFrame(48.137, 11.575)


def run(*words: object) -> int:
    return cli.main([str(word) for word in words])


def observation(k: int, x: float) -> Observation:
    line = MapElements.of([np.array([[-20.0, 1.0], [20.0, 1.0]])], DIVIDER)
    view = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
    return Observation(f"agent{k % 3}", "pass", k, np.array([x, 0.0, 0.0]), np.diag((0.1, 0.1, 1e-4)), view, line)


EARLY = [observation(k, 100.0 + 4.0 * k) for k in range(4)]
LATE = [observation(10 + k, 200.0 + 4.0 * k) for k in range(4)]


@pytest.fixture(params=["folder", "memory", "s3"])
def store(request, tmp_path, monkeypatch) -> str:
    """The place of a store of two releases: of EARLY, and of EARLY and LATE, which is 100 m farther on."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    place = str(tmp_path / "city")
    if request.param == "memory":
        place = f"memory://{uuid.uuid4().hex}/city"
    if request.param == "s3":
        place = use_s3(request.getfixturevalue("s3_options"), monkeypatch)
        request.addfinalizer(forget_s3)
    made = MapStore.create(place, FRAME)
    for observations in (EARLY, LATE):
        with made.open_for_writing() as log:
            log.append(observations)
        made.fuse(executor=InlineExecutor())
    return place


def use_s3(options: tuple[tuple[str, str], ...], monkeypatch: pytest.MonkeyPatch) -> str:
    """Set the environment of a worker, and return the URL of a store in a new bucket."""
    import s3fs

    values = dict(options)
    monkeypatch.setenv("AWS_ENDPOINT_URL", values["endpoint_url"])
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", values["key"])
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", values["secret"])
    forget_s3()
    bucket = f"b{uuid.uuid4().hex}"
    s3fs.S3FileSystem(**values).mkdir(bucket)
    return f"s3://{bucket}/city"


def forget_s3() -> None:
    """Drop the file systems, which keep the environment that they were made in."""
    import s3fs

    from manyeyes.maps.store import object_store

    object_store._file_system.cache_clear()
    s3fs.S3FileSystem.clear_instance_cache()


def test_a_place_is_a_folder_or_a_url_with_a_release(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert MapPlace.parse("s3://bucket/city/@12") == MapPlace("s3://bucket/city", 12)
    assert MapPlace.parse("s3://user@host/city") == MapPlace("s3://user@host/city")
    assert MapPlace.parse("a/city/") == MapPlace.parse(Path("./a/city")) == MapPlace.parse("file://a/city")
    assert MapPlace.parse("city@2") == MapPlace("city", 2) and str(MapPlace("city", 2)) == "city@2"
    Path("city@2").mkdir()
    assert MapPlace.parse("city@2") == MapPlace("city@2")
    at_url = MapPlace("s3://bucket/city", 2)
    assert (at_url.folder, at_url.name, at_url.output_folder) == (None, "city@2", Path("out/map/city@2"))
    assert at_url.exists() and at_url.beside("truth") is None
    (tmp_path / "truth").mkdir()
    assert MapPlace("city").beside("truth") == Path("truth") and MapPlace("city").output_folder == Path("city")


def test_a_map_is_read_by_release_at_any_place(store):
    releases = [read_vector_map(f"{store}@{number}") for number in (1, 2)]
    assert releases[0].elements.points[:, 0].max() < 150 < releases[1].elements.points[:, 0].max()
    assert read_vector_map(store).quantised_hash() == releases[1].quantised_hash()
    with pytest.raises(StoreError, match=r"no release 3; there are 1, 2\."):
        read_vector_map(f"{store}@3")


def test_the_ground_of_a_release_is_what_its_own_observations_saw(store):
    points = np.array([[100.0, 0.0], [210.0, 0.0]])
    for place, seen in ((f"{store}@1", [True, False]), (store, [True, True])):
        assert read_ground(place, read_vector_map(place)).covers(points, FRAME).tolist() == seen
    made = open_store(store)
    with made.open_for_writing() as log:
        log.retract([LATE[0].id], "test")
    # No beginning of the log is what a release was made of: all that count stand for it.
    assert {o.id for o in made.observations_of(2)} == {o.id for o in (*EARLY, *LATE[1:])}


def test_the_log_of_another_machine_is_indexed_to_be_read(tmp_path, monkeypatch, s3_options):
    place = use_s3(s3_options, monkeypatch)
    try:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "one"))
        made = MapStore.create(place, FRAME)
        with made.open_for_writing() as log:
            log.append(EARLY)
        made.fuse(executor=InlineExecutor())
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
        assert len(read_vector_map(place)) > 0 and not (tmp_path / "other").exists()
        assert [o.id for o in open_store(place).observations_of()] == sorted(o.id for o in EARLY)
    finally:
        forget_s3()


def test_commands_read_a_store_at_any_place(store, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("map", "export", store, "last.geojson") == 0 and run("map", "export", f"{store}@1", "first.geojson") == 0
    first, last = (json.loads(Path(f"{name}.geojson").read_text())["features"] for name in ("first", "last"))
    assert 0 < len(first) < len(last) == len(read_vector_map(store).select_published())
    assert run("map", "diff", f"{store}@1", store, "--out", "change.json") == 0
    (row,) = (r for r in json.loads(Path("change.json").read_text())["result"]["kinds"] if r["kind"] == "divider")
    assert row["num_unchanged"] == 1 and row["num_added"] == 0, "the old release did not see the new ground"
    assert run("map", "diff", f"{store}@1", store, "--out", "change.html") == 0
    assert "city@1 to city" in Path("change.html").read_text()
    write_vector_map(read_vector_map(store), tmp_path / "true")
    is_folder = "://" not in store
    out = Path(store) if is_folder else Path("out/map/city")
    assert run("map", "view", store, "--truth", "true") == 0 and "maplibregl" in (out / "map.html").read_text()
    assert run("map", "view", "true", "--truth", f"{store}@1", "--out", "true.html") == 0
    assert run("map", "evaluate", store, "--truth", store) == 0
    assert json.loads((out / "quality.json").read_text())["result"]["mean_ap"]["exact"] == 1.0
    assert run("map", "evaluate", store) == 1
    assert "--truth" in capsys.readouterr().err
    assert run("map", "import", f"{store}@1", "true", "--out", "in") == 0
    loaded = read_observations(Path("in/observations")).observations
    assert {o.agent for o in loaded} == {"city@1", "true"}
    assert {o.time_ns for o in loaded if o.agent == "city@1"} == {EARLY[-1].time_ns}


def test_errors_name_the_place_and_the_remedy(tmp_path, monkeypatch, capsys, s3_options):
    monkeypatch.chdir(tmp_path)
    place = use_s3(s3_options, monkeypatch)
    empty = f"memory://{uuid.uuid4().hex}/city"
    try:
        for words, texts in (
            (("export", place, "x.geojson"), (place, "no store of maps", f"--store {place}")),
            (("view", "s3://no-such-bucket/city"), ("s3://no-such-bucket/city", "check the address")),
            (("diff", empty, empty), (empty, "of one process")),
            (("view", "city"), ("city: expected a store", "lines.parquet")),
            (("view", "city", "--truth", "tru"), ("--truth needs a map", "there is no tru")),
            (("retract", place, "--agent", "a", "--reason", "b"), (place, "no store of maps")),
        ):
            assert run("map", *words) > 0
            error = " ".join(capsys.readouterr().err.split())
            assert all(text in error for text in texts), error
        MapStore.create(place, FRAME)
        assert run("map", "export", place, "x.geojson") == 1
        assert f"{place}: no release yet; fuse and publish one first." in capsys.readouterr().err
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.delenv(name)
        for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"):
            monkeypatch.setenv(name, str(tmp_path / "none"))
        monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        forget_s3()
        assert run("map", "view", place) == 1
        error = " ".join(capsys.readouterr().err.split())
        assert place in error and "Unable to locate credentials" in error and "AWS_SECRET_ACCESS_KEY" in error
    finally:
        forget_s3()
    line = MapElements.of([np.array([[0.0, 0.0], [9.0, 0.0]])], DIVIDER)
    write_vector_map(VectorMap.of(line, FRAME), tmp_path / "map")
    with pytest.raises(ConfigError, match="only a store has releases"):
        read_vector_map(tmp_path / "map@1")
