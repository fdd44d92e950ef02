# SPDX-License-Identifier: Apache-2.0
"""What speaks for and against each station of a map: who saw it, who could have and did not, in the order of time.

Stages 4 and 7 of specs/maps.md 3.4. A station gains log(P_D / P_FA) for an observation that has a line there, or a
share of it where that agent's model was not sure of the line, and loses visibility times log((1 - P_FA) / (1 - P_D))
for one that could see the place and has none; a line a little aside says neither. Each agent's sum of a day is capped,
so that one busy or malicious agent cannot decide. It is published and retired with hysteresis. Clear views of the place
before the first sighting count against it too, but only down to ``doubt``: what many looked for in vain and one saw is
more likely false than new, and still a few who agree suffice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import njit
from manyeyes.maps.fusion.observation_arrays import Sightings, is_line, sight
from manyeyes.maps.fusion.point_grid import build_grid, lower_bound, span

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_LOOK_CELL_M = 32.0
_DAY_S = 86400.0


@dataclass(frozen=True)
class EvidenceConfig:
    """detection, false_alarm: P_D and P_FA. clamp: largest |log-odds|; doubt: before the first sighting. daily: largest
    change one agent makes in a day. unsure, sure: scores of an element below which a sighting adds nothing and above
    which it adds all; in between, a share.

    publish: log-odds at which a station is published, given publish_agents distinct agents or a surveyed pole;
    publish_ring: the same of a crossing; publish_seldom: of a line's station that was in view at most ``seldom`` times
    (summed visibility), which few could have confirmed. retire: at which it is retired, given retire_agents distinct
    agents that missed it. margin_m: of a view, within which a miss counts less. decay_s: by kind, seconds in which
    evidence fades to 1/e. along_m, across_m, heading_rad: when a line is at the station; aside_m: when it may be.
    kernel_m: Geman-McClure scale of the place across. bias_m: error that no number of observations removes.
    """

    detection: float = 0.7
    false_alarm: float = 0.15
    clamp: float = 6.0
    doubt: float = 2.0
    daily: float = 2.0
    unsure: float = 0.4
    sure: float = 0.7
    publish: float = 2.2
    publish_ring: float = 2.2
    publish_seldom: float = 2.2
    seldom: float = 3.0
    publish_agents: int = 2
    retire: float = -1.4
    retire_agents: int = 3
    margin_m: float = 2.0
    decay_s: tuple[float, float, float, float] = (180 * _DAY_S, 180 * _DAY_S, 365 * _DAY_S, 180 * _DAY_S)
    along_m: float = 1.5
    across_m: float = 0.9
    aside_m: float = 1.2
    heading_rad: float = 0.35
    kernel_m: float = 0.5
    bias_m: float = 0.05

    @property
    def hit(self) -> float:
        """What a sighting adds."""
        return float(np.log(self.detection / self.false_alarm))

    def worth(self, score: Floats) -> Floats:
        """(E,) which share of ``hit`` a sighting of an element of that score adds."""
        return np.clip((np.asarray(score) - self.unsure) / (self.sure - self.unsure), 0.0, 1.0)

    def publish_from(self, kind: Ints) -> Floats:
        """(K,) log-odds at which something of that kind is published."""
        return np.where(is_line(kind), self.publish, self.publish_ring)

    @property
    def miss(self) -> float:
        """What a clear view without a sighting adds; negative."""
        return float(np.log((1 - self.detection) / (1 - self.false_alarm)))

    @property
    def numbers(self) -> Floats:
        """The numbers that the compiled loops read, in their order."""
        gates = (self.along_m, self.across_m, self.aside_m, float(np.cos(self.heading_rad)), self.kernel_m, self.bias_m)
        sums = (self.hit, self.miss, self.clamp, self.daily, self.publish, self.retire, self.margin_m)
        return np.array((*sums, *gates, self.doubt))


@dataclass(frozen=True, eq=False)
class Looks:
    """Which observations may see a place: rows ``of[start[c]:start[c + 1]]``, in time order, for the cell with key
    ``keys[c]``.
    """

    keys: Ints
    start: Ints
    of: Ints


@dataclass(frozen=True, eq=False)
class Witness:
    """Evidence of K stations. shift: (K,) metres along the normal to where the observations agree; sigma: (K,).

    log_odds, coverage: (K,), coverage the sum of visibilities. support, agents: (K,). state: (K,). t_first, t_last:
    (K,) ns. style: (K, S) votes. Station k was seen by observations ``sources[first[k]:first[k + 1]]``, rows of the
    sightings.
    """

    shift: Floats
    sigma: Floats
    log_odds: Floats
    coverage: Floats
    support: Ints
    agents: Ints
    state: Ints
    t_first: Ints
    t_last: Ints
    style: Floats
    first: Ints
    sources: Ints


def looks(sightings: Sightings, pose: Floats, heard: NDArray[np.bool_] | None = None) -> Looks:
    """The index of who may see what, by cells of 32 m that each view's box meets, for agents at pose (O, 3); heard: (O,) who
    is in it, None: all.
    """
    xy, first, of = sightings.view.xy, sightings.view.first, sightings.view.of
    owner = np.repeat(np.repeat(np.arange(len(of) - 1), np.diff(of)), np.diff(first))
    c, s = np.cos(pose[owner, 2]), np.sin(pose[owner, 2])
    placed = np.stack((c * xy[:, 0] - s * xy[:, 1], s * xy[:, 0] + c * xy[:, 1]), 1) + pose[owner, :2]
    low, high = np.full((len(pose), 2), np.inf), np.full((len(pose), 2), -np.inf)
    np.minimum.at(low, owner, placed)
    np.maximum.at(high, owner, placed)
    cell, who = _cells(np.floor(low / _LOOK_CELL_M).astype(np.int64), np.floor(high / _LOOK_CELL_M).astype(np.int64))
    if heard is not None:
        cell, who = cell[heard[who]], who[heard[who]]
    order = np.lexsort((who, cell))
    keys, start = np.unique(cell[order], return_index=True)
    return Looks(keys, np.append(start, len(order)).astype(np.int64), who[order])


@njit(cache=True, nogil=True)
def _cells(low, high):  # pragma: no cover - compiled
    total = 0
    for o in range(len(low)):
        total += (high[o, 0] - low[o, 0] + 1) * (high[o, 1] - low[o, 1] + 1)
    cell, who = np.empty(total, np.int64), np.empty(total, np.int64)
    k = 0
    for o in range(len(low)):
        for ix in range(low[o, 0], high[o, 0] + 1):
            for iy in range(low[o, 1], high[o, 1] + 1):
                cell[k] = ((ix + 536870912) << 30) | (iy + 536870912)
                who[k] = o
                k += 1
    return cell, who


def witnesses(sightings: Sightings, pose: Floats) -> tuple[Floats, Ints, Ints, NDArray[np.bool_], int]:
    """Who looks, as the compiled loops read it: pose (O, 3), agent, time, trust (O,) and the number of agents."""
    arrays = (np.asarray(sightings.agent), np.asarray(sightings.time_ns), np.asarray(sightings.trusted))
    return (np.ascontiguousarray(pose), *arrays, len(sightings.agents))


def sights(sightings: Sightings) -> tuple[tuple[Floats, Ints, Ints], tuple[Floats, Ints, Ints]]:
    """Views and occluders, as the compiled loops read them."""
    view, hidden = sightings.view, sightings.occluders
    return (view.xy, view.first, view.of), (hidden.xy, hidden.first, hidden.of)


def witness(
    xy: Floats,
    tangent: Floats,
    kind: Ints,
    sightings: Sightings,
    pose: Floats,
    weight: Floats,
    believed: NDArray[np.bool_],
    config: EvidenceConfig = EvidenceConfig(),
) -> Witness:
    """The evidence for line stations (K,) at xy with unit tangents, from all sightings with agents at pose (O, 3).

    ``weight`` (P,) is how much each point of the sightings counts for the place across, 0: it is not there; what it is seen
    counts once an observation. believed: (O,) whose word that something is not there counts.
    """
    points = np.flatnonzero(is_line(sightings.kind) & (weight > 0.0))
    world, direction = sightings.world(pose)
    grid = build_grid(world[points, 0], world[points, 1], sightings.kind[points], 2.5)
    order = points[grid.order]
    index = looks(sightings, pose, believed)
    out = _witness(
        (xy, tangent, kind),
        (
            grid.keys,
            grid.start,
            world[order],
            direction[order],
            sightings.observation[order],
            sightings.element[order],
            weight[order],
        ),
        (index.keys, index.start, index.of),
        witnesses(sightings, pose),
        sights(sightings),
        (np.asarray(sightings.elements.style), config.worth(sightings.elements.score)),
        config.numbers,
        (config.publish_agents, config.retire_agents),
        np.array(config.decay_s),
    )
    return Witness(*out)


@njit(cache=True, nogil=True)
def _witness(stations, others, index, who, sights, told, numbers, least, decay):  # pragma: no cover - compiled
    xy, tangent, kind = stations
    style, worth = told
    count, observations = len(xy), len(who[0])
    shift, sigma, odds, coverage = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
    support, agents, state = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count, np.int64)
    t_first, t_last = np.zeros(count, np.int64), np.zeros(count, np.int64)
    votes = np.zeros((count, style.shape[1]))
    first, sources, filled = np.zeros(count + 1, np.int64), np.empty(max(16, 8 * count), np.int64), 0
    mass, offset, pull = np.zeros(observations), np.zeros(observations), np.zeros(observations)
    nearest, element, gain = np.zeros(observations), np.zeros(observations, np.int64), np.zeros(observations)
    aside_of = np.zeros(observations, np.int64)  # 1: a line at the station, 2: one a little aside
    touched, place = np.empty(observations, np.int64), np.empty((1, 2))
    book = np.zeros((who[4], 4))
    stamp = np.zeros((who[4], 4), np.int64)
    for k in range(count):
        n = _collect(k, stations, others, numbers, (mass, offset, pull, nearest, element, aside_of, touched))
        # Sums over observations go in their order, whatever order the grid gave.
        touched[:n].sort()
        shift[k], sigma[k] = _agree(n, touched, aside_of, mass, offset, pull, numbers)
        for t in range(n):
            o = touched[t]
            if aside_of[o] == 1 and abs(offset[o] / mass[o] - shift[k]) > numbers[8]:
                aside_of[o] = 2
        # Only now is it known which of them are at the place that they agree on.
        for t in range(n):
            o = touched[t]
            if aside_of[o] == 1:
                if filled == len(sources):
                    bigger = np.empty(2 * filled, np.int64)
                    bigger[:filled] = sources
                    sources = bigger
                sources[filled] = o
                filled += 1
                votes[k] += style[element[o]]
                gain[o] = worth[element[o]]
        first[k + 1] = filled
        place[0, 0], place[0, 1] = xy[k, 0] - shift[k] * tangent[k, 1], xy[k, 1] + shift[k] * tangent[k, 0]
        odds[k], coverage[k], agents[k], state[k] = fold_looks(
            place,
            k,
            sources[first[k] : filled],
            (aside_of, gain),
            index,
            who,
            sights,
            numbers,
            least,
            decay[kind[k]],
            book,
            stamp,
        )
        support[k] = filled - first[k]
        if support[k] > 0:
            t_first[k], t_last[k] = who[2][sources[first[k]]], who[2][sources[filled - 1]]
        for t in range(n):
            o = touched[t]
            mass[o], offset[o], pull[o], aside_of[o] = 0.0, 0.0, 0.0, 0
    return shift, sigma, odds, coverage, support, agents, state, t_first, t_last, votes, first, sources[:filled].copy()


@njit(cache=True, nogil=True)
def _collect(k, stations, others, numbers, scratch):  # pragma: no cover - compiled
    """Each observation's place across station k, averaged over its points near; the number of observations that have
    any.
    """
    xy, tangent, kind = stations
    keys, start, rxy, rtangent, robservation, relement, rweight = others
    mass, offset, pull, nearest, element, aside_of, touched = scratch
    reach, across, wide, cosine = numbers[7], numbers[8], numbers[9], numbers[10]
    x, y, u, v = xy[k, 0], xy[k, 1], tangent[k, 0], tangent[k, 1]
    ix, iy = int(np.floor(x / 2.5)), int(np.floor(y / 2.5))
    n = 0
    for dx in range(-1, 2):
        low, high = span(keys, start, kind[k], ix + dx, iy - 1, iy + 1)
        for q in range(low, high):
            ex, ey = rxy[q, 0] - x, rxy[q, 1] - y
            if ex * ex + ey * ey > reach * reach + wide * wide:
                continue
            dot = u * rtangent[q, 0] + v * rtangent[q, 1]
            if abs(dot) < cosine:
                continue
            sign = 1.0 if dot > 0.0 else -1.0
            norm = np.sqrt(2.0 + 2.0 * abs(dot))
            mx, my = (u + sign * rtangent[q, 0]) / norm, (v + sign * rtangent[q, 1]) / norm
            along, aside = abs(ex * mx + ey * my), ey * mx - ex * my
            if along > reach or abs(aside) > wide:
                continue
            o = robservation[q]
            if aside_of[o] == 0:
                touched[n] = o
                n += 1
                aside_of[o] = 2
                nearest[o] = np.inf
            if abs(aside) > across:
                continue
            aside_of[o] = 1
            # The nearest points decide: weights fall steeply, so that two points astride the station interpolate.
            w = (1.0 - along / reach) ** 2 + 1e-9
            mass[o] += w
            offset[o] += w * aside
            pull[o] += w * rweight[q]
            if along < nearest[o]:
                nearest[o] = along
                element[o] = relement[q]
    return n


@njit(cache=True, nogil=True)
def _agree(n, touched, aside_of, mass, offset, pull, numbers):  # pragma: no cover - compiled
    """Where across the station the observations agree, and its sigma: reweighted means, one contribution an
    observation.
    """
    kernel, floor = numbers[11], numbers[12]
    place, spread = 0.0, 1.0
    for turn in range(4):
        total, aside, information = 0.0, 0.0, 0.0
        # The kernel narrows from the gate's width, so that the start, which may lie between two lines, decides little.
        c2 = (kernel * (2.0 if turn == 0 else 1.0)) ** 2
        for i in range(n):
            o = touched[i]
            if aside_of[o] == 1:
                d = offset[o] / mass[o]
                g = c2 / (c2 + (d - place) ** 2)
                w = pull[o] / mass[o] * g * g
                total += w
                aside += w * d
                information += w * g
        if total <= 0.0:
            return 0.0, 1.0
        place = aside / total
        spread = np.sqrt(1.0 / max(information, 1e-9) + floor * floor)
    return place, spread


@njit(cache=True, nogil=True)
def fold_looks(
    places, k, hits, found_by, index, who, sights, numbers, least, decay, book, stamp
):  # pragma: no cover - compiled
    """Log-odds, coverage, distinct agents and state of one thing after all looks at it, in time order.

    ``places`` (M, 2) are points of it whose visibilities are averaged. ``hits`` are the rows that saw it, ascending;
    ``found_by`` tells for each row whether it saw it (1) or something a little aside (2), and what share of a hit that
    is worth.
    Scratch by agent: ``book`` holds the sum of a day; ``stamp`` the thing and day of that sum, and when it last counted
    as a supporter and as a witness of absence.
    """
    agent, time_ns, trusted = who[1], who[2], who[3]
    aside_of, worth = found_by
    hit, miss, clamp, daily, publish, retire = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5]
    low, high = _cell_of(places, index)
    of = index[2]
    odds, coverage, state, then, surveyed, started = 0.0, 0.0, 0, 0, False, False
    seen_by, all_by, missed_by, next_hit, q, floor = 0, 0, 0, 0, low, -numbers[13]
    era_seen, era_missed = 1, 1
    while next_hit < len(hits) or q < high:
        found = next_hit < len(hits) and (q >= high or hits[next_hit] <= of[q])
        if found:
            o, seen = hits[next_hit], 1.0
            next_hit += 1
            if q < high and of[q] == o:
                q += 1
        else:
            o = of[q]
            q += 1
            seen = 0.0 if aside_of[o] == 2 else visibility(places, o, who[0], sights, numbers[6])
        coverage += seen
        if seen <= 0.0:
            continue
        if started:
            odds *= np.exp(-(time_ns[o] - then) * 1e-9 / decay)
        started, then = True, time_ns[o]
        a, day = agent[o], time_ns[o] // 86400000000000
        if stamp[a, 0] != k + 1:
            stamp[a, 0], stamp[a, 1], stamp[a, 2], stamp[a, 3] = k + 1, day, 0, 0
            book[a, 0], book[a, 1] = 0.0, 0.0
        if stamp[a, 1] != day:
            stamp[a, 1], book[a, 0] = day, 0.0
        change = hit * worth[o] if found else miss * seen
        if not trusted[o]:
            allowed = min(daily, max(-daily, book[a, 0] + change))
            change, book[a, 0] = allowed - book[a, 0], allowed
        if found:
            floor = -clamp
        odds = min(clamp, max(floor, odds + change))
        if found:
            if stamp[a, 2] != era_seen:
                stamp[a, 2] = era_seen
                seen_by += 1
            if book[a, 1] == 0.0:
                book[a, 1] = 1.0
                all_by += 1
            surveyed = surveyed or trusted[o]
        elif all_by > 0 and stamp[a, 3] != era_missed:
            stamp[a, 3] = era_missed
            missed_by += 1
        if odds >= publish and (seen_by >= least[0] or surveyed):
            state = 1
            era_missed += 1
            missed_by = 0
        elif odds <= retire and missed_by >= least[1] and state != 3:
            state = 3
            era_seen += 1
            seen_by, surveyed = 0, False
    return odds, coverage, all_by, state


def vouched(
    sightings: Sightings, pose: Floats, believed: NDArray[np.bool_], agents: int, margin_m: float
) -> NDArray[np.bool_]:
    """(P,) which points of observations that nobody believes (O,) lie where so many believed agents looked."""
    out = np.zeros(len(sightings.xy), np.bool_)
    if not believed.all():
        index = looks(sightings, pose, believed)
        doubted = np.flatnonzero(~believed)
        xy = sightings.world(pose)[0]
        among = (index.keys, index.start, index.of), witnesses(sightings, pose), sights(sightings)
        _vouch(doubted, np.asarray(sightings.first), xy, *among, margin_m, agents, out)
    return out


@njit(cache=True, nogil=True)
def _vouch(doubted, first, xy, index, who, sights, margin, agents, out):  # pragma: no cover - compiled
    seen, place = np.full(who[4], -1), np.empty((1, 2))
    for o in doubted:
        for p in range(first[o], first[o + 1]):
            place[0, 0], place[0, 1] = xy[p, 0], xy[p, 1]
            low, high = _cell_of(place, index)
            count = 0
            for q in range(low, high):
                other = index[2][q]
                if seen[who[1][other]] != p and visibility(place, other, who[0], sights, margin) > 0.0:
                    seen[who[1][other]] = p
                    count += 1
                    if count == agents:
                        out[p] = True
                        break


@njit(cache=True, nogil=True)
def _cell_of(places, index):  # pragma: no cover - compiled
    keys, start, _ = index
    key = ((int(np.floor(places[0, 0] / 32.0)) + 536870912) << 30) | (int(np.floor(places[0, 1] / 32.0)) + 536870912)
    cell = lower_bound(keys, key)
    if cell < len(keys) and keys[cell] == key:
        return start[cell], start[cell + 1]
    return 0, 0


@njit(cache=True, nogil=True)
def visibility(places, o, pose, sights, margin):  # pragma: no cover - compiled
    """Mean visibility of the places from observation o; what is seen by less than half says nothing."""
    c, s = np.cos(pose[o, 2]), np.sin(pose[o, 2])
    total = 0.0
    for i in range(len(places)):
        dx, dy = places[i, 0] - pose[o, 0], places[i, 1] - pose[o, 1]
        total += sight(c * dx + s * dy, -s * dx + c * dy, o, sights[0], sights[1], margin)
    mean = total / len(places)
    return mean if len(places) == 1 or mean >= 0.5 else 0.0
