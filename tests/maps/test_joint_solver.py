# SPDX-License-Identifier: Apache-2.0
"""The joint step against slow dense twins: pairs by loops and numeric derivatives, stations as unknowns, the dense inverse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.evaluation.maps.registry import make_tuned_settings
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion import pose_optimization
from manyeyes.maps.fusion.agent_weights import AgentLimits, estimate_agent_weights
from manyeyes.maps.fusion.coarse_search import find_isolated_shifts
from manyeyes.maps.fusion.joint_solver import (
    assemble_joint_system,
    compute_prior_weights,
    make_drive_chain,
    solve_joint_step,
)
from manyeyes.maps.fusion.observation_arrays import to_observation_arrays
from manyeyes.maps.fusion.pair_blocks import PairBlocks
from manyeyes.maps.fusion.pose_config import JointIteration, PoseSolverConfig
from manyeyes.maps.fusion.pose_optimization import merge_solutions, search_coarse_poses, solve_poses
from manyeyes.maps.fusion.pose_solution import REJECTED_WEIGHT, make_initial_solution
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.simulator.fleet.simulate import HONEST, OUTLIER

VIEW = np.array([[-20.0, -10.0], [20.0, -10.0], [20.0, 10.0], [-20.0, 10.0]])
P = np.diag([0.16, 0.16, 1e-4])
CONFIG = PoseSolverConfig()
LIMITS = AgentLimits(0.5, 2.0, 3.0, 0.5)


def make_observation(at, agent, number, error=(0.0, 0.0, 0.0), covariance=P, noise=0.05, turned=True):
    """A road of two kinds of lines, and a line across it, seen from a true pose."""
    rng = np.random.default_rng(number)
    along = np.arange(-12.0, 12.5, 2.0)
    lines = [np.stack((along, np.full(len(along), y - at[1])), 1) for y in (-3.5, 0.0, 3.5)]
    lines += [np.stack((np.full(5, 5.0 - at[0]), np.linspace(-4.0, 4.0, 5) - at[1]), 1)] if turned else []
    lines = [line + rng.normal(0.0, noise, line.shape) for line in lines]
    kinds = [BOUNDARY, DIVIDER, DIVIDER, DIVIDER][: len(lines)]
    return Observation(
        agent, f"{agent}-1", 1_700_000_000_000_000_000 + number * 10**9, np.array(at) + error, covariance, VIEW,
        MapElements.of(lines, kinds, 0.9),
    )  # fmt: skip


def make_problem(observations, widths, config=CONFIG):
    """Pair blocks and priors at the prior poses, and the arrays in the order of the solution."""
    arrays = to_observation_arrays(observations, config.spacing_m)
    state = make_initial_solution(arrays)
    keep = np.arange(len(arrays.xy))
    part = pose_optimization._sum_home_pairs(arrays, state, keep, widths, np.arange(len(arrays)), config)
    assert part.pairs is not None
    blocks = PairBlocks.of_sums(part.pairs, part.ids)
    return arrays, state, blocks, pose_optimization._make_priors(state, config)


def move(pose, step, point):
    """A point of the map's frame after its observation moved by a step about its own position."""
    c, s = np.cos(step[2]), np.sin(step[2])
    d = point - pose[:2]
    return pose[:2] + step[:2] + (c * d[0] - s * d[1], s * d[0] + c * d[1])


def sum_pairs_slowly(arrays, pose, order, widths, config):
    """Rows of a dense least squares, (weights, derivatives, residuals), of all ordered pairs of points."""
    xy, tangent = arrays.to_world(pose)
    owner, rows = np.asarray(arrays.observation_of_point), []
    for p in range(len(xy)):
        members = []
        for q in range(len(xy)):
            if owner[q] == owner[p] or arrays.kind_of_point[q] != arrays.kind_of_point[p]:
                continue
            cosine = tangent[p] @ tangent[q]
            mean = tangent[p] + np.sign(cosine) * tangent[q]
            mean = mean / np.linalg.norm(mean)
            normal, away = np.array([-mean[1], mean[0]]), xy[q] - xy[p]
            if (
                abs(cosine) < np.cos(config.max_heading_rad)
                or abs(away @ mean) > 1.0
                or abs(away @ normal) > widths.gate_m
            ):
                continue
            kernel = (widths.kernel_m**2 / (widths.kernel_m**2 + (away @ normal) ** 2)) ** 2
            members.append((kernel * (1.0 - abs(away @ mean)), q, normal))
        total = sum(k for k, _, _ in members)
        unit = 1.0 / (config.points_per_independent * (arrays.sigma[p] ** 2 + config.sigma_m**2))
        for k, q, normal in members:
            derivative = np.zeros(3 * len(pose))

            def residual(row, step, p=p, q=q, normal=normal):
                steps = np.zeros((len(pose), 3))
                steps[row] = step
                one, two = (move(pose[owner[n]], steps[owner[n]], xy[n]) for n in (p, q))
                return normal @ (two - one)

            for o in (owner[p], owner[q]):
                for axis in range(3):
                    h = 1e-6 * np.eye(3)[axis]
                    derivative[3 * order[o] + axis] = (residual(o, h) - residual(o, -h)) / 2e-6
            rows.append((0.5 * unit * k / (1.0 + total), derivative, residual(owner[p], np.zeros(3))))
    return rows


@pytest.fixture(scope="module")
def crossroads():
    """Five observations of three drives with errors of poses."""
    rng = np.random.default_rng(5)
    names = ("a", "a", "b", "b", "c")
    return [
        make_observation((2.0 * k - 4.0, 0.5 * k - 1.0, 0.0), name, k, rng.normal(0.0, (0.3, 0.3, 0.01)))
        for k, name in enumerate(names)
    ]


def test_a_step_equals_that_of_a_dense_least_squares(crossroads):
    widths = JointIteration(2.0, 0.8, 4.0)
    arrays, state, blocks, priors = make_problem(crossroads, widths)
    bias = np.random.default_rng(2).normal(0.0, 0.1, (5, 3)) * (1.0, 1.0, 0.02)
    priors = replace(priors, bias=bias, correction=0.5 * bias[priors.chain.state][::-1])
    found = solve_joint_step(blocks, priors, 4.0)
    order = state.row_indices(arrays.ids)
    count, rows = len(arrays), []
    for weight, derivative, residual in sum_pairs_slowly(arrays, np.asarray(arrays.pose), order, widths, CONFIG):
        rows.append((weight, np.concatenate((derivative, np.zeros(3 * count))), residual))
    own, drive = compute_prior_weights(priors, 4.0)
    half = np.linalg.cholesky(np.linalg.inv(0.5 * P)).T
    for o in range(count):
        s = priors.chain.state[o]
        for axis in range(3):
            derivative = np.zeros(6 * count)
            derivative[3 * o : 3 * o + 3] = half[axis]
            derivative[3 * (count + s) : 3 * (count + s) + 3] = -half[axis]
            rows.append((own[o], derivative, half[axis] @ priors.correction[o]))
    for s in range(count):
        before = priors.chain.previous[s]
        for axis in range(3):
            derivative = np.zeros(6 * count)
            derivative[3 * (count + s) : 3 * (count + s) + 3] = half[axis]
            if before >= 0:
                derivative[3 * (count + before) : 3 * (count + before) + 3] = -half[axis]
            rows.append((1.0 / priors.chain.step_ratio[s] if before >= 0 else drive[s], derivative, 0.0))
    root = np.sqrt([w for w, _, _ in rows])
    dense = np.linalg.lstsq(
        root[:, None] * np.array([d for _, d, _ in rows]), -root * np.array([r for _, _, r in rows]), rcond=None
    )[0]
    np.testing.assert_allclose(found.increment, dense[: 3 * count].reshape(-1, 3), atol=1e-6)
    np.testing.assert_allclose(found.bias, dense[3 * count :].reshape(-1, 3), atol=1e-6)
    assert np.abs(found.increment[:, :2]).max() > 0.05


def test_pairs_equal_stations_as_unknowns():
    """Four observations see the same points of straight lines, so that every station has one point of each."""
    shifts = (0.3, -0.2, 0.1, 0.4)
    seen = [
        make_observation((0.0, 0.0, 0.0), f"a{k}", k, (0.0, y, 0.0), noise=0.0, turned=False)
        for k, y in enumerate(shifts)
    ]
    config = replace(CONFIG, max_longitudinal_m=0.4)
    _, state, blocks, priors = make_problem(seen, JointIteration(2.0, 1e6, 1e6), config)
    found = solve_joint_step(blocks, priors, 1e6)
    # The same by hand: y of each pose, one unknown a station; all stations are alike, heading is determined and stays.
    weight = 3 * 25 / (CONFIG.points_per_independent * (CONFIG.sigma_m**2 + float(seen[0].elements.sigma[0]) ** 2))
    y = np.array([state.pose[k, 1] for k in range(4)])
    design = np.vstack((np.hstack((np.eye(4), -np.ones((4, 1)))), np.hstack((np.eye(4), np.zeros((4, 1))))))
    root = np.sqrt(np.repeat((weight, 1.0 / 0.16), 4))
    right = -root * np.concatenate((y, np.zeros(4)))
    dense = np.linalg.lstsq(root[:, None] * design, right, rcond=None)[0]
    np.testing.assert_allclose(found.increment[:, 1], dense[:4], atol=1e-6)
    np.testing.assert_allclose(found.increment[:, [0, 2]], 0.0, atol=1e-9)


def test_a_crowd_around_every_point_equals_the_sum_by_hand():
    """A thousand points lie around each of 200 observations of the same lines; only those beside it count."""
    rng = np.random.default_rng(5)
    seen = [
        make_observation((0.0, 0.0, 0.0), f"a{k}", k, (0.0, y, 0.0), noise=0.0, turned=False)
        for k, y in enumerate(rng.uniform(-0.4, 0.4, 200))
    ]
    arrays, widths = to_observation_arrays(seen, CONFIG.spacing_m), JointIteration(2.0, 0.8, 9.0)
    state, rows = make_initial_solution(arrays), np.arange(len(seen))
    part = pose_optimization._sum_home_pairs(arrays, state, np.arange(len(arrays.xy)), widths, rows, CONFIG)
    assert part.pairs is not None
    y = part.pose[:, 1]
    kernel = (0.64 / (0.64 + (y[:, None] - y) ** 2)) ** 2 * (1.0 - np.eye(len(y)))
    unit = 1.0 / (CONFIG.points_per_independent * (CONFIG.sigma_m**2 + float(arrays.sigma[0]) ** 2))
    points = len(arrays.xy) / len(seen)
    np.testing.assert_allclose(
        part.pairs.own[:, 3], points * unit * 0.5 * kernel.sum(1) / (1.0 + kernel.sum(1)), rtol=1e-9
    )
    assert (np.diff(part.pairs.offsets) == len(seen) - 1).all()


def test_iterations_equal_factors(crossroads):
    _, _, blocks, priors = make_problem(crossroads, JointIteration(2.0, 0.8, 9.0))
    direct, iterated = solve_joint_step(blocks, priors, 9.0), solve_joint_step(blocks, priors, 9.0, 1e-9)
    np.testing.assert_allclose(iterated.increment, direct.increment, atol=1e-7)
    np.testing.assert_allclose(iterated.bias, direct.bias, atol=1e-7)
    assert direct.factor is not None and iterated.factor is None


def test_marginal_covariance_of_squares_is_nearly_that_of_the_whole_street():
    """A street of 1.4 km that seven drives saw: three squares, whose halos end in the middle of their neighbours.

    What is fixed beyond a halo fixes a part of the drives' biases, which lowers the standard deviations of a street seen so rarely.
    """
    rng = np.random.default_rng(8)
    seen = [
        make_observation((10.0 * k - 700.0, 0.0, 0.0), f"a{k % 7}", k, rng.normal(0.0, (0.3, 0.3, 0.005)), turned=False)
        for k in range(141)
    ]
    whole = solve_poses(seen, CONFIG)
    squares = solve_poses(seen, replace(CONFIG, max_factorized=140))
    np.testing.assert_array_equal(squares.pose, whole.pose)
    sigma = [np.sqrt(np.einsum("oii->oi", s.covariance + s.common_covariance)) for s in (squares, whole)]
    assert not np.array_equal(*sigma)
    np.testing.assert_allclose(sigma[0], sigma[1], rtol=0.15)


def test_squares_of_the_covariance_that_do_not_fit_into_domains_are_refused():
    with pytest.raises(ConfigError, match="odd number"):
        PoseSolverConfig(covariance_squares=2)


def test_marginal_covariance_equals_the_dense_inverse(crossroads):
    _, _, blocks, priors = make_problem(crossroads, JointIteration(2.0, 0.8, 9.0))
    system = assemble_joint_system(blocks, priors, *compute_prior_weights(priors, 9.0)).to_matrix()
    dense = np.linalg.inv(system.toarray())
    factor = solve_joint_step(blocks, priors, 9.0).factor
    assert factor is not None
    found = factor.compute_diagonal_blocks(len(crossroads))
    for o in range(len(crossroads)):
        np.testing.assert_allclose(found[o], dense[3 * o : 3 * o + 3, 3 * o : 3 * o + 3], rtol=1e-8, atol=1e-14)


def make_drives(sigma, covariance, bad=0.0):
    """Six drives of four observations along one road; the second of the first drive is off by ``bad`` across it."""
    rng = np.random.default_rng(11)
    common, own = rng.normal(0.0, 1.0, (6, 3)), rng.normal(0.0, 1.0, (6, 4, 3))
    scale = np.sqrt(0.5) * sigma * np.array([1.0, 1.0, 0.02])
    out = []
    for d in range(6):
        for k in range(4):
            error = scale * (common[d] + own[d, k]) + (0.0, bad if (d, k) == (0, 1) else 0.0, 0.0)
            at = (2.0 * k - 3.0, 0.3 * d - 1.0, 0.0)
            out.append((at, make_observation(at, f"d{d}", 4 * d + k, error, covariance)))
    return out


def lateral_error(drives, skip=()):
    solved = solve_poses([o for _, o in drives])
    rows = solved.row_indices([o.id for _, o in drives])
    away = np.abs(solved.pose[rows, 1] - [at[1] for at, _ in drives])
    return np.delete(away, list(skip)), away


def test_exact_priors_are_not_worse_than_bad_ones():
    exact = lateral_error(make_drives(0.0, np.diag([0.05**2, 0.05**2, 1e-6])))[0]
    assert np.sqrt(np.mean(exact**2)) <= np.sqrt(np.mean(lateral_error(make_drives(0.4, P))[0] ** 2))
    assert exact.max() < 0.05


@pytest.mark.parametrize("bad", [0.6, 1.0])
def test_one_bad_observation_does_not_spoil_its_drive(bad):
    covariance = np.diag([0.05**2, 0.05**2, 1e-6])
    others, all_of_them = lateral_error(make_drives(0.0, covariance, bad), skip=(1,))
    assert others.max() < 0.05 and all_of_them[1] < 0.1


def test_drive_chain_follows_time_and_breaks_at_gaps():
    xy = np.array([[100.0, 0.0], [0.0, 0.0], [50.0, 0.0], [900.0, 0.0], [0.0, 0.0]])
    chain = make_drive_chain(("a", "a", "a", "a", "b"), np.array([3, 1, 2, 4, 1]), xy, 1000.0, 300.0)
    assert chain.state.tolist() == [2, 0, 1, 3, 4]
    assert chain.previous.tolist() == [-1, 0, 1, -1, -1] and chain.start.tolist() == [0, 0, 0, 3, 4]
    assert chain.step_ratio == pytest.approx([0.0, 0.05, 0.05, 0.0, 0.0])


def agent_weights(offset, agent, observability=1.0):
    """Estimate the agent weight of each observation at this observability."""
    count = len(agent)
    matrix = np.tile(observability * np.eye(2), (count, 1, 1))
    return estimate_agent_weights(np.array(offset), matrix, np.full(count, 0.16), np.array(agent), LIMITS)


def test_agent_weight_matches_hand_computed_value():
    """n observations with mean offset m: n m² / (sigma² (1 + rho (n - 1))), less the tolerance, for n = 4 and observability 1."""
    offset = [(0.5, 0.1), (0.3, -0.1), (0.4, 0.0), (0.4, 0.0)]
    mean = np.array([1.6, 0.0]) / 4.1  # 0.1 is the regularization of unobservable directions
    away = 4.0 * mean @ mean / (0.16 * (1.0 + 0.5 * 3.0))
    assert agent_weights(offset, [0] * 4) == pytest.approx((4.0 / (4.0 + (away**0.5 - 0.5) ** 2)) ** 2)
    assert agent_weights([(0.15, 0.0)], [0]) == pytest.approx(1.0)


def test_equal_offsets_lower_weight_more_than_one():
    one, four = agent_weights([(1.1, 0.0)], [0]), agent_weights([(1.1, 0.0)] * 4, [0] * 4)
    apart = agent_weights([(1.1, 0.0), (-1.1, 0.0), (0.0, 1.1), (0.0, -1.1)], [0] * 4)
    assert one[0] > 0.1 and (four < one).all() and apart == pytest.approx(1.0)


def test_agent_beyond_limit_is_rejected_only_where_observable():
    assert agent_weights([(3.0, 0.0)] * 4, [0] * 4) == pytest.approx(REJECTED_WEIGHT)
    assert agent_weights([(3.0, 0.0)] * 4, [0] * 4, observability=0.0) == pytest.approx(1.0)
    mixed = agent_weights([(3.0, 0.0)] * 3 + [(0.1, 0.0)] * 3, [0] * 3 + [1] * 3)
    assert (mixed[:3] == REJECTED_WEIGHT).all() and (mixed[3:] > 0.95).all()


def isolated(shifted, drives=None, step_m=40.0):
    count = len(shifted)
    xy = np.stack((np.arange(count) * step_m, np.zeros(count)), 1).astype(np.float64)
    rows = np.random.default_rng(0).permutation(count)  # the order of the observations has no effect
    found = np.empty(count, bool)
    names = drives or "a" * count
    found[rows] = find_isolated_shifts(tuple(names[k] for k in rows), xy[rows], np.array(shifted, bool)[rows], 300.0)
    return found.astype(int).tolist()


def test_a_shift_alone_in_its_drive_is_isolated_and_one_of_a_majority_is_not():
    assert isolated([0, 1, 0, 0]) == [0, 1, 0, 0]
    assert isolated([1, 1, 0, 1]) == [0, 0, 0, 0]
    assert isolated([1]) == [0], "a drive of one observation has nothing that contradicts it"
    assert isolated([1, 0]) == [1, 0] and isolated([]) == []


def test_isolation_counts_the_same_drive_nearby_alone():
    assert isolated([1, 1, 0, 0], drives="abab") == [1, 1, 0, 0]
    assert isolated([1, 1, 0, 0], drives="aabb") == [0, 0, 0, 0]
    far = isolated([1, 1, 1] + 9 * [0], step_m=140.0)
    assert far[0] == 0, "two of three within 300 m are shifted, though a minority of the drive"


@pytest.mark.slow
def test_honest_observations_are_not_locked_on_the_next_lane():
    """On the tuning place cross a drive was rejected since one of its looks was moved by a lane."""
    experiment = run_trial(FleetTrial("cross", 60, 3000, fleet_config=CROWDS["local"]))
    solution = solve_poses(experiment.observations, make_tuned_settings().config_of("manyeyes").pose_solver)
    rows = solution.row_indices([o.id for o in experiment.observations])
    true, honest = experiment.fleet.true_poses, experiment.fleet.roles == HONEST
    error = solution.pose[rows] - true
    lateral = np.abs(np.cos(true[:, 2]) * error[:, 1] - np.sin(true[:, 2]) * error[:, 0])[honest]
    assert honest.sum() == 56 and lateral.max() < 1.5
    assert (solution.agent_weight[rows][honest] < 0.1).sum() == 0
    assert (solution.agent_weight[rows][experiment.fleet.roles == OUTLIER] < 0.1).all()


def test_a_search_among_the_same_inliers_runs_once(monkeypatch):
    searched = []

    def search(arrays, keep, home, config):
        searched.append(int(keep.sum()))
        return np.asarray(arrays.pose)[home]

    monkeypatch.setattr(pose_optimization, "search_coarse", search)
    honest = [make_observation((2.0 * k, 0.0, 0.0), f"a{k}", k, (0.0, 0.1 * (k % 3), 0.0)) for k in range(8)]
    assert (solve_poses(honest).agent_weight > REJECTED_WEIGHT).all()
    assert len(searched) == 1
    moved = [make_observation((4.0 * k, 0.0, 0.0), "moved", 10 + k, (0.0, 1.8, 0.0)) for k in range(4)]
    found = solve_poses([*honest, *moved])
    assert [found.agents[k] for k in np.flatnonzero(found.agent_weight <= REJECTED_WEIGHT)] == ["moved"] * 4
    # Among all, then among those that are left, of which both passes leave the same.
    first, second = searched[1:]
    assert second < first


def test_a_rejection_pass_among_the_same_inliers_runs_once(monkeypatch):
    numbers, original = [], pose_optimization.run_step

    def run(arrays, state, number, *rest):
        numbers.append(number)
        return original(arrays, state, number, *rest)

    monkeypatch.setattr(pose_optimization, "run_step", run)
    honest = [make_observation((2.0 * k, 0.0, 0.0), f"a{k}", k, (0.0, 0.1 * (k % 3), 0.0)) for k in range(8)]
    schedule = CONFIG.schedule
    first, second = (k for k, step in enumerate(schedule) if step.joint is None)
    found = solve_poses(honest)
    assert numbers == [*range(first), *range(second + 1, len(schedule))]
    # All steps, one after the other, give the same poses.
    arrays = to_observation_arrays(honest, CONFIG.spacing_m)
    home = np.arange(len(honest))
    state = merge_solutions([search_coarse_poses(arrays, home)])
    for number in range(len(schedule)):
        state = merge_solutions([original(arrays, state, number, home)], CONFIG, number)
    np.testing.assert_array_equal(state.pose, found.pose)
    numbers.clear()
    solve_poses([*honest, *(make_observation((4.0 * k, 0.0, 0.0), "moved", 10 + k, (0.0, 1.8, 0.0)) for k in range(4))])
    # The inliers of the second pass are others, so that it runs; the last search finds those of the one before.
    assert numbers == [k for k in range(len(schedule)) if k != second]


def test_steps_of_the_final_pass_take_more_points_once_their_widths_no_longer_fall():
    joint = [step.joint for step in CONFIG.schedule[-CONFIG.num_iterations :]]
    has_settled = [step.gate_m == pytest.approx(CONFIG.gate_m[1]) for step in joint]
    assert 0 < sum(has_settled) < len(joint) and has_settled == sorted(has_settled)
    strides = [CONFIG.settled_point_stride if settled else CONFIG.annealed_point_stride for settled in has_settled]
    assert [step.point_stride for step in joint] == strides
