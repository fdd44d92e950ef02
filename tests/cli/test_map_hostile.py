# SPDX-License-Identifier: Apache-2.0
"""One observation with far, dense or extreme numbers is quarantined; the rest is fused to the map without it, stores recover."""

import copy
import math
import shutil
import sqlite3
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="the 'map' extra is not installed")
pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.cli import main as cli
from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.observation_file import read_observations, write_observations
from manyeyes.maps.store.store import MapStore
from manyeyes.studies.map_folder import read_vector_map

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

NUM_HONEST = 12
VALUES = (1e3, 2e4, 1e7, 1e15, 1e300, -1e300, math.nan, math.inf)


def run(*words: object) -> int:
    """Run the command; a warning of numpy's is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        return cli.main([str(word) for word in words])


@pytest.fixture(scope="module")
def honest(tmp_path_factory) -> Path:
    """A folder of honest observations and their map."""
    path = tmp_path_factory.mktemp("honest")
    assert run("map", "simulate", "cross", "--observations", NUM_HONEST, "--size", 120, "--out", path) == 0
    assert run("map", "fuse", path) == 0
    return path


def content(folder: Path) -> str:
    return read_vector_map(folder).quantised_hash()


def point(x: float, y: float) -> dict:
    return {"x": x, "y": y, "sigma": 0.1}


def square(half: float) -> list[dict]:
    return [point(-half, -half), point(half, -half), point(half, half), point(-half, half)]


def element(kind: str, points: list[dict], **more) -> dict:
    return {"kind": kind, "score": 0.9, "style": None, "points": points, **more}


def setting(column: str, value: object) -> Callable[[dict], None]:
    return lambda row: row.__setitem__(column, value)


def line(points: list[dict]) -> Callable[[dict], None]:
    return setting("elements", [element("divider", points)])


def rings(points: list[dict]) -> Callable[[dict], None]:
    return setting("elements", [element("crossing", points)])


def view(points: list[dict]) -> Callable[[dict], None]:
    return setting("view", [{"x": p["x"], "y": p["y"]} for p in points])


def covariance(k: int, value: float) -> Callable[[dict], None]:
    return lambda row: row["covariance"].__setitem__(k, value)


def circle(count: int) -> list[dict]:
    angles = 2 * math.pi * np.arange(count) / count
    return [point(10 * math.cos(a), 10 * math.sin(a)) for a in angles]


# What is done to an honest row, and what the reason names.
CASES: dict[str, tuple[str, Callable[[dict], None]]] = {
    "line to 1e7 m": ("points", line([point(0, 0), point(1e7, 0)])),
    "line to 1e308 m": ("points", line([point(-1e308, 0), point(1e308, 1e308)])),
    "crossing of 1e5 m": ("points", rings(square(1e5))),
    "crossing of 300 m": ("points", rings(square(150))),
    "view of 1e6 m": ("view", view(square(1e6))),
    "view of 1e308 m": ("view", view(square(1e308))),
    "occluder of 1e9 m": ("occluders", setting("occluders", [[{"x": p["x"], "y": p["y"]} for p in square(1e9)]])),
    "x of 1e300 m": ("pose", setting("x", 1e300)),
    "x of 1e15 m": ("pose", setting("x", 1e15)),
    "y of -1e8 m": ("pose", setting("y", -1e8)),
    "yaw of 1e300 rad": ("pose", setting("yaw", 1e300)),
    "yaw of 1e15 rad": ("pose", setting("yaw", 1e15)),
    "variance of 1e300": ("covariance", covariance(0, 1e300)),
    "variance of 1e-300": ("covariance", setting("covariance", [1e-300, 0.0, 0.0, 1e-300, 0.0, 1e-300])),
    "variance of yaw of 100": ("covariance", covariance(5, 100.0)),
    "sigma of 1e300 m": ("sigma", line([{"x": 0, "y": 0, "sigma": 1e300}, point(9, 0)])),
    "20,000 points in 10 m": ("points", line([point(10 * k / 20_000, 0) for k in range(20_000)])),
    "crossing of 20,000 points": ("points", rings(circle(20_000))),
    "view of 20,000 points": ("view", view(circle(20_000))),
    "100 km to and fro": ("points", line([point(500 * (k % 2), 0.1 * k) for k in range(200)])),
    "5,000 elements": ("elements", setting("elements", [element("divider", square(3))] * 5_000)),
    "80,000 points": ("points", setting("elements", [element("divider", circle(100))] * 800)),
    "a name of 10,000 letters": ("agent", setting("agent", "a" * 10_000)),
}


def with_rows(honest: Path, folder: Path, changes: list[Callable[[dict], None]]) -> Path:
    """A folder of the honest observations and, in front of them in one file, a changed copy of the first for each change."""
    table = pq.read_table(next((honest / "observations").glob("*.parquet")))
    rows = table.to_pylist()
    bad = []
    for k, change in enumerate(changes):
        row = copy.deepcopy(rows[0])
        row.update(agent=f"hostile-{k}", id=None)
        change(row)
        bad.append(row)
    folder.mkdir()
    pq.write_table(pa.Table.from_pylist([*bad, *rows], schema=table.schema), folder / "all.parquet")
    return folder


@pytest.mark.parametrize(
    "name", ["line to 1e7 m", "crossing of 1e5 m", "view of 1e6 m", "x of 1e300 m", "x of 1e15 m", "variance of 1e-300"]
)
def test_one_hostile_row_is_one_line_and_the_map_is_that_of_the_rest(name, honest, tmp_path, capsys) -> None:
    folder = with_rows(honest, tmp_path / "in", [CASES[name][1]])
    assert run("map", "fuse", folder) == 0
    output = [text for text in capsys.readouterr().out.splitlines() if text.startswith("rejected")]
    assert len(output) == 1 and f"{folder}/all.parquet row 0: Observation.{CASES[name][0]}: expected " in output[0]
    assert "; got " in output[0] and output[0].endswith(".") and len(output[0]) < 400
    assert content(folder / "map") == content(honest / "map")


def test_every_hostile_row_of_a_file_is_named_and_the_map_is_that_of_the_rest(honest, tmp_path, capsys) -> None:
    folder = with_rows(honest, tmp_path / "in", [change for _, change in CASES.values()])
    assert run("map", "fuse", folder) == 0
    output = [text for text in capsys.readouterr().out.splitlines() if text.startswith("rejected")]
    assert len(output) == len(CASES) and max(map(len, output)) < 400
    for row, (name, (field, _)) in enumerate(CASES.items()):
        assert f" row {row}: Observation.{field}: expected " in output[row], name
    assert content(folder / "map") == content(honest / "map")


def every_number(row: dict, value: float) -> list[Callable[[dict], None]]:
    """Changes that each put the value at one place of a row."""
    first = row["elements"][0]
    changes = [setting(name, value) for name in ("x", "y", "yaw")]
    changes += [covariance(k, value) for k in range(6)]
    changes += [lambda r, n=n: r["view"][1].__setitem__(n, value) for n in ("x", "y")]
    changes += [lambda r, n=n: r["elements"][0]["points"][1].__setitem__(n, value) for n in ("x", "y", "sigma")]
    changes += [lambda r: r["elements"][0].__setitem__("score", value)]
    changes += [lambda r, k=k: r["elements"][0]["style"].__setitem__(k, value) for k in range(len(first["style"]))]
    shade = [{"x": 5.0, "y": 2.0}, {"x": 9.0, "y": 3.0}, {"x": value, "y": 4.0}]
    return [*changes, setting("occluders", [shade])]


def test_one_extreme_number_leaves_the_rest_fused(honest, tmp_path, capsys) -> None:
    row = read_rows(honest)[0]
    changes = [change for value in VALUES for change in every_number(row, value)]
    folder = with_rows(honest, tmp_path / "in", changes)
    assert run("map", "fuse", folder) == 0
    output = capsys.readouterr().out
    refused = output.count("rejected: ")
    # 1 km is a variance, a sigma and a place; 20 km still is a place and a variance.
    assert len(changes) - 20 <= refused < len(changes)
    assert f"from {NUM_HONEST + len(changes) - refused} observations" in output
    kept = {o.id for o in read_observations(folder).observations}
    assert {o.id for o in read_observations(honest / "observations").observations} <= kept


def read_rows(folder: Path) -> list[dict]:
    return pq.read_table(next((folder / "observations").glob("*.parquet"))).to_pylist()


def test_a_file_of_model_results_with_extreme_numbers_is_imported_without_them(tmp_path, capsys) -> None:
    far = [[[0.0, 0.0], [1e300, 0.0]], [[1e300, 0.0], [0.0, 1e300], [-1e300, 0.0], [1e300, 1e300]]]
    near = [[[0.0, 0.0], [10.0, 0.0]], [[0.0, 3.5], [10.0, 3.5], [9.0, 9.0], [5.0, 9.0]]]
    tokens = {"a": near, "b": far, "c": near, "d": near}
    results = {t: {"vectors": v, "scores": [0.9, 0.5], "labels": [1, 0]} for t, v in tokens.items()}
    (tmp_path / "submission_vector.json").write_text(str({"meta": {}, "results": results}).replace("'", '"'))
    rows = ["a,car,one,1000,5,5,0.1,1,1,0.1", "b,car,one,2000,5,5,0.1,1,1,0.1"]
    rows += ["c,car,one,3000,5e300,5,0.1,1,1,0.1", "d,car,one,4000,5,5,0.1,1e300,1,0.1"]
    header = "token,agent,pass_id,time_ns,x,y,yaw,sigma_x,sigma_y,sigma_yaw"
    (tmp_path / "poses.csv").write_text("\n".join([header, *rows]) + "\n")
    words = ("map", "import", tmp_path / "submission_vector.json", "--poses", tmp_path / "poses.csv")
    assert run(*words, "--origin", 49.0, 8.4, "--out", tmp_path / "in") == 0
    output = capsys.readouterr().out
    assert output.count("rejected: ") == 3 and "1 observations of 2 elements" in output


# Stores.


def fuse_into(store: Path, folder: Path) -> int:
    return run("map", "fuse", folder, "--store", store, "--executor", "inline")


def retract(store: Path, *words: object) -> int:
    return run("map", "retract", store, "--executor", "inline", *words)


@pytest.fixture(scope="module")
def honest_store(honest, tmp_path_factory) -> Path:
    """A store that holds the honest observations and one release."""
    path = tmp_path_factory.mktemp("stores") / "city"
    assert fuse_into(path, honest) == 0
    return path


@pytest.fixture
def store(honest_store, tmp_path) -> Path:
    return Path(shutil.copytree(honest_store, tmp_path / "city"))


@pytest.mark.slow
def test_a_store_takes_in_the_rest_of_a_folder_with_hostile_rows(honest, tmp_path, capsys) -> None:
    folder = with_rows(honest, tmp_path / "in", [change for _, change in CASES.values()])
    assert fuse_into(tmp_path / "city", folder) == 0
    output = capsys.readouterr().out
    assert output.count("rejected: ") == len(CASES)
    assert f"{NUM_HONEST} new observations, 0 known, {len(CASES)} rejected" in output
    assert content(tmp_path / "city") == content(honest / "map")


def unbounded(good: Observation, **changes: object) -> Observation:
    """An observation as versions without bounds made it."""
    made = Observation(**{name: getattr(good, name) for name in good.__dataclass_fields__})
    for name, value in {"agent": "hostile", **changes}.items():
        object.__setattr__(made, name, value)
    return made


def spoil(store: Path, indexed: bool) -> dict[str, str]:
    """Append a segment with unbounded observations as an older version left it, with its index or without any: id, field."""
    reading = read_observations(next((store / "log").glob("*.parquet")))
    good = reading.observations[0]
    elements = MapElements.of([[[0.0, 0.0], [1e7, 0.0]]], DIVIDER)
    bad = {
        "pose": unbounded(good, pose=np.array([1e300, 0.0, 0.0])),
        "points": unbounded(good, elements=elements),
        "view": unbounded(good, view=1e6 * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])),
    }
    path = store / "log" / "00000007-0123456789abcdef.parquet"
    write_observations(path, list(bad.values()), reading.frame)
    database = store / "catalogue.sqlite"
    columns = "id, segment, row_group, time_ns, agent, x, y, reach_m"
    with sqlite3.connect(database) as db:
        rows = db.execute(f"SELECT {columns} FROM observations").fetchall()
        entries = db.execute("SELECT name, rows FROM entries").fetchall()
    for file in store.glob("catalogue.sqlite*"):
        file.unlink()
    if indexed:
        for o, reach in zip(bad.values(), (40.0, 1e7, 1.5e6)):
            rows.append((bytes.fromhex(o.id), path.name, 0, o.time_ns, o.agent, *o.pose[:2].tolist(), reach))
        with sqlite3.connect(database) as db:
            db.execute("CREATE TABLE entries (name TEXT PRIMARY KEY, rows INTEGER NOT NULL) WITHOUT ROWID")
            db.execute(
                "CREATE TABLE observations (id BLOB PRIMARY KEY, segment TEXT NOT NULL, row_group INTEGER NOT NULL, "
                "time_ns INTEGER NOT NULL, agent TEXT NOT NULL, x REAL NOT NULL, y REAL NOT NULL, reach_m REAL NOT NULL"
                ") WITHOUT ROWID"
            )
            db.execute("CREATE TABLE retracted (id BLOB PRIMARY KEY, reason TEXT NOT NULL) WITHOUT ROWID")
            db.execute("CREATE TABLE quarantine (entry TEXT, file TEXT, row INTEGER, count INTEGER, reason TEXT)")
            db.executemany("INSERT INTO entries VALUES (?, ?)", [*entries, (path.name, len(bad))])
            db.executemany("INSERT INTO observations VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows)
            db.execute("PRAGMA user_version = 1")
    return {o.id: field for field, o in bad.items()}


@pytest.mark.parametrize("indexed", [True, False], ids=["indexed", "index-lost"])
def test_a_store_of_an_older_version_quarantines_invalid_rows(indexed, store, honest, capsys) -> None:
    bad = spoil(store, indexed)
    capsys.readouterr()
    assert fuse_into(store, honest) == 0
    out = capsys.readouterr().out
    output = [text for text in out.splitlines() if text.startswith("rejected")]
    assert len(output) == 3 and f"0 new observations, {NUM_HONEST} known, 3 rejected" in out
    for row, (name, field) in enumerate(bad.items()):
        assert f"parquet row {row}: Observation.{field}: expected" in output[row] and name in output[row]
    assert content(store) == content(honest / "map")
    with MapStore(store).open_for_writing() as log:
        assert [row[:3] for row in log.index.list_rejected()] == [
            ("00000007-0123456789abcdef.parquet", k, 1) for k in range(3)
        ]
    # A known rejection is not reported again, and can be retracted.
    assert retract(store, "--agent", "hostile", "--reason", "made up") == 0
    output = capsys.readouterr().out
    assert (
        "3 observations retracted now, 0 before; 12 count" in output and "release 2 is already without them" in output
    )
    assert "rejected" not in output


def test_damage_of_a_segment_is_still_an_error_that_names_it(store, honest, capsys) -> None:
    (segment,) = (store / "log").glob("*.parquet")
    data = bytearray(segment.read_bytes())
    data[len(data) // 3] ^= 255
    segment.write_bytes(bytes(data))
    for file in store.glob("catalogue.sqlite*"):
        file.unlink()
    shutil.rmtree(store / "work")
    capsys.readouterr()
    assert fuse_into(store, honest) == 1
    (output,) = capsys.readouterr().err.splitlines()
    assert segment.name in output and "from a copy" in output


def test_a_row_that_differs_from_its_id_is_damage(store, honest, capsys) -> None:
    (segment,) = (store / "log").glob("*.parquet")
    table = pq.read_table(segment)
    rows = table.to_pylist()
    rows[0]["x"] = 1e300
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), segment)
    for file in store.glob("catalogue.sqlite*"):
        file.unlink()
    capsys.readouterr()
    assert fuse_into(store, honest) == 1
    (output,) = capsys.readouterr().err.splitlines()
    assert segment.name in output and rows[0]["id"][:8] in output and "from a copy" in output


def map_without(honest: Path, folder: Path, left_out: set[str]) -> str:
    reading = read_observations(honest / "observations")
    folder.mkdir()
    write_observations(folder / "a.parquet", [o for o in reading.observations if o.id not in left_out], reading.frame)
    assert run("map", "fuse", folder) == 0
    return content(folder / "map")


@pytest.mark.slow
def test_a_retracted_observation_is_not_in_the_next_release_and_stays_out(store, honest, tmp_path, capsys) -> None:
    name = read_observations(honest / "observations").observations[3].id
    want = map_without(honest, tmp_path / "rest", {name})
    capsys.readouterr()
    assert retract(store, "--ids", name[:12].upper(), name, "--reason", "asked for") == 0
    output = capsys.readouterr().out
    assert "1 observations retracted now, 0 before; 11 count" in output and "release 2 is without them" in output
    assert content(store) == want != content(honest / "map")
    log = sorted(path.name for path in (store / "log").iterdir())
    assert retract(store, "--ids", name, "--reason", "asked for again") == 0
    output = capsys.readouterr().out
    assert (
        "0 observations retracted now, 1 before; 11 count" in output and "release 2 is already without them" in output
    )
    assert sorted(path.name for path in (store / "log").iterdir()) == log and MapStore(store).releases() == (1, 2)
    assert fuse_into(store, honest) == 0
    assert content(store) == want


@pytest.mark.slow
def test_an_agent_and_a_pass_can_be_retracted_and_published_later(store, honest, tmp_path, capsys) -> None:
    many = read_observations(honest / "observations").observations
    agent, pass_id = many[0].agent, many[-1].pass_id
    first = {o.id for o in many if o.agent == agent}
    both = first | {o.id for o in many if o.pass_id == pass_id}
    want = map_without(honest, tmp_path / "rest", both)
    capsys.readouterr()
    assert 0 < len(first) < len(both) < NUM_HONEST
    assert retract(store, "--agent", agent, "--reason", "privacy", "--no-fuse") == 0
    output = capsys.readouterr().out
    assert f"{len(first)} observations retracted now" in output and "no new release; run this again" in output
    assert MapStore(store).releases() == (1,)
    assert retract(store, "--pass-id", pass_id, "--agent", many[-1].agent, "--reason", "privacy") == 0
    assert content(store) == want


def test_everything_can_be_retracted(store, honest, capsys) -> None:
    assert (
        retract(
            store, "--ids", *(o.id for o in read_observations(honest / "observations").observations), "--reason", "x"
        )
        == 0
    )
    assert len(read_vector_map(store)) == 0


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--ids", "0" * 32), ("0" * 32, "no observation")),
        (("--ids", "xyz"), ("xyz", "hexadecimal")),
        (("--agent", "unknown-agent"), ("unknown-agent",)),
        (("--pass-id", "nowhere"), ("nowhere",)),
        ((), ("--ids", "--agent")),
        (("--ids", "ab", "--agent", "unknown-agent"), ("--ids", "--agent")),
    ],
)
def test_an_invalid_retraction_is_one_line_and_changes_nothing(words, named, store, capsys) -> None:
    before = sorted((store / "log").iterdir())
    capsys.readouterr()
    assert retract(store, "--reason", "x", *words) == 1
    (output,) = capsys.readouterr().err.splitlines()
    assert output.startswith("manyeyes: ") and all(name in output for name in named)
    assert sorted((store / "log").iterdir()) == before and MapStore(store).releases() == (1,)


def test_retract_needs_a_store_and_a_reason(store, tmp_path, capsys) -> None:
    assert retract(tmp_path / "nowhere", "--ids", "ab", "--reason", "x") == 1
    (output,) = capsys.readouterr().err.splitlines()
    assert "nowhere: there is no store of maps" in output and "manyeyes map fuse OBSERVATIONS --store" in output
    assert not (tmp_path / "nowhere").exists()
    assert retract(store, "--ids", "ab", "--reason", " ") == 1
    assert "--reason" in capsys.readouterr().err
    assert retract(store, "--ids", "ab") == 2
