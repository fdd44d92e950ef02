# SPDX-License-Identifier: Apache-2.0
"""Observations: what is refused, by field; and an identity that content alone decides."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from manyeyes.datatypes.map_element import MapElements, Polygons
from manyeyes.maps.elements.observation import MapFrame, Observation, ObservationError, is_simple_ring
from manyeyes.maps.elements.observation_limits import LIMITS

VIEW = np.array([[0.0, -15.0], [60.0, -15.0], [60.0, 15.0], [0.0, 15.0]])
ELEMENTS = MapElements.of(
    [[[0, 0], [30, 0]], [[10, -5], [14, -5], [14, 5], [10, 5]]], [0, 2], score=[0.5, 0.75], style=[1, 3]
)
GOOD = Observation("car", "pass", 7, np.array([1.0, 2.0, 0.1]), np.diag([0.5, 0.5, 1e-4]), VIEW, ELEMENTS)
BOW_TIE = [[0, 0], [2, 2], [2, 0], [0, 2]]
CIRCLE = np.stack([f(np.linspace(0, 2 * np.pi, 1001)[:-1]) for f in (np.cos, np.sin)], 1)
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def lines(*many: object, kind: int = 0) -> dict:
    return {"elements": MapElements.of([np.asarray(line, float) for line in many], kind)}


def placed(x: float, yaw: float = 0.0) -> dict:
    return {"pose": np.array([x, -x, yaw])}


def stds(position: float, yaw: float) -> dict:
    return {"covariance": np.diag([position**2, position**2, yaw**2])}


def with_nan(points: np.ndarray) -> np.ndarray:
    points = points.copy()
    points[0, 1] = math.nan
    return points


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("agent", {"agent": ""}),
        ("time_ns", {"time_ns": -1}),
        ("time_ns", {"time_ns": 2.5}),
        ("pose", {"pose": np.array([1.0, math.inf, 0.0])}),
        ("pose", {"pose": np.zeros(4)}),
        ("covariance", {"covariance": np.diag([1.0, 0.0, 1.0])}),
        ("covariance", {"covariance": np.array([[1, 0.5, 0], [0.4, 1, 0], [0, 0, 1]])}),
        ("covariance", {"covariance": np.array([[1, 2, 0], [2, 1, 0], [0, 0, 1.0]])}),
        ("covariance", {"covariance": np.full((3, 3), math.nan)}),
        ("view", {"view": np.array(BOW_TIE, float)}),
        ("view", {"view": with_nan(VIEW)}),
        ("view", {"view": VIEW[:2]}),
        ("occluders", {"occluders": Polygons.of([VIEW[:2]])}),
        ("occluders", {"occluders": Polygons.of([with_nan(VIEW)])}),
        ("points", {"elements": ELEMENTS.with_points(with_nan(ELEMENTS.points))}),
        ("points", {"elements": MapElements.of([BOW_TIE], 2)}),
        ("points", {"elements": MapElements.of([[[0, 0]]], 0)}),
        ("points", {"elements": MapElements.of([[[0, 0], [1, 1]]], 2)}),
        ("score", {"elements": MapElements.of([[[0, 0], [1, 1]]], 0, score=1.01)}),
        ("score", {"elements": MapElements.of([[[0, 0], [1, 1]]], 0, score=math.nan)}),
        ("sigma", {"elements": MapElements.of([[[0, 0], [1, 1]]], 0, sigma=-0.1)}),
        ("style", {"elements": MapElements.of([[[0, 0], [1, 1]]], 0, style=np.array([[0.5, 0.4, 0, 0]]))}),
    ],
)
def test_invalid_values_are_rejected_by_field(field: str, changes: dict) -> None:
    with pytest.raises(ObservationError, match=rf"^Observation\.{field}: expected .*; got .*\. Mend it") as caught:
        replace(GOOD, **changes)
    assert "\n" not in str(caught.value)


# One pair a bound: what is just within it, and what is just outside.
BOUNDS = {
    "agent": ({"agent": "a" * 256}, {"agent": "a" * 257}),
    "pass_id": ({"pass_id": "a" * 256}, {"pass_id": "a" * 257}),
    "model": ({"model": "a" * 256}, {"model": "a" * 257}),
    "pose": (placed(200_000.0), placed(200_001.0)),
    "pose yaw": (placed(0.0, -100.0), placed(0.0, -100.1)),
    "covariance": (stds(999.0, 0.1), stds(1001.0, 0.1)),
    "covariance yaw": (stds(1.0, 3.14), stds(1.0, 3.15)),
    "covariance least": (stds(1.1e-6, 1e-5), stds(0.9e-6, 1e-5)),
    "covariance least yaw": (stds(1.0, 1.1e-6), stds(1.0, 0.9e-6)),
    "view": ({"view": 500.0 * SQUARE}, {"view": 500.1 * SQUARE}),
    "view points": ({"view": CIRCLE}, {"view": np.concatenate((CIRCLE, [[1.1, 0.0]]))}),
    "occluders": ({"occluders": Polygons.of([500.0 * SQUARE])}, {"occluders": Polygons.of([500.1 * SQUARE])}),
    "occluders rings": ({"occluders": Polygons.of([SQUARE] * 256)}, {"occluders": Polygons.of([SQUARE] * 257)}),
    "occluders points": (
        {"occluders": Polygons.of([CIRCLE])},
        {"occluders": Polygons.of([np.concatenate((CIRCLE, CIRCLE[:1]))])},
    ),
    "points": (lines([[0, 0], [500, -500]]), lines([[0, 0], [0, -500.1]])),
    "points of a ring": (lines(50 * CIRCLE, kind=2), lines(50 * np.concatenate((CIRCLE, [[1.0, -0.001]])), kind=2)),
    "points around a ring": (lines(62.5 * SQUARE, kind=2), lines(62.6 * SQUARE, kind=2)),
    "points a metre": (
        lines(np.linspace([0, 0], [10, 0], 600), [[0, 0], [0, 0]], [[1, 1]] * 100),
        lines(np.linspace([0, 0], [10, 0], 601)),
    ),
    "points at one place": (lines([[1, 1]] * 100), lines([[1, 1]] * 101)),
    "points metres": (
        lines([[500 * (-1) ** k, 0] for k in range(21)]),
        lines([[500 * (-1) ** k, 0.1] for k in range(21)], [[0, 0], [1, 0]]),
    ),
    "points of all": (lines(*[50 * CIRCLE] * 50), lines(*[50 * CIRCLE] * 50, [[0, 0], [1, 0]])),
    "elements": (lines(*[[[0, 0], [1, 0]]] * 1000), lines(*[[[0, 0], [1, 0]]] * 1001)),
    "sigma": (
        {"elements": MapElements.of([[[0, 0], [1, 1]]], 0, sigma=1000.0)},
        {"elements": MapElements.of([[[0, 0], [1, 1]]], 0, sigma=1000.1)},
    ),
}


@pytest.mark.parametrize("name", BOUNDS)
def test_numbers_are_taken_up_to_their_bound_and_refused_beyond(name: str) -> None:
    within, outside = BOUNDS[name]
    assert replace(GOOD, **within).agent
    with pytest.raises(ObservationError, match=rf"^Observation\.{name.split()[0]}: expected .*; got .+\. ") as error:
        replace(GOOD, **outside)
    assert len(str(error.value)) < 250 and "\n" not in str(error.value)


def test_the_documented_limits_are_those_that_are_checked() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "map-observations.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| (\S+) \| [\w, ]+ \| ", page, re.MULTILINE)
    assert rows == [(f.name, f"{getattr(LIMITS, f.name):g}") for f in fields(LIMITS)]


@pytest.mark.parametrize("value", [1e300, -1e308, 1.7e308])
def test_numbers_that_overflow_when_squared_are_refused_without_a_warning(value: float) -> None:
    far = np.array([[value, -value], [value, value], [-value, value]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for changes in (
            placed(value),
            placed(0.0, value),
            {"covariance": np.full((3, 3), abs(value)) + np.eye(3)},
            {"view": far},
            {"occluders": Polygons.of([far])},
            lines(far),
            lines(far, kind=2),
            {"elements": MapElements.of([[[0, 0], [1, 1]]], 0, score=value)},
            {"elements": MapElements.of([[[0, 0], [1, 1]]], 0, style=np.full((1, 4), value))},
        ):
            with pytest.raises(ObservationError, match="got"):
                replace(GOOD, **changes)


def test_rings_cross_or_only_touch() -> None:
    assert is_simple_ring(VIEW) and is_simple_ring(np.array([[0.0, 0], [4, 0], [2, 1], [4, 2], [0, 2]]))
    assert not is_simple_ring(np.array(BOW_TIE, float))
    square = np.array([[0.0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]])
    assert is_simple_ring(square), "points along one side touch, they do not cross"


def test_crossing_edges_agree_with_shapely() -> None:
    shapely = pytest.importorskip("shapely")
    generator = np.random.default_rng(4)
    rings = [generator.normal(size=(n, 2)) for n in generator.integers(3, 8, 300)]
    simple = [bool(shapely.LinearRing(ring).is_simple) for ring in rings]
    assert 0.2 < np.mean(simple) < 0.8
    assert [is_simple_ring(ring) for ring in rings] == simple


def test_equal_content_has_one_id_and_every_field_counts() -> None:
    again = replace(GOOD, pose=GOOD.pose.copy())
    assert again.id == GOOD.id and len(GOOD.id) == 32
    others = [
        replace(GOOD, agent="bus"),
        replace(GOOD, pass_id="other"),
        replace(GOOD, time_ns=8),
        replace(GOOD, pose=GOOD.pose + 1e-12),
        replace(GOOD, covariance=GOOD.covariance * 2),
        replace(GOOD, view=VIEW[::-1]),
        replace(GOOD, elements=ELEMENTS.take([0])),
        replace(GOOD, elements=ELEMENTS.take([1, 0])),
        replace(GOOD, model="m"),
        replace(GOOD, trusted=True),
        replace(GOOD, occluders=Polygons.of([VIEW])),
    ]
    assert len({o.id for o in [GOOD, *others]}) == len(others) + 1


def test_adjacent_texts_hash_differently_when_shifted() -> None:
    assert replace(GOOD, agent="ab", pass_id="c").id != replace(GOOD, agent="a", pass_id="bc").id


def test_a_negative_zero_is_a_zero() -> None:
    turned = replace(GOOD, view=np.where(VIEW == 0.0, -0.0, VIEW))
    assert turned.id == GOOD.id


def test_elements_in_map_follow_pose() -> None:
    o = replace(GOOD, pose=np.array([10.0, 20.0, math.pi / 2]))
    assert np.allclose(o.elements_in_map().polyline(0), [[10, 20], [10, 50]])
    assert np.allclose(o.elements_in_map(np.array([0.0, 0.0, math.pi])).polyline(0), [[0, 0], [-30, 0]])


def test_a_frame_is_a_scale_one_projection_about_its_origin() -> None:
    assert MapFrame(49.5, 8.25).proj.startswith("+proj=tmerc +lat_0=49.5 +lon_0=8.25 +k=1 ")
    with pytest.raises(ObservationError, match="latitude"):
        MapFrame(91.0, 0.0)
