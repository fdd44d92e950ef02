# SPDX-License-Identifier: Apache-2.0
"""Observations: what is refused, by field; and an identity that content alone decides."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes.map_element import MapElements, Polygons
from manyeyes.maps.observation import Frame, Observation, ObservationError, is_simple_ring

VIEW = np.array([[0.0, -15.0], [60.0, -15.0], [60.0, 15.0], [0.0, 15.0]])
ELEMENTS = MapElements.of(
    [[[0, 0], [30, 0]], [[10, -5], [14, -5], [14, 5], [10, 5]]], [0, 2], score=[0.5, 0.75], style=[1, 3]
)
GOOD = Observation("car", "pass", 7, np.array([1.0, 2.0, 0.1]), np.diag([0.5, 0.5, 1e-4]), VIEW, ELEMENTS)
BOW_TIE = [[0, 0], [2, 2], [2, 0], [0, 2]]


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
def test_what_cannot_be_used_is_refused_by_the_name_of_its_field(field: str, changes: dict) -> None:
    with pytest.raises(ObservationError, match=rf"^Observation\.{field}: expected .*; got .*\. Mend it") as caught:
        replace(GOOD, **changes)
    assert "\n" not in str(caught.value)


def test_rings_cross_or_only_touch() -> None:
    assert is_simple_ring(VIEW) and is_simple_ring(np.array([[0.0, 0], [4, 0], [2, 1], [4, 2], [0, 2]]))
    assert not is_simple_ring(np.array(BOW_TIE, float))
    square = np.array([[0.0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]])
    assert is_simple_ring(square), "points along one side touch, they do not cross"


def test_rings_cross_where_shapely_says_so() -> None:
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


def test_texts_cannot_borrow_from_each_other() -> None:
    assert replace(GOOD, agent="ab", pass_id="c").id != replace(GOOD, agent="a", pass_id="bc").id


def test_a_negative_zero_is_a_zero() -> None:
    turned = replace(GOOD, view=np.where(VIEW == 0.0, -0.0, VIEW))
    assert turned.id == GOOD.id


def test_elements_stand_in_the_map_where_the_pose_says() -> None:
    o = replace(GOOD, pose=np.array([10.0, 20.0, math.pi / 2]))
    assert np.allclose(o.in_map().polyline(0), [[10, 20], [10, 50]])
    assert np.allclose(o.in_map(np.array([0.0, 0.0, math.pi])).polyline(0), [[0, 0], [-30, 0]])


def test_a_frame_is_a_scale_one_projection_about_its_origin() -> None:
    assert Frame(49.5, 8.25).proj.startswith("+proj=tmerc +lat_0=49.5 +lon_0=8.25 +k=1 ")
    with pytest.raises(ObservationError, match="latitude"):
        Frame(91.0, 0.0)
