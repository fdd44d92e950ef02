# SPDX-License-Identifier: Apache-2.0
"""The laws and cases of the fusion: specs/maps.md 3.5 and 8 (a) to (l), on straight roads small enough to work out by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, NO_STYLE, SOLID, MapElements, Polygons
from manyeyes.evaluation.maps.adversarial import measure_displacement
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.vector_map import PUBLISHED, RETIRED
from manyeyes.maps.fusion.existence import find_covered_by_inliers
from manyeyes.maps.fusion.fuse import MapFusionConfig, assemble_map, fuse, fuse_at_poses
from manyeyes.maps.fusion.observation_arrays import to_observation_arrays
from manyeyes.maps.fusion.pose_optimization import (
    find_overlapping,
    merge_solutions,
    run_step,
    search_coarse_poses,
    solve_poses,
)
from manyeyes.maps.fusion.pose_solution import REJECTED_WEIGHT
from manyeyes.maps.fusion.stations import StationTable, build_stations
from manyeyes.maps.registry import make_two_agents_config
from manyeyes.ops.nearest_line import find_nearest_line
from manyeyes.simulator.fleet import CROWDS, load_place, simulate_crowd
from manyeyes.simulator.fleet.simulate import MALICIOUS

HALF_X, HALF_Y = 30.0, 15.0
VIEW = np.array([[-HALF_X, -HALF_Y], [HALF_X, -HALF_Y], [HALF_X, HALF_Y], [-HALF_X, HALF_Y]])
PRIOR_COVARIANCE = np.diag([0.4**2, 0.4**2, np.radians(0.5) ** 2])
HOUR = 3_600_000_000_000


def road(length=100.0, sides=(-5.25, -1.75, 1.75, 5.25)):
    """Straight lines along x, boundaries outside and dividers inside."""
    lines = [np.array([[0.0, y], [length, y]]) for y in sides]
    return [(BOUNDARY if y in (sides[0], sides[-1]) else DIVIDER, line) for y, line in zip(sides, lines)]


def make_observation(
    world, at, agent="a", hour=0, error=(0.0, 0.0, 0.0), noise=0.0, seed=0, style=NO_STYLE, score=0.9, **more
):
    """What an agent at true pose ``at`` sees of world lines, when its prior pose is off by ``error``."""
    rng = np.random.default_rng(seed)
    x, y, yaw = at
    back = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    lines, kinds = [], []
    for kind, line in world:
        own = (np.asarray(line) - (x, y)) @ back
        if kind == CROSSING:
            inside = (np.abs(own) <= (HALF_X, HALF_Y)).all(1)
            pieces = [own] if inside.all() else []
        else:
            pieces = _inside(own)
        for piece in pieces:
            lines.append(piece + rng.normal(0.0, noise, piece.shape) if noise else piece)
            kinds.append(kind)
    elements = MapElements.of(lines, kinds, score, style=style)
    pose = np.array(at) + error
    fields = {"covariance": PRIOR_COVARIANCE, "view": VIEW, **more}
    return Observation(
        agent, agent + "-1", 1_700_000_000_000_000_000 + int(hour * HOUR), pose, elements=elements, **fields
    )


def _inside(line):
    """The piece of a straight line inside the view, with a point about every 3 m."""
    share = np.linspace(0.0, 1.0, 401)[:, None]
    points = line[0] + share * (line[1] - line[0])
    points = points[(np.abs(points) <= (HALF_X, HALF_Y)).all(1)]
    if len(points) < 2 or np.linalg.norm(points[-1] - points[0]) < 2.0:
        return []
    count = max(2, int(np.linalg.norm(points[-1] - points[0]) / 3.0) + 1)
    return [points[0] + np.linspace(0.0, 1.0, count)[:, None] * (points[-1] - points[0])]


def crowd(world, count=12, sigma=0.4, noise=0.1, seed=1, length=100.0):
    """Observations along a road by as many agents, with errors of pose and points."""
    rng = np.random.default_rng(seed)
    return [
        make_observation(
            world,
            (rng.uniform(10.0, length - 10.0), rng.choice([-1.5, 1.5]), rng.choice([0.0, np.pi])),
            agent=f"agent{k}",
            hour=k,
            error=(*rng.normal(0.0, sigma, 2), rng.normal(0.0, np.radians(0.4))),
            noise=noise,
            seed=seed * 1000 + k,
        )
        for k in range(count)
    ]


def lines_of(fused, kind, state=PUBLISHED):
    rows = np.flatnonzero((fused.elements.kind == kind) & (fused.state == state))
    return [fused.elements.polyline(int(k)) for k in rows]


def furthest(a, b):
    """The largest distance from a point of elements ``a`` to the lines of ``b``."""
    offsets, points = b.offsets, b.points
    return find_nearest_line(a.points, points, offsets, 50.0).distance.max(initial=0.0)


def test_a_copies_of_an_observation_are_that_observation():
    one = make_observation(road(), (30.0, 1.5, 0.0))
    once, often = fuse([one]), fuse([one] * 5)
    assert once.quantised_hash(0.1) == often.quantised_hash(0.1)
    assert (once.id == often.id).all() and once.observations.tobytes().hex() == one.id
    assert len(once) == 4
    seen = one.elements_in_map()
    assert furthest(once.elements, seen) < 1e-3 and abs(once.elements.lengths() - 59.9).max() < 1.0


def test_b_order_does_not_matter():
    observations = crowd(road())
    turned = [observations[k] for k in np.random.default_rng(0).permutation(len(observations))]
    a, b = fuse(observations), fuse(turned)
    assert a.quantised_hash(0.1) == b.quantised_hash(0.1) and (a.sources == b.sources).all()


@pytest.mark.parametrize("pieces", [2, 3, 5])
def test_c_a_line_observed_in_pieces_is_one_line(pieces):
    cuts = np.linspace(0.0, 50.0, pieces + 1)
    whole = road(50.0)
    world = [(kind, np.array([[a + 0.5, line[0, 1]], [b - 0.5, line[0, 1]]]))
             for kind, line in whole for a, b in pairwise(cuts)]  # fmt: skip
    fused = fuse([make_observation(world, (25.0 + k, 0.0, 0.0), f"agent{k}", k) for k in range(4)])
    assert len(lines_of(fused, DIVIDER)) == 2 and len(lines_of(fused, BOUNDARY)) == 2
    assert abs(fused.elements.lengths() - 49.0).max() < 1.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_d_seven_parallel_lines_stay_seven_whatever_common_offset_each_agent_has(seed):
    sides = [3.5 * k for k in range(-3, 4)]
    world, rng = road(sides=sides), np.random.default_rng(seed)
    prior_covariance = np.diag([0.5**2, 0.7**2, 1e-4])
    errors = rng.uniform(-1.0, 1.0, 10)
    seen = [
        make_observation(
            world, (30.0 + 4 * k, 0.0, 0.0), f"agent{k}", k, (0.0, errors[k], 0.0), 0.1, k, covariance=prior_covariance
        )
        for k in range(10)
    ]
    fused = fuse(seen).select_published()
    assert len(fused) == 7
    across = np.sort([fused.elements.polyline(k)[:, 1].mean() for k in range(7)])
    assert np.abs(np.diff(across) - 3.5).max() < 0.1


def test_e_lines_that_cross_stay_two():
    world = [(DIVIDER, np.array([[0.0, 0.0], [50.0, 0.0]])), (DIVIDER, np.array([[25.0, -14.0], [25.0, 14.0]]))]
    fused = fuse([make_observation(world, (25.0 + k, 0.5, 0.0), f"agent{k}", k, noise=0.1, seed=k) for k in range(5)])
    lengths = np.sort([np.linalg.norm(line[-1] - line[0]) for line in lines_of(fused, DIVIDER)])
    assert len(lengths) == 2 and abs(lengths[0] - 28.0) < 1.5 and abs(lengths[1] - 50.0) < 1.5


def test_f_dashes_are_one_dashed_line():
    dashes = [(DIVIDER, np.array([[a, 0.0], [a + 6.0, 0.0]])) for a in (0.0, 15.0, 30.0, 45.0)]
    seen = [make_observation(dashes, (25.0 + k, 0.5, 0.0), f"agent{k}", k, style=DASHED) for k in range(4)]
    fused = fuse(seen).select_published()
    assert len(fused) == 1 and abs(fused.elements.lengths()[0] - 51.0) < 1.0
    assert fused.elements.style[0].argmax() == DASHED
    solid = fuse([make_observation(road(), (25.0 + k, 0.5, 0.0), f"agent{k}", k, style=SOLID) for k in range(4)])
    assert (solid.elements.style.argmax(1) == SOLID).all()


def test_g_one_outlier_agent_of_ten_moves_nothing():
    world = [*road(), (CROSSING, np.array([[40.0, -5.0], [44.0, -5.0], [44.0, 5.0], [40.0, 5.0]]))]
    honest = [make_observation(world, (35.0 + 2 * k, 0.0, 0.0), f"agent{k}", k, noise=0.1, seed=k) for k in range(9)]
    wrong = make_observation(world, (42.0, 0.0, 0.0), "outlier", 3, (0.0, 3.0, 0.0), 0.1, 77)
    before, after = fuse(honest).select_published(), fuse([*honest, wrong]).select_published()
    assert len(before) == len(after) == 5
    assert furthest(before.elements, after.elements) < 0.1
    pose = solve_poses([*honest, wrong])
    assert abs(pose.pose[pose.row_indices([wrong.id])[0], 1]) < 0.2


def _crossing_seen_then(count, missed, occluders=None):
    ring = (CROSSING, np.array([[40.0, -5.0], [44.0, -5.0], [44.0, 5.0], [40.0, 5.0]]))
    before = [make_observation([*road(), ring], (30.0, 0.0, 0.0), f"agent{k}", k) for k in range(count)]
    hidden = Polygons.of(occluders or ())
    after = [
        make_observation(road(), (30.0, 0.0, 0.0), f"later{k}", count + k, occluders=hidden) for k in range(missed)
    ]
    fused = fuse([*before, *after])
    return int(fused.state[np.flatnonzero(fused.elements.kind == CROSSING)[0]])


@pytest.mark.parametrize("missed, state", [(0, PUBLISHED), (6, PUBLISHED), (9, RETIRED)])
def test_h_a_removed_crossing_retires_after_eight_clear_misses(missed, state):
    assert _crossing_seen_then(8, missed) == state


def test_h_a_crossing_behind_a_lorry_never_retires():
    lorry = np.array([[6.0, -9.0], [8.0, -9.0], [8.0, 9.0], [6.0, 9.0]])
    assert _crossing_seen_then(8, 14, [lorry]) == PUBLISHED
    assert _crossing_seen_then(8, 14, [lorry - (30.0, 0.0)]) == RETIRED


def test_prior_misses_raise_evidence_needed_to_publish():
    ghost = (DIVIDER, np.array([[0.0, 0.0], [60.0, 0.0]]))
    early = [make_observation(road(60.0), (30.0, 0.5, 0.0), f"early{k}", k) for k in range(6)]
    late = [make_observation([*road(60.0), ghost], (30.0, 0.5, 0.0), f"late{k}", 10 + k) for k in range(3)]

    def dividers(observations):
        return len(lines_of(fuse(observations), DIVIDER))

    assert dividers(late[:1]) == 3  # no earlier view covers it
    assert dividers([*early, *late[:1]]) == 2
    assert dividers([*early, *late]) == 3  # three agree: it is new


@pytest.mark.parametrize(
    ("num_agents", "score", "by_default", "by_two"),
    [(1, 0.6, 0, 0), (1, 0.65, 4, 0), (1, 0.9, 4, 0), (2, 0.41, 0, 0), (2, 0.45, 4, 4), (2, 0.9, 4, 4)],
)
def test_publication_needs_a_calibrated_probability(num_agents, score, by_default, by_two):
    """A detection counts 1.54 times its weight, 0 at a score of 0.4 and 1 at 0.7.

    The probability reaches 0.7 at log-odds of 1.24 in one view (score of 0.64) and of 0.21 by two agents (0.42 each).
    """
    seen = [make_observation(road(), (30.0, 1.5, 0.0), f"agent{k}", k, score=score) for k in range(num_agents)]
    assert len(fuse(seen).select_published()) == by_default
    assert len(fuse(seen, make_two_agents_config()).select_published()) == by_two


@pytest.mark.parametrize(("score", "missed", "found"), [(0.9, 1, 2), (0.55, 0, 0), (0.9, 2, 0)])
def test_a_line_that_was_missed_before_needs_less_log_odds_than_one_of_low_score(score, missed, found):
    """A sure detection after one miss and an unsure one in the only view both have log-odds of 0.5 or a little more."""
    early = [make_observation([], (30.0, 0.0, 0.0), f"early{k}", k) for k in range(missed)]
    seen = make_observation(road(sides=(-1.75, 1.75)), (30.0, 0.0, 0.0), "a", missed, score=score)
    assert len(fuse([*early, seen]).select_published()) == found


@pytest.mark.parametrize(("missed", "state"), [(0, PUBLISHED), (3, PUBLISHED), (4, RETIRED)])
def test_a_line_of_one_agent_stays_published_until_four_others_missed_it(missed, state):
    """Its log-odds fall from 1.54 by 1.04 a miss. After one it would still be published anew, and three agents must miss it then.

    Its ends lie at the border of the view, where a miss counts less.
    """
    first = make_observation([(DIVIDER, np.array([[0.0, 1.75], [60.0, 1.75]]))], (30.0, 0.0, 0.0), "first")
    later = [make_observation([], (30.0, 0.0, 0.0), f"later{k}", k + 1) for k in range(missed)]
    fused = fuse([first, *later])
    assert fused.state.tolist() == [state]
    assert fused.log_odds[0] == pytest.approx(1.54 - 1.04 * missed, abs=0.3)


@pytest.mark.parametrize(("together", "left"), [(True, 1), (False, 0)])
def test_a_line_beside_an_edge_is_kept_if_both_were_observed_together(together, left):
    edge, paint = np.array([[0.0, 0.0], [60.0, 0.0]]), np.array([[0.0, 0.5], [60.0, 0.5]])
    both, only = [(BOUNDARY, edge), (DIVIDER, paint)], [(BOUNDARY, edge)]
    # Three see the divider, beside the edge or instead of it; five more the edge alone, too few to say that it is gone.
    worlds = [both if together else [(DIVIDER, paint)]] * 3 + [only] * 5
    fused = fuse([make_observation(w, (30.0, 1.5, 0.0), agent=f"agent{k}", hour=k) for k, w in enumerate(worlds)])
    assert len(lines_of(fused, BOUNDARY)) == 1
    assert len(lines_of(fused, DIVIDER)) == left


def test_i_a_moved_divider_switches_and_is_never_averaged():
    def world(y):
        return [(BOUNDARY, np.array([[0.0, s], [60.0, s]])) for s in (-6.0, 6.0)] + [
            (DIVIDER, np.array([[0.0, y], [60.0, y]]))
        ]

    old = [make_observation(world(0.0), (30.0, 0.5, 0.0), f"old{k}", k, noise=0.05, seed=k) for k in range(8)]
    new = [
        make_observation(world(1.5), (30.0, 0.5, 0.0), f"new{k}", 10 + k, noise=0.05, seed=100 + k) for k in range(12)
    ]
    at = []
    for count in (0, 2, 4, 8, 12):
        lines = lines_of(fuse([*old, *new[:count]]), DIVIDER)
        across = [float(line[:, 1].mean()) for line in lines]
        assert all(min(abs(y), abs(y - 1.5)) < 0.15 for y in across), across
        assert all(np.ptp(line[:, 1]) < 0.5 for line in lines)
        at.append(sorted(round(y / 1.5) for y in across))
    # Two agents' word is not enough against eight; then for a while both may stand; then the old one has gone.
    assert at[0] == [0] and 0 in at[1] and at[-1] == [1]


def test_j_areas_that_are_cut_give_the_map_of_one():
    observations, config = crowd(road(), 16), MapFusionConfig()
    whole = fuse(observations, config)
    tiles = [[o for o in observations if (o.pose[0] >= 50.0) == side] for side in (False, True)]
    near = [to_observation_arrays(find_overlapping(observations, home), 1.0) for home in tiles]
    rows = [np.array([s.ids.index(o.id) for o in home]) for s, home in zip(near, tiles)]
    state = merge_solutions([search_coarse_poses(s, r) for s, r in zip(near, rows)])
    for number in range(config.pose_solver.num_steps):
        parts = [run_step(s, state.take(state.row_indices(s.ids)), number, r) for s, r in zip(near, rows)]
        state = merge_solutions(parts, config.pose_solver, number)
    assert (state.pose == solve_poses(observations).pose).all()
    arrays = to_observation_arrays(observations, config.pose_solver.spacing_m)
    areas = [(-100.0, -100.0, 47.3, 100.0), (47.3, -100.0, 200.0, 1.1), (47.3, 1.1, 200.0, 100.0)]
    tables = [build_stations(arrays, state, area, config.stations) for area in areas]
    assert min(len(t) for t in tables) > 20
    assert assemble_map(StationTable.cat(tables), config).quantised_hash(0.1) == whole.quantised_hash(0.1)


def test_k_an_observation_taken_out_was_never_there():
    observations = crowd(road())
    fresh = fuse(observations[:-1])
    fuse(observations)
    again = fuse(observations[:-1][::-1])
    assert again.quantised_hash(0.1) == fresh.quantised_hash(0.1)
    assert observations[-1].id not in {row.tobytes().hex() for row in again.observations}


@pytest.mark.parametrize("motion", [(0.3, 0.4, 0.0), (130.0, -70.0, 0.7), (-40.0, 15.0, 2.5)])
def test_l_the_map_moves_with_the_world(motion):
    x, y, yaw = motion
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    world = [*road(), (CROSSING, np.array([[40.0, -5.0], [44.0, -5.0], [44.0, 5.0], [40.0, 5.0]]))]
    observations = crowd(world, 10)
    moved = [
        replace(o, pose=turn @ o.pose + (x, y, yaw), covariance=turn @ np.asarray(o.covariance) @ turn.T)
        for o in observations
    ]
    here, there = fuse(observations), fuse(moved)
    expected = here.elements.transform(x, y, yaw)
    assert sorted(here.elements.kind) == sorted(there.elements.kind)
    assert furthest(expected, there.elements) < 0.01 and furthest(there.elements, expected) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 6, 7])
def test_colluding_agents_displace_no_station_observed_by_honest_agents(seed):
    """An offset of 1 m is 2.5 sigmas of a prior pose, which some honest agents have: there the displacement is bounded alone."""
    world = [*road(), (CROSSING, np.array([[40.0, -5.0], [44.0, -5.0], [44.0, 5.0], [40.0, 5.0]]))]
    honest = crowd(world, 40)
    before = fuse(honest).select_published().elements
    for offset, limit in ((1.0, 0.25), (2.0, 0.05), (4.0, 0.05)):
        malicious = [
            replace(o, agent=f"malicious{k}", elements=o.elements.with_points(o.elements.points + (0.0, offset)))
            for k, o in enumerate(crowd(world, 10, seed=seed))
            if np.cos(o.pose[2]) > 0
        ]
        after = fuse([*honest, *malicious]).select_published().elements
        # The last station of a line may come or go with a rejected agent.
        inside = before.points[(before.points[:, 0] > 3.0) & (before.points[:, 0] < 97.0)]
        assert find_nearest_line(inside, after.points, after.offsets, 50.0).distance.max() < limit, offset


def test_rejected_agents_leave_poses_unchanged():
    """Nine honest agents and two who agree on 2 m: the nine stand where they stand alone."""
    world = [*road(), (CROSSING, np.array([[40.0, -5.0], [44.0, -5.0], [44.0, 5.0], [40.0, 5.0]]))]
    honest = crowd(world, 9, sigma=0.2)
    malicious = [
        replace(
            o,
            agent=f"malicious{k}",
            elements=o.elements.with_points(o.elements.points + (0.0, 2.0 * np.cos(o.pose[2]))),
        )
        for k, o in enumerate(crowd(world, 2, sigma=0.2, seed=5))
    ]
    alone, together = solve_poses(honest), solve_poses([*honest, *malicious])
    rows = together.row_indices(alone.ids)
    assert (together.agent_weight[together.row_indices([o.id for o in malicious])] == REJECTED_WEIGHT).all()
    assert (together.agent_weight[rows] > 0.1).all()
    assert np.abs(together.pose[rows] - alone.pose).max() < 1e-3


@pytest.mark.slow
def test_no_honest_agent_is_rejected_beside_colluding_ones():
    """Of a crossroads' crowd every fifth lies by 3 m as the others do: honest agents stand where they stand alone."""
    crowd_config = replace(
        CROWDS["local"], malicious_fraction=0.2, attack_mode="colluding", malicious_offset_m=(3.0, 3.0)
    )
    simulated = simulate_crowd(load_place("cross"), 60, crowd_config, seed=6)
    honest = [o for o, role in zip(simulated.observations, simulated.roles) if role != MALICIOUS]
    alone, together = solve_poses(honest), solve_poses(simulated.observations)
    rows = together.row_indices(alone.ids)
    assert not ((together.agent_weight[rows] == REJECTED_WEIGHT) & (alone.agent_weight > REJECTED_WEIGHT)).any()
    malicious = np.setdiff1d(np.arange(len(together.ids)), rows)
    assert (together.agent_weight[malicious] == REJECTED_WEIGHT).all()
    assert np.abs(together.pose[rows] - alone.pose).max() < 1e-3
    # Where five honest agents cover the ground, malicious observations do not count; smoothing adds a centimetre near other ground.
    away = measure_displacement(fuse(honest), fuse(simulated.observations))
    assert len(away) > 500 and away.max() < 0.03 and np.median(away) < 1e-5


def test_rejected_observations_count_only_outside_inlier_coverage():
    """A road in a view of 60 m; four inlier agents stand 20 m behind, so that they see two thirds of it."""
    observations = [make_observation(road(), (30.0, 0.0, 0.0), "rejected")]
    observations += [make_observation(road(), (10.0, 0.0, 0.0), f"agent{k}", k) for k in range(4)]
    arrays = to_observation_arrays(observations, 1.0)
    pose = np.array(arrays.pose)
    is_inlier = np.array([arrays.agents[a] != "rejected" for a in arrays.agent])
    is_rejected = ~is_inlier[arrays.observation_of_point]
    x = arrays.to_world(pose)[0][:, 0]
    seen = find_covered_by_inliers(arrays, pose, is_inlier, 4, 2.0)
    assert (seen[is_rejected] == (x[is_rejected] < 40.0)).all() and not seen[~is_rejected].any()
    assert not find_covered_by_inliers(arrays, pose, is_inlier, 5, 2.0).any()
    assert not find_covered_by_inliers(arrays, pose, np.ones(5, bool), 1, 2.0).any()


@pytest.mark.parametrize("later, moved", [({}, True), ({"pass_id": "another"}, False)])
def test_drive_bias_corrects_isolated_observation(later, moved):
    """Twelve agents see the first half of a road, one of them the second half too; its prior poses are off by 0.6 m."""
    world = road(300.0)
    others = crowd(world, 12, sigma=0.05)
    seen, alone = (
        make_observation(world, (x, 0.0, 0.0), "far", k, (0.0, 0.6, 0.0)) for k, x in enumerate((60.0, 250.0))
    )
    alone = replace(alone, **later)
    solved = solve_poses([*others, seen, alone])
    off = solved.pose[solved.row_indices([seen.id, alone.id]), 1]
    assert abs(off[0]) < 0.1
    assert off[1] < 0.4 if moved else off[1] == pytest.approx(0.6, abs=0.05)


def test_surveyed_pole_overrules_agreeing_agents():
    pole = make_observation(road(), (30.0, 0.0, 0.0), "pole", trusted=True)
    cars = [make_observation(road(), (30.0 + k, 0.0, 0.0), f"car{k}", k, (0.0, 0.9, 0.0)) for k in range(6)]
    pose = solve_poses([pole, *cars])
    assert pose.agent_weight[pose.row_indices([pole.id])[0]] == 1.0
    assert np.abs(pose.pose[pose.row_indices([o.id for o in cars]), 1]).max() < 0.15


def test_bends_do_not_shrink():
    angle = np.linspace(0.0, np.pi / 2, 40)
    bend = (BOUNDARY, 9.0 * np.stack((np.cos(angle), np.sin(angle)), 1))
    seen = []
    for k in range(6):
        o = make_observation([], (0.0, 0.0, 0.0), f"agent{k}", k)
        rng = np.random.default_rng(k)
        seen.append(replace(o, elements=MapElements.of([bend[1] + rng.normal(0, 0.05, bend[1].shape)], [BOUNDARY])))
    line = lines_of(fuse(seen), BOUNDARY)
    assert len(line) == 1 and abs(np.hypot(*line[0].T) - 9.0).max() < 0.1


def test_one_trusted_roadside_unit_publishes_and_its_pose_is_fixed():
    pole = make_observation(road(), (30.0, 0.0, 0.0), "pole", trusted=True)
    car = make_observation(road(), (35.0, 0.0, 0.0), "car", 1, (0.0, 0.8, 0.0))
    pose = solve_poses([pole, car])
    assert (pose.pose[pose.row_indices([pole.id])[0]] == pole.pose).all()
    assert abs(pose.pose[pose.row_indices([car.id])[0], 1]) < 0.1
    assert len(fuse([pole, replace(pole, time_ns=pole.time_ns + HOUR)]).select_published()) == 4
    assert len(fuse([car], make_two_agents_config()).select_published()) == 0


def test_one_observation_of_a_trusted_unit_publishes_its_confident_elements():
    pole = make_observation(road(), (30.0, 0.0, 0.0), "pole", trusted=True)
    fused = fuse([pole])
    assert len(fused) == len(fused.select_published()) == 4
    assert fused.log_odds == pytest.approx(math.log(0.7 / 0.05)) and (fused.elements.score < 1.0).all()
    two_agents = make_two_agents_config()
    assert len(fuse([pole], two_agents).select_published()) == 4
    assert len(fuse([replace(pole, trusted=False)], two_agents).select_published()) == 0
    # Its detection counts 2.64 times its weight: 1.24 is reached at a score of 0.541.
    for score, found in ((0.53, 0), (0.55, 4)):
        unsure = replace(pole.elements, score=pole.elements.score * 0.0 + score)
        assert len(fuse([replace(pole, elements=unsure)]).select_published()) == found


def test_nothing_gives_nothing():
    assert len(fuse([])) == 0
    assert len(fuse([make_observation([], (0.0, 0.0, 0.0))])) == 0


@settings(max_examples=6)  # an example takes 0.2 s
@given(st.randoms(use_true_random=False), st.lists(st.integers(0, 9), max_size=12))
def test_the_map_is_a_function_of_the_set(random, again):
    observations = crowd(road(), 10)
    chosen = [observations[k] for k in range(10) if random.random() < 0.7]
    more = chosen + [observations[k] for k in again if observations[k] in chosen]
    random.shuffle(more)
    assert fuse(more).quantised_hash(0.1) == fuse(chosen).quantised_hash(0.1)


@settings(max_examples=4)  # an example takes 0.2 s
@given(st.floats(-2.0, 2.0), st.integers(2, 5))
def test_gauge_is_the_mean_of_the_prior_poses(error, count):
    """Two groups whose prior poses differ by error / 2 meet in the middle."""
    seen = [
        make_observation(road(), (30.0 + k, 0.0, 0.0), f"agent{k}", k, (0.0, error / 4 * (-1) ** k, 0.0))
        for k in range(2 * count)
    ]
    line = lines_of(fuse_at_poses(seen, solve_poses(seen)), DIVIDER)
    across = sorted(float(one[:, 1].mean()) for one in line)
    assert len(across) == 2 and abs(across[0] + 1.75) < 0.06 and abs(across[1] - 1.75) < 0.06
