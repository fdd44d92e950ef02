# SPDX-License-Identifier: Apache-2.0
"""More than two agents: answers between pairs become one set of poses, and those that contradict the others are left
out.

Around a triangle of agents three relative poses must compose to none: an edge that fails this with every triangle
while others hold is a lie or a mistake. The largest set of edges without a failing triangle is kept (greedily: the
worst edge goes first), then all poses are settled by least squares on SE(2) with what each agent claims as a prior.
An agent whose every triangle failed is isolated. Spec: specs/pose.md 4.7.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.ops.se2 import Edges, between, compose, inverse, log, solve
from manyeyes.pose.corrector import REFUTED
from manyeyes.pose.types import PoseClaim, difference

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Link:
    """What was measured between two agents: pose (3,) of j in i's frame, covariance (3, 3) in i's axes."""

    i: int
    j: int
    pose: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        if self.i == self.j or self.pose.shape != (3,) or self.covariance.shape != (3, 3):
            raise ConfigError("Link joins two agents by a pose (3,) with a covariance (3, 3).")


@dataclass(frozen=True)
class Settled:
    """pose: each connected agent's (3,) in the ego's frame; covariance: (3, 3) each, in the ego's axes. kept: the
    links that were used. refused: links that contradict the others. isolated: agents that no kept link joins to the
    rest while a refused one would.
    """

    pose: Mapping[int, Floats]
    covariance: Mapping[int, Floats]
    kept: tuple[Link, ...]
    refused: tuple[Link, ...]
    isolated: tuple[int, ...]


def settle(
    ego: int, links: Sequence[Link], claims: Mapping[int, PoseClaim], limit: float = REFUTED, huber: float = 3.0
) -> Settled:
    """Poses of all agents that links or claims join to the ego. claims: ego_from_agent as claimed.

    limit: squared Mahalanobis length (3 degrees of freedom) of a cycle that still closes. The order of links has no
    part.
    """
    ordered = sorted(links, key=lambda n: (n.i, n.j, *n.pose))
    kept, refused = consistent(ordered, limit, [_doubt(ego, n, claims) for n in ordered])
    agents = sorted({ego, *claims, *(a for n in ordered for a in (n.i, n.j))})
    reached = _reached(ego, kept, claims)
    poses, covariance = _solve(ego, [a for a in agents if a in reached], kept, claims, huber)
    joined = {a for n in kept for a in (n.i, n.j)}
    isolated = tuple(sorted({a for n in refused for a in (n.i, n.j)} - joined - {ego}))
    return Settled(poses, covariance, tuple(kept), tuple(refused), isolated)


def consistent(links: Sequence[Link], limit: float, doubts: Sequence[float] = ()) -> tuple[list[Link], list[Link]]:
    """The links without those that no triangle agrees with, and those: the link in most failing triangles goes first.

    doubts: how badly each link agrees with what is claimed; it decides where triangles do not, as in a single one.
    """
    kept, refused = list(links), []
    doubt = list(doubts) or [0.0] * len(kept)
    while True:
        failing = [0.0] * len(kept)
        closing = [0] * len(kept)
        for triple in _triangles(kept):
            excess = cycle_distance(*(kept[n] for n in triple))
            for n in triple:
                failing[n] += min(excess / limit, 1e3) if excess > limit else 0.0
                closing[n] += excess <= limit
        bad = [n for n in range(len(kept)) if failing[n] > 0]
        if not bad:
            break
        # A link that some triangle confirms is trusted before one that none does.
        worst = max(bad, key=lambda n: (-closing[n], round(failing[n], 9), doubt[n], -n))
        refused.append(kept.pop(worst))
        doubt.pop(worst)
    # Whoever contradicted more than one other and is confirmed by no triangle is not believed for its last link either.
    confirmed = {a for n, count in enumerate(closing) if count for a in (kept[n].i, kept[n].j)}
    contradicted = [a for n in refused for a in (n.i, n.j)]
    alone = {a for a in contradicted if contradicted.count(a) > 1} - confirmed
    refused += [n for n in kept if {n.i, n.j} & alone]
    return [n for n in kept if not {n.i, n.j} & alone], refused


def _doubt(ego: int, link: Link, claims: Mapping[int, PoseClaim]) -> float:
    """Squared Mahalanobis distance of a link from what both its agents claim; 0 where one of them claims nothing."""
    known = {**claims, ego: PoseClaim.of(Transform.identity(), 0.0, 0.0)}
    if link.i not in known or link.j not in known:
        return 0.0
    one, two = known[link.i], known[link.j]
    said = between(torch.from_numpy(one.pose), torch.from_numpy(two.pose)).numpy()
    c, s = np.cos(one.pose[2]), np.sin(one.pose[2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    lever = np.array([[1.0, 0.0, -said[1]], [0.0, 1.0, said[0]], [0.0, 0.0, 1.0]]) @ turn
    spread = link.covariance + lever @ one.covariance @ lever.T + turn @ two.covariance @ turn.T
    delta = difference(link.pose, said)
    return float(delta @ np.linalg.solve(spread, delta))


def cycle_distance(one: Link, two: Link, three: Link) -> float:
    """Squared Mahalanobis length of going once around three links that join three agents."""
    first = one
    second = two if first.j in (two.i, two.j) else three
    third = three if second is two else two
    a, b = first.i, first.j
    path = [_from(first, a), _from(second, b)]
    path.append(_from(third, second.j if second.i == b else second.i))
    total, spread = torch.zeros(3, dtype=torch.float64), np.zeros((3, 3))
    for pose, covariance in path:
        by_total, by_step = _compose_jacobians(total.numpy(), pose)
        spread = by_total @ spread @ by_total.T + by_step @ covariance @ by_step.T
        total = compose(total, torch.from_numpy(pose))
    error = log(total).numpy()
    return float(error @ np.linalg.solve(spread, error))


def _triangles(links: Sequence[Link]) -> list[tuple[int, int, int]]:
    found = []
    for triple in itertools.combinations(range(len(links)), 3):
        ends = [frozenset((links[n].i, links[n].j)) for n in triple]
        if len(set(ends)) == 3 and len(frozenset().union(*ends)) == 3:
            found.append(triple)
    return found


def _from(link: Link, agent: int) -> tuple[Floats, Floats]:
    """The link's pose and covariance, seen from one of its agents."""
    if link.i == agent:
        return link.pose, link.covariance
    back = inverse(torch.from_numpy(link.pose)).numpy()
    c, s = np.cos(link.pose[2]), np.sin(link.pose[2])
    by = np.array([[-c, -s, back[1]], [s, -c, -back[0]], [0.0, 0.0, -1.0]])
    return back, by @ link.covariance @ by.T


def _compose_jacobians(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Derivatives (3, 3), (3, 3) of compose(a, b) in x, y, yaw of a and of b."""
    c, s = np.cos(a[2]), np.sin(a[2])
    by_a = np.array([[1.0, 0.0, -s * b[0] - c * b[1]], [0.0, 1.0, c * b[0] - s * b[1]], [0.0, 0.0, 1.0]])
    by_b = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return by_a, by_b


def _reached(ego: int, links: Sequence[Link], claims: Mapping[int, PoseClaim]) -> set[int]:
    """Agents that links or claims join to the ego."""
    reached = {ego, *claims}
    while True:
        more = {a for n in links if {n.i, n.j} & reached for a in (n.i, n.j)} - reached
        if not more:
            return reached
        reached |= more


def _solve(
    ego: int, agents: list[int], links: Sequence[Link], claims: Mapping[int, PoseClaim], huber: float
) -> tuple[dict[int, Floats], dict[int, Floats]]:
    row = {a: n for n, a in enumerate(agents)}
    start = _start(ego, agents, links, claims)
    used = [n for n in links if n.i in row and n.j in row]
    priors = [(ego, a, claims[a].pose, claims[a].covariance) for a in agents if a in claims and a != ego]
    rows = [(n.i, n.j, n.pose, n.covariance) for n in used] + priors
    if not rows:
        return {ego: np.zeros(3)}, {ego: np.zeros((3, 3))}
    edges = Edges(
        torch.tensor([row[r[0]] for r in rows]),
        torch.tensor([row[r[1]] for r in rows]),
        torch.from_numpy(np.array([r[2] for r in rows])),
        torch.from_numpy(np.array([_information(r[2], r[3]) for r in rows])),
    )
    found = solve(start, edges, torch.tensor([a == ego for a in agents]), huber)
    covariance = found.covariance.numpy()
    poses = {a: found.poses[n].numpy() for a, n in row.items()}
    return poses, {a: covariance[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] for a, n in row.items()}


def _information(pose: Floats, covariance: Floats) -> Floats:
    """Inverse covariance as a small motion on the right of the measured pose; an exact claim counts as known to a
    tenth of a millimetre.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.linalg.inv(turn @ covariance @ turn.T + 1e-8 * np.eye(3))


def _start(ego: int, agents: list[int], links: Sequence[Link], claims: Mapping[int, PoseClaim]) -> torch.Tensor:
    """Where to start: along the links from the ego, else as claimed."""
    known = {ego: torch.zeros(3, dtype=torch.float64)}
    pending = list(links)
    while pending:
        usable = [n for n in pending if (n.i in known) != (n.j in known)]
        if not usable:
            rest = [a for a in agents if a not in known and a in claims and any(a in (n.i, n.j) for n in pending)]
            if not rest:
                break
            known[rest[0]] = torch.from_numpy(claims[rest[0]].pose)
            continue
        link = usable[0]
        pose = torch.from_numpy(link.pose)
        if link.i in known:
            known[link.j] = compose(known[link.i], pose)
        else:
            known[link.i] = compose(known[link.j], inverse(pose))
        pending = [n for n in pending if n.i not in known or n.j not in known]
    return torch.stack([known[a] if a in known else torch.from_numpy(claims[a].pose) for a in agents])
