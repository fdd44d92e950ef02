# SPDX-License-Identifier: Apache-2.0
"""Joint pose correction of all observations: robust, damped Gauss-Newton on point-to-line residuals with a pose prior.

Each sweep moves every observation towards the lines of the others as they were before the sweep (Jacobi iteration), so the
order of observations has no effect. Residuals are lateral, along the mean normal of both lines, which has no bias on a bend.
Each point has a total weight of at most one. The prior is the prior pose, corrected by the bias of the drive
(:mod:`manyeyes.maps.fusion.drive_bias`). Directions that no line determines, such as along a straight road, keep the prior.

The solution runs in passes. A rejection pass is a few sweeps after which agents are rejected whose corrections share an offset
beyond what their covariance explains. Then the solution starts again from the prior poses without the lines of those agents, so
that a rejected agent influences neither the coarse search nor intermediate poses. The second rejection pass uses inlier agents
alone and re-evaluates all agents at its end, so that wrongly rejected agents are reinstated. The final pass uses a wider kernel
for the gauge offset, which is more accurate once malicious agents are rejected.

A step of an observation depends only on observations that overlap it. So a large area can be solved tile by tile with the same
result: :func:`search_coarse_poses` and each :func:`run_step` run for the home observations of each tile, given all observations
that :func:`find_overlapping` returns and the poses after the previous step. :func:`merge_solutions` joins the results of the
tiles. :func:`solve_poses` is the case of one tile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion.agent_weights import (
    REJECTED_WEIGHT,
    compute_observability,
    compute_observation_weights,
    estimate_agent_weights,
    estimate_gauge_offset,
)
from manyeyes.maps.fusion.coarse_search import search_coarse
from manyeyes.maps.fusion.drive_bias import estimate_drive_bias
from manyeyes.maps.fusion.gauss_newton import build_normal_equations, step_poses
from manyeyes.maps.fusion.observation_arrays import ObservationArrays, to_observation_arrays
from manyeyes.maps.fusion.point_grid import build_grid, cell_key, limit_observations
from manyeyes.maps.fusion.pose_config import DEFAULT_ALIGN, PoseSolverConfig

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BOUND_CELL_M = 8.0
_SWEEP_CELL_M = 1.0


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """Corrected poses of O observations, ids ascending.

    ids: (O,) hexadecimal. agents, drives: (O,) names; a drive belongs to one agent.
    prior_covariance: (O, 3, 3) of the prior pose. initial_pose: (O, 3) after the coarse search, the prior pose where it found
        no shift.
    pose: (O, 3) and covariance: (O, 3, 3) of it.
    scale: (O,) metres, robust residual scale of the agent's lines.
    observability: (O, 3) from 0 (prior alone) to 1, ascending, of the three principal directions of the pose.
    residual: (O,) m², weighted sum of squared residuals; num_matched: (O,) number of points with neighbours.
    relative_offset: (O, 2) metres, correction relative to observations nearby.
    agent_weight: (O,) in (0, 1], see :func:`~manyeyes.maps.fusion.agent_weights.estimate_agent_weights`.
    gauge_weight: (O,) weight of the prior pose in the gauge offset; 0 if the search shifted it.
    is_surveyed: (O,) 1 for surveyed poles. search_shift: (O, 2) metres, shift by the coarse search.
    information_matrix: (O, 3, 3) of the lines; information_vector: (O, 3), that times the correction of initial_pose that they
        give.
    prior_mean: (O, 3) mode of the prior, relative to initial_pose.
    """

    ids: tuple[str, ...]
    agents: tuple[str, ...]
    drives: tuple[str, ...]
    prior_covariance: Floats
    initial_pose: Floats
    pose: Floats
    covariance: Floats
    scale: Floats
    observability: Floats
    residual: Floats
    num_matched: Floats
    relative_offset: Floats
    agent_weight: Floats
    gauge_weight: Floats
    is_surveyed: Floats
    search_shift: Floats
    information_matrix: Floats
    information_vector: Floats
    prior_mean: Floats

    def row_indices(self, ids: Sequence[str]) -> Ints:
        """Return the rows of these ids."""
        place = {name: k for k, name in enumerate(self.ids)}
        return np.array([place[name] for name in ids], np.int64)

    def take(self, rows: Ints) -> PoseSolution:
        """Return the chosen rows, in the order given."""
        return PoseSolution(
            tuple(self.ids[k] for k in rows.tolist()),
            tuple(self.agents[k] for k in rows.tolist()),
            tuple(self.drives[k] for k in rows.tolist()),
            *(getattr(self, name)[rows] for name in _COLUMNS),
        )


_STATE = (
    "prior_covariance",
    "initial_pose",
    "pose",
    "covariance",
    "scale",
    "observability",
    "residual",
    "num_matched",
)
_COLUMNS = (
    *_STATE,
    "relative_offset",
    "agent_weight",
    "gauge_weight",
    "is_surveyed",
    "search_shift",
    "information_matrix",
    "information_vector",
    "prior_mean",
)


def solve_poses(observations: Sequence[Observation], config: PoseSolverConfig = DEFAULT_ALIGN) -> PoseSolution:
    """Solve for the pose of each observation; a pure function of the set."""
    arrays = to_observation_arrays(observations, config.spacing_m)
    home = np.arange(len(arrays))
    state = merge_solutions([search_coarse_poses(arrays, home, config)], config)
    keep = None
    for number in range(config.num_steps):
        if (
            number == 0 or config.schedule[number - 1].gate_and_kernel_m is None
        ):  # after a search, which alone changes the initial poses
            keep = limit_per_cell(
                arrays, state.initial_pose[state.row_indices(arrays.ids)], config.max_observations_per_cell
            )
        state = merge_solutions([run_step(arrays, state, number, home, config, keep)], config, number)
    return state


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


def make_initial_solution(arrays: ObservationArrays) -> PoseSolution:
    """Make the solution at the prior poses, ids ascending."""
    count = len(arrays)
    pose = np.array(arrays.pose)
    start = PoseSolution(
        arrays.ids,
        tuple(arrays.agents[a] for a in arrays.agent.tolist()),
        arrays.drives,
        np.array(arrays.covariance),
        pose,
        pose,
        np.array(arrays.covariance),
        np.full(count, 0.2),
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros(count),
        np.zeros((count, 2)),
        np.ones(count),
        compute_observation_weights(arrays, pose, np.zeros(count), np.ones(count)),
        np.asarray(arrays.trusted).astype(np.float64),
        np.zeros((count, 2)),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
    )
    return start.take(np.array(sorted(range(count), key=lambda k: arrays.ids[k]), np.int64))


def search_coarse_poses(
    arrays: ObservationArrays, home: Ints, config: PoseSolverConfig = DEFAULT_ALIGN
) -> PoseSolution:
    """Run the coarse search for the home observations, rows (H,) of the arrays; ids ascending."""
    state = _select_home(make_initial_solution(arrays), arrays, home)
    rows = _rows_in(arrays, state)
    keep = limit_per_cell(arrays, np.asarray(arrays.pose), config.max_observations_per_cell)
    return _apply_search(state, search_coarse(arrays, keep, rows, config.coarse_search))


def run_step(
    arrays: ObservationArrays,
    state: PoseSolution,
    number: int,
    home: Ints,
    config: PoseSolverConfig = DEFAULT_ALIGN,
    keep: NDArray[np.bool_] | None = None,
) -> PoseSolution:
    """Run one more step for the home observations; ids ascending.

    state: all observations of the arrays after the previous step. keep: (P,) points that count in a sweep,
    :func:`limit_per_cell` at the initial poses of the state; None: computed here.
    """
    step = config.schedule[number]
    if step.gate_and_kernel_m is None:
        return _repeat_search(arrays, state, home, config)
    if keep is None:
        keep = limit_per_cell(
            arrays, state.initial_pose[state.row_indices(arrays.ids)], config.max_observations_per_cell
        )
    return _sweep(arrays, state, np.flatnonzero(keep), (*step.gate_and_kernel_m, step.point_stride), home, config)


def _repeat_search(
    arrays: ObservationArrays, state: PoseSolution, home: Ints, config: PoseSolverConfig
) -> PoseSolution:
    """Reset the home observations to their prior poses and search again among inlier agents alone."""
    initial = _select_home(make_initial_solution(arrays), arrays, home)
    initial = replace(
        initial,
        agent_weight=np.where(_select_home(state, arrays, home).agent_weight > REJECTED_WEIGHT, 1.0, REJECTED_WEIGHT),
    )
    keep = limit_per_cell(arrays, np.asarray(arrays.pose), config.max_observations_per_cell)
    keep &= (state.agent_weight[state.row_indices(arrays.ids)] > REJECTED_WEIGHT)[arrays.observation_of_point]
    return _apply_search(initial, search_coarse(arrays, keep, _rows_in(arrays, initial), config.coarse_search))


def _select_home(state: PoseSolution, arrays: ObservationArrays, home: Ints) -> PoseSolution:
    """Return the rows of a state for the home observations, ids ascending."""
    return state.take(state.row_indices(sorted(arrays.ids[k] for k in home.tolist())))


def _rows_in(arrays: ObservationArrays, state: PoseSolution) -> Ints:
    """Return the rows of the arrays for the observations of a state."""
    place = {name: k for k, name in enumerate(arrays.ids)}
    return np.array([place[name] for name in state.ids], np.int64)


def _apply_search(state: PoseSolution, found_pose: Floats) -> PoseSolution:
    """Move a state from the prior poses to those of the coarse search."""
    unmoved = (found_pose == state.pose).all(1)
    shift = (found_pose - state.pose)[:, :2]
    return replace(
        state,
        initial_pose=found_pose,
        pose=found_pose,
        gauge_weight=np.where(unmoved, state.gauge_weight, 0.0),
        search_shift=shift,
    )


def _sweep(
    arrays: ObservationArrays,
    state: PoseSolution,
    keep: Ints,
    gate_kernel_stride: tuple[float, float, int],
    home: Ints,
    config: PoseSolverConfig,
) -> PoseSolution:
    """Run one sweep for the home observations with this gate, kernel and stride among the points ``keep``."""
    gate, kernel, stride = gate_kernel_stride
    rows = state.row_indices(arrays.ids)
    start, prior_mean, pose = state.initial_pose[rows], state.prior_mean[rows], state.pose[rows]
    xy, tangent = arrays.to_world(pose)
    weight = compute_observation_weights(arrays, start, state.scale[rows], state.agent_weight[rows])
    grid = build_grid(xy[keep, 0], xy[keep, 1], arrays.kind_of_point[keep], _SWEEP_CELL_M)
    order = keep[grid.order]
    far = np.asarray(arrays.observation_of_point)[order]
    sums = build_normal_equations(
        home,
        (arrays.observation_offsets, xy, tangent, arrays.kind_of_point, arrays.sigma),
        (grid.cell_m, grid.keys, grid.offsets, xy[order], tangent[order], far, weight[far]),
        (
            gate,
            kernel,
            config.max_longitudinal_m,
            np.cos(config.max_heading_rad),
            config.sigma_m,
            config.points_per_independent,
        ),
        stride,
    )
    columns = step_poses(arrays, home, (start, prior_mean, pose), sums, config)
    part = state.take(rows[home])
    part = replace(part, **columns)
    return part.take(np.array(sorted(range(len(part.ids)), key=lambda k: part.ids[k]), np.int64))


def merge_solutions(
    parts: Sequence[PoseSolution], config: PoseSolverConfig = DEFAULT_ALIGN, number: int | None = None
) -> PoseSolution:
    """Merge the home observations of all tiles after a step (None: the first search), ids ascending.

    After a sweep, update each agent's residual scale and weight. After the rejection passes, also update each drive's bias.
    """
    ids = [name for part in parts for name in part.ids]
    agents = [name for part in parts for name in part.agents]
    drives = [name for part in parts for name in part.drives]
    order = np.array(sorted(range(len(ids)), key=lambda k: ids[k]), np.int64)
    whole = PoseSolution(
        tuple(ids[k] for k in order.tolist()),
        tuple(agents[k] for k in order.tolist()),
        tuple(drives[k] for k in order.tolist()),
        *(np.concatenate([getattr(part, name) for part in parts])[order] for name in _COLUMNS),
    )
    step = None if number is None else config.schedule[number]
    if step is None or step.gate_and_kernel_m is None:
        return whole
    names, agent = np.unique(np.array(whole.agents), return_inverse=True)
    residual = np.bincount(agent, whole.residual, len(names))
    matched = np.bincount(agent, whole.num_matched, len(names))
    # A prior of 20 points keeps the scale of an agent without matches at 0.2 m.
    variance = (residual + 20.0 * 0.04) / (matched + 20.0)
    prior_covariance = whole.prior_covariance[:, :2, :2]
    observability = compute_observability(whole.covariance, prior_covariance)
    mean_variance = np.trace(prior_covariance, axis1=1, axis2=2) / 2
    gauge = (config.gauge_radius_m, config.rejection_gauge_scale if step.is_rejection_pass else config.gauge_scale)
    common = estimate_gauge_offset(
        (whole.initial_pose, whole.pose), observability, whole.gauge_weight * whole.agent_weight, mean_variance, gauge
    )
    offset = (whole.pose - whole.initial_pose)[:, :2] - common
    pose = whole.pose.copy()
    pose[:, :2] -= np.where(whole.is_surveyed[:, None] > 0, 0.0, common)
    limits = (
        config.agent_scale,
        config.rejection_agent_scale if step.is_rejection_pass else np.inf,
        config.drive_correlation,
    )
    agent_weight = estimate_agent_weights(offset + whole.search_shift, observability, mean_variance, agent, limits)
    # An agent that a rejection pass rejected stays rejected until the next one ends.
    stays_rejected = (whole.agent_weight <= REJECTED_WEIGHT) & (not step.reinstates)
    agent_weight = np.where(whole.is_surveyed > 0, 1.0, np.where(stays_rejected, REJECTED_WEIGHT, agent_weight))
    prior_mean = whole.prior_mean if step.is_rejection_pass else _estimate_prior_mean(whole, common, config)
    return replace(
        whole,
        pose=pose,
        relative_offset=offset,
        scale=np.sqrt(variance)[agent],
        agent_weight=agent_weight,
        prior_mean=prior_mean,
    )


def _estimate_prior_mean(whole: PoseSolution, common: Floats, config: PoseSolverConfig) -> Floats:
    """Estimate the mode of the prior (O, 3), relative to initial_pose, from the bias of each drive."""
    drive = np.unique(np.array(whole.drives), return_inverse=True)[1]
    from_claim = np.zeros((len(drive), 3))
    from_claim[:, :2] = whole.search_shift - common
    information_vector = whole.information_vector + np.einsum("oij,oj->oi", whole.information_matrix, from_claim)
    prior_mean = estimate_drive_bias(
        whole.information_matrix,
        information_vector,
        whole.prior_covariance,
        drive,
        config.drive_correlation,
        config.drive_scale,
    )
    prior_mean[:, :2] -= whole.search_shift
    return np.where(whole.is_surveyed[:, None] > 0, 0.0, prior_mean)


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
