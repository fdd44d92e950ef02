# SPDX-License-Identifier: Apache-2.0
"""Joint pose correction of all observations and drives: robust nonlinear least squares on the lines that observations share.

The unknowns are the pose of every observation and the error of every drive's prior poses
(:mod:`manyeyes.maps.fusion.joint_solver`); the stations of the lines are eliminated (:mod:`manyeyes.maps.fusion.pair_system`).
Each step associates points at the current poses, then solves one sparse system for all unknowns, so the order of observations has
no effect. Kernels narrow from step to step (graduated non-convexity). Directions that no line determines, such as along a
straight road, keep the prior.

The solution runs in passes. A rejection pass ends with a decision which agents' prior poses share a bias that their covariance
does not explain. Then the solution starts again from the prior poses without the lines of those agents, so that a rejected agent
influences neither the coarse search nor intermediate poses. The second rejection pass uses inlier agents alone and decides on all
agents again at its end, so that wrongly rejected agents are reinstated. A rejected agent's observations are aligned to the
others.

The association and the sums of an observation depend only on observations that overlap it. So a large area is handled tile by
tile with the same result: :func:`search_coarse_poses` and each :func:`run_step` run for the home observations of each tile, given
all observations that :func:`find_overlapping` returns and the poses after the previous step. A joint step is solved domain by
domain (:func:`solve_domain`), squares of 1,536 m with a halo of 384 m, so that no process holds the poses of a city; only agents
are weighed over all of it, from sums (:mod:`manyeyes.maps.fusion.agent_weights`). :func:`merge_solutions` does both in memory, and
:func:`solve_poses` is the case of one tile. The map is defined as the result of the fixed number of steps with this halo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion.agent_weights import (
    NUM_COLUMNS,
    AgentLimits,
    AgentSums,
    AgentWeights,
    apply_agents,
    make_agent_columns,
)
from manyeyes.maps.fusion.coarse_search import find_isolated_shifts, search_coarse
from manyeyes.maps.fusion.joint_solver import (
    JointPriors,
    JointStep,
    make_drive_chain,
    solve_joint_step,
)
from manyeyes.maps.fusion.observation_arrays import ObservationArrays, to_observation_arrays
from manyeyes.maps.fusion.pair_blocks import PairBlocks
from manyeyes.maps.fusion.pair_system import OtherPoints, OwnPoints, PairLimits, sum_pairs
from manyeyes.maps.fusion.point_grid import build_grid, cell_key, limit_observations
from manyeyes.maps.fusion.pose_config import DEFAULT_ALIGN, JointIteration, PoseSolverConfig, SolverStep
from manyeyes.maps.fusion.pose_solution import (
    REJECTED_WEIGHT,
    PairSums,
    PoseSolution,
    make_initial_solution,
    take_pairs,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

STEP_TOLERANCE = 1e-5
"""Relative residual of the joint steps; what is left of a step is in the next one."""
_BOUND_CELL_M = 8.0
_PAIR_CELL_M = 1.0
_STRIP_M = 64.0


def solve_poses(observations: Sequence[Observation], config: PoseSolverConfig = DEFAULT_ALIGN) -> PoseSolution:
    """Solve for the pose of each observation; a pure function of the set."""
    arrays = to_observation_arrays(observations, config.spacing_m)
    home = np.arange(len(arrays))
    # All searches begin at the prior poses.
    searched = limit_per_cell(arrays, np.asarray(arrays.pose), config.max_observations_per_cell)
    found = search_coarse_poses(arrays, home, config, searched)
    state, keep = merge_solutions([found], config), None
    # A search depends on the inliers alone, and so does the rejection pass after it.
    inliers = _inliers_of(state)
    searches, is_repeated = {inliers: found}, False
    last_search = max((number for number, step in enumerate(config.schedule) if step.joint is None), default=-1)
    for number, step in enumerate(config.schedule):
        if step.joint is None:
            before, inliers = inliers, _inliers_of(state)
            is_repeated = inliers == before
            if inliers not in searches:
                searches[inliers] = run_step(arrays, state, number, home, config, searched)
            state, keep = merge_solutions([searches[inliers]], config, number), None
        elif number > last_search or not is_repeated:
            if keep is None:
                # Only a search changes the initial poses.
                keep = limit_per_cell(
                    arrays, state.initial_pose[state.row_indices(arrays.ids)], config.max_observations_per_cell
                )
            state = merge_solutions([run_step(arrays, state, number, home, config, keep)], config, number)
    return state


def _inliers_of(state: PoseSolution) -> bytes:
    return (state.agent_weight > REJECTED_WEIGHT).tobytes()


def find_overlapping(
    observations: Sequence[Observation], home_observations: Sequence[Observation], margin_m: float = 45.0
) -> list[Observation]:
    """Find the observations that any step of the home observations reads, themselves included, ids ascending."""
    if not len(home_observations):
        return []
    radius_of = {o.id: _bounding_radius(o) for o in (*observations, *home_observations)}
    xy = np.array([o.pose[:2] for o in observations]).reshape(-1, 2)
    radius = np.array([radius_of[o.id] for o in observations])
    chosen = np.zeros(len(observations), bool)
    for o in home_observations:
        near = np.hypot(*(xy - o.pose[:2]).T)
        # A cell that a home point lies in keeps its best observations among all that have a point in it.
        chosen |= near <= radius + radius_of[o.id] + margin_m + _BOUND_CELL_M * np.sqrt(2.0)
    return sorted((observations[k] for k in np.flatnonzero(chosen).tolist()), key=lambda o: o.id)


def search_coarse_poses(
    arrays: ObservationArrays,
    home: Ints,
    config: PoseSolverConfig = DEFAULT_ALIGN,
    keep: NDArray[np.bool_] | None = None,
) -> PoseSolution:
    """Run the coarse search for the home observations, rows (H,) of the arrays; ids ascending.

    keep: (P,) points that count, :func:`limit_per_cell` at the prior poses; None: computed here.
    """
    state = _select_home(make_initial_solution(arrays), arrays, home)
    rows = _rows_in(arrays, state)
    if keep is None:
        keep = limit_per_cell(arrays, np.asarray(arrays.pose), config.max_observations_per_cell)
    found = search_coarse(arrays, keep, rows, config.coarse_search)
    return replace(state, initial_pose=found, pose=found)


def run_step(
    arrays: ObservationArrays,
    state: PoseSolution,
    number: int,
    home: Ints,
    config: PoseSolverConfig = DEFAULT_ALIGN,
    keep: NDArray[np.bool_] | None = None,
) -> PoseSolution:
    """Run the local part of one more step for the home observations; ids ascending.

    state: all observations of the arrays after the previous step. keep: (P,) points that count, :func:`limit_per_cell` at the
    prior poses in a search, at the initial poses of the state in a joint step; None: computed here.
    """
    step = config.schedule[number]
    if keep is None:
        start = np.asarray(arrays.pose) if step.joint is None else state.initial_pose[state.row_indices(arrays.ids)]
        keep = limit_per_cell(arrays, start, config.max_observations_per_cell)
    if step.joint is None:
        return _repeat_search(arrays, state, keep, home, config)
    return _sum_home_pairs(arrays, state, np.flatnonzero(keep), step.joint, home, config)


def _repeat_search(
    arrays: ObservationArrays, state: PoseSolution, keep: NDArray[np.bool_], home: Ints, config: PoseSolverConfig
) -> PoseSolution:
    """Reset the home observations to their prior poses and search again, among the points ``keep`` of inlier agents alone."""
    initial = _select_home(make_initial_solution(arrays), arrays, home)
    is_inlier = state.agent_weight > REJECTED_WEIGHT
    keep = keep & is_inlier[state.row_indices(arrays.ids)][arrays.observation_of_point]
    found = search_coarse(arrays, keep, _rows_in(arrays, initial), config.coarse_search)
    agent_weight = np.where(is_inlier[state.row_indices(initial.ids)], 1.0, REJECTED_WEIGHT)
    return replace(initial, initial_pose=found, pose=found, agent_weight=agent_weight)


def _select_home(state: PoseSolution, arrays: ObservationArrays, home: Ints) -> PoseSolution:
    """Return the rows of a state for the home observations, ids ascending."""
    return state.take(state.row_indices(sorted(arrays.ids[k] for k in home.tolist())))


def _rows_in(arrays: ObservationArrays, state: PoseSolution) -> Ints:
    """Return the rows of the arrays for the observations of a state."""
    place = {name: k for k, name in enumerate(arrays.ids)}
    return np.array([place[name] for name in state.ids], np.int64)


def _sum_home_pairs(
    arrays: ObservationArrays,
    state: PoseSolution,
    keep: Ints,
    widths: JointIteration,
    home: Ints,
    config: PoseSolverConfig,
) -> PoseSolution:
    """Sum the pairs of the home observations at the poses of the state, among the points ``keep``."""
    part = _select_home(state, arrays, home)
    rows = state.row_indices(arrays.ids)
    pose = np.ascontiguousarray(state.pose[rows])
    xy, tangent = arrays.to_world(pose)
    weight = np.where(state.agent_weight[rows] > REJECTED_WEIGHT, 1.0, 0.0)
    weight[np.asarray(arrays.trusted)] = config.surveyed_weight
    grid = build_grid(xy[keep, 0], xy[keep, 1], arrays.kind_of_point[keep], _PAIR_CELL_M)
    order = keep[grid.order]
    # Neighbours one after the other meet the same points, which then lie in the cache.
    nearby = np.lexsort((part.pose[:, 0], np.floor(part.pose[:, 1] / _STRIP_M)))
    own, offsets, other, shared = sum_pairs(
        _rows_in(arrays, part)[nearby],
        pose,
        weight,
        OwnPoints(arrays.observation_offsets, xy, tangent, np.asarray(arrays.kind_of_point), np.asarray(arrays.sigma)),
        OtherPoints(
            grid.cell_m,
            grid.keys,
            grid.offsets,
            xy.take(order, 0),
            tangent.take(order, 0),
            np.asarray(arrays.observation_of_point)[order],
        ),
        PairLimits(
            widths.gate_m,
            widths.kernel_m,
            config.max_longitudinal_m,
            float(np.cos(config.max_heading_rad)),
            config.sigma_m,
            config.points_per_independent,
            widths.point_stride,
        ),
    )
    pairs = PairSums(own, offsets, arrays.digests[other], shared)
    return replace(part, pairs=take_pairs(pairs, np.argsort(nearby)))


def merge_solutions(
    parts: Sequence[PoseSolution], config: PoseSolverConfig = DEFAULT_ALIGN, number: int | None = None
) -> PoseSolution:
    """Merge the home observations of all tiles after a step (None: the first search), ids ascending; solve a joint step."""
    whole = PoseSolution.cat(parts)
    step = None if number is None else config.schedule[number]
    if not len(whole.ids):
        return replace(whole, pairs=None)
    if step is None or step.joint is None:
        domains = list_domains(whole.prior_pose, config)
        return PoseSolution.cat([settle_domain([whole], domain, config) for domain in domains])
    if whole.pairs is None:
        return whole
    states: list[PoseSolution] = []
    sums: list[AgentSums] = []
    rows, solved = np.zeros(0, np.int64), None
    for domain in list_domains(whole.prior_pose, config):
        near = _rows_near_domain(whole, domain, config)
        if solved is None or not np.array_equal(near, rows):
            rows, solved = near, _solve_near(whole.take_with_pairs(near), step, config)
        state, found = _select_domain(*solved, domain, config)
        state = _add_common_covariance(state, whole.take_with_pairs(near), step, config) if step.is_last else state
        states.append(state)
        sums.append(found)
    table = weigh_agents(AgentSums.merge(sums), AgentWeights.of_state(whole), step, config)
    return apply_agents(PoseSolution.cat(states), table)


def _reset_isolated(whole: PoseSolution, config: PoseSolverConfig) -> PoseSolution:
    """Reset the observations that a search shifted alone of their drive to their prior poses."""
    is_shifted = (whole.initial_pose != whole.prior_pose).any(1)
    isolated = find_isolated_shifts(whole.drives, whole.prior_pose[:, :2], is_shifted, config.drive_support_m)
    start = np.where(isolated[:, None], whole.prior_pose, whole.initial_pose)
    return replace(whole, initial_pose=start, pose=start, pairs=None)


def settle_domain(
    parts: Sequence[PoseSolution], domain: tuple[int, int], config: PoseSolverConfig = DEFAULT_ALIGN
) -> PoseSolution:
    """Reset the observations of one domain that a search shifted alone of their drive; ids ascending.

    A pure function of the observations within the halo of the domain, which the disjoint parts together hold.
    """
    near = PoseSolution.cat([take_near_domain(part, domain, config) for part in parts])
    home = np.flatnonzero((_domain_indices(near.prior_pose, config) == domain).all(1))
    return _reset_isolated(near, config).take(home)


def list_domains(prior_pose: Floats, config: PoseSolverConfig = DEFAULT_ALIGN) -> list[tuple[int, int]]:
    """Return the domains (column, row) that hold prior poses (O, 3), ascending."""
    return [(int(x), int(y)) for x, y in np.unique(_domain_indices(prior_pose, config), axis=0)]


def _domain_indices(prior_pose: Floats, config: PoseSolverConfig) -> Ints:
    return _square_indices(prior_pose, config.domain_m)


def _square_indices(prior_pose: Floats, side_m: float) -> Ints:
    """Return column and row (O, 2) of the square that each prior pose lies in; the origin is the middle of one."""
    return np.floor(prior_pose[:, :2] / side_m + 0.5).astype(np.int64)


def find_domain_area(domain: tuple[int, int], config: PoseSolverConfig) -> tuple[float, float, float, float]:
    """Return the area (x0, y0, x1, y1; metres) of a domain with its halo; the origin is the middle of domain (0, 0)."""
    reach = config.domain_m / 2 + config.domain_halo_m
    x, y = (d * config.domain_m for d in domain)
    return x - reach, y - reach, x + reach, y + reach


def solve_domain(
    parts: Sequence[PoseSolution], domain: tuple[int, int], step: SolverStep, config: PoseSolverConfig = DEFAULT_ALIGN
) -> tuple[PoseSolution, AgentSums]:
    """Solve a joint step for the poses in one domain; a pure function of the observations within its halo.

    Observations beyond the halo do not move during the step, and a drive is cut there. Each step starts from the poses that all
    domains had after the previous one (restricted additive Schwarz).

    Args:
        parts: disjoint parts with their pairs, which together hold all observations within the halo.
        domain: column and row.

    Returns:
        The observations of the domain, ids ascending, and the sums of their agents.
    """
    near = PoseSolution.cat([take_near_domain(part, domain, config) for part in parts])
    if not len(near.ids):
        return near, AgentSums.of((), np.zeros((0, NUM_COLUMNS)))
    state, sums = _select_domain(*_solve_near(near, step, config), domain, config)
    return _add_common_covariance(state, near, step, config) if step.is_last else state, sums


def take_near_domain(
    part: PoseSolution, domain: tuple[int, int], config: PoseSolverConfig = DEFAULT_ALIGN
) -> PoseSolution:
    """Return the observations, with their pairs, that a step of the domain reads."""
    return part.take_with_pairs(_rows_near_domain(part, domain, config))


def _rows_near_domain(whole: PoseSolution, domain: tuple[int, int], config: PoseSolverConfig) -> Ints:
    """Return the rows whose prior position lies in a domain or within its halo."""
    area, place = find_domain_area(domain, config), whole.prior_pose[:, :2]
    return np.flatnonzero(((place >= area[:2]) & (place < area[2:])).all(1))


def _select_domain(
    state: PoseSolution, columns: Floats, domain: tuple[int, int], config: PoseSolverConfig
) -> tuple[PoseSolution, AgentSums]:
    """Return the observations of a domain, and the sums of their agents of columns (O, 9)."""
    home = np.flatnonzero((_domain_indices(state.prior_pose, config) == domain).all(1))
    at_home = state.take(home)
    return at_home, AgentSums.of(at_home.agents, columns[home])


def _solve_near(near: PoseSolution, step: SolverStep, config: PoseSolverConfig) -> tuple[PoseSolution, Floats]:
    """Solve a joint step for these observations; their state, and what each adds to the sums of its agent (O, 9)."""
    assert step.joint is not None and near.pairs is not None
    blocks = PairBlocks.of_sums(near.pairs, near.ids)
    priors = _make_priors(near, config)
    solved = solve_joint_step(blocks, priors, step.joint.prior_scale, STEP_TOLERANCE)
    state = _apply_step(near, blocks, priors, solved, config)
    return state, _make_columns(state, blocks.own, near.pairs, config)


def _add_common_covariance(
    at_home: PoseSolution, near: PoseSolution, step: SolverStep, config: PoseSolverConfig
) -> PoseSolution:
    """Add the common covariance to the observations of a domain after a step; near: all within its halo before the step.

    The marginal covariance is that of the system of the domain or, where that is too large to be factorized, of the system around
    each of smaller squares, beyond whose halo poses are fixed. Too large means densely seen, where that lowers standard deviations
    by less than 1 %; on a street that seven drives saw it would lower them by a tenth.
    """
    assert step.joint is not None
    side, halo = config.domain_m, config.domain_halo_m
    if len(near.ids) > config.max_factorized:
        side, halo = side / config.covariance_squares, min(halo, config.covariance_halo_m)
    reach = side / 2 + halo
    common, square_of = np.empty_like(at_home.covariance), _square_indices(at_home.prior_pose, side)
    for square in np.unique(square_of, axis=0):
        offset = near.prior_pose[:, :2] - square * side
        part = near.take_with_pairs(np.flatnonzero(((offset >= -reach) & (offset < reach)).all(1)))
        assert part.pairs is not None
        priors = _make_priors(part, config)
        factor = solve_joint_step(PairBlocks.of_sums(part.pairs, part.ids), priors, step.joint.prior_scale).factor
        assert factor is not None
        marginal = factor.compute_diagonal_blocks(len(part.ids))
        marginal[priors.fixed] = part.prior_covariance[priors.fixed]
        home = np.flatnonzero((square_of == square).all(1))
        state = at_home.take(home)
        marginal = marginal[part.row_indices(state.ids)]
        bounded = bound_covariance(marginal, state.prior_covariance, state.correction, step.joint.prior_scale)
        common[home] = bounded - state.covariance
    return replace(at_home, common_covariance=common)


def bound_covariance(
    covariance: Floats, prior_covariance: Floats, correction: Floats, min_sigmas: float
) -> NDArray[np.float64]:
    """Bound covariances (O, 3, 3) of poses in each direction by the prior ones, times the square of the corrections in sigmas.

    A robust weight that releases a prior, as of a rejected agent, leaves directions that no line constrains to the inverse of that
    weight: kilometres. That is a freedom of the system of equations, not an error of the pose, which stays at its prior there.

    Args:
        covariance, prior_covariance: (O, 3, 3). correction: (O, 3) of the prior poses.
        min_sigmas: the bound is at least so many standard deviations of the prior.
    """
    out = covariance.copy()
    # Relative to the prior, so that metres and radians compare; L L' is the prior covariance.
    root = np.linalg.cholesky(prior_covariance)
    whitening = np.linalg.inv(root)
    square, axes = np.linalg.eigh(whitening @ covariance @ whitening.transpose(0, 2, 1))
    limit = np.maximum(min_sigmas**2, (np.einsum("oij,oj->oi", whitening, correction) ** 2).sum(1))[:, None]
    rows = np.flatnonzero((square > limit).any(1))
    scaled = root[rows] @ axes[rows]
    bounded = np.minimum(square, limit)[rows]
    out[rows] = scaled * bounded[:, None, :] @ scaled.transpose(0, 2, 1)
    return out


def weigh_agents(
    sums: AgentSums, previous: AgentWeights | None, step: SolverStep, config: PoseSolverConfig = DEFAULT_ALIGN
) -> AgentWeights:
    """Weigh all agents after a joint step."""
    limits = AgentLimits(config.agent_tolerance, config.agent_scale, config.max_agent_error, config.drive_fraction)
    return AgentWeights.of_sums(sums, previous, step.decides, limits)


def _make_priors(whole: PoseSolution, config: PoseSolverConfig) -> JointPriors:
    """Gather the priors of all observations and drives at the current poses."""
    chain = make_drive_chain(
        whole.drives, whole.time_ns, whole.prior_pose[:, :2], config.drift_length_m, config.max_drive_gap_m
    )
    bias = np.empty_like(whole.drive_bias)
    bias[chain.state] = whole.drive_bias
    return JointPriors(
        whole.correction,
        whole.prior_covariance,
        bias,
        whole.is_surveyed > 0,
        whole.agent_weight,
        chain,
        config.drive_fraction,
    )


def _apply_step(
    whole: PoseSolution, blocks: PairBlocks, priors: JointPriors, solved: JointStep, config: PoseSolverConfig
) -> PoseSolution:
    """Move the poses by a bounded step; their covariance given all other unknowns."""
    limit = np.array([config.max_step_m, config.max_step_m, config.max_step_rad])
    increment = np.where(priors.fixed[:, None], 0.0, np.clip(solved.increment, -limit, limit))
    own_prior = np.linalg.inv((1.0 - config.drive_fraction) * whole.prior_covariance)
    covariance = np.linalg.inv(blocks.own + solved.own_weight[:, None, None] * own_prior)
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    return replace(
        whole,
        pose=whole.pose + increment,
        covariance=np.where(priors.fixed[:, None, None], whole.prior_covariance, covariance),
        drive_bias=solved.bias[priors.chain.state],
        pairs=None,
    )


def _make_columns(state: PoseSolution, information: Floats, pairs: PairSums, config: PoseSolverConfig) -> Floats:
    """Make what each observation, whose lines give information (O, 3, 3), adds to the sums of its agent: (O, 9)."""
    prior = np.linalg.inv(state.prior_covariance)
    ratio = (np.linalg.inv(information + prior) @ prior)[:, :2, :2]
    variance = np.trace(state.prior_covariance[:, :2, :2], axis1=1, axis2=2) / 2
    return make_agent_columns(
        state.correction[:, :2],
        np.eye(2) - (ratio + ratio.transpose(0, 2, 1)) / 2,
        variance + config.observation_error_m**2,
        pairs.own[:, 9],
        pairs.own[:, 10],
    )


def limit_per_cell(arrays: ObservationArrays, pose: Floats, max_observations: int) -> NDArray[np.bool_]:
    """Select the points (P,) that count with agents at pose (O, 3).

    At most ``max_observations`` observations count per class, heading and cell of 8 m.
    """
    xy, tangent = arrays.to_world(pose)
    bins = np.floor(np.arctan2(tangent[:, 1], tangent[:, 0]) / np.pi % 1.0 * 6.0).astype(np.int64) % 6
    key = (
        cell_key(np.zeros(len(xy), np.int64), xy[:, 0], xy[:, 1], _BOUND_CELL_M) * 32 + bins * 4 + arrays.kind_of_point
    )
    information = -np.trace(np.asarray(arrays.covariance)[:, :2, :2], axis1=1, axis2=2)
    ids = np.array(arrays.ids)
    order = np.lexsort((ids, -np.asarray(arrays.time_ns), -information, ~np.asarray(arrays.trusted)))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return limit_observations(
        key, np.asarray(arrays.observation_of_point), np.asarray(arrays.agent), rank, max_observations
    )


def _bounding_radius(o: Observation) -> float:
    points = np.concatenate((o.view, o.elements.points))
    return float(np.hypot(points[:, 0], points[:, 1]).max())
