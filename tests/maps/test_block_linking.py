# SPDX-License-Identifier: Apache-2.0
"""Stations linked block by block, on rows of stations 1 m apart: links are those of one block, and borders cut no line."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import DIVIDER, STYLES
from manyeyes.maps.elements.vector_map import RETIRED
from manyeyes.maps.fusion.block_linking import (
    LinkedStations,
    find_block_area,
    link_block,
    link_in_blocks,
    list_blocks,
    stitch_blocks,
)
from manyeyes.maps.fusion.existence import EvidenceTable
from manyeyes.maps.fusion.parallel_extension import ParallelExtensionConfig, extend_parallel
from manyeyes.maps.fusion.polyline_linking import LinkConfig, link_stations, trace_chains
from manyeyes.maps.fusion.stations import StationTable

EXTENSION = ParallelExtensionConfig()
ONE_BLOCK = LinkConfig(block_m=4096)
SMALL = LinkConfig(block_m=40, block_halo_m=60.0)


def rows_of(*rows: tuple[float, float, float], retired: bool = False) -> StationTable:
    """Stations at x = a..b at a height, for each (a, b, y); observed ground is the strip of each row."""
    x = [np.arange(a, b + 0.5) + 0.25 for a, b, _ in rows]
    xy = np.concatenate([np.stack((part, np.full(len(part), y)), 1) for part, (_, _, y) in zip(x, rows)])
    evidence = EvidenceTable.zeros(np.full(len(xy), DIVIDER, np.int64), len(STYLES))
    ones = np.ones(len(xy))
    evidence = evidence._replace(sigma=0.1 * ones, coverage=2.0 * ones, log_odds=3.0 * ones)
    if retired:
        evidence = evidence._replace(state=np.full(len(xy), RETIRED))
    rings = EvidenceTable.zeros(np.zeros(0, np.int64), len(STYLES))
    ground = np.array([[int(np.floor(y)), int(a), int(b) + 1] for a, b, y in rows], np.int64)
    made = StationTable(
        xy, np.tile((1.0, 0.0), (len(xy), 1)), evidence, np.zeros(1, np.int64), np.zeros((0, 2)), rings, ground
    )
    return StationTable.cat([made])


def lines_of(stations: LinkedStations) -> list[list[tuple[float, float]]]:
    """The chains by their points, each from its lesser end."""
    offsets, members = trace_chains(stations.linked, stations.table.line_evidence.log_odds)
    chains = [[tuple(p) for p in stations.table.xy[members[a:b]].tolist()] for a, b in pairwise(offsets.tolist())]
    return sorted(min(chain, chain[::-1]) for chain in chains)


def test_a_line_across_four_borders_is_one_line_with_the_ground_of_one_block():
    table = rows_of((-70.0, 90.0, 3.0), (-70.0, 90.0, 21.0))
    got, want = link_in_blocks(table, SMALL, EXTENSION), link_in_blocks(table, ONE_BLOCK, EXTENSION)
    assert [len(line) for line in lines_of(got)] == [161, 161] and lines_of(got) == lines_of(want)
    np.testing.assert_array_equal(got.table.observed_cells, table.observed_cells)
    np.testing.assert_array_equal(got.table.xy, want.table.xy)
    assert np.isnan(got.outside).all()


def test_stations_inferred_across_a_border_are_those_of_one_block():
    # The gap from 5 to 45 has the border at 20 in it.
    table = rows_of((-60.0, 90.0, 0.0), (-60.0, 5.0, 3.5), (45.0, 90.0, 3.5))
    got, want = link_in_blocks(table, SMALL, EXTENSION), link_in_blocks(table, ONE_BLOCK, EXTENSION)
    assert (~got.is_observed).sum() > 10
    assert lines_of(got) == lines_of(want) and len(lines_of(got)) == 2
    np.testing.assert_array_equal(got.is_observed, want.is_observed)


def test_one_block_gives_the_lines_of_plain_linking():
    table = rows_of((-60.0, 90.0, 0.0), (-60.0, 5.0, 3.5), (45.0, 90.0, 3.5))
    line, dashed = table.line_evidence, np.zeros(len(table), bool)
    chains = link_stations(table.xy, table.tangent, line.kind, line.log_odds, dashed, line.coverage)
    added, turned, source = extend_parallel(table.xy, line.kind, line.coverage, chains, EXTENSION)
    rows = np.concatenate((np.arange(len(table)), source))
    xy, tangent = np.concatenate((table.xy, added)), np.concatenate((table.tangent, turned))
    offsets, members = link_stations(
        xy, tangent, line.kind[rows], line.log_odds[rows], dashed[rows], line.coverage[rows]
    )
    want = [[tuple(p) for p in xy[members[a:b]].tolist()] for a, b in pairwise(offsets.tolist())]
    assert len(added) > 10
    assert lines_of(link_in_blocks(table, ONE_BLOCK, EXTENSION)) == sorted(min(c, c[::-1]) for c in want)


def test_links_of_a_block_depend_on_stations_within_its_halo_alone():
    table = rows_of((-200.0, 200.0, 0.0), (-200.0, 12.0, 3.5), (30.0, 200.0, 3.5))
    near = table.take_area(find_block_area((0, 0), SMALL), SMALL.block_halo_m)
    assert len(near) < len(table)
    got, want = (link_block(t, (0, 0), SMALL, EXTENSION) for t in (near, table))
    for name in ("is_observed", "linked", "outside"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name))
    np.testing.assert_array_equal(got.table.xy, want.table.xy)
    assert np.abs(got.table.xy[:, 0]).max() <= 20.0 and (~np.isnan(got.outside)).sum() > 0


def test_a_link_that_only_one_block_has_is_dropped():
    left, right = (link_block(rows_of((-60.0, 60.0, 0.0)), block, SMALL, EXTENSION) for block in ((0, 0), (1, 0)))
    assert len(lines_of(stitch_blocks([left, right]))) == 1
    alone = LinkedStations(right.table, right.is_observed, right.linked, np.full_like(right.outside, np.nan))
    assert len(lines_of(stitch_blocks([left, alone]))) == 2
    assert lines_of(stitch_blocks([alone, left])) == lines_of(stitch_blocks([left, alone]))


def test_retired_stations_are_linked_by_themselves():
    table = StationTable.cat([rows_of((-60.0, 0.0, 0.0)), rows_of((1.0, 60.0, 0.0), retired=True)])
    assert [len(line) for line in lines_of(link_in_blocks(table, SMALL, EXTENSION))] == [61, 60]


def test_no_stations_give_no_links():
    table = rows_of((0.0, 5.0, 0.0)).take_area((100.0, 100.0, 101.0, 101.0), 0.0)
    assert len(link_in_blocks(table, SMALL, EXTENSION).table) == 0


def test_blocks_lie_about_the_origin():
    assert list_blocks([(-20.0, -20.0, 20.0, 20.0)], SMALL) == [(0, 0)]
    assert list_blocks([(0.0, 0.0, 40.0, 20.0)], SMALL) == [(0, 0), (1, 0)]
    assert find_block_area((1, -1), SMALL) == (20.0, -60.0, 60.0, -20.0)


def test_blocks_of_part_metres_are_refused():
    with pytest.raises(ConfigError, match="block_m of whole metres"):
        LinkConfig(block_m=41)
