# SPDX-License-Identifier: Apache-2.0
"""What is written can be read by the programs it is written for, in the right place on earth, and loses nothing it should keep."""

import json
import sqlite3
import xml.etree.ElementTree as ET
from contextlib import closing
from dataclasses import fields, replace

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.simplify import simplify_map
from manyeyes.maps.elements.vector_map import PointEvidence, VectorMap
from manyeyes.maps.formats.argoverse2_map import read_argoverse2_map
from manyeyes.maps.formats.attributes import orient_counter_clockwise, to_hex_ids
from manyeyes.maps.formats.export import FORMATS, export_map
from manyeyes.maps.formats.geoparquet import MapFileError, projjson, read_map, write_map
from manyeyes.maps.formats.lanes import find_lane_pairs
from manyeyes.maps.formats.rings import split_long_sides
from manyeyes.maps.roads.transverse_mercator import degrees_from_metres

pytest.importorskip("pyarrow", reason="the map extra is not installed")
shapely = pytest.importorskip("shapely", reason="the map extra is not installed")

_MM_DEGREES = 2e-8


def _by_id(m: VectorMap) -> VectorMap:
    return m.take(np.lexsort(m.id.T[::-1]))


def _named_pairs(m: VectorMap, name: str) -> set[tuple[str, str]]:
    ids = to_hex_ids(m.id)
    return {(ids[a], ids[b]) for a, b in getattr(m.topology, name).tolist()}


def _branches(m: VectorMap) -> set[tuple[float, float, str]]:
    ids = to_hex_ids(m.id)
    return {(*m.topology.branch_xy[node].tolist(), ids[row]) for node, row in m.topology.branch.tolist()}


def test_the_lossless_form_keeps_every_field_bit_by_bit(two_lanes, tmp_path):
    m = two_lanes()
    write_map(m, tmp_path / "lines.parquet", tmp_path / "crossings.parquet")
    got, want = read_map(tmp_path / "lines.parquet", tmp_path / "crossings.parquet"), _by_id(m)
    assert got.frame == want.frame
    for f in fields(MapElements):
        np.testing.assert_array_equal(getattr(got.elements, f.name), getattr(want.elements, f.name), err_msg=f.name)
    for f in fields(PointEvidence):
        np.testing.assert_array_equal(
            getattr(got.point_evidence, f.name), getattr(want.point_evidence, f.name), err_msg=f.name
        )
    for name in ("id", "state", "log_odds", "supporters", "agents", "t_first", "t_last"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)
    assert [got.sources_of(k) for k in range(5)] == [want.sources_of(k) for k in range(5)]
    for name in ("successor", "left", "right"):
        assert _named_pairs(got, name) == _named_pairs(want, name) != set()
    assert _branches(got) == _branches(want) and len(_branches(got)) == 3


def test_the_lossless_form_is_the_same_file_each_time_and_holds_an_empty_map(two_lanes, tmp_path):
    for turn in "ab":
        write_map(two_lanes(), tmp_path / f"{turn}.parquet", tmp_path / f"{turn}c.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    write_map(VectorMap.empty(MapFrame(1.0, 2.0)), tmp_path / "a.parquet", tmp_path / "b.parquet")
    assert len(read_map(tmp_path / "a.parquet", tmp_path / "b.parquet")) == 0


def test_geopandas_reads_the_lossless_form_with_its_own_metric_crs_and_bounding_boxes(two_lanes, tmp_path):
    geopandas = pytest.importorskip("geopandas", reason="the map extra is not installed")
    pyproj = pytest.importorskip("pyproj", reason="the map extra is not installed")
    m = two_lanes(100.0, 200.0)
    write_map(m, tmp_path / "lines.parquet", tmp_path / "crossings.parquet")
    lines = geopandas.read_parquet(tmp_path / "lines.parquet")
    assert lines.crs == pyproj.CRS.from_json_dict(projjson(m.frame))
    assert lines.geometry.iloc[1].equals(shapely.LineString(m.elements.polyline(1)))
    # The frame's projection is the one that the PROJ library does under that name, to 0.1 mm.
    degrees = lines.to_crs("EPSG:4326").geometry.iloc[0].coords[60]
    latitude, longitude = degrees_from_metres(m.elements.points[60], (m.frame.latitude, m.frame.longitude))
    assert degrees == pytest.approx((longitude, latitude), abs=1e-9)
    crossings = geopandas.read_parquet(tmp_path / "crossings.parquet", bbox=(119, 190, 121, 210))
    assert crossings.geometry.iloc[0].equals(shapely.Polygon(m.elements.polyline(3)))
    assert len(geopandas.read_parquet(tmp_path / "crossings.parquet", bbox=(0, 0, 10, 10))) == 0


@pytest.mark.slow
@pytest.mark.parametrize("format", ["geojson", "geopackage", "geoparquet"])
def test_geopandas_reads_all_elements_in_their_place_on_earth(two_lanes, tmp_path, format):
    geopandas = pytest.importorskip("geopandas", reason="the map extra is not installed")
    m = two_lanes(-300.0, 500.0)
    path = tmp_path / {"geojson": "m.geojson", "geopackage": "m.gpkg", "geoparquet": "m.parquet"}[format]
    export_map(m, path)
    if format == "geoparquet":
        parts = [geopandas.read_parquet(path)]
    else:
        layers = ("lines", "crossings") if format == "geopackage" else (None,)
        parts = [geopandas.read_file(path, **({"layer": layer} if layer else {})) for layer in layers]
    assert all(part.crs.to_epsg() == 4326 or part.crs.to_string() == "OGC:CRS84" for part in parts)
    ids = to_hex_ids(m.id)
    found = {row.id: row for part in parts for row in part.itertuples()}
    assert set(found) == set(ids)
    for row, name in enumerate(ids):
        metric = geopandas.GeoSeries([found[name].geometry], crs="EPSG:4326").to_crs(m.frame.proj).iloc[0]
        line = m.elements.polyline(row)
        want = shapely.Polygon(line) if m.elements.kind[row] == CROSSING else shapely.LineString(line)
        assert metric.geom_type == want.geom_type
        assert shapely.hausdorff_distance(metric, want) < 0.002
    first = found[ids[1]]
    assert (first.kind, first.state, first.style) == ("divider", "published", "dashed")
    assert first.supporters == 2 and first.confidence == pytest.approx(1 / (1 + np.exp(-m.log_odds[1])), abs=1e-6)


QGIS_STYLE_QUERY = """SELECT f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, styleQML, styleSLD,
useAsDefault, description, owner, ui, update_time FROM layer_styles WHERE f_table_schema = '' AND f_table_name = 'lines'
AND f_geometry_column = 'geom' ORDER BY CASE WHEN useAsDefault THEN 1 ELSE 2 END, update_time DESC LIMIT 1"""


@pytest.mark.parametrize("crs", ["EPSG:25832", "local"])
def test_a_geopackage_in_metres_holds_the_same_places_with_a_style_of_each_layer(two_lanes, tmp_path, crs):
    geopandas = pytest.importorskip("geopandas", reason="the map extra is not installed")
    m, path = two_lanes(-300.0, 500.0), tmp_path / "m.gpkg"
    export_map(m, path, crs=crs)
    lines = geopandas.read_file(path, layer="lines")
    assert lines.crs.is_projected and lines.crs.axis_info[0].unit_name == "metre"
    assert crs == "local" or lines.crs.to_epsg() == 25832
    placed = dict(zip(lines["id"], lines.to_crs(m.frame.proj).geometry))
    for row, name in enumerate(to_hex_ids(m.id)):
        if m.elements.kind[row] != CROSSING:
            want = shapely.LineString(m.elements.polyline(row))
            assert shapely.hausdorff_distance(placed[name], want) < 0.002
    if crs == "local":
        assert lines.crs.name == "manyeyes_local"
        np.testing.assert_array_equal(shapely.get_coordinates(lines.geometry[0]), m.elements.polyline(0))
    with closing(sqlite3.connect(path)) as data:
        styles = dict(data.execute("SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault = 1").fetchall())
        (kind,) = data.execute("SELECT data_type FROM gpkg_contents WHERE table_name = 'layer_styles'").fetchone()
        columns = dict(data.execute("SELECT table_name, column_name FROM gpkg_geometry_columns").fetchall())
        # QGIS's own query of a layer's styles: an unknown column fails it, and the layer stays grey.
        data.execute(QGIS_STYLE_QUERY).fetchall()
    assert kind == "attributes" and set(columns.values()) == {"geom"}
    for layer, kinds in (("lines", {"divider", "boundary", "stop_line"}), ("crossings", {"crossing"})):
        root = ET.fromstring(styles[layer])
        assert {c.get("value") for c in root.iter("category")} == kinds
        assert {c.get("symbol") for c in root.iter("category")} == {s.get("name") for s in root.iter("symbol")}


def test_exported_times_are_iso_texts_in_utc(two_lanes, tmp_path):
    seen = np.array([0, 1_772_352_000_123_456_789, 10, 20, 30])
    m = replace(two_lanes(), t_first=seen)
    export_map(m, tmp_path / "m.geojson")
    features = json.loads((tmp_path / "m.geojson").read_text())["features"]
    assert [f["properties"]["t_first"] for f in features][:2] == [
        "1970-01-01T00:00:00.000Z",
        "2026-03-01T08:00:00.123Z",
    ]


def test_coordinate_systems_that_do_not_fit_are_named(two_lanes, tmp_path):
    pytest.importorskip("pyproj", reason="the map extra is not installed")
    with pytest.raises(ConfigError, match=r"'EPSG:99'.*EPSG:25832"):
        export_map(two_lanes(), tmp_path / "m.gpkg", crs="EPSG:99")
    with pytest.raises(ConfigError, match="only a GeoPackage"):
        export_map(two_lanes(), tmp_path / "m.osm", crs="EPSG:25832")
    assert not list(tmp_path.iterdir())


def test_geojson_rings_close_and_run_counter_clockwise(two_lanes, tmp_path):
    export_map(two_lanes(), tmp_path / "m.geojson")
    root = json.loads((tmp_path / "m.geojson").read_text())
    (ring,) = next(f["geometry"]["coordinates"] for f in root["features"] if f["geometry"]["type"] == "Polygon")
    assert ring[0] == ring[-1] and shapely.LinearRing(ring).is_ccw


def test_counter_clockwise_turns_only_rings_that_run_clockwise():
    square = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])
    e = MapElements.of([square, square[::-1], square], [CROSSING, CROSSING, DIVIDER])
    turned = orient_counter_clockwise(e)
    np.testing.assert_array_equal(turned.polyline(0), square[[0, 3, 2, 1]])
    np.testing.assert_array_equal(turned.polyline(1), square[::-1])
    np.testing.assert_array_equal(turned.polyline(2), square)


def test_lanelet2_reads_lanes_crosswalk_and_styles_back(two_lanes, tmp_path):
    lanelet2 = pytest.importorskip("lanelet2", reason="the lanelet2 package is not installed")
    m = two_lanes()
    export_map(m, tmp_path / "m.osm")
    origin = lanelet2.io.Origin(m.frame.latitude, m.frame.longitude)
    read, errors = lanelet2.io.loadRobust(str(tmp_path / "m.osm"), lanelet2.projection.LocalCartesianProjector(origin))
    assert list(errors) == []
    kinds = sorted(lanelet.attributes["subtype"] for lanelet in read.laneletLayer)
    assert kinds == ["crosswalk", "road", "road"]
    for lanelet in read.laneletLayer:
        centre = np.array([(p.x, p.y) for p in lanelet.centerline])
        if lanelet.attributes["subtype"] == "road":
            assert min(abs(centre[0, 1] - 1.75), abs(centre[0, 1] + 1.75)) < 0.05
    lines = {line.attributes["manyeyes:id"]: line for line in read.lineStringLayer}
    divider = lines[to_hex_ids(m.id)[1]]
    assert (divider.attributes["type"], divider.attributes["subtype"]) == ("line_thin", "dashed")
    got = np.array([(p.x, p.y) for p in divider])
    # Lanelet2's local projection is a tangent plane, ours transverse Mercator: 60 m from the origin they agree to 1 mm.
    np.testing.assert_allclose(got, m.elements.polyline(1), atol=1e-3)
    # The stop line is a candidate: formats without a state hold what is published.
    assert to_hex_ids(m.id)[4] not in lines


def test_argoverse_2_form_is_read_by_the_reader_of_that_data_set(two_lanes, tmp_path):
    m = two_lanes()
    lone = MapElements.of([np.array([[0.0, 90.0], [50.0, 90.0]])], DIVIDER)
    both = VectorMap.cat([m, VectorMap.of(lone, m.frame)])
    export_map(both, tmp_path / "m.json", "argoverse2")
    network = read_argoverse2_map(tmp_path / "m.json")
    painted = [mark.line[:, :2] for mark in network.marks if mark.kind in ("solid", "broken")]
    # The dashed divider bounds two lanes and stands with both, as in the data set; the lone divider has no style, so no paint.
    assert len(painted) == 2
    for line in painted:
        np.testing.assert_allclose(line, m.elements.polyline(1), atol=1e-4)
    (crossing,) = network.crossings
    assert shapely.Polygon(crossing.polygon[:, :2]).equals(shapely.Polygon(m.elements.polyline(3)))
    assert len(network.lanes) == 3
    assert len(json.loads((tmp_path / "m.json").read_text())["road_boundaries"]) == 2


def test_nuscenes_form_joins_by_tokens_and_keeps_the_points(two_lanes, tmp_path):
    m = two_lanes()
    m = replace(m, state=np.ones(5, np.int64))
    export_map(m, tmp_path / "m.json", "nuscenes")
    root = json.loads((tmp_path / "m.json").read_text())
    node = {n["token"]: (n["x"], n["y"]) for n in root["node"]}
    line = {one["token"]: one["node_tokens"] for one in root["line"]}
    area = {one["token"]: one["exterior_node_tokens"] for one in root["polygon"]}
    (divider,) = root["lane_divider"]
    np.testing.assert_allclose([node[t] for t in line[divider["line_token"]]], m.elements.polyline(1), atol=1e-4)
    assert {s["segment_type"] for s in divider["lane_divider_segments"]} == {"SINGLE_DASHED_WHITE"}
    (crossing,) = root["ped_crossing"]
    np.testing.assert_allclose([node[t] for t in area[crossing["polygon_token"]]], m.elements.polyline(3), atol=1e-4)
    (stop,) = root["stop_line"]
    strip = shapely.Polygon([node[t] for t in area[stop["polygon_token"]]])
    assert strip.area == pytest.approx(3.5 * 0.4, rel=1e-3) and strip.is_valid
    assert len(root["road_boundary"]) == 2
    tokens = [row["token"] for table in root.values() if isinstance(table, list) for row in table if type(row) is dict]
    assert len(set(tokens) - {divider["token"]}) == len(tokens) - 1 and root["lane"] == []


def test_gdal_reads_the_vector_tiles_back(two_lanes, tmp_path):
    pyogrio = pytest.importorskip("pyogrio", reason="the map extra is not installed")
    m = two_lanes()
    export_map(m, tmp_path / "m.pmtiles")
    info = pyogrio.read_info(tmp_path / "m.pmtiles", layer="elements")
    assert info["crs"] == "EPSG:3857"
    tiles = pyogrio.read_dataframe(tmp_path / "m.pmtiles", layer="elements")
    assert set(tiles["id"]) == set(to_hex_ids(m.id))
    metric = tiles.to_crs(m.frame.proj)
    divider = shapely.line_merge(shapely.union_all(metric.geometry[tiles["kind"] == "divider"].to_numpy()))
    # A step of zoom 16 is 10 cm at this latitude.
    assert shapely.hausdorff_distance(divider, shapely.LineString(m.elements.polyline(1))) < 0.2


def test_the_graph_has_elements_as_nodes_and_their_relations_as_edges(tmp_path):
    # Two dividers that continue each other 2 m apart, and a boundary 3.5 m to their left.
    lines = [[[0.0, 0.0], [20.0, 0.0]], [[22.0, 0.0], [40.0, 0.0]], [[0.0, 3.5], [40.0, 3.5]]]
    m = VectorMap.of(MapElements.of(lines, [0, 0, 1]), MapFrame(49.0, 8.0), log_odds=np.array([0.0, 2.0, -2.0]))
    export_map(m, tmp_path / "graph.npz")
    with np.load(tmp_path / "graph.npz") as graph:
        relation = graph["relation_names"][graph["relation"]].tolist()
        assert list(zip(map(tuple, graph["edge"].tolist()), relation)) == [
            ((0, 1), "continues"),
            ((0, 2), "parallel"),
            ((1, 2), "parallel"),
        ]
        assert graph["gap"][0] == 2.0 and graph["ends"].tolist() == [[1, 0], [-1, -1], [-1, -1]]
        np.testing.assert_allclose(graph["lateral"][1:], 3.5)
        np.testing.assert_allclose(graph["interval"][1:], [[0, 20, 0, 20], [0, 18, 22, 40]], atol=1e-9)
        np.testing.assert_allclose(graph["existence_prob"], [0.5, 0.880797, 0.119203])
        assert graph["offsets"].tolist() == [0, 2, 4, 6] and graph["points"].shape == (6, 2)
        assert graph["kind_names"][graph["kind"]].tolist() == ["divider", "divider", "boundary"]
        assert graph["origin"].tolist() == [49.0, 8.0] and graph["id"].tolist() == to_hex_ids(m.id)


def test_unknown_format_or_ambiguous_suffix_lists_known_formats(two_lanes, tmp_path):
    with pytest.raises(ConfigError, match=", ".join(FORMATS)):
        export_map(two_lanes(), tmp_path / "m.osm", "kml")
    with pytest.raises(ConfigError, match="nuscenes"):
        export_map(two_lanes(), tmp_path / "m.json")


def test_an_empty_map_is_exported_where_the_format_can_hold_it(tmp_path):
    pyogrio = pytest.importorskip("pyogrio", reason="the map extra is not installed")
    empty = VectorMap.empty()
    for name in ("m.geojson", "m.gpkg", "m.parquet", "m.osm"):
        export_map(empty, tmp_path / name)
    assert pyogrio.read_info(tmp_path / "m.gpkg", layer="lines")["features"] == 0
    with pytest.raises(ConfigError, match="empty map"):
        export_map(empty, tmp_path / "m.pmtiles")


@pytest.mark.parametrize("damage", ["cut", "version", "column", "other"])
def test_a_damaged_file_is_named_with_its_fault(two_lanes, tmp_path, damage):
    from pyarrow import parquet

    path = tmp_path / "lines.parquet"
    write_map(two_lanes(), path, tmp_path / "crossings.parquet")
    table = parquet.read_table(path)
    meta = dict(table.schema.metadata)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-300])
    elif damage == "version":
        parquet.write_table(table.replace_schema_metadata({**meta, b"manyeyes:version": b"99"}), path)
    elif damage == "column":
        parquet.write_table(table.drop_columns(["score"]), path)
    else:
        parquet.write_table(table.replace_schema_metadata({}), path)
    reason = {"cut": "expected a Parquet file", "version": "version 99", "column": "'score'", "other": "metadata"}[
        damage
    ]
    with pytest.raises(MapFileError, match=rf"lines\.parquet.*{reason}"):
        read_map(path)


def test_files_of_two_frames_do_not_become_one_map(two_lanes, tmp_path):
    for k, frame in enumerate((MapFrame(1.0, 1.0), MapFrame(1.0, 2.0))):
        write_map(two_lanes(frame=frame), tmp_path / f"{k}.parquet", tmp_path / f"{k}c.parquet")
    with pytest.raises(MapFileError, match="one frame"):
        read_map(tmp_path / "0.parquet", tmp_path / "1.parquet")


def test_lanes_lie_between_lines_a_lane_apart_whichever_way_they_run(two_lanes):
    m = two_lanes()
    points = m.elements.points.copy()
    points[61:122] = points[61:122][::-1]
    turned = replace(m, elements=m.elements.with_points(points))
    pairs = find_lane_pairs(turned)
    assert [(p.left, p.right, p.right_is_reversed) for p in pairs] == [(0, 1, True)]
    apart = m.elements.points.copy()
    apart[:61, 1] += 3.0
    assert [(p.left, p.right) for p in find_lane_pairs(replace(m, elements=m.elements.with_points(apart)))] == [(1, 2)]


def test_the_long_sides_of_a_ring_run_side_by_side_left_first():
    ring = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 10.0], [0.0, 10.0]])
    for shift in range(4):
        for line in (ring, ring[::-1]):
            left, right = split_long_sides(np.roll(line, shift, axis=0))
            assert len(left) == len(right) == 2
            heading = left[1] - left[0]
            np.testing.assert_allclose(np.abs(heading), (0, 10))
            np.testing.assert_allclose(right[1] - right[0], heading)
            across = left[0] - right[0]
            assert heading[0] * across[1] - heading[1] * across[0] > 0
    many = np.array(
        [[0.0, 0.0], [1.5, -0.4], [3.0, 0.0], [3.0, 5.0], [3.0, 10.0], [1.5, 10.4], [0.0, 10.0], [0.0, 5.0]]
    )
    left, right = split_long_sides(many)
    assert shapely.Polygon(np.concatenate((left, right[::-1]))).area == pytest.approx(shapely.Polygon(many).area)


def test_simplified_lines_stay_within_the_tolerance_and_keep_their_evidence(two_lanes):
    m = two_lanes()
    less = simplify_map(m, 0.05)
    assert len(less.elements.points) < 0.4 * len(m.elements.points)
    for row in range(len(m)):
        a, b = m.elements.polyline(row), less.elements.polyline(row)
        ring = m.elements.kind[row] == CROSSING
        make = shapely.LinearRing if ring else shapely.LineString
        assert shapely.distance(shapely.points(a), make(b)).max() <= 0.05
        np.testing.assert_array_equal(a[0], b[0])
        assert ring or (a[-1] == b[-1]).all()
    kept = [np.flatnonzero((m.elements.points == p).all(1))[0] for p in less.elements.points[:10]]
    np.testing.assert_array_equal(less.point_evidence.support[:10], m.point_evidence.support[kept])
    np.testing.assert_array_equal(simplify_map(m, 0.0).elements.polyline(3), m.elements.polyline(3))
