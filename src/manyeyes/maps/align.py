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
    a direction stays as claimed. most: observations that count in a cell of 8 m, class and heading.
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
    gross: GrossConfig = field(default_factory=GrossConfig)


@dataclass(frozen=True, eq=False)
class Alignment:
    """Corrected poses, ids ascending: ids: (O,) hexadecimal. pose: (O, 3), covariance: (O, 3, 3) of it.

    start: (O, 3) after the gross search, the claimed pose where it moved nothing. scale: (O,) metres, how far the lines
    of the observation's agent lie from others' (robust). observability: (O, 3) from 0 (only the prior speaks) to 1,
    ascending, of the three directions of the pose. residual: (O,) and matched (O,): weighted square residual (m²) and
    number of points with neighbours.
    """

    ids: tuple[str, ...]
    agents: tuple[str, ...]
    start: Floats
    pose: Floats
    covariance: Floats
    scale: Floats
    observability: Floats
    residual: Floats
    matched: Floats

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


_COLUMNS = ("start", "pose", "covariance", "scale", "observability", "residual", "matched")


def solve_poses(observations: Sequence[Observation], config: AlignConfig = AlignConfig()) -> Alignment:
    """The corrected pose of each observation; a pure function of the set."""
    sightings = gather(observations, config.spacing_m)
    home = np.arange(len(sightings))
    state = search(sightings, home, config)
    for number in range(len(config.gates_m)):
        state = merge([sweep(sightings, state, number, home, config)])
    return state


def overlapping(
    observations: Sequence[Observation], home: Sequence[Observation], margin_m: float = 12.0
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
        pose,
        pose,
        np.array(sightings.covariance),
        np.full(count, 0.2),
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros(count),
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
    return replace(state, start=moved, pose=moved)


def sweep(
    sightings: Sightings, state: Alignment, number: int, home: Ints, config: AlignConfig = AlignConfig()
) -> Alignment:
    """The home observations after one more sweep; ``state`` holds all of the sightings after the sweep before."""
    rows = state.rows(sightings.ids)
    start, pose, scale = state.start[rows], state.pose[rows], state.scale[rows]
    keep = np.flatnonzero(bounded(sightings, start, config.most))
    xy, tangent = sightings.world(pose)
    weight = looks_weight(sightings, start, scale)
    grid = build_grid(xy[keep, 0], xy[keep, 1], sightings.kind[keep], 2.5)
    order = keep[grid.order]
    far = np.asarray(sightings.observation)[order]
    gate, kernel = config.gates_m[number], config.kernels_m[number]
    sums = _sweep(
        home,
        (sightings.first, xy, tangent, sightings.kind, sightings.sigma),
        (grid.keys, grid.start, xy[order], tangent[order], far, weight[far]),
        (gate, kernel, config.along_m, np.cos(config.heading_rad), config.sigma_m, config.correlation),
    )
    moved = _step(sightings, home, start, pose, sums, config)
    part = state.take(rows[home])
    part = replace(part, **moved)
    return part.take(np.array(sorted(range(len(part.ids)), key=lambda k: part.ids[k]), np.int64))


def merge(parts: Sequence[Alignment]) -> Alignment:
    """Home observations of all tiles as one, ids ascending, with each agent's scale from all its residuals."""
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
    return replace(whole, scale=np.sqrt(variance)[agent])


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


def looks_weight(sightings: Sightings, start: Floats, scale: Floats, radius_m: float = 30.0) -> Floats:
    """(O,) how much an observation's lines weigh for others: surveyed poles much, agents with odd lines and repeated
    looks little.
    """
    grid = build_grid(start[:, 0], start[:, 1], np.zeros(len(start), np.int64), radius_m)
    looks = _same_agent(start, np.asarray(sightings.agent), grid.keys, grid.start, grid.order, radius_m)
    usual = 1.0 / (1.0 + (scale / 0.2) ** 4)
    return np.where(sightings.trusted, 50.0, 2.0 * usual / looks)


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
def _sweep(home, own, others, numbers):  # pragma: no cover - compiled
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


def _step(
    sightings: Sightings, home: Ints, start: Floats, pose: Floats, sums: Floats, config: AlignConfig
) -> dict[str, Floats]:
    """The columns of an Alignment that a sweep changes, for the home rows."""
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
