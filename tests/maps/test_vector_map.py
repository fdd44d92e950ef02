# SPDX-License-Identifier: Apache-2.0
"""A fused map as columns: parts, joins, provenance, and a hash that only what is mapped decides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes import ShapeError
from manyeyes.datatypes.map_element import MapElements
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import PUBLISHED, RETIRED, Topology, VectorMap

LINES = [
    [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]],
    [[2.0, 0.0], [3.0, 0.5]],
    [[5.0, 5.0], [7.0, 5.0], [7.0, 9.0], [5.0, 9.0]],
]
A, B, C = ("0a" * 16, "0b" * 16, "0c" * 16)


def small() -> VectorMap:
    whole = VectorMap.of(
        MapElements.of(LINES, [0, 0, 2]), MapFrame(49.0, 8.0), [[B, A], [B], [C, B]], [2, 1, 2], ([1, 2, 3], [4, 5, 6])
    )
    stations = replace(whole.point_evidence, support=np.arange(9))
    topology = Topology(
        successor=np.array([[0, 1]]),
        left=np.array([[0, 2]]),
        right=np.array([[2, 1]]),
        branch=np.array([[0, 0], [1, 1], [1, 2]]),
        branch_xy=np.array([[2.0, 0.0], [5.0, 5.0]]),
    )
    return replace(whole, point_evidence=stations, topology=topology)


def test_sources_are_found_by_element() -> None:
    assert [small().sources_of(i) for i in range(3)] == [[A, B], [B], [B, C]]
    assert small().supporters.tolist() == [2, 1, 2]


def test_a_part_keeps_its_points_evidence_sources_and_inner_relations() -> None:
    some = small().take([2, 1])
    assert some.elements.kind.tolist() == [2, 0] and some.point_evidence.support.tolist() == [5, 6, 7, 8, 3, 4]
    assert [some.sources_of(i) for i in range(2)] == [[B, C], [B]] and len(some.observations) == 2
    assert some.t_last.tolist() == [6, 5]
    assert some.topology.successor.tolist() == [] and some.topology.right.tolist() == [[0, 1]]
    assert some.topology.branch.tolist() == [[0, 1], [0, 0]] and some.topology.branch_xy.tolist() == [[5.0, 5.0]]


def test_maps_join_into_one_with_one_list_of_observations() -> None:
    one, two = small().take([0]), small().take([1, 2])
    both = VectorMap.cat([one, two])
    assert [both.sources_of(i) for i in range(3)] == [[A, B], [B], [B, C]] and len(both.observations) == 3
    assert both.point_evidence.support.tolist() == list(range(9)) and both.elements.offsets.tolist() == [0, 3, 5, 9]
    assert both.topology.right.tolist() == [[2, 1]]
    assert both.topology.branch_xy[both.topology.branch[:, 0]].tolist() == [[2, 0], [5, 5], [5, 5]]
    assert both.topology.branch[:, 1].tolist() == [0, 1, 2]
    assert both.quantised_hash() == small().quantised_hash()


def test_maps_of_two_frames_do_not_join() -> None:
    with pytest.raises(ShapeError, match="one frame"):
        VectorMap.cat([small(), VectorMap.empty(MapFrame(1.0, 1.0))])
    assert len(VectorMap.cat([], MapFrame(1.0, 1.0))) == 0


def test_only_published_elements_remain() -> None:
    mixed = replace(small(), state=np.array([PUBLISHED, RETIRED, PUBLISHED]))
    assert mixed.select_published().elements.kind.tolist() == [0, 2]


def test_the_hash_is_invariant_to_order_direction_ring_start_and_rounding() -> None:
    first = small().quantised_hash()
    turned = [LINES[2][2:] + LINES[2][:2], LINES[0][::-1], LINES[1]]
    assert VectorMap.of(MapElements.of(turned, [2, 0, 0])).quantised_hash() == first
    back = [LINES[2][::-1], LINES[0], LINES[1]]
    assert VectorMap.of(MapElements.of(back, [2, 0, 0])).quantised_hash() == first
    near = MapElements.of([np.array(line) + 0.0003 for line in LINES], [0, 0, 2])
    assert VectorMap.of(near).quantised_hash() == first


@pytest.mark.parametrize("change", ["kind", "point", "state", "less"])
def test_the_hash_depends_on_the_content(change: str) -> None:
    first, other = small().quantised_hash(), small()
    if change == "kind":
        other = VectorMap.of(MapElements.of(LINES, [1, 0, 2]))
    if change == "point":
        other = VectorMap.of(other.elements.with_points(other.elements.points + 0.011))
    if change == "state":
        other = replace(other, state=np.array([PUBLISHED, RETIRED, PUBLISHED]))
    if change == "less":
        other = other.take([0, 2])
    assert other.quantised_hash() != first


def test_ids_follow_content_and_equal_elements_differ_by_rank() -> None:
    twice = VectorMap.of(MapElements.of([LINES[0], LINES[1], LINES[0]], 0))
    assert len({row.tobytes() for row in twice.id}) == 3
    assert twice.id[1].tobytes() == small().id[1].tobytes() and twice.id[0].tobytes() == small().id[0].tobytes()


def test_columns_that_do_not_fit_are_refused_by_name() -> None:
    with pytest.raises(ShapeError, match=r"VectorMap.state needs shape \(3,\)"):
        replace(small(), state=np.zeros(2, np.int64))
    with pytest.raises(ShapeError, match="point_evidence needs 9 rows"):
        replace(small(), point_evidence=small().point_evidence.take(np.arange(8)))
    with pytest.raises(ShapeError, match=r"sources\.offsets needs offsets"):
        replace(small(), sources=np.zeros(3, np.int64))
