# SPDX-License-Identifier: Apache-2.0
"""Observations as files: the documented example, round trips, and what is rejected with its reason."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manyeyes.datatypes.map_element import MapElements, Polygons
from manyeyes.maps.elements.observation import MapFrame, Observation, ObservationError
from manyeyes.maps.elements.observation_file import (
    METADATA_KEY,
    InvalidRow,
    iterate_observations,
    iterate_rows,
    make_file_metadata,
    observation_table,
    read_observations,
    write_observations,
)

pa = pytest.importorskip("pyarrow", reason="the 'map' extra is not installed")
pq = pytest.importorskip("pyarrow.parquet")

FRAME = MapFrame(49.0, 8.4)
VIEW = np.array([[0.0, -15.0], [60.0, -15.0], [60.0, 15.0], [0.0, 15.0]])
ELEMENTS = MapElements.of(
    [[[0, 0], [30, 0.25]], [[10, -5], [14, -5], [14, 5], [10, 5]]], [0, 2], score=[0.5, 0.75], style=[1, 3]
)


def crowd(count: int) -> list[Observation]:
    rng = np.random.default_rng(3)
    return [
        Observation(
            agent=f"car-{k % 3}",
            pass_id=f"p{k}",
            time_ns=k,
            pose=rng.normal(size=3),
            covariance=np.diag([0.5, 0.4, 1e-4]),
            view=VIEW,
            elements=ELEMENTS.with_points(ELEMENTS.points + rng.normal(0, 0.01, ELEMENTS.points.shape))
            if k % 4
            else MapElements.empty(),
            model="net",
            trusted=k == 2,
            occluders=Polygons.of([VIEW * 0.1, VIEW[:3] * 0.2]) if k % 2 else Polygons.of(),
        )
        for k in range(count)
    ]


def test_the_documented_example_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "map-observations.md").read_text()
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
    (seen,) = names["reading"].observations
    assert names["reading"].frame == FRAME and not names["reading"].rejected
    assert seen.agent == "car-17" and seen.elements.kind.tolist() == [0, 2]
    assert seen.elements.sigma.tolist() == [0.12, 0.3, 0.12, 0.12, 0.12, 0.12]
    assert seen.elements.style.tolist() == [[0.1, 0.9, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    assert seen.covariance[2, 2] == 0.0002 and seen.covariance[0, 1] == 0.0
    assert np.allclose(seen.elements_in_map().polyline(0)[0], [120.5 - 1.75, -40.25], atol=1e-4)


def test_files_round_trip_bit_by_bit(tmp_path: Path) -> None:
    many = crowd(7)
    many[3] = replace(many[3], covariance=np.array([[0.5, 0.1, 0.01], [0.1, 0.6, 0.02], [0.01, 0.02, 0.3]]))
    write_observations(tmp_path / "a.parquet", many, FRAME)
    reading = read_observations(tmp_path / "a.parquet")
    assert [o.id for o in reading.observations] == [o.id for o in many]
    assert reading.frame == FRAME and reading.rejected == ()
    assert [p.name for p in tmp_path.iterdir()] == ["a.parquet"]


def test_no_observations_are_a_file_too(tmp_path: Path) -> None:
    write_observations(tmp_path / "a.parquet", [], FRAME)
    assert read_observations(tmp_path).observations == ()


def test_a_table_cut_out_of_another_gives_its_own_rows() -> None:
    many = crowd(6)
    rows = list(iterate_observations(observation_table(many, FRAME).slice(2, 3)))
    assert [o.id for _, o in rows if isinstance(o, Observation)] == [o.id for o in many[2:5]]


def rewritten(table, row: int, change) -> object:
    rows = table.to_pylist()
    change(rows[row])
    return pa.Table.from_pylist(rows, schema=table.schema)


def _nan(row: dict) -> None:
    row["elements"][0]["points"][0]["x"] = math.nan


def _no_point(row: dict) -> None:
    row["elements"][0]["points"][1]["y"] = None


def _bow_tie(row: dict) -> None:
    corners = row["elements"][1]["points"]
    corners[1], corners[2] = corners[2], corners[1]


def _kind(row: dict) -> None:
    row["elements"][1]["kind"] = "tree"


def _no_kind(row: dict) -> None:
    row["elements"][1]["kind"] = None


def _score(row: dict) -> None:
    row["elements"][1]["score"] = 1.5


def _style(row: dict) -> None:
    row["elements"][1]["style"] = [1.0]


def _covariance(row: dict) -> None:
    row["covariance"] = [1.0, 0.0]


def _agent(row: dict) -> None:
    row["agent"] = None


def _view(row: dict) -> None:
    row["view"] = None


def _moved(row: dict) -> None:
    row["elements"][0]["points"][0]["x"] += 0.001


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_nan, "points: expected finite"),
        (_no_point, "points: expected finite"),
        (_bow_tie, "cross"),
        (_kind, "kind: expected one of divider, boundary, crossing, stop_line; got tree"),
        (_no_kind, "kind: expected one of divider, boundary, crossing, stop_line"),
        (_score, "score: expected values in .0, 1.; got 1.5"),
        (_style, "style"),
        (_covariance, "covariance: expected 6 numbers"),
        (_agent, "agent"),
        (_view, "view"),
        (_moved, "id: expected [0-9a-f]{32}, the hash of its content"),
    ],
)
def test_a_bad_row_is_put_aside_with_its_reason_and_the_rest_is_read(tmp_path: Path, change, message: str) -> None:
    many = crowd(6)
    pq.write_table(rewritten(observation_table(many, FRAME), 3, change), tmp_path / "a.parquet")
    reading = read_observations(tmp_path)
    assert [o.id for o in reading.observations] == [o.id for o in many if o is not many[3]]
    (aside,) = reading.rejected
    assert (aside.row, aside.count) == (3, 1) and aside.file.endswith("a.parquet")
    assert re.search(message, aside.reason)


def stated(change: dict) -> dict[bytes, str]:
    return {METADATA_KEY: json.dumps(make_file_metadata(FRAME) | change)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "version 2. Read a newer version"),
        ({"version": "1"}, "version '1'"),
        ({"crs": "EPSG:25832"}, "crs: expected .* got 'EPSG:25832'.*Reproject"),
        ({"origin": {"crs": "EPSG:4258", "latitude": 49.0, "longitude": 8.4}}, "EPSG:4258"),
        ({"origin": {"crs": "EPSG:4326", "latitude": 49.1, "longitude": 8.4}}, "origin: expected latitude 49.0"),
        ({"origin": {}}, "expected metadata"),
        ({"format": "release"}, "got 'release'"),
    ],
)
def test_a_file_of_another_kind_version_or_frame_is_put_aside_whole(tmp_path: Path, change: dict, message: str) -> None:
    many = crowd(4)
    write_observations(tmp_path / "a.parquet", many[:2], FRAME)
    pq.write_table(observation_table(many[2:], FRAME).replace_schema_metadata(stated(change)), tmp_path / "b.parquet")
    reading = read_observations(tmp_path)
    assert [o.id for o in reading.observations] == [o.id for o in many[:2]]
    (aside,) = reading.rejected
    assert aside.row == -1 and re.search(message, aside.reason)


def test_a_first_file_about_another_origin_is_put_aside_and_not_all_others(tmp_path: Path) -> None:
    many = crowd(5)
    write_observations(tmp_path / "a.parquet", many[:3], MapFrame(10.0, 8.4))
    write_observations(tmp_path / "b.parquet", many[3:4], FRAME)
    write_observations(tmp_path / "c.parquet", many[4:], FRAME)
    reading = read_observations(tmp_path)
    assert reading.frame == FRAME and [o.id for o in reading.observations] == [o.id for o in many[3:]]
    (aside,) = reading.rejected
    assert aside.file.endswith("a.parquet") and re.search(
        "origin: expected latitude 49.0.*most files; got 10.0", aside.reason
    )


def test_of_two_files_about_two_origins_that_of_more_rows_decides(tmp_path: Path) -> None:
    many = crowd(5)
    write_observations(tmp_path / "a.parquet", many[:1], MapFrame(10.0, 8.4))
    write_observations(tmp_path / "b.parquet", many[1:], FRAME)
    assert read_observations(tmp_path).frame == FRAME


def test_files_without_our_metadata_or_columns_are_put_aside(tmp_path: Path) -> None:
    table = observation_table(crowd(2), FRAME)
    write_observations(tmp_path / "a.parquet", crowd(2), FRAME)
    pq.write_table(table.replace_schema_metadata({}), tmp_path / "b.parquet")
    pq.write_table(table.drop_columns(["yaw", "view"]), tmp_path / "c.parquet")
    reasons = [q.reason for q in read_observations(tmp_path).rejected]
    assert "expected metadata 'manyeyes'" in reasons[0] and "yaw, view missing" in reasons[1]


def test_a_cut_or_damaged_file_is_put_aside_and_never_read_wrong(tmp_path: Path) -> None:
    many = crowd(8)
    write_observations(tmp_path / "a.parquet", many, FRAME)
    whole = (tmp_path / "a.parquet").read_bytes()
    (tmp_path / "b.parquet").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "c.parquet").write_bytes(b"")
    for k, place in enumerate(range(100, len(whole) // 2, 97)):
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        (tmp_path / f"d{k}.parquet").write_bytes(damaged)
    reading = read_observations(tmp_path)
    good = {o.id for o in many}
    assert {o.id for o in reading.observations} <= good
    files = {Path(q.file).name for q in reading.rejected}
    assert {"b.parquet", "c.parquet"} <= files and any(name.startswith("d") for name in files)
    assert all("\n" not in q.reason for q in reading.rejected)


def test_empty_input_raises(tmp_path: Path) -> None:
    with pytest.raises(ObservationError, match="found none"):
        read_observations(tmp_path)
    (tmp_path / "a.parquet").write_bytes(b"no")
    with pytest.raises(ObservationError, match="no file could be read"):
        read_observations(tmp_path)


def test_the_frame_asked_for_is_the_frame_required(tmp_path: Path) -> None:
    write_observations(tmp_path / "a.parquet", crowd(1), FRAME)
    reading = read_observations(tmp_path, MapFrame(48.0, 8.4))
    assert reading.observations == () and "latitude 48.0" in reading.rejected[0].reason


FAR_ORIGIN = {"crs": "EPSG:4326", "latitude": 10**400, "longitude": 0}


def metadata_text(text: str) -> dict[bytes, str]:
    return {METADATA_KEY: text}


def repeated_text(table: Any, name: str) -> Any:
    """Return 3,000 rows whose text of a million letters is stored once."""
    column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(3000, np.int8)), pa.array(["a" * 1_000_000]))
    many = table.take([0] * 3000)
    return many.set_column(many.column_names.index(name), name, column)


def not_unicode(table: Any) -> Any:
    offsets = pa.py_buffer(np.arange(len(table) + 1, dtype=np.int32).tobytes())
    column = pa.Array.from_buffers(pa.string(), len(table), [None, offsets, pa.py_buffer(b"\xff" * len(table))])
    return table.set_column(0, "agent", column)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace_schema_metadata(metadata_text("[" * 100_000)), "expected metadata 'manyeyes'.*RecursionError"),
        (lambda t: t.replace_schema_metadata(stated({"origin": FAR_ORIGIN})), "OverflowError"),
        (lambda t: t.replace_schema_metadata(stated({"crs": "x" * 1_000_000})), "crs: expected"),
        (lambda t: t.replace_schema_metadata(stated({"version": 10**300})), "of version 1"),
        (lambda t: t.append_column("agent", t["agent"]), "agent more than once"),
        (not_unicode, "rows 0 to 1 cannot be decoded: 'utf-8'"),
        (lambda t: repeated_text(t, "agent"), "column agent: expected at most 268435456 bytes of text; got 3000000000"),
        (lambda t: repeated_text(t, "model"), "column model: expected at most 268435456 bytes of text"),
    ],
    ids=["nested", "latitude", "crs", "version", "twice", "utf-8", "agents", "models"],
)  # fmt: skip
def test_absurd_files_are_put_aside_with_a_short_reason(tmp_path: Path, change: Callable, message: str) -> None:
    many = crowd(4)
    write_observations(tmp_path / "a.parquet", many[:2], FRAME)
    bad = change(observation_table(many[2:], FRAME))
    pq.write_table(bad, tmp_path / "b.parquet", row_group_size=10_000)
    reading = read_observations(tmp_path)
    assert [o.id for o in reading.observations] == [o.id for o in many[:2]]
    (aside,) = reading.rejected
    assert aside.file.endswith("b.parquet") and re.search(message, aside.reason) and len(aside.reason) < 800


def test_a_group_of_rows_that_expands_without_bound_is_put_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_observations(tmp_path / "a.parquet", crowd(4), FRAME)
    monkeypatch.setattr("manyeyes.maps.elements.observation_file._MAX_GROUP_VALUES", 10)
    reading = read_observations(tmp_path)
    (aside,) = reading.rejected
    assert reading.observations == () and aside.count == 4 and "expected at most 10 values a column" in aside.reason


def test_a_row_with_the_id_of_a_checked_observation_is_not_checked_again(monkeypatch) -> None:
    many = crowd(3)
    table = observation_table(many, FRAME)
    checked = {o.id for o in many[:2]}
    seen = []
    monkeypatch.setattr("manyeyes.maps.elements.observation._check", lambda o: seen.append(o.id))
    made = list(iterate_rows(table, checked))
    assert seen == [many[2].id] and all(isinstance(o, Observation) for o in made)
    for got, want in zip(made, many, strict=True):
        assert got.id == want.id and got.canonical_bytes() == want.canonical_bytes()
        assert not got.pose.flags.writeable


def test_a_changed_row_is_no_checked_observation() -> None:
    """Its content has another id than the one that it states."""
    many = crowd(3)
    table = observation_table(many, FRAME)
    moved = table.set_column(table.column_names.index("x"), "x", pa.array([o.pose[0] + 1.0 for o in many]))
    made = list(iterate_rows(moved, {o.id for o in many}))
    assert all(isinstance(item, InvalidRow) and "the hash of its content" in item.reason for item in made)
