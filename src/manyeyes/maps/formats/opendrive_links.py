# SPDX-License-Identifier: Apache-2.0
"""Which lanes of an OpenDRIVE file continue each other, lie side by side, and meet in junctions (1.4H §5.3.2, §5.4)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np

from manyeyes.maps.roads.road_network import Junction, Lane

_End = tuple[int, bool]
"""A lane and whether its end at the road's larger s is meant."""


def link_lanes(root: ET.Element, lanes: Sequence[Lane], left_hand: Set[str]) -> tuple[Lane, ...]:
    """Return the lanes with predecessors, successors and neighbours filled in; left_hand: ids of roads with left-hand traffic."""
    place = {(lane.road_id, lane.section, lane.lane_id): lane.id for lane in lanes}
    last = {}
    for lane in lanes:
        last[lane.road_id] = max(last.get(lane.road_id, 0), lane.section)
    touching: set[tuple[_End, _End]] = set()

    def touch(one: tuple[str, int, int], one_far: bool, two: tuple[str, int, int], two_far: bool) -> None:
        if one in place and two in place:
            a, b = (place[one], one_far), (place[two], two_far)
            touching.update(((a, b), (b, a)))

    for road in root.findall("road"):
        road_id = road.get("id", "")
        for section, element in enumerate(road.findall("lanes/laneSection")):
            for lane in element.iter("lane"):
                own = (road_id, section, int(lane.get("id", "0")))
                for tag, far in (("predecessor", False), ("successor", True)):
                    link = lane.find(f"link/{tag}")
                    if link is None:
                        continue
                    other_id = int(link.get("id", "0"))
                    inner = section + 1 if far else section - 1
                    if 0 <= inner <= last.get(road_id, 0):
                        touch(own, far, (road_id, inner, other_id), not far)
                        continue
                    road_link = road.find(f"link/{tag}")
                    if road_link is not None and road_link.get("elementType") == "road":
                        other = road_link.get("elementId", "")
                        other_far = road_link.get("contactPoint") == "end"
                        touch(own, far, (other, last.get(other, 0) if other_far else 0, other_id), other_far)
    _touch_junctions(root, last, touch)
    return _with_links(lanes, touching, left_hand)


def _touch_junctions(root: ET.Element, last: dict[str, int], touch) -> None:
    """Ends that meet by the junctions' tables: an incoming road's end faces the junction that its link names."""
    facing = {}
    for road in root.findall("road"):
        for tag, far in (("predecessor", False), ("successor", True)):
            link = road.find(f"link/{tag}")
            if link is not None and link.get("elementType") == "junction":
                facing.setdefault((road.get("id"), link.get("elementId")), []).append(far)
    for junction in root.findall("junction"):
        for connection in junction.findall("connection"):
            incoming, connecting = connection.get("incomingRoad", ""), connection.get("connectingRoad", "")
            ends = facing.get((incoming, junction.get("id")), [])
            # A road with both ends in one junction cannot be distinguished here; its lanes' own links do it.
            if len(ends) != 1:
                continue
            far, other_far = ends[0], connection.get("contactPoint") == "end"
            for link in connection.findall("laneLink"):
                own = (incoming, last.get(incoming, 0) if far else 0, int(link.get("from", "0")))
                other = (connecting, last.get(connecting, 0) if other_far else 0, int(link.get("to", "0")))
                touch(own, far, other, other_far)


def _with_links(lanes: Sequence[Lane], touching: set[tuple[_End, _End]], left_hand: Set[str]) -> tuple[Lane, ...]:
    """Touching ends as predecessors and successors by travel, neighbours from the order within the section."""
    along_s = [(lane.lane_id < 0) != (lane.road_id in left_hand) for lane in lanes]
    before: list[set[int]] = [set() for _ in lanes]
    after: list[set[int]] = [set() for _ in lanes]
    for (one, one_far), (two, two_far) in touching:
        if one_far == along_s[one] and two_far != along_s[two]:
            after[one].add(two)
            before[two].add(one)
    sections: dict[tuple[str, int], list[Lane]] = {}
    for lane in lanes:
        sections.setdefault((lane.road_id, lane.section), []).append(lane)
    linked = list(lanes)
    for members in sections.values():
        ordered = [lane.id for lane in sorted(members, key=lambda lane: -lane.lane_id)]
        for k, lane_id in enumerate(ordered):
            sides = (ordered[k - 1] if k else -1, ordered[k + 1] if k + 1 < len(ordered) else -1)
            left, right = sides if along_s[lane_id] else sides[::-1]
            linked[lane_id] = replace(
                lanes[lane_id],
                predecessors=tuple(sorted(before[lane_id])),
                successors=tuple(sorted(after[lane_id])),
                left_neighbor=left,
                right_neighbor=right,
            )
    return tuple(linked)


def read_junctions(root: ET.Element, lanes: Sequence[Lane]) -> tuple[Junction, ...]:
    """Return junctions with the extent of their drivable lanes; those without any are left out."""
    members: dict[str, list[Lane]] = {}
    for lane in lanes:
        if lane.junction_id is not None and lane.is_drivable:
            members.setdefault(lane.junction_id, []).append(lane)
    found = []
    for element in root.findall("junction"):
        inside = members.get(element.get("id", ""), [])
        if not inside:
            continue
        points = np.concatenate([np.concatenate((lane.left, lane.right)) for lane in inside])
        low, high = points.min(0), points.max(0)
        center = (low + high) / 2
        radius = float(np.linalg.norm(points[:, :2] - center[:2], axis=1).max())
        own = {lane.id for lane in inside}
        incoming = sorted({p for lane in inside for p in lane.predecessors if p not in own and lanes[p].is_drivable})
        found.append(Junction(element.get("id", ""), center, radius, tuple(sorted(own)), tuple(incoming)))
    return tuple(found)
