# SPDX-License-Identifier: Apache-2.0
"""A store at a URL is the store in a folder: whole objects, keys created once, releases that are the old or the new one."""

import json
import sys
import uuid
from dataclasses import dataclass, field

import numpy as np
import pytest

from manyeyes.cli import main as cli
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.observation_file import write_observations
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.store.executors import InlineExecutor, ProcessExecutor
from manyeyes.maps.store.object_store import (
    FolderStore,
    ObjectNotFoundError,
    StoreError,
    UrlStore,
    open_object_store,
)
from manyeyes.maps.store.releases import ReleaseStore
from manyeyes.maps.store.store import MapStore, compute_watermark

pytest.importorskip("pyarrow", reason="the map extra is not installed")
pytest.importorskip("shapely", reason="the map extra is not installed")
pytest.importorskip("fsspec", reason="the cloud extra is not installed")

FRAME = MapFrame(48.137, 11.575)
MARK = compute_watermark((), np.zeros(0, np.int64))


def observation(k: int) -> Observation:
    line = MapElements.of([np.array([[-20.0, 1.0], [20.0, 1.0]])], DIVIDER)
    view = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
    pose = np.array([100.0 + 9.0 * k, 0.0, 0.0])
    return Observation(f"agent{k % 3}", "pass", k, pose, np.diag((0.1, 0.1, 1e-4)), view, line)


OBSERVATIONS = [observation(k) for k in range(9)]


def lines(*ys: float, x: float = 0.0) -> VectorMap:
    points = [np.stack((np.arange(x, x + 31), np.full(31, y)), 1) for y in ys]
    return VectorMap.of(MapElements.of(points, DIVIDER), FRAME)


@pytest.fixture(params=["folder", "memory", "s3"])
def place(request, tmp_path, monkeypatch):
    """An empty place and the options of its file system."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    if request.param == "folder":
        return str(tmp_path / "store"), ()
    if request.param == "memory":
        return f"memory://{uuid.uuid4().hex}/city", ()
    options = request.getfixturevalue("s3_options")
    import s3fs

    bucket = f"b{uuid.uuid4().hex}"
    s3fs.S3FileSystem(**dict(options)).mkdir(bucket)
    return f"s3://{bucket}/city", options


def test_objects_are_put_once_read_in_parts_listed_and_deleted(place):
    store = open_object_store(*place)
    assert store.list("a") == [] and store.location == place[0]
    store.put("a/0_-1/one", b"0123456789")
    assert store.put_new("a/0_-1/two", b"2") and not store.put_new("a/0_-1/two", b"3")
    store.put("ab/three", b"")
    store.put("a/0_-1/one", b"abcdefghij")
    assert store.list("a") == ["a/0_-1/one", "a/0_-1/two"] and store.get("a/0_-1/two") == b"2"
    with store.open("a/0_-1/one") as file:
        file.seek(4)
        assert file.read(3) == b"efg"
    store.delete(["a/0_-1/one", "a/none"])
    assert store.list("a") == ["a/0_-1/two"] and store.get("ab/three") == b""
    for read in (store.get, store.open):
        with pytest.raises(ObjectNotFoundError, match="a/0_-1/one"):
            read("a/0_-1/one")


def test_each_call_is_one_request_to_s3(s3_options, monkeypatch):
    import s3fs

    asked = []
    call = s3fs.S3FileSystem._call_s3

    async def record(self, method, *args, **kwargs):
        asked.append(method)
        return await call(self, method, *args, **kwargs)

    bucket = f"b{uuid.uuid4().hex}"
    s3fs.S3FileSystem(**dict(s3_options)).mkdir(bucket)
    store = open_object_store(f"s3://{bucket}/city", s3_options)
    store.put("a/one", b"1")
    monkeypatch.setattr(s3fs.S3FileSystem, "_call_s3", record)
    assert store.list("nothing") == [] and store.list("a") == ["a/one"]
    assert asked == ["list_objects_v2"] * 2
    store.put("a/two", b"2")
    assert store.get("a/two") == b"2"
    store.delete(["a/two"])
    assert asked[2:] == ["put_object", "get_object", "delete_object"]


def test_a_store_at_any_place_fuses_to_the_map_of_one_piece_and_takes_more(place):
    assert not MapStore.exists(*place)
    store = MapStore.create(place[0], FRAME, place[1])
    with store.open_for_writing() as log:
        assert log.append(OBSERVATIONS[:7]) == (7, 0)
    first = store.fuse(executor=InlineExecutor())
    assert first.content == fuse(OBSERVATIONS[:7], frame=FRAME).quantised_hash() == store.read().quantised_hash()
    again = MapStore(*place)
    with again.open_for_writing() as log:
        assert log.append(OBSERVATIONS) == (2, 7)
        log.retract([OBSERVATIONS[0].id], "test")
    second = again.fuse(executor=InlineExecutor())
    assert second.content == fuse(OBSERVATIONS[1:], frame=FRAME).quantised_hash() != first.content
    assert (second.number, second.watermark.observations, store.releases()) == (2, 8, (1, 2))
    assert store.read(1).quantised_hash() == first.content and len(store.delta(2).changed) > 0
    assert not [key for key in store.objects.list("work") if "/arrays/" in key]


@pytest.mark.slow
def test_processes_fuse_a_store_on_s3(s3_options, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    import s3fs

    bucket = f"b{uuid.uuid4().hex}"
    s3fs.S3FileSystem(**dict(s3_options)).mkdir(bucket)
    store = MapStore.create(f"s3://{bucket}", FRAME, s3_options)
    with store.open_for_writing() as log:
        log.append(OBSERVATIONS)
    made = store.fuse(executor=ProcessExecutor(2))
    assert made.content == fuse(OBSERVATIONS, frame=FRAME).quantised_hash()


@dataclass
class DyingStore:
    """A store whose writer dies before its n-th change; records the keys that were written."""

    inner: FolderStore | UrlStore
    dies_at: int = -1
    written: list[str] = field(default_factory=list)

    def __getattr__(self, name: str) -> object:
        return getattr(self.inner, name)

    def _count(self, key: str) -> None:
        if len(self.written) == self.dies_at:
            raise KeyboardInterrupt
        self.written.append(key)

    def put(self, key: str, data: bytes, durable: bool = True) -> None:
        self._count(key)
        self.inner.put(key, data)

    def put_new(self, key: str, data: bytes) -> bool:
        self._count(key)
        return self.inner.put_new(key, data)


def test_a_writer_that_dies_at_any_object_leaves_the_old_release_or_the_new_one():
    root = f"memory://{uuid.uuid4().hex}"
    maps = [lines(10, 20, x=x) for x in (0.0, 0.5)]
    contents = set()
    for dies_at in range(20):
        objects = UrlStore(f"{root}/{dies_at}")
        release = ReleaseStore(objects, FRAME)
        release.commit(release.write(maps[0], "a", "", MARK))
        dying = DyingStore(objects, dies_at)
        writer = ReleaseStore(dying, FRAME)
        try:
            writer.commit(writer.write(maps[1], "b", "", MARK))
            died = False
        except KeyboardInterrupt:
            died = True
        manifest = release.manifest()
        assert release.read().quantised_hash() == manifest.content == maps[manifest.number - 1].quantised_hash()
        assert manifest.number == (1 if died else 2)
        contents.add(manifest.content)
        # The next writer completes the work.
        if died:
            release.commit(release.write(maps[1], "b", "", MARK))
        assert release.read().quantised_hash() == maps[1].quantised_hash()
        if not died:
            assert dying.written[-1] == "releases/000002.json" and dies_at > 4
            break
    assert len(contents) == 2 and not died


def test_a_tile_that_did_not_change_is_not_written_again():
    objects = UrlStore(f"memory://{uuid.uuid4().hex}")
    release = ReleaseStore(objects, FRAME)
    far = lines(10, x=2000.0)
    release.commit(release.write(VectorMap.cat([lines(10), far]), "a", "", MARK))
    recorded = DyingStore(objects)
    second = ReleaseStore(recorded, FRAME).write(VectorMap.cat([lines(10.5), far]), "a", "", MARK)
    # A tile's crossings, of which there are none, are equal too.
    assert [key.split("/")[1] for key in recorded.written if key.startswith("tiles/")] == ["0_0"]
    assert release.manifest().tiles[-1] == second.tiles[-1]


def test_of_two_writers_of_a_release_the_second_is_refused():
    release = ReleaseStore(UrlStore(f"memory://{uuid.uuid4().hex}"), FRAME)
    one, two = release.write(lines(10), "a", "", MARK), release.write(lines(20), "b", "", MARK)
    release.commit(one)
    with pytest.raises(StoreError, match="another program published release 1"):
        release.commit(two)
    assert release.manifest() == one


def test_an_index_of_another_time_is_made_again():
    url = f"memory://{uuid.uuid4().hex}/city"
    for many in (OBSERVATIONS[:5], OBSERVATIONS[5:]):
        store = MapStore.create(url, FRAME)
        with store.open_for_writing() as log:
            log.append(many)
            assert set(log.active_observations().ids) == {o.id for o in many}
        store.objects.delete(store.objects.list("log"))


def test_the_command_fuses_into_a_url_and_its_errors_name_the_remedy(tmp_path, monkeypatch, capsys):
    folder, url = tmp_path / "in", f"memory://{uuid.uuid4().hex}/city"
    folder.mkdir()
    write_observations(folder / "a.parquet", OBSERVATIONS, FRAME)
    fusing = ["map", "fuse", str(folder), "--store"]
    assert cli.main([*fusing, url, "--executor", "inline"]) == 0
    assert f"{url}: release 1 after 9 new observations" in capsys.readouterr().out.replace("\n", " ")
    assert json.loads(MapStore(url).objects.get("fuse.json"))["result"]["release"] == 1
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    for words, text in (
        ([*fusing, url], "--executor inline"),
        ([*fusing, "nothing://x"], "fsspec has no 'nothing'"),
        ([*fusing, "s3://bucket/city"], "cannot be reached"),
        ([*fusing, url, "--executor", "inline", "--address", "tcp://a:1"], "choose dask or ray"),
        (["map", "fuse", str(folder), "--out", url], "say --store"),
    ):
        assert cli.main(words) == 1
        assert text in " ".join(capsys.readouterr().err.split())


def test_a_missing_package_names_the_extra(monkeypatch):
    from manyeyes.datatypes import MissingExtraError
    from manyeyes.maps.store import object_store

    object_store._file_system.cache_clear()
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(MissingExtraError, match=r"manyeyes\[cloud\]"):
        MapStore("s3://bucket/city")
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(MissingExtraError, match=r"manyeyes\[cloud\]"):
        MapStore("memory://city")
    monkeypatch.undo()
    with pytest.raises(ConfigError, match="fsspec has no 'x'"):
        open_object_store("x://city")


def test_a_half_written_release_is_named(tmp_path):
    store = MapStore.create(tmp_path, FRAME)
    store.publish(lines(10), "a", "", MARK)
    path = next((tmp_path / "tiles").rglob("*.lines.parquet"))
    path.unlink()
    with pytest.raises(StoreError, match="missing or damaged in release 1"):
        store.read()
    (tmp_path / "releases/000001.json").write_text('{"number": 1')
    with pytest.raises(StoreError, match="expected the manifest of a release"):
        store.manifest()
