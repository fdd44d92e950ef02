# SPDX-License-Identifier: Apache-2.0
"""Maps of other programs as observations: their place on earth, what is left out, and two of them merged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manyeyes.cli import main as cli
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, STOP_LINE, MapElements
from manyeyes.maps.elements.map_observation import MapSource, compute_covered_ground, make_map_observations
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.observation_file import read_observations
from manyeyes.maps.elements.observation_limits import LIMITS
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.argoverse2_city import degrees_from_city, find_city
from manyeyes.maps.formats.export import export_map
from manyeyes.maps.formats.reframe import move_to_frame
from manyeyes.maps.formats.vector_layers import VectorLayerError, find_kind, read_vector_layers
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.roads.transverse_mercator import metres_from_degrees
from manyeyes.ops.nearest_line import find_nearest_line
from manyeyes.studies.map_folder import read_vector_map, write_vector_map
from manyeyes.studies.map_import import is_map, read_source_map

shapely = pytest.importorskip("shapely", reason="the map extra is not installed")
pyogrio = pytest.importorskip("pyogrio", reason="the map extra is not installed")
pyproj = pytest.importorskip("pyproj", reason="the map extra is not installed")
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
PITTSBURGH = SHARED / "av2" / "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
real = pytest.mark.skipif(not PITTSBURGH.is_dir(), reason="the Argoverse 2 logs are not in ../shared/data")


def furthest(points, lines):
    return find_nearest_line(points, lines.points, lines.offsets, 100.0).distance.max()


def duplicated_fraction(elements):
    """How much of the lines lies within 1 m of another line of its kind."""
    near = []
    for row in np.flatnonzero(elements.kind != CROSSING).tolist():
        others = elements.take((elements.kind == elements.kind[row]) & (np.arange(len(elements)) != row))
        line = shapely.segmentize(shapely.LineString(elements.polyline(row)), 1.0)
        near.append(find_nearest_line(shapely.get_coordinates(line), others.points, others.offsets, 1.0).line >= 0)
    return np.concatenate(near).mean()


def test_city_frames_are_utm_about_their_origin():
    xy = np.array([[0.0, 0.0], [5041.84, 2230.8], [-3000.0, 900.0]])
    for city, zone, origin in (
        ("PIT", 17, (40.44177902989321, -80.01294377242584)),
        ("PAO", 10, (37.416065, -122.13571963362166)),
    ):
        utm = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:326{zone}", always_xy=True)
        longitude, latitude = utm.transform(*(xy + utm.transform(*origin[::-1])).T, direction="INVERSE")
        np.testing.assert_allclose(degrees_from_city(xy, city), np.stack((latitude, longitude), 1), atol=1e-9)
    assert find_city(Path("log_map_archive_7fab____PIT_city_47896.json")) == "PIT"
    assert find_city(Path("m.json")) is None and find_city(Path("a____XYZ_city_1.json")) is None


def write_layer(path, layer, shapes, crs, fields, **more):
    values = [np.array(v, None if isinstance(v[0], float | int) else object) for v in fields.values()]
    pyogrio.raw.write(
        path, np.array([s.wkb for s in shapes], object), values, list(fields), layer=layer, driver="GPKG",
        geometry_type="Unknown", crs=crs, append=path.exists(), **more,
    )  # fmt: skip


def test_a_geopackage_is_read_in_the_coordinate_system_that_it_states(tmp_path):
    path = tmp_path / "city.gpkg"
    line, ring = (
        shapely.LineString([(691000, 5334000), (691050, 5334010)]),
        shapely.box(691010, 5334020, 691014, 5334030),
    )
    double = shapely.MultiLineString([[(0, 0), (9, 0)], [(0, 5), (9, 5)]])
    shifted = shapely.transform(double, lambda xy: xy + (691000, 5334000))
    write_layer(path, "everything", [line, ring, shifted, line, line], "EPSG:25832", {
        "kind": ["lane_divider", "crosswalk", "boundary", "tree", "divider"],
        "style": ["dashed", None, "none", None, None],
        "state": [None, "published", "published", "published", "retired"],
        "score": [0.5, np.nan, 0.75, 1.0, 1.0],
    })  # fmt: skip
    write_layer(path, "stop_lines", [shapely.LineString([(11.57, 48.13), (11.58, 48.13)])], "EPSG:4258", {"n": [1]})
    write_layer(path, "trees", [shapely.Point(691000, 5334000)], "EPSG:25832", {"n": [1]})
    found = read_vector_layers(path)
    assert found.elements.kind.tolist() == [DIVIDER, CROSSING, BOUNDARY, BOUNDARY, STOP_LINE]
    assert found.left_out == {"kind tree": 1, "state retired": 1, "layer trees without a kind": 1}
    np.testing.assert_allclose(found.elements.score, [0.5, 1.0, 0.75, 0.75, 1.0])
    assert found.elements.style[0].argmax() == DASHED and found.elements.counts.tolist() == [2, 4, 2, 2, 2]
    back = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True)
    np.testing.assert_allclose(np.stack(back.transform(*found.elements.polyline(0).T), 1), line.coords, atol=1e-4)


def test_layers_without_a_place_on_earth_need_a_stated_one(tmp_path):
    path = tmp_path / "site.gpkg"
    line = shapely.LineString([(691000, 5334000), (691050, 5334010)])
    with pytest.warns(UserWarning, match="crs"):
        write_layer(path, "dividers", [line], None, {"n": [1]})
    with pytest.raises(VectorLayerError, match=r"site\.gpkg.*'dividers'.*--crs"):
        read_vector_layers(path)
    assert read_vector_layers(path, "EPSG:25832").elements.points[0] == pytest.approx((11.58, 48.13), abs=0.02)
    with pytest.raises(VectorLayerError, match="coordinate system nonsense"):
        read_vector_layers(path, "nonsense")
    (tmp_path / "broken.gpkg").write_bytes(b"no data base")
    with pytest.raises(VectorLayerError, match=r"broken\.gpkg"):
        read_vector_layers(tmp_path / "broken.gpkg")


def test_names_of_layers_and_fields_stand_for_kinds():
    assert [find_kind(n) for n in ("Crosswalks", "stop-line", "road boundary", "x")] == [
        CROSSING,
        STOP_LINE,
        BOUNDARY,
        None,
    ]


@pytest.mark.parametrize("ending", ["gpkg", "geojson", "osm"])
def test_what_export_wrote_import_reads_in_its_place(two_lanes, tmp_path, ending):
    m = two_lanes()
    export_map(m, tmp_path / f"m.{ending}")
    read = read_source_map(tmp_path / f"m.{ending}", m.frame)
    want = m.select_published().elements
    assert sorted(read.elements.kind.tolist()) == sorted(want.kind.tolist())
    for kind in (DIVIDER, CROSSING):
        got, line = (e.take(e.kind == kind) for e in (read.elements, want))
        assert furthest(got.points, line) < 0.03
    elsewhere = read_source_map(tmp_path / f"m.{ending}")
    assert (abs(elsewhere.frame.latitude - 48.137), abs(elsewhere.frame.longitude - 11.575)) < (1e-3, 1e-3)


def test_a_map_moves_to_another_frame_and_back(two_lanes):
    m = two_lanes(500.0, -200.0)
    there = move_to_frame(m, MapFrame(48.14, 11.57))
    assert np.abs(there.elements.points - m.elements.points).max() > 100.0
    back = move_to_frame(there, m.frame)
    np.testing.assert_allclose(back.elements.points, m.elements.points, atol=1e-6)
    np.testing.assert_allclose(back.topology.branch_xy, m.topology.branch_xy, atol=1e-6)
    assert (there.id == m.id).all()


def test_a_map_is_one_observation_for_each_connected_ground():
    straight = np.array([[0.0, 0.0], [100.0, 0.0]])
    e = MapElements.of([straight, straight + (0, 15), straight + (0, 200)], [DIVIDER, BOUNDARY, DIVIDER], sigma=0.05)
    near, far = sorted(make_map_observations(e, MapSource("a", 7, 0.3, 0.002)), key=lambda o: o.pose[1])
    assert (len(near.elements), len(far.elements)) == (2, 1)
    np.testing.assert_allclose(near.elements_in_map().points, e.points[:4], atol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(near.covariance)), [0.3, 0.3, 0.002])
    assert near.time_ns == 7 and near.pass_id == far.pass_id and (near.elements.sigma == 0.05).all()
    ground = shapely.Polygon(near.view + near.pose[:2])
    # 10 m around both lines, and all between them.
    assert (
        ground.covers(shapely.Point(50, 7))
        and ground.covers(shapely.Point(50, -9))
        and not ground.covers(shapely.Point(50, -12))
    )
    assert compute_covered_ground(e, 10.0).area == pytest.approx(ground.area + 100 * 20 + np.pi * 100, rel=0.02)
    assert make_map_observations(MapElements.empty(), MapSource("a")) == []


def test_the_yard_inside_a_ring_road_is_not_covered():
    circle = 60.0 * np.stack((np.cos(np.linspace(0, 2 * np.pi, 90)), np.sin(np.linspace(0, 2 * np.pi, 90))), 1)
    (one,) = make_map_observations(MapElements.of([circle], BOUNDARY), MapSource("a"))
    (hole,) = [shapely.Polygon(one.occluders.ring(k) + one.pose[:2]) for k in range(len(one.occluders))]
    assert hole.covers(shapely.Point(0, 0)) and not hole.intersects(shapely.Point(52, 0))


def test_a_large_map_is_halved_and_nothing_of_it_is_lost():
    rng = np.random.default_rng(0)
    lines = [np.array([[0.0, y], [3000.0, y + 3.0]]) for y in rng.uniform(0, 300, 40)]
    rings = [shapely.get_coordinates(shapely.box(x, 10, x + 4, 18))[:4] for x in np.arange(20.0, 3000.0, 2.9)]
    e = MapElements.of(lines + rings, [DIVIDER] * 40 + [CROSSING] * len(rings))
    parts = make_map_observations(e, MapSource("a"))
    assert len(parts) > 3
    assert all(len(o.elements) <= LIMITS.max_elements for o in parts)
    cut = MapElements.cat([o.elements_in_map() for o in parts])
    assert (cut.kind == CROSSING).sum() == len(rings)
    assert cut.lengths()[cut.kind == DIVIDER].sum() == pytest.approx(e.lengths()[:40].sum(), abs=0.5)


@real
def test_two_maps_of_one_place_become_one_and_their_shift_is_found(tmp_path):
    first = read_source_map(PITTSBURGH)
    assert (abs(first.frame.latitude - 40.46), abs(first.frame.longitude + 79.95)) < (0.02, 0.02)
    shift = (0.5, -0.4, np.radians(0.05))
    moved = first.elements.transform(*shift)
    observations = [
        o
        for name, elements in (("survey", first.elements), ("other", moved))
        for o in make_map_observations(elements, MapSource(name, 1_700_000_000_000_000_000))
    ]
    fused = fuse(observations, frame=first.frame).select_published()
    assert duplicated_fraction(MapElements.cat([first.elements, moved])) == 1.0
    assert duplicated_fraction(fused.elements) < duplicated_fraction(first.elements) < 0.12
    assert fused.elements.lengths().sum() > 0.95 * first.elements.lengths().sum()
    # Half way between the two, as neither is known to be right.
    distance = find_nearest_line(fused.elements.points, first.elements.points, first.elements.offsets, 5.0).distance
    assert np.median(distance) < 0.35


@real
def test_import_takes_maps_of_three_formats_into_one_frame(tmp_path, capsys):
    first = read_source_map(PITTSBURGH)
    whole = VectorMap.of(first.elements, first.frame)
    export_map(whole, tmp_path / "a.gpkg")
    write_vector_map(whole, tmp_path / "own")
    words = ["map", "import", PITTSBURGH, tmp_path / "a.gpkg", tmp_path / "own", "--out", tmp_path / "in"]
    assert cli.main([*map(str, words), "--date", "2026-03-01"]) == 0
    loaded = read_observations(tmp_path / "in" / "observations")
    assert {o.agent for o in loaded.observations} == {PITTSBURGH.name, "a", "own"}
    assert loaded.frame == first.frame and {o.time_ns for o in loaded.observations} == {1772323200 * 10**9}
    for agent in ("a", "own"):
        e = MapElements.cat([o.elements_in_map() for o in loaded.observations if o.agent == agent])
        assert furthest(e.points, first.elements) < 0.1
    assert cli.main(["map", "fuse", str(tmp_path / "in")]) == 0
    fused = read_vector_map(tmp_path / "in" / "map").select_published().elements
    assert 0.95 < fused.lengths().sum() / first.elements.lengths().sum() < 1.1


def test_import_prints_what_it_leaves_out_and_refuses_mixtures(two_lanes, tmp_path, capsys):
    export_map(two_lanes(), tmp_path / "m.gpkg")
    assert cli.main(["map", "import", str(tmp_path / "m.gpkg"), "--out", str(tmp_path / "in")]) == 0
    assert "left out: 1 of m.gpkg: state candidate" in capsys.readouterr().out
    assert '"m.gpkg: state candidate": 1' in (tmp_path / "in" / "import.json").read_text()
    (tmp_path / "r.json").write_text('{"results": []}')
    assert not is_map(tmp_path / "r.json") and is_map(tmp_path / "m.gpkg")
    assert cli.main(["map", "import", str(tmp_path / "m.gpkg"), str(tmp_path / "r.json")]) == 1
    assert "r.json is no map" in capsys.readouterr().err
    assert cli.main(["map", "import", str(tmp_path / "m.gpkg"), "--date", "soon"]) == 1
    assert "--date" in capsys.readouterr().err


def test_an_argoverse_2_form_without_a_city_needs_an_origin(two_lanes, tmp_path):
    m = two_lanes()
    export_map(m, tmp_path / "m.json", "argoverse2")
    with pytest.raises(ConfigError, match="--origin"):
        read_source_map(tmp_path / "m.json")
    read = read_source_map(tmp_path / "m.json", m.frame)
    assert furthest(read.elements.take(read.elements.kind == DIVIDER).points, m.elements) < 0.03
    xy = metres_from_degrees(48.137, 11.575, (48.137, 11.575))
    np.testing.assert_allclose(xy, 0.0, atol=1e-9)


def test_maps_of_two_regions_are_refused_by_the_name_of_the_second(two_lanes, tmp_path, capsys):
    for name, frame in (("karlsruhe", MapFrame(49.0, 8.4)), ("pittsburgh", MapFrame(40.4, -80.0))):
        export_map(replace(two_lanes(), frame=frame), tmp_path / f"{name}.geojson")
    files = [tmp_path / f"{name}.geojson" for name in ("karlsruhe", "pittsburgh")]
    assert cli.main(["map", "import", *map(str, files), "--out", str(tmp_path / "out")]) == 1
    text = " ".join(capsys.readouterr().err.split())
    assert "pittsburgh.geojson: lies 6," in text and "one region" in text and not list(tmp_path.rglob("*.parquet"))
