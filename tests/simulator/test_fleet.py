# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, STOP_LINE
from manyeyes.simulator.fleet import (
    CROWDS,
    PLACES,
    ROLES,
    Change,
    ChangingMap,
    crowd_config,
    load_place,
    simulate_crowd,
)
from manyeyes.simulator.fleet.config import DAY_NS

shapely = pytest.importorskip("shapely")
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
LOCAL, PERFECT = CROWDS["local"], CROWDS["perfect"]


@pytest.fixture(scope="module")
def cross():
    return load_place("cross")


def shapes_of(truth):
    return [shapely.LineString(truth.polyline(i)) for i in range(len(truth))]


def distances(crowd, shapes):
    """Distance of each line point from its true element, at the true pose."""
    found = []
    for k, observation in enumerate(crowd.observations):
        own = observation.elements_in_map(crowd.true_poses[k])
        origin = crowd.origin[crowd.origin_offsets[k] : crowd.origin_offsets[k + 1]]
        for i in np.flatnonzero((own.kind != CROSSING) & (origin >= 0)):
            found.append(shapely.distance(shapely.points(own.polyline(i)), shapes[origin[i]]))
    return np.concatenate(found)


def poses(crowd):
    return np.array([o.pose for o in crowd.observations])


def test_a_perfect_crowd_reports_the_truth_at_its_true_poses(cross):
    crowd = simulate_crowd(cross, 30, PERFECT)
    np.testing.assert_array_equal(poses(crowd), crowd.true_poses)
    assert distances(crowd, shapes_of(cross.truth)).max() < 0.3  # chords of 20 points across the corners
    straight = [shape if shape.length > 12 else shapely.LineString() for shape in shapes_of(cross.truth)]
    on_straights = distances(crowd, straight)
    assert np.nanmax(on_straights) < 1e-6
    assert (crowd.origin >= 0).all()
    kinds = [cross.truth.kind[e] for e in crowd.origin]
    assert (np.concatenate([o.elements.kind for o in crowd.observations]) == kinds).all()
    assert set(kinds) == {DIVIDER, BOUNDARY, CROSSING, STOP_LINE}


def test_a_perfect_crowd_reports_everything_in_view(cross):
    crowd = simulate_crowd(cross, 20, PERFECT)
    for k, o in enumerate(crowd.observations):
        x, y, yaw = crowd.true_poses[k]
        local = cross.truth.transform(-x, -y, 0).transform(0, 0, -yaw)
        view = shapely.Polygon(o.view)
        seen = crowd.origin[crowd.origin_offsets[k] : crowd.origin_offsets[k + 1]]
        for e in range(len(local)):
            if local.kind[e] != CROSSING:
                inside = shapely.LineString(local.polyline(e)).intersection(view).length
                assert (e in seen) or inside < 6.0


def test_crossings_lie_on_their_true_ground(cross):
    crowd = simulate_crowd(cross, 40, PERFECT)
    shares = []
    for k, o in enumerate(crowd.observations):
        own = o.elements_in_map(crowd.true_poses[k])
        origin = crowd.origin[crowd.origin_offsets[k] : crowd.origin_offsets[k + 1]]
        for i in np.flatnonzero(own.kind == CROSSING):
            ring, true = shapely.Polygon(own.polyline(i)), shapely.Polygon(cross.truth.polyline(origin[i]))
            shares.append(ring.intersection(true).area / ring.area)
    assert len(shares) > 20 and min(shares) > 0.99


def test_a_smaller_crowd_is_the_start_of_a_larger_one(cross):
    few, many = simulate_crowd(cross, 17, LOCAL, seed=3), simulate_crowd(cross, 40, LOCAL, seed=3)
    assert [o.id for o in few.observations] == [o.id for o in many.observations[:17]]
    assert len({o.id for o in many.observations}) == 40
    other = simulate_crowd(cross, 17, LOCAL, seed=4)
    assert not {o.id for o in few.observations} & {o.id for o in other.observations}


def test_pose_errors_scale_the_same_draws(cross):
    quiet = dataclasses.replace(LOCAL, outlier_fraction=0.0)
    errors = []
    for sigma in (0.0, 0.5, 1.5):
        config = dataclasses.replace(quiet, pose_sigma_m=sigma, yaw_sigma_rad=sigma * math.radians(1))
        crowd = simulate_crowd(cross, 24, config)
        errors.append(poses(crowd) - crowd.true_poses)
    assert np.abs(errors[0]).max() == 0.0
    np.testing.assert_allclose(errors[2], 3 * errors[1], atol=1e-9)


def test_element_noise_scales_and_does_not_change_visibility(cross):
    still = dataclasses.replace(PERFECT, miss_rate=0.2, fragment_rate=0.25, point_sigma_m=1e-9)
    noisy = dataclasses.replace(still, point_sigma_m=0.2)
    noisier = dataclasses.replace(still, point_sigma_m=0.4)
    a, b, c = (simulate_crowd(cross, 20, config) for config in (still, noisy, noisier))
    np.testing.assert_array_equal(a.origin, b.origin)
    for one, two, three in zip(a.observations, b.observations, c.observations):
        lines = one.elements.element_of_point[:, None] >= 0
        lines &= (one.elements.kind != CROSSING)[one.elements.element_of_point][:, None]
        once = (two.elements.points - one.elements.points) * lines
        twice = (three.elements.points - one.elements.points) * lines
        np.testing.assert_allclose(twice, 2 * once, atol=1e-6)


def test_point_noise_has_the_configured_sigma(cross):
    config = dataclasses.replace(PERFECT, point_sigma_m=0.15)
    crowd = simulate_crowd(cross, 80, config)
    beside = distances(crowd, [s if s.length > 12 else shapely.LineString() for s in shapes_of(cross.truth)])
    beside = beside[np.isfinite(beside)]
    # |N(0, s)| has the median 0.6745 s.
    assert np.median(beside) == pytest.approx(0.15 * 0.6745, rel=0.06)
    reported_sigma = np.concatenate([o.elements.sigma for o in crowd.observations])
    np.testing.assert_allclose(reported_sigma, 0.15)


def test_rates_are_met(cross):
    whole = simulate_crowd(cross, 200, PERFECT)
    dropped = simulate_crowd(cross, 200, dataclasses.replace(PERFECT, miss_rate=0.3))
    assert 1 - len(dropped.origin) / len(whole.origin) == pytest.approx(0.3, abs=0.04)
    ghosts = simulate_crowd(cross, 200, dataclasses.replace(PERFECT, false_positive_rate=0.15))
    lines = sum((o.elements.kind != CROSSING).sum() for o in whole.observations)
    assert (ghosts.origin < 0).sum() / lines == pytest.approx(0.15, abs=0.03)
    confused = simulate_crowd(cross, 200, dataclasses.replace(PERFECT, confusion_rate=0.2))
    wrong = np.concatenate([o.elements.kind for o in confused.observations]) != cross.truth.kind[confused.origin]
    assert wrong.mean() == pytest.approx(0.2 * lines / len(whole.origin), abs=0.04)


def test_occluded_elements_are_not_reported(cross):
    config = dataclasses.replace(PERFECT, occluders=3.0)
    crowd = simulate_crowd(cross, 60, config)
    hidden = 0
    for o in crowd.observations:
        assert len(o.occluders) == 3
        shadow = shapely.union_all([shapely.Polygon(o.occluders.ring(k)) for k in range(3)])
        assert shadow.is_valid and all(shapely.Polygon(o.occluders.ring(k)).exterior.is_ccw for k in range(3))
        lines = o.elements.take(o.elements.kind != CROSSING)
        deep = shadow.buffer(-0.5)
        assert not shapely.contains(deep, shapely.points(lines.points)).any()
        hidden += shadow.intersection(shapely.Polygon(o.view)).area
    assert hidden / 60 > 50.0
    assert len(crowd.origin) != len(simulate_crowd(cross, 60, PERFECT).origin)


def test_elements_stay_in_view(cross):
    for o in simulate_crowd(cross, 60, PERFECT).observations:
        assert shapely.contains(shapely.Polygon(o.view).buffer(1e-6), shapely.points(o.elements.points)).all()


@pytest.mark.parametrize(
    ("fraction_field", "role"), [("outlier_fraction", "outlier"), ("outdated_fraction", "outdated")]
)
def test_fractions_of_agents_are_near_exact_for_any_count(cross, fraction_field, role):
    config = dataclasses.replace(LOCAL, outlier_fraction=0.0, max_observations_per_drive=1)
    crowd = simulate_crowd(cross, 200, dataclasses.replace(config, **{fraction_field: 0.2}))
    agents = {o.agent: r for o, r in zip(crowd.observations, crowd.roles)}
    found = np.array([r == ROLES.index(role) for r in agents.values()])
    for count in (20, 60, len(found)):
        assert abs(found[:count].mean() - 0.2) <= 2.0 / count + 1e-9


def test_outliers_report_wrong_poses_with_unchanged_covariance(cross):
    config = dataclasses.replace(PERFECT, outlier_fraction=0.3)
    crowd = simulate_crowd(cross, 60, config)
    off = np.linalg.norm((poses(crowd) - crowd.true_poses)[:, :2], axis=1)
    outlier = crowd.roles == ROLES.index("outlier")
    assert outlier.sum() > 8
    assert (off[outlier] >= 2.0).all() and (off[outlier] <= 4.0).all() and (off[~outlier] == 0.0).all()
    assert len({o.covariance.tobytes() for o in crowd.observations}) == 1


@pytest.mark.parametrize("how", ["independent", "colluding"])
def test_malicious_agents_displace_elements_independently_or_alike(cross, how):
    honest = simulate_crowd(cross, 80, dataclasses.replace(LOCAL, outlier_fraction=0.0))
    config = dataclasses.replace(LOCAL, outlier_fraction=0.0, malicious_fraction=0.2, attack_mode=how)
    crowd = simulate_crowd(cross, 80, config)
    shifts = {}
    for k, (o, h) in enumerate(zip(crowd.observations, honest.observations)):
        np.testing.assert_array_equal(o.pose, h.pose)
        moved = o.elements_in_map(crowd.true_poses[k]).points - h.elements_in_map(crowd.true_poses[k]).points
        if crowd.roles[k] == ROLES.index("malicious"):
            assert np.ptp(moved, axis=0).max() < 1e-9
            shifts.setdefault(o.agent, []).append(moved[0])
        else:
            assert not moved.any()
    means = np.array([np.mean(s, axis=0) for s in shifts.values()])
    assert max(np.ptp(np.array(s), axis=0).max() for s in shifts.values()) < 1e-9
    size = np.linalg.norm(means, axis=1)
    assert len(means) >= 3 and (size >= 1.0).all() and (size <= 4.0).all()
    same = np.ptp(means, axis=0).max() < 1e-9
    assert same == (how == "colluding")


def test_malicious_agents_may_displace_some_kinds_only(cross):
    honest = simulate_crowd(cross, 40, PERFECT)
    config = dataclasses.replace(PERFECT, malicious_fraction=1.0, malicious_kinds=("divider",))
    for o, h in zip(simulate_crowd(cross, 40, config).observations, honest.observations):
        moved = (o.elements.points != h.elements.points).any(1)
        np.testing.assert_array_equal(moved, (o.elements.kind == DIVIDER)[o.elements.element_of_point])


def test_the_map_changes_at_a_time_for_all_but_outdated_agents(cross):
    at = LOCAL.start_ns + 5 * DAY_NS
    crossings = np.flatnonzero(cross.truth.kind == CROSSING)
    dividers = np.flatnonzero(cross.truth.kind == DIVIDER)
    changes = [
        Change(int(crossings[0]), at, "remove"),
        Change(int(crossings[1]), at, "add"),
        Change(int(dividers[0]), at, "move", (0.0, 1.5)),
    ]
    config = dataclasses.replace(PERFECT, outdated_fraction=0.5)
    crowd = simulate_crowd(cross, 120, config, changes=changes)
    seen = {k: {"before": 0, "after": 0, "outdated": 0} for k in (0, 1)}
    for k, o in enumerate(crowd.observations):
        is_outdated = crowd.roles[k] == ROLES.index("outdated")
        phase = "before" if o.time_ns < at else "outdated" if is_outdated else "after"
        origin = crowd.origin[crowd.origin_offsets[k] : crowd.origin_offsets[k + 1]]
        for j in (0, 1):
            seen[j][phase] += int((origin == crossings[j]).sum())
        own = o.elements_in_map(crowd.true_poses[k])
        for i in np.flatnonzero(origin == dividers[0]):
            shift = 1.5 if phase == "after" else 0.0
            true = cross.truth.polyline(dividers[0]) + [0.0, shift]
            assert shapely.distance(shapely.points(own.polyline(i)), shapely.LineString(true)).max() < 1e-6
    assert seen[0]["before"] > 0 and seen[0]["after"] == 0 and seen[0]["outdated"] > 0
    assert seen[1]["before"] == 0 and seen[1]["after"] > 0 and seen[1]["outdated"] == 0
    assert len(crowd.changing_map.at(at - 1)) == len(cross.truth) - 1 == len(crowd.changing_map.at(at))


def test_an_element_may_move_twice(cross):
    changes = [Change(0, 100, "move", (1.0, 0.0)), Change(0, 200, "move", (0.0, 2.0)), Change(1, 50, "remove")]
    changing_map = ChangingMap.of(cross.truth, changes)
    place_of = {t: changing_map.at(t) for t in (0, 150, 250)}
    first = [e.points[0] - cross.truth.points[0] for e in (place_of[0],)]
    np.testing.assert_array_equal(first, [[0.0, 0.0]])
    for t, shift in ((150, (1.0, 0.0)), (250, (1.0, 2.0))):
        rows = changing_map.rows_at(t)
        own = changing_map.elements.take(rows[changing_map.element_name[rows] == 0])
        np.testing.assert_allclose(own.points, cross.truth.polyline(0) + shift)
    assert changing_map.epochs.tolist() == [0, 50, 100, 200]
    with pytest.raises(ConfigError, match="element"):
        ChangingMap.of(cross.truth, [Change(10_000, 1, "remove")])


def test_infrastructure_is_trusted_and_static(cross):
    crowd = simulate_crowd(cross, 60, dataclasses.replace(LOCAL, infrastructure_fraction=0.3))
    pole = crowd.roles == ROLES.index("infrastructure")
    assert pole.sum() >= 8
    assert [o.trusted for o in crowd.observations] == pole.tolist()
    where = {(o.agent, *o.pose.tolist()) for o, p in zip(crowd.observations, pole) if p}
    assert len(where) == len({agent for agent, *_ in where}) == 1
    off = np.linalg.norm((poses(crowd) - crowd.true_poses)[pole], axis=1)
    assert off.max() == 0.0
    assert np.mean([len(o.elements) for o, p in zip(crowd.observations, pole) if p]) > 3


def test_views_are_those_of_the_preset(cross):
    for name, size in (("local", (60, 30)), ("semi-global", (120, 60))):
        o = simulate_crowd(cross, 1, crowd_config(name)).observations[0]
        np.testing.assert_allclose(np.ptp(o.view, axis=0), size)
    assert o.elements.counts.tolist() == [40] * len(o.elements)


def test_time_runs_forward_within_a_pass_and_between_passes(cross):
    crowd = simulate_crowd(cross, 40, LOCAL)
    time = [o.time_ns for o in crowd.observations]
    assert time == sorted(time) and len(set(time)) == 40
    assert time[-1] - time[0] > DAY_NS


def test_invalid_settings_raise(cross):
    with pytest.raises(ConfigError, match="miss_rate"):
        dataclasses.replace(LOCAL, miss_rate=1.5)
    with pytest.raises(ConfigError, match="attack_mode"):
        dataclasses.replace(LOCAL, attack_mode="sometimes")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="semi-global"):
        crowd_config("huge")
    with pytest.raises(ConfigError, match="av2-miami"):
        load_place("Atlantis")
    with pytest.raises(ConfigError, match="0 observations or more"):
        simulate_crowd(cross, -1)
    assert len(simulate_crowd(cross, 0)) == 0


@pytest.mark.parametrize("name", ["grid", "grid-2", "cross"])
def test_generated_lanes_run_beside_their_paint_and_through_junctions(name):
    found = load_place(name, None)
    routes, truth = found.routes, found.truth
    dividers = truth.take(truth.kind == DIVIDER)
    lines = shapely.MultiLineString([dividers.polyline(i) for i in range(len(dividers))])
    outside = [p for p in routes.points if not found.junctions.contains(shapely.Point(p))]
    near = shapely.distance(shapely.points(outside[::7]), lines)
    np.testing.assert_allclose(near, 1.75, atol=0.15)
    ends = {
        i: routes.successor[routes.successor_offsets[i] : routes.successor_offsets[i + 1]] for i in range(len(routes))
    }
    gaps = [np.linalg.norm(routes.lane(i)[-1] - routes.lane(int(k))[0]) for i, after in ends.items() for k in after]
    assert len(gaps) > 30 and max(gaps) < 1e-6


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "av2").is_dir(), reason="../shared/data is absent")
@pytest.mark.parametrize("name", ["Town02", "av2-miami", "lanelet2"])
def test_real_places_can_be_simulated(name):
    found = load_place(name, data=SHARED)
    assert name in PLACES
    low, high = np.array(found.area[:2]), np.array(found.area[2:])
    np.testing.assert_allclose(low + high, 0.0, atol=1.0)
    crowd = simulate_crowd(found, 24, PERFECT)
    assert (crowd.true_poses[:, :2] >= low - 1).all() and (crowd.true_poses[:, :2] <= high + 1).all()
    assert np.mean([len(o.elements) for o in crowd.observations]) > 3
    inside = found.clip_to_area()
    assert len(inside) > 20
    lines = inside.take(inside.kind < CROSSING)
    assert (lines.points >= low - 1e-6).all() and (lines.points <= high + 1e-6).all()
    # Vehicles drive on the ground between edges, not on them: a mirrored frame would cross them all the time.
    edges = found.truth.take(found.truth.kind == BOUNDARY)
    shape = shapely.MultiLineString([edges.polyline(i) for i in range(len(edges))])
    assert np.median(shapely.distance(shapely.points(crowd.true_poses[:, :2]), shape)) > 1.0
