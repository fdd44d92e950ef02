# SPDX-License-Identifier: Apache-2.0
"""The baselines, each on a case worked by hand, and what they share."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, MapElements, Polygons
from manyeyes.maps.baselines import (
    chamfer_nms,
    crowdmap_graph,
    crowdmap_literal,
    frechet_clustering,
    global_map_builder,
    heatmap_buffer,
    polymerge,
    union,
)
from manyeyes.maps.baselines._common import LOG_ODDS_HIT, LOG_ODDS_MISS, MAX_LOG_ODDS, BaselineRules, filter_elements
from manyeyes.maps.baselines._raster import find_longest_walks, label_components, skeletonize
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import CANDIDATE, PUBLISHED, VectorMap

VIEW = np.array([[-10.0, -20.0], [60.0, -20.0], [60.0, 20.0], [-10.0, 20.0]])
SQUARE = [[20.0, -4.0], [24.0, -4.0], [24.0, 4.0], [20.0, 4.0]]


def line(y: float, x0: float = 0.0, x1: float = 40.0, n: int = 9) -> list[list[float]]:
    return [[float(x), y] for x in np.linspace(x0, x1, n)]


def make_observation(
    k: int, lines: list, kinds: int | list[int] = DIVIDER, score: float | list[float] = 0.8, view: np.ndarray = VIEW
) -> Observation:
    elements = MapElements.of(lines, kinds, score=score)
    return Observation(f"car-{k}", "p", k, np.zeros(3), np.diag([0.25, 0.25, 1e-4]), view, elements)


def lines_in(made: VectorMap, kind: int = DIVIDER) -> list[np.ndarray]:
    return [made.elements.polyline(i) for i in np.flatnonzero(made.elements.kind == kind).tolist()]


BASELINES = [
    union,
    chamfer_nms,
    crowdmap_graph,
    crowdmap_literal,
    polymerge,
    frechet_clustering,
    heatmap_buffer,
    global_map_builder,
]


@pytest.mark.parametrize("baseline", BASELINES, ids=lambda r: r.__name__.split(".")[-1])
def test_no_observation_gives_an_empty_map(baseline) -> None:
    assert (
        len(baseline.fuse([], frame=MapFrame(49.0, 8.0))) == 0
        and baseline.fuse([], frame=MapFrame(49.0, 8.0)).frame.latitude == 49.0
    )
    assert len(baseline.fuse([make_observation(0, [])])) == 0


@pytest.mark.parametrize("baseline", BASELINES, ids=lambda r: r.__name__.split(".")[-1])
def test_one_observation_is_mapped_at_its_pose_with_its_style_and_source(baseline) -> None:
    one = replace(
        make_observation(0, [line(2.0), SQUARE], [DIVIDER, CROSSING]), pose=np.array([100.0, 50.0, math.pi / 2])
    )
    one = replace(one, elements=replace(one.elements, style=np.eye(4)[[DASHED, 3]]))
    made = baseline.fuse([one])
    (divider,), (crossing,) = lines_in(made), lines_in(made, CROSSING)
    ends = sorted([divider[0].tolist(), divider[-1].tolist()], key=lambda p: p[1])
    # A thinned picture ends a little before its line does.
    assert (np.abs(np.array(ends) - [[98, 50], [98, 90]]) <= [0.15, 0.6]).all()
    assert np.allclose(crossing.mean(0), [100, 72], atol=0.1)
    assert made.elements.style[0, DASHED] == 1.0 and made.sources_of(0) == [one.id]


def test_the_pre_filter_drops_weak_and_short_elements_and_a_repeated_observation() -> None:
    many = [
        make_observation(0, [line(0), line(1, 0, 3.9), line(2)], DIVIDER, [0.9, 0.9, 0.29]),
        make_observation(1, [line(0, 0, 3), SQUARE], [3, 2]),
    ]
    kept = filter_elements([*many, many[0]], BaselineRules())
    assert kept.elements.kind.tolist() == [0, 3, 2] and kept.observation_of_element.tolist() == [0, 1, 1]


def test_scores_follow_hits_misses_and_length() -> None:
    far = VIEW + (400.0, 0.0)
    many = [
        make_observation(0, [line(0.0)]),
        make_observation(1, []),
        make_observation(2, []),
        make_observation(3, [], view=far),
    ]
    made = union.fuse(many)
    assert made.log_odds[0] == pytest.approx(LOG_ODDS_HIT + 2 * LOG_ODDS_MISS, abs=1e-9)
    assert made.elements.score[0] == pytest.approx(
        0.8 / (1 + math.exp(-(LOG_ODDS_HIT + 2 * LOG_ODDS_MISS) / 4)), abs=1e-9
    )
    short = union.fuse([make_observation(0, [line(0.0, 0, 10)])])
    assert short.elements.score[0] == pytest.approx(0.8 * 0.5 / (1 + math.exp(-LOG_ODDS_HIT / 4)), abs=1e-9)
    assert (
        union.fuse([make_observation(0, [line(0.0)]), *(make_observation(k, []) for k in range(1, 30))]).log_odds[0]
        == -MAX_LOG_ODDS
    )


def test_occluded_observation_is_no_miss() -> None:
    wall = Polygons.of([[[1.0, -30.0], [1.5, -30.0], [1.5, 30.0], [1.0, 30.0]]])
    hidden = replace(make_observation(1, []), occluders=wall)
    assert union.fuse([make_observation(0, [line(0.0, 5, 45)]), hidden]).log_odds[0] == pytest.approx(
        LOG_ODDS_HIT, abs=1e-9
    )


def test_elements_with_few_observations_are_candidates() -> None:
    rules = BaselineRules(min_observations=2)
    many = [make_observation(0, [line(0.0), line(9.0)]), make_observation(1, [line(0.2)])]
    made = chamfer_nms.fuse(many, chamfer_nms.ChamferNmsConfig(rules=rules))
    assert made.state.tolist() == [PUBLISHED, CANDIDATE] and made.supporters.tolist() == [2, 1]
    made = chamfer_nms.fuse(many, chamfer_nms.ChamferNmsConfig(rules=BaselineRules(publish_log_odds=2.0)))
    assert made.state.tolist() == [PUBLISHED, CANDIDATE]


def test_union_keeps_everything() -> None:
    made = union.fuse(
        [make_observation(0, [line(0.0), SQUARE], [0, 2]), make_observation(1, [line(0.2), line(0.2, 0, 5)])]
    )
    assert len(made) == 4 and made.state.tolist() == [PUBLISHED, CANDIDATE, PUBLISHED, PUBLISHED]


def test_nms_keeps_the_best_of_lines_on_each_other_and_all_others() -> None:
    many = [
        make_observation(0, [line(0.0), line(3.5)], DIVIDER, [0.6, 0.9]),
        make_observation(1, [line(0.6), line(0.3)], [DIVIDER, BOUNDARY], [0.8, 0.7]),
        make_observation(2, [line(1.1), line(0.0, 0, 20)], DIVIDER, [0.7, 0.5]),
    ]
    made = chamfer_nms.fuse(many)
    # 0.8 at 0.6 m takes 0.6 at 0.0 and 0.7 at 1.1; half the line is 5 m away by Chamfer and stays.
    assert [round(float(line[0, 1]), 6) for line in lines_in(made)] == [0.0, 0.6, 3.5]
    assert len(lines_in(made, BOUNDARY)) == 1
    assert sorted(made.supporters[made.elements.kind == DIVIDER].tolist()) == [1, 1, 3]


def test_the_literal_pipeline_keeps_the_most_confident_or_takes_the_mean_after_registration() -> None:
    turned = [[x, y + 0.4 + 0.01 * x] for x, y in line(0.0)]
    many = [
        make_observation(0, [line(0.0)], score=0.9),
        make_observation(1, [turned]),
        make_observation(2, [line(0.3)], score=0.7),
        make_observation(3, [line(3.5)]),
    ]
    made = crowdmap_literal.fuse(many)
    assert [len(made), made.supporters.tolist()] == [2, [3, 1]]
    assert made.elements.polyline(0).tolist() == line(0.0)
    mean = crowdmap_literal.fuse(many, crowdmap_literal.CrowdMapLiteralConfig(merge="mean"))
    # Registered onto it, the others lie on the anchor: the mean is the anchor, not the middle of the offsets.
    assert np.abs(mean.elements.polyline(0)[:, 1]).max() < 0.05 and len(mean.elements.polyline(0)) == 50


def test_crowdmap_graph_keeps_the_covering_line_then_the_surer_and_separates_lines_of_one_observation() -> None:
    short = make_observation(0, [line(0.0, 0, 20)], score=0.8)
    long = make_observation(1, [line(0.2)], score=0.6)
    # Half of the long line is not most of it, so the long one takes the short one's place.
    made = crowdmap_graph.fuse([short, long])
    assert [(p[0].tolist(), p[-1].tolist()) for p in lines_in(made)] == [([0.0, 0.2], [40.0, 0.2])]
    assert made.sources_of(0) == sorted([short.id, long.id])
    # Both lines of one observation overlap it, 1.1 m apart: the surer one joins, the other is a line of its own.
    for score, kept in ((0.5, 0.2), (0.9, 0.3)):
        two = make_observation(2, [line(0.3), line(-0.8)], score=[score, 0.4])
        made = crowdmap_graph.fuse([short, long, two])
        ordinates = [float(p[0, 1]) for p in lines_in(made)]
        assert sorted(ordinates) == [-0.8, kept]
        assert sorted(made.supporters.tolist()) == [1, 3]


def test_crowdmap_graph_registers_the_common_interval_before_it_merges() -> None:
    straight, other = make_observation(0, [line(0.0)]), make_observation(1, [line(0.9)])
    bent = make_observation(1, [[[float(x), 1.0 - abs(x - 20) / 10] for x in range(0, 41, 2)]])
    assert len(lines_in(crowdmap_graph.fuse([straight, other]))) == 1, "0.9 m aside: registration removes it"
    config = crowdmap_graph.CrowdMapGraphConfig(max_registered_chamfer_m=0.3)
    assert len(lines_in(crowdmap_graph.fuse([straight, bent]))) == 1
    assert len(lines_in(crowdmap_graph.fuse([straight, bent], config))) == 2, "no motion makes a bent line straight"
    opposite = make_observation(1, [line(0.9, 40.0, 0.0)])
    assert len(lines_in(crowdmap_graph.fuse([straight, opposite], config))) == 1


def test_the_literal_pipeline_has_no_edge_between_a_line_and_its_part() -> None:
    made = crowdmap_literal.fuse([make_observation(0, [line(0.0)]), make_observation(1, [line(0.0, 0, 15)])])
    assert len(made) == 2


def test_lines_fold_into_middles_where_they_face_and_lengthen_each_other_beyond() -> None:
    whole = polymerge.merge_two_lines(np.array(line(0.0, 0, 10, 3)), np.array(line(1.0, 8, 20, 4)[::-1]))
    # At 5 m nothing faces the line; 8 and 10 face each other; 12 and on are beyond.
    assert whole.tolist() == [[0, 0], [5, 0], [8, 0.5], [10, 0.5], [12, 1], [16, 1], [20, 1]]


def test_polymerge_chains_lines_that_touch_and_keeps_others_apart() -> None:
    many = [
        make_observation(0, [line(0.0, 0, 20)]),
        make_observation(1, [line(0.5, 10, 40)]),
        make_observation(2, [line(3.5)]),
    ]
    first, second = lines_in(polymerge.fuse(many))
    assert sorted((first[0, 0], first[-1, 0])) == [0.0, 40.0] and second[0, 1] == 3.5
    bridge = make_observation(3, [[[5.0, 0.0], [20.0, 3.5]]])
    assert len(lines_in(polymerge.fuse([*many, bridge]))) == 1


def test_polymerge_votes_for_crossings_on_a_raster() -> None:
    rings = [np.array(SQUARE) + (dx, 0.0) for dx in (-0.5, 0.0, 0.5)]
    (ring,) = lines_in(polymerge.fuse([make_observation(k, [r], CROSSING) for k, r in enumerate(rings)]), CROSSING)
    assert np.allclose(ring.min(0), [20.0, -4.0], atol=0.15) and np.allclose(ring.max(0), [24.0, 4.0], atol=0.15)


def test_frechet_clusters_average_lines_that_are_close_along_their_length() -> None:
    many = [
        make_observation(0, [line(0.0)]),
        make_observation(1, [line(0.6)[::-1]]),
        make_observation(2, [line(0.9)]),
        make_observation(3, [line(0.3, 0, 20)]),
    ]
    made = frechet_clustering.fuse(many)
    assert made.supporters.tolist() == [1, 3]
    assert np.allclose(made.elements.polyline(1)[:, 1], 0.5) and len(made.elements.polyline(1)) == 20
    medoid = frechet_clustering.fuse(many, frechet_clustering.FrechetClusteringConfig(representative="medoid"))
    assert sorted(round(float(line[0, 1]), 6) for line in lines_in(medoid)) == [0.3, 0.6]


def test_single_linkage_chains_where_average_linkage_does_not() -> None:
    many = [make_observation(k, [line(1.5 * k)]) for k in range(4)]
    assert len(frechet_clustering.fuse(many, frechet_clustering.FrechetClusteringConfig(linkage="single"))) == 1
    assert len(frechet_clustering.fuse(many)) == 2


def test_complete_linkage_joins_nothing_that_has_two_members_too_far_apart() -> None:
    many = [make_observation(k, [line(y)]) for k, y in enumerate((0.0, 0.9, 2.1))]
    # The mean of 1.2 and 2.1 is within the gate of 1.75; the greater is not.
    assert len(frechet_clustering.fuse(many)) == 1
    assert len(frechet_clustering.fuse(many, frechet_clustering.FrechetClusteringConfig(linkage="complete"))) == 2


@pytest.mark.parametrize(
    ("config_class", "change"),
    [
        (frechet_clustering.FrechetClusteringConfig, {"linkage": "ward"}),
        (frechet_clustering.FrechetClusteringConfig, {"representative": "best"}),
        (crowdmap_literal.CrowdMapLiteralConfig, {"merge": "sum"}),
        (heatmap_buffer.HeatmapBufferConfig, {"walks": "none"}),
    ],
)
def test_an_unknown_choice_is_refused(config_class: type, change: dict) -> None:
    with pytest.raises(ConfigError, match=r"expected .*; got"):
        config_class(**change)


def test_frechet_clusters_of_rings_ignore_start_and_direction() -> None:
    rings = [SQUARE, SQUARE[2:] + SQUARE[:2], [[x + 0.5, y] for x, y in SQUARE][::-1]]
    (ring,) = lines_in(
        frechet_clustering.fuse([make_observation(k, [r], CROSSING) for k, r in enumerate(rings)]), CROSSING
    )
    assert np.allclose(ring.mean(0), [22 + 0.5 / 3, 0.0], atol=0.02)


def test_the_builder_replaces_elements_covered_by_the_newest() -> None:
    old, new = np.array(line(0.0, 0, 40, 2)), np.array(line(0.5, 10, 50, 2)[::-1])
    assert global_map_builder.replace_covered(old, new, 0.01).tolist() == [[0, 0], [10, 0.5], [50, 0.5]]
    inner = global_map_builder.replace_covered(old, np.array(line(0.5, 10, 20, 2)), 0.01)
    assert inner.tolist() == [[0, 0], [10, 0.5], [20, 0.5], [40, 0]]


def test_the_builder_matches_one_to_one_adds_unmatched_and_suppresses_duplicates() -> None:
    many = [
        make_observation(0, [line(0.0), line(3.5)], score=0.6),
        make_observation(1, [line(0.8), line(4.0), line(9.0)]),
        make_observation(2, [line(0.5, 0, 20), line(10.5, 0, 40)], score=0.9),
    ]
    made = global_map_builder.fuse(many)
    assert made.supporters.tolist() == [3, 2, 1]
    first = lines_in(made)[0]
    assert (first[0].tolist(), first[-1].tolist()) == ([0.0, 0.5], [40.0, 0.8])
    # 10.5 matches nothing (1.5 m from 9.0) and, more confident, suppresses it: their buffers overlap.
    assert lines_in(made)[2][0, 1] == 10.5


def test_the_heat_map_joins_pieces_into_one_line_between_them() -> None:
    many = [
        make_observation(0, [line(0.0, 0, 22), line(3.5)]),
        make_observation(1, [line(0.4, 15, 40), line(3.5)]),
        make_observation(2, [line(0.2, 5, 35), line(-8.0, 0, 5)]),
    ]
    first, second = sorted(lines_in(heatmap_buffer.fuse(many)), key=lambda points: points[0, 1])
    assert abs(first[:, 0].min()) < 1.5 and abs(first[:, 0].max() - 40) < 1.5
    assert np.abs(first[:, 1] - 0.2).max() < 0.35 and np.abs(second[:, 1] - 3.5).max() < 0.3


def test_heat_of_a_small_fraction_of_views_is_no_line() -> None:
    many = [
        make_observation(0, [line(0.0), line(8.0)]),
        make_observation(1, [line(0.0), line(8.0)]),
        *(make_observation(k, [line(0.0)]) for k in range(2, 12)),
    ]
    assert len(lines_in(heatmap_buffer.fuse(many))) == 1
    assert len(lines_in(heatmap_buffer.fuse(many, heatmap_buffer.HeatmapBufferConfig(min_view_fraction=0.05)))) == 2


def test_a_branch_is_a_walk_of_its_own_where_all_are_asked_for() -> None:
    many = [make_observation(k, [line(0.0), [[20.0, 0.0], [20.0, 18.0]]]) for k in range(3)]
    assert len(heatmap_buffer.fuse(many)) == 2
    assert len(heatmap_buffer.fuse(many, heatmap_buffer.HeatmapBufferConfig(walks="longest"))) == 1


def test_the_heat_map_refuses_a_raster_that_would_not_fit() -> None:
    far = replace(make_observation(1, [line(0.0)]), pose=np.array([9000.0, 9000.0, 0.0]))
    with pytest.raises(ConfigError, match="larger cells"):
        heatmap_buffer.fuse([make_observation(0, [line(0.0)]), far])


def test_a_bar_thins_to_its_middle_and_components_are_numbered_by_rows() -> None:
    mask = np.zeros((9, 20), bool)
    mask[2:5, 2:18] = True
    mask[7, 3] = True
    skeleton = skeletonize(mask)
    assert skeleton[3, 5:15].all() and not skeleton[2].any() and not skeleton[4, :16].any()
    label = label_components(mask)
    assert (label[mask] >= 0).all() and (label[~mask] == -1).all() and (label[3, 4], label[7, 3]) == (0, 1)


def test_walks_run_from_end_to_end_of_a_skeleton() -> None:
    skeleton = np.zeros((12, 20), bool)
    skeleton[5, 1:20] = True
    skeleton[6:12, 10] = True
    cells, first = find_longest_walks(skeleton, 4, 1, True)
    assert np.diff(first).tolist() == [19, 5]
    assert sorted(cells[:19, 1].tolist()) == list(range(1, 20)) and cells[19:, 1].tolist() == [10] * 5
    assert len(find_longest_walks(skeleton, 4, 1, False)[1]) == 2
    cells, first = find_longest_walks(skeleton, 20, 1, True)
    assert first.tolist() == [0] and len(cells) == 0
