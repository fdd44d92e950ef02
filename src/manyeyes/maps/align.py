# SPDX-License-Identifier: Apache-2.0
"""Where each observation really stood: one robust rigid motion an observation, that all its lines must agree on.

Stages 1 and 2 of specs/maps.md 3.4. Each sweep moves every observation a damped Gauss-Newton step towards the lines of
the others as they stood before the sweep (Jacobi), so that the order of observations does not matter. Residuals count
across lines only, along the mean normal of both lines, which has no bias on a bend; each point has at most one vote;
the prior is the claimed pose. What the lines cannot tell (along a straight road) stays as claimed.

A sweep of an observation reads only observations that overlap it. So a city is solved tile by tile with the result of
one piece: :func:`search` and each :func:`sweep` are run for the home observations of each tile, given all observations
that :func:`overlapping` names and the poses after the sweep before, and :func:`merge` joins the tiles' answers;
:func:`solve_poses` is that with one tile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from manyeyes.maps.associate import bound_observations, build_grid, cell_key, span
from manyeyes.maps.gross import GrossConfig, gross_search
from manyeyes.maps.observation import Observation
from manyeyes.maps.sightings import Sightings, gather

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BOUND_CELL_M = 8.0


@dataclass(frozen=True)
class AlignConfig:
    """gates_m: how far across a line a neighbour may be, one number a sweep; kernels_m: the Geman-McClure scale of each
    sweep.

    along_m, heading_rad: how far along and how turned a neighbour may be. sigma_m: what lines of other observations
    scatter. correlation: points of one line that count as one. damping: share of a step taken. prior_scale: corrections
    beyond about so many standard deviations stop pulling back. frozen_above: posterior over prior variance above which
    a direction stays as claimed. most: observations that count in a cell of 8 m, class and heading. gauge_m: within
    which distance what all were moved alike is taken back; gauge_scale: standard deviations beyond which a correction
    has little say in that; agent_scale: beyond which an agent's mean correction makes its lines weigh little.
    """

    spacing_m: float = 1.0
    gates_m: tuple[float, ...] = (2.0, 2.0, 1.6, 1.3, 1.0, 0.8, 0.8, 0.8)
    kernels_m: tuple[float, ...] = (0.8, 0.8, 0.6, 0.5, 0.4, 0.35, 0.35, 0.35)
    along_m: float = 1.0
    heading_rad: float = 0.31
    sigma_m: float = 0.2
    correlation: float = 8.0
    damping: float = 0.7
    prior_scale: float = 3.0
    frozen_above: float = 0.8
    most: int = 32
    gauge_m: float = 250.0
    gauge_scale: float = 1.0
    agent_scale: float = 2.0
    gross: GrossConfig = field(default_factory=GrossConfig)


@dataclass(frozen=True, eq=False)
class Alignment:
    """Corrected poses, ids ascending: ids: (O,) hexadecimal. pose: (O, 3), covariance: (O, 3, 3) of it.

    start: (O, 3) after the gross search, the claimed pose where it moved nothing. scale: (O,) metres, how far the lines
    of the observation's agent lie from others' (robust). observability: (O, 3) from 0 (only the prior speaks) to 1,
    ascending, of the three directions of the pose. residual: (O,) and matched (O,): weighted square residual (m²) and
    number of points with neighbours. offset: (O, 2) metres moved more than those around. faith: (O,) in (0, 1], how
    well the claims of the observation's agent and others' fit. claim: (O, 2, 2) covariance of the claimed place. voice:
    (O,) how much that claim counts for where all stand, 0 if the search moved it. fixed: (O,) 1 for surveyed poles.
    """

    ids: tuple[str, ...]
    agents: tuple[str, ...]
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

    def rows(self, ids: Sequence[str]) -> Ints:
        """Where these ids stand."""
        place = {name: k for k, name in enumerate(self.ids)}
        return np.array([place[name] for name in ids], np.int64)

    def take(self, rows: Ints) -> Alignment:
        """The chosen rows, in the order given."""
        return Alignment(
            tuple(self.ids[k] for k in rows.tolist()),
            tuple(self.agents[k] for k in rows.tolist()),
            *(getattr(self, name)[rows] for name in _COLUMNS),
        )


_STATE = ("claim", "start", "pose", "covariance", "scale", "observability", "residual", "matched")
_COLUMNS = (*_STATE, "offset", "faith", "voice", "fixed")


def solve_poses(observations: Sequence[Observation], config: AlignConfig = AlignConfig()) -> Alignment:
    """The corrected pose of each observation; a pure function of the set."""
    sightings = gather(observations, config.spacing_m)
    home = np.arange(len(sightings))
    state = merge([search(sightings, home, config)], config)
    for number in range(len(config.gates_m)):
        state = merge([sweep(sightings, state, number, home, config)], config)
    return state


def overlapping(
    observations: Sequence[Observation], home: Sequence[Observation], margin_m: float = 45.0
) -> list[Observation]:
    """Those of the observations that any sweep of the home observations reads, themselves included, ids ascending."""
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
        np.array(sightings.covariance)[:, :2, :2],
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
    )
    return start.take(np.array(sorted(range(count), key=lambda k: sightings.ids[k]), np.int64))


def search(sightings: Sightings, home: Ints, config: AlignConfig = AlignConfig()) -> Alignment:
    """The home observations (H,) rows of the sightings after the gross search, ids ascending."""
    keep = bounded(sightings, np.asarray(sightings.pose), config.most)
    found = gross_search(sightings, keep, home, config.gross)
    state = claimed(sightings)
    state = state.take(state.rows([sightings.ids[k] for k in home.tolist()]))
    place = state.rows([sightings.ids[k] for k in home.tolist()])
    moved = np.empty_like(found)
    moved[place] = found
    still = (moved == state.pose).all(1)
    return replace(state, start=moved, pose=moved, voice=np.where(still, state.voice, 0.0))


def sweep(
    sightings: Sightings, state: Alignment, number: int, home: Ints, config: AlignConfig = AlignConfig()
) -> Alignment:
    """The home observations after one more sweep; ``state`` holds all of the sightings after the sweep before."""
    rows = state.rows(sightings.ids)
    start, pose = state.start[rows], state.pose[rows]
    keep = np.flatnonzero(bounded(sightings, start, config.most))
    xy, tangent = sightings.world(pose)
    weight = looks_weight(sightings, start, state.scale[rows], state.faith[rows])
    grid = build_grid(xy[keep, 0], xy[keep, 1], sightings.kind[keep], 2.5)
    order = keep[grid.order]
    far = np.asarray(sightings.observation)[order]
    gate, kernel = config.gates_m[number], config.kernels_m[number]
    sums = normal_equations(
        home,
        (sightings.first, xy, tangent, sightings.kind, sightings.sigma),
        (grid.keys, grid.start, xy[order], tangent[order], far, weight[far]),
        (gate, kernel, config.along_m, np.cos(config.heading_rad), config.sigma_m, config.correlation),
    )
    moved = step_poses(sightings, home, (start, pose), sums, config)
    part = state.take(rows[home])
    part = replace(part, **moved)
    return part.take(np.array(sorted(range(len(part.ids)), key=lambda k: part.ids[k]), np.int64))


def merge(parts: Sequence[Alignment], config: AlignConfig = AlignConfig()) -> Alignment:
    """Home observations of all tiles as one, ids ascending, with each agent's scale and faith from all its residuals
    and offsets.
    """
    ids = [name for part in parts for name in part.ids]
    agents = [name for part in parts for name in part.agents]
    order = np.array(sorted(range(len(ids)), key=lambda k: ids[k]), np.int64)
    whole = Alignment(
        tuple(ids[k] for k in order.tolist()),
        tuple(agents[k] for k in order.tolist()),
        *(np.concatenate([getattr(part, name) for part in parts])[order] for name in _COLUMNS),
    )
    names, agent = np.unique(np.array(whole.agents), return_inverse=True)
    residual = np.bincount(agent, whole.residual, len(names))
    matched = np.bincount(agent, whole.matched, len(names))
    # Two points of prior knowledge keep an agent that nobody else saw at the usual scatter.
    variance = (residual + 20.0 * 0.04) / (matched + 20.0)
    told = _told(whole)
    common = _common_error(whole, told, config)
    offset = (whole.pose - whole.start)[:, :2] - common
    pose = whole.pose.copy()
    pose[:, :2] -= np.where(whole.fixed[:, None] > 0, 0.0, common)
    faith = _faith(offset, told, np.trace(whole.claim, axis1=1, axis2=2) / 2, agent, config.agent_scale)
    return replace(whole, pose=pose, offset=offset, scale=np.sqrt(variance)[agent], faith=faith)


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


def _told(whole: Alignment) -> Floats:
    """(O, 2, 2) from 0 (the lines tell nothing of the place in that direction) to the identity."""
    told = np.eye(2) - whole.covariance[:, :2, :2] @ np.linalg.inv(whole.claim)
    return (told + told.transpose(0, 2, 1)) / 2


def _faith(offset: Floats, told: Floats, variance: Floats, agent: Ints, scale: float) -> Floats:
    """(O,) in (0, 1]: small for agents whose claims are off alike, in the directions that lines told, by more than
    ``scale`` sigmas.

    The mean over an agent's observations tells more than any one of them: its noise averages out, its lie does not.
    """
    count = int(agent.max(initial=-1)) + 1
    weight, pull, usual = np.zeros((count, 2, 2)), np.zeros((count, 2)), np.zeros(count)
    np.add.at(weight, agent, told)
    np.add.at(pull, agent, _apply(told, offset))
    np.add.at(usual, agent, variance)
    mean = np.linalg.solve(weight + 0.1 * np.eye(2), pull[:, :, None])[:, :, 0]
    away = np.einsum("ai,aij,aj->a", mean, weight, mean).clip(0.0) / np.maximum(usual, 1e-12)
    return ((scale**2 / (scale**2 + away)) ** 2)[agent]


def _common_error(whole: Alignment, told: Floats, config: AlignConfig) -> Floats:
    """(O, 2) metres by which the observations around each one were moved alike, which nothing but chance explains.

    Lines tell where observations stand to each other; where all of them stand is told by their claims alone, whose
    errors have no common direction. So the mode of the corrections around is an error of all, and is taken back. It is
    a mode, not a mean: a fifth of agents who lie alike do not move it far. Each correction counts in the directions
    that lines told; one that the gross search moved does not.
    """
    grid = build_grid(whole.start[:, 0], whole.start[:, 1], np.zeros(len(told), np.int64), config.gauge_m)
    return _modes(
        whole.start,
        whole.pose[:, :2] - whole.start[:, :2],
        told,
        whole.voice * whole.faith,
        np.sqrt(np.trace(whole.claim, axis1=1, axis2=2) / 2),
        (grid.keys, grid.start, grid.order),
        (config.gauge_m, config.gauge_scale),
    )


@njit(cache=True, nogil=True)
def _modes(place, correction, told, weight, sigma, grid, numbers):  # pragma: no cover - compiled
    keys, start, order = grid
    radius, scale = numbers
    out = np.zeros((len(place), 2))
    for o in range(len(place)):
        ix, iy = int(np.floor(place[o, 0] / radius)), int(np.floor(place[o, 1] / radius))
        x, y = 0.0, 0.0
        for turn in range(6):
            # The scale narrows from where everything counts.
            c2 = (scale * max(1.0, 4.0 - turn)) ** 2
            # One quiet observation more, so that the mode of few is not a rumour.
            xx, xy, yy, bx, by = 1.0, 0.0, 1.0, 0.0, 0.0
            for dx in range(-1, 2):
                low, high = span(keys, start, 0, ix + dx, iy - 1, iy + 1)
                for k in range(low, high):
                    q = order[k]
                    far = ((place[q, 0] - place[o, 0]) ** 2 + (place[q, 1] - place[o, 1]) ** 2) / radius**2
                    if far >= 1.0 or weight[q] <= 0.0:
                        continue
                    t = told[q]
                    ex, ey = correction[q, 0] - x, correction[q, 1] - y
                    m2 = (ex * (t[0, 0] * ex + t[0, 1] * ey) + ey * (t[0, 1] * ex + t[1, 1] * ey)) / sigma[q] ** 2
                    g = c2 / (c2 + max(0.0, m2))
                    w = weight[q] * (1.0 - far) ** 2 * g * g
                    xx += w * t[0, 0]
                    xy += w * t[0, 1]
                    yy += w * t[1, 1]
                    bx += w * (t[0, 0] * correction[q, 0] + t[0, 1] * correction[q, 1])
                    by += w * (t[0, 1] * correction[q, 0] + t[1, 1] * correction[q, 1])
            determinant = xx * yy - xy * xy
            x, y = (yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant
        out[o, 0], out[o, 1] = x, y
    return out


def looks_weight(sightings: Sightings, start: Floats, scale: Floats, faith: Floats, radius_m: float = 30.0) -> Floats:
    """(O,) how much an observation's lines weigh for others: surveyed poles much, agents with odd lines and repeated
    looks little.
    """
    grid = build_grid(start[:, 0], start[:, 1], np.zeros(len(start), np.int64), radius_m)
    looks = _same_agent(start, np.asarray(sightings.agent), grid.keys, grid.start, grid.order, radius_m)
    usual = 1.0 / (1.0 + (scale / 0.2) ** 4)
    return np.where(sightings.trusted, 50.0, 2.0 * usual * faith / looks)


@njit(cache=True, nogil=True)
def _same_agent(pose, agent, keys, start, order, radius):  # pragma: no cover - compiled
    """How many looks of the same agent stand within a radius, each counted by 1 - (distance / radius)²; itself counts
    1.
    """
    looks = np.zeros(len(pose))
    for o in range(len(pose)):
        ix, iy = int(np.floor(pose[o, 0] / radius)), int(np.floor(pose[o, 1] / radius))
        for dx in range(-1, 2):
            low, high = span(keys, start, 0, ix + dx, iy - 1, iy + 1)
            for q in range(low, high):
                other = order[q]
                if agent[other] == agent[o]:
                    d = ((pose[other, 0] - pose[o, 0]) ** 2 + (pose[other, 1] - pose[o, 1]) ** 2) / radius**2
                    looks[o] += max(0.0, 1.0 - d)
    return looks


@njit(cache=True, nogil=True)
def normal_equations(home, own, others, numbers):  # pragma: no cover - compiled
    """Normal equations of each home observation: (H, 11) pivot x, y; information xx, xy, xt, yy, yt, tt; right side is
    last of (H, 14): then x, y, t of the gradient, residual sum, vote sum, points.
    """
    first, xy, tangent, kind, sigma = own
    keys, start, rxy, rtangent, robservation, rweight = others
    gate, kernel, reach, cosine, scatter, correlation = numbers
    out = np.zeros((len(home), 13))
    c2 = kernel * kernel
    for h in range(len(home)):
        o = home[h]
        a, b = first[o], first[o + 1]
        if a == b:
            continue
        px, py = xy[a:b, 0].mean(), xy[a:b, 1].mean()
        out[h, 0], out[h, 1] = px, py
        for p in range(a, b):
            x, y, u, v = xy[p, 0], xy[p, 1], tangent[p, 0], tangent[p, 1]
            ix, iy = int(np.floor(x / 2.5)), int(np.floor(y / 2.5))
            total, pull, square = 0.0, 0.0, 0.0
            for dx in range(-1, 2):
                low, high = span(keys, start, kind[p], ix + dx, iy - 1, iy + 1)
                for q in range(low, high):
                    ex, ey = rxy[q, 0] - x, rxy[q, 1] - y
                    if ex * ex + ey * ey > gate * gate + reach * reach or robservation[q] == o:
                        continue
                    dot = u * rtangent[q, 0] + v * rtangent[q, 1]
                    if abs(dot) < cosine:
                        continue
                    sign = 1.0 if dot > 0.0 else -1.0
                    norm = np.sqrt(2.0 + 2.0 * abs(dot))
                    mx, my = (u + sign * rtangent[q, 0]) / norm, (v + sign * rtangent[q, 1]) / norm
                    along, aside = abs(ex * mx + ey * my), ey * mx - ex * my
                    if along > reach or abs(aside) > gate:
                        continue
                    g = c2 / (c2 + aside * aside)
                    w = rweight[q] * g * g * (1.0 - along / reach)
                    total += w
                    pull += w * aside
                    square += w * aside * aside
            if total <= 0.0:
                continue
            vote = total / (total + 0.5)
            aside = pull / total
            w = vote / (correlation * (sigma[p] * sigma[p] + scatter * scatter))
            jx, jy = -v, u
            jt = -jx * (y - py) + jy * (x - px)
            out[h, 2] += w * jx * jx
            out[h, 3] += w * jx * jy
            out[h, 4] += w * jx * jt
            out[h, 5] += w * jy * jy
            out[h, 6] += w * jy * jt
            out[h, 7] += w * jt * jt
            out[h, 8] += w * jx * aside
            out[h, 9] += w * jy * aside
            out[h, 10] += w * jt * aside
            out[h, 11] += vote * aside * aside
            out[h, 12] += vote
    return out


def step_poses(
    sightings: Sightings, home: Ints, at: tuple[Floats, Floats], sums: Floats, config: AlignConfig
) -> dict[str, Floats]:
    """The columns of an Alignment that a sweep changes, for the home rows."""
    start, pose = at
    prior = np.asarray(sightings.covariance)[home]
    pivot, now, begin = sums[:, :2], pose[home], start[home]
    jacobian = np.tile(np.eye(3), (len(home), 1, 1))
    jacobian[:, 0, 2] = -(now[:, 1] - pivot[:, 1])
    jacobian[:, 1, 2] = now[:, 0] - pivot[:, 0]
    information = sums[:, [2, 3, 4, 3, 5, 6, 4, 6, 7]].reshape(-1, 3, 3)
    gradient = sums[:, 8:11]
    off = now - begin
    off[:, 2] = (off[:, 2] + np.pi) % (2 * np.pi) - np.pi
    # In units in which the prior is a unit ball the data's information tells directly how much it adds to the prior.
    inverse = np.linalg.inv(jacobian)
    root = np.linalg.cholesky(inverse @ prior @ inverse.transpose(0, 2, 1))
    root_t = root.transpose(0, 2, 1)
    strength, axes = np.linalg.eigh(root_t @ information @ root)
    strength = np.maximum(strength, 0.0)
    axes_t = axes.transpose(0, 2, 1)
    speaks = 1.0 / (1.0 + strength) <= config.frozen_above
    weighted = np.linalg.solve(prior, off[:, :, None])[:, :, 0]
    distance = np.einsum("oi,oi->o", off, weighted)
    trust = (config.prior_scale**2 / (config.prior_scale**2 + distance)) ** 2
    pull = _apply(axes_t, _apply(root_t, gradient)) * speaks
    back = _apply(axes_t, _apply(root_t, _apply(jacobian.transpose(0, 2, 1), weighted))) * trust[:, None]
    step = _apply(root, _apply(axes, (pull - back) / (strength * speaks + trust[:, None]))) * config.damping
    step = np.clip(step, (-1.0, -1.0, -0.05), (1.0, 1.0, 0.05))
    step[np.asarray(sightings.trusted)[home]] = 0.0
    c, s = np.cos(step[:, 2]), np.sin(step[:, 2])
    ax, ay = (now[:, :2] - pivot).T
    after = np.stack(
        (
            pivot[:, 0] + c * ax - s * ay + step[:, 0],
            pivot[:, 1] + s * ax + c * ay + step[:, 1],
            now[:, 2] + step[:, 2],
        ),
        1,
    )
    spread = jacobian @ root @ axes
    covariance = (spread / (1.0 + strength * speaks)[:, None, :]) @ spread.transpose(0, 2, 1)
    return {
        "pose": after,
        "covariance": (covariance + covariance.transpose(0, 2, 1)) / 2,
        "observability": np.sort(strength * speaks / (1.0 + strength), axis=1),
        "residual": sums[:, 11],
        "matched": sums[:, 12],
    }


def _apply(matrix: NDArray, vector: NDArray) -> Floats:
    return np.einsum("oij,oj->oi", matrix, vector)


def _reach(o: Observation) -> float:
    points = np.concatenate((o.view, o.elements.points))
    return float(np.hypot(points[:, 0], points[:, 1]).max())
