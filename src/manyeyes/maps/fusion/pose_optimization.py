# SPDX-License-Identifier: Apache-2.0
"""Where each observation really stood: one robust rigid motion an observation, that all its lines must agree on.

Stages 1 and 2 of specs/maps.md 3.4. Each sweep moves every observation a damped Gauss-Newton step towards the lines of
the others as they stood before the sweep (Jacobi), so that the order of observations does not matter. Residuals count
across lines only, along the mean normal of both lines, which has no bias on a bend; each point has at most one vote;
the prior is the claimed pose, less what the lines around its other looks tell of its drive (drive_error). What no line
tells (along a straight road) stays as claimed.

It is done three times. A few sweeps, the trial, tell whose claims are off alike by more than honest errors explain; then
all begins again from the claims, and those agents pull nobody. So a lie that was found out leaves no trace, neither in the
search nor in poses that have come halfway back. The second trial is held among those who were believed, and judges all
anew at its end: whom liars had made look a liar is heard again. Once liars are out, the mode of corrections that is taken
back is wider, which errs less.

A step of an observation reads only observations that overlap it. So a city is solved tile by tile with the result of
one piece: :func:`search` and each :func:`advance` are run for the home observations of each tile, given all
observations that :func:`overlapping` names and the poses after the step before, and :func:`merge` joins the tiles'
answers; :func:`solve_poses` is that with one tile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion.agent_weights import NOT_BELIEVED, common_error, faith_of, looks_weight, told_by_lines
from manyeyes.maps.fusion.coarse_search import gross_search
from manyeyes.maps.fusion.drive_bias import drive_error
from manyeyes.maps.fusion.gauss_newton import normal_equations, step_poses
from manyeyes.maps.fusion.observation_arrays import Sightings, gather
from manyeyes.maps.fusion.point_grid import bound_observations, build_grid, cell_key
from manyeyes.maps.fusion.pose_config import DEFAULT_ALIGN, AlignConfig

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BOUND_CELL_M = 8.0
_SWEEP_CELL_M = 1.0


@dataclass(frozen=True, eq=False)
class Alignment:
    """Corrected poses, ids ascending: ids: (O,) hexadecimal. pose: (O, 3), covariance: (O, 3, 3) of it.

    start: (O, 3) after the gross search, the claimed pose where it moved nothing. scale: (O,) metres, how far the lines
    of the observation's agent lie from others' (robust). observability: (O, 3) from 0 (only the prior speaks) to 1,
    ascending, of the three directions of the pose. residual: (O,) and matched (O,): weighted square residual (m²) and
    number of points with neighbours. offset: (O, 2) metres moved more than those around. faith: (O,) in (0, 1], how
    well the claims of the observation's agent and others' fit. claim: (O, 3, 3) covariance of the claimed pose. voice:
    (O,) how much that claim counts for where all stand, 0 if the search moved it. fixed: (O,) 1 for surveyed poles.
    moved: (O, 2) metres that the gross search moved. heard: (O, 3, 3) and urge (O, 3): information of the lines on the
    pose, and that times the move from start that they ask for. lean: (O, 3) from start, where the prior has its mode.
    drives: (O,) names of drives, each one agent's.
    """

    ids: tuple[str, ...]
    agents: tuple[str, ...]
    drives: tuple[str, ...]
    claim: Floats
    start: Floats
    pose: Floats
    covariance: Floats
    scale: Floats
    observability: Floats
    residual: Floats
    matched: Floats
    offset: Floats
    faith: Floats
    voice: Floats
    fixed: Floats
    moved: Floats
    heard: Floats
    urge: Floats
    lean: Floats

    def rows(self, ids: Sequence[str]) -> Ints:
        """Where these ids stand."""
        place = {name: k for k, name in enumerate(self.ids)}
        return np.array([place[name] for name in ids], np.int64)

    def take(self, rows: Ints) -> Alignment:
        """The chosen rows, in the order given."""
        return Alignment(
            tuple(self.ids[k] for k in rows.tolist()),
            tuple(self.agents[k] for k in rows.tolist()),
            tuple(self.drives[k] for k in rows.tolist()),
            *(getattr(self, name)[rows] for name in _COLUMNS),
        )


_STATE = ("claim", "start", "pose", "covariance", "scale", "observability", "residual", "matched")
_COLUMNS = (*_STATE, "offset", "faith", "voice", "fixed", "moved", "heard", "urge", "lean")


def solve_poses(observations: Sequence[Observation], config: AlignConfig = DEFAULT_ALIGN) -> Alignment:
    """The corrected pose of each observation; a pure function of the set."""
    sightings = gather(observations, config.spacing_m)
    home = np.arange(len(sightings))
    state = merge([search(sightings, home, config)], config)
    keep = None
    for number in range(config.steps):
        if number == 0 or config.schedule[number - 1].width is None:  # after a search, which alone moves the starts
            keep = bounded(sightings, state.start[state.rows(sightings.ids)], config.most)
        state = merge([advance(sightings, state, number, home, config, keep)], config, number)
    return state


def overlapping(
    observations: Sequence[Observation], home: Sequence[Observation], margin_m: float = 45.0
) -> list[Observation]:
    """Those of the observations that any step of the home observations reads, themselves included, ids ascending."""
    if not len(home):
        return []
    reach = {o.id: _reach(o) for o in (*observations, *home)}
    xy = np.array([o.pose[:2] for o in observations]).reshape(-1, 2)
    radius = np.array([reach[o.id] for o in observations])
    chosen = np.zeros(len(observations), bool)
    for o in home:
        near = np.hypot(*(xy - o.pose[:2]).T)
        # A cell that a home point lies in keeps its best observations among all that have a point in it.
        chosen |= near <= radius + reach[o.id] + margin_m + _BOUND_CELL_M * np.sqrt(2.0)
    return sorted((observations[k] for k in np.flatnonzero(chosen).tolist()), key=lambda o: o.id)


def claimed(sightings: Sightings) -> Alignment:
    """The observations where they claim to stand, ids ascending."""
    count = len(sightings)
    pose = np.array(sightings.pose)
    start = Alignment(
        sightings.ids,
        tuple(sightings.agents[a] for a in sightings.agent.tolist()),
        sightings.drives,
        np.array(sightings.covariance),
        pose,
        pose,
        np.array(sightings.covariance),
        np.full(count, 0.2),
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros(count),
        np.zeros((count, 2)),
        np.ones(count),
        looks_weight(sightings, pose, np.zeros(count), np.ones(count)),
        np.asarray(sightings.trusted).astype(np.float64),
        np.zeros((count, 2)),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
    )
    return start.take(np.array(sorted(range(count), key=lambda k: sightings.ids[k]), np.int64))


def search(sightings: Sightings, home: Ints, config: AlignConfig = DEFAULT_ALIGN) -> Alignment:
    """The home observations (H,) rows of the sightings after the gross search, ids ascending."""
    state = _of(claimed(sightings), sightings, home)
    rows = _rows_in(sightings, state)
    keep = bounded(sightings, np.asarray(sightings.pose), config.most)
    return _searched(state, gross_search(sightings, keep, rows, config.gross))


def advance(
    sightings: Sightings,
    state: Alignment,
    number: int,
    home: Ints,
    config: AlignConfig = DEFAULT_ALIGN,
    keep: NDArray[np.bool_] | None = None,
) -> Alignment:
    """The home observations after one more step, ids ascending; ``state`` holds all of the sightings after the step
    before. keep: (P,) the points that count in a sweep, :func:`bounded` at the state's starts; None: found here.
    """
    step = config.schedule[number]
    if step.width is None:
        return _search_again(sightings, state, home, config)
    if keep is None:
        keep = bounded(sightings, state.start[state.rows(sightings.ids)], config.most)
    return _sweep(sightings, state, np.flatnonzero(keep), (*step.width, step.stride), home, config)


def _search_again(sightings: Sightings, state: Alignment, home: Ints, config: AlignConfig) -> Alignment:
    """The home observations where they claim to stand, or where the search finds them among those alone who are believed now:
    the others leave no trace.
    """
    begun = _of(claimed(sightings), sightings, home)
    begun = replace(begun, faith=np.where(_of(state, sightings, home).faith > NOT_BELIEVED, 1.0, NOT_BELIEVED))
    keep = bounded(sightings, np.asarray(sightings.pose), config.most)
    keep &= (state.faith[state.rows(sightings.ids)] > NOT_BELIEVED)[sightings.observation]
    return _searched(begun, gross_search(sightings, keep, _rows_in(sightings, begun), config.gross))


def _of(state: Alignment, sightings: Sightings, home: Ints) -> Alignment:
    """The rows of a state that are at home, ids ascending."""
    return state.take(state.rows(sorted(sightings.ids[k] for k in home.tolist())))


def _rows_in(sightings: Sightings, state: Alignment) -> Ints:
    """Where the state's observations stand among the sightings."""
    place = {name: k for k, name in enumerate(sightings.ids)}
    return np.array([place[name] for name in state.ids], np.int64)


def _searched(state: Alignment, found: Floats) -> Alignment:
    """A state at the claimed poses, moved to those that the search found."""
    still = (found == state.pose).all(1)
    moved = (found - state.pose)[:, :2]
    return replace(state, start=found, pose=found, voice=np.where(still, state.voice, 0.0), moved=moved)


def _sweep(
    sightings: Sightings, state: Alignment, keep: Ints, width: tuple[float, float, int], home: Ints, config: AlignConfig
) -> Alignment:
    """The home observations after one sweep with this gate, kernel and stride among the points ``keep``."""
    gate, kernel, stride = width
    rows = state.rows(sightings.ids)
    start, lean, pose = state.start[rows], state.lean[rows], state.pose[rows]
    xy, tangent = sightings.world(pose)
    weight = looks_weight(sightings, start, state.scale[rows], state.faith[rows])
    grid = build_grid(xy[keep, 0], xy[keep, 1], sightings.kind[keep], _SWEEP_CELL_M)
    order = keep[grid.order]
    far = np.asarray(sightings.observation)[order]
    sums = normal_equations(
        home,
        (sightings.first, xy, tangent, sightings.kind, sightings.sigma),
        (grid.cell_m, grid.keys, grid.start, xy[order], tangent[order], far, weight[far]),
        (gate, kernel, config.along_m, np.cos(config.heading_rad), config.sigma_m, config.correlation),
        stride,
    )
    moved = step_poses(sightings, home, (start, lean, pose), sums, config)
    part = state.take(rows[home])
    part = replace(part, **moved)
    return part.take(np.array(sorted(range(len(part.ids)), key=lambda k: part.ids[k]), np.int64))


def merge(parts: Sequence[Alignment], config: AlignConfig = DEFAULT_ALIGN, number: int | None = None) -> Alignment:
    """Home observations of all tiles as one after a step (None: the first search), ids ascending; after a sweep with
    each agent's scale from all its residuals and its faith from all its offsets, after the trial with each drive's error.
    """
    ids = [name for part in parts for name in part.ids]
    agents = [name for part in parts for name in part.agents]
    drives = [name for part in parts for name in part.drives]
    order = np.array(sorted(range(len(ids)), key=lambda k: ids[k]), np.int64)
    whole = Alignment(
        tuple(ids[k] for k in order.tolist()),
        tuple(agents[k] for k in order.tolist()),
        tuple(drives[k] for k in order.tolist()),
        *(np.concatenate([getattr(part, name) for part in parts])[order] for name in _COLUMNS),
    )
    step = None if number is None else config.schedule[number]
    if step is None or step.width is None:
        return whole
    names, agent = np.unique(np.array(whole.agents), return_inverse=True)
    residual = np.bincount(agent, whole.residual, len(names))
    matched = np.bincount(agent, whole.matched, len(names))
    # Two points of prior knowledge keep an agent that nobody else saw at the usual scatter.
    variance = (residual + 20.0 * 0.04) / (matched + 20.0)
    claim = whole.claim[:, :2, :2]
    told = told_by_lines(whole.covariance, claim)
    usual = np.trace(claim, axis1=1, axis2=2) / 2
    gauge = (config.gauge_m, config.trial_gauge_scale if step.trial else config.gauge_scale)
    common = common_error((whole.start, whole.pose), told, whole.voice * whole.faith, usual, gauge)
    offset = (whole.pose - whole.start)[:, :2] - common
    pose = whole.pose.copy()
    pose[:, :2] -= np.where(whole.fixed[:, None] > 0, 0.0, common)
    limits = (config.agent_scale, config.agent_limit if step.trial else np.inf, config.alike)
    faith = faith_of(offset + whole.moved, told, usual, agent, limits)
    # Whom a trial did not believe is not heard until the next one ends.
    silent = (whole.faith <= NOT_BELIEVED) & (not step.judges)
    faith = np.where(whole.fixed > 0, 1.0, np.where(silent, NOT_BELIEVED, faith))
    lean = whole.lean if step.trial else _lean(whole, common, config)
    return replace(whole, pose=pose, offset=offset, scale=np.sqrt(variance)[agent], faith=faith, lean=lean)


def _lean(whole: Alignment, common: Floats, config: AlignConfig) -> Floats:
    """(O, 3) from start, where each observation stands by its claim and the error of its drive."""
    drive = np.unique(np.array(whole.drives), return_inverse=True)[1]
    from_claim = np.zeros((len(drive), 3))
    from_claim[:, :2] = whole.moved - common
    urge = whole.urge + np.einsum("oij,oj->oi", whole.heard, from_claim)
    lean = drive_error(whole.heard, urge, whole.claim, drive, config.alike, config.drive_scale)
    lean[:, :2] -= whole.moved
    return np.where(whole.fixed[:, None] > 0, 0.0, lean)


def bounded(sightings: Sightings, pose: Floats, most: int) -> NDArray[np.bool_]:
    """Which points (P,) count when the agents stand at pose (O, 3): at most ``most`` observations a class, heading and
    cell of 8 m.
    """
    xy, tangent = sightings.world(pose)
    bins = np.floor(np.arctan2(tangent[:, 1], tangent[:, 0]) / np.pi % 1.0 * 6.0).astype(np.int64) % 6
    key = cell_key(np.zeros(len(xy), np.int64), xy[:, 0], xy[:, 1], _BOUND_CELL_M) * 32 + bins * 4 + sightings.kind
    information = -np.trace(np.asarray(sightings.covariance)[:, :2, :2], axis1=1, axis2=2)
    ids = np.array(sightings.ids)
    order = np.lexsort((ids, -np.asarray(sightings.time_ns), -information, ~np.asarray(sightings.trusted)))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return bound_observations(key, np.asarray(sightings.observation), np.asarray(sightings.agent), rank, most)


def _reach(o: Observation) -> float:
    points = np.concatenate((o.view, o.elements.points))
    return float(np.hypot(points[:, 0], points[:, 1]).max())
