# SPDX-License-Identifier: Apache-2.0
"""Pose graph of more than two agents: reject inconsistent relative poses, then optimize all poses.

Around a triangle of agents three relative poses compose to the identity. An edge that fails this test in every triangle,
while other triangles pass, is an outlier. The largest set of edges without a failing triangle is kept (greedily: the worst
edge is removed first). All poses are then found by least squares on SE(2), with the agents' reported poses as priors. An agent
whose every triangle fails is isolated.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.ops.se2 import PoseGraphEdges, between, compose, inverse, log, solve_pose_graph
from manyeyes.pose.corrector import CHI2_3DOF_P001
from manyeyes.pose.types import PosePrior, pose_difference

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RelativePoseEdge:
    """A measured relative pose of two agents: pose (3,) of j in i's frame, covariance (3, 3) in i's axes."""

    i: int
    j: int
    pose: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        if self.i == self.j or self.pose.shape != (3,) or self.covariance.shape != (3, 3):
            raise ConfigError("RelativePoseEdge joins two agents by a pose (3,) with a covariance (3, 3).")


@dataclass(frozen=True)
class PoseGraphResult:
    """pose: each connected agent's (3,) in the ego's frame; covariance: (3, 3) each, in the ego's axes. kept_edges: edges that
    were used. rejected_edges: edges that are inconsistent with the others. isolated: agents that only rejected edges connect.
    """

    pose: Mapping[int, Floats]
    covariance: Mapping[int, Floats]
    kept_edges: tuple[RelativePoseEdge, ...]
    rejected_edges: tuple[RelativePoseEdge, ...]
    isolated: tuple[int, ...]


def optimize_poses(
    ego: int,
    edges: Sequence[RelativePoseEdge],
    priors: Mapping[int, PosePrior],
    max_cycle_chi2: float = CHI2_3DOF_P001,
    huber: float = 3.0,
) -> PoseGraphResult:
    """Return poses of all agents that edges or priors connect to the ego. priors: ego_from_agent.

    max_cycle_chi2: largest squared Mahalanobis length (3 degrees of freedom) of a consistent cycle. The result does not depend on
    the order of edges.
    """
    ordered = sorted(edges, key=lambda n: (n.i, n.j, *n.pose))
    kept, rejected = reject_inconsistent_edges(
        ordered, max_cycle_chi2, [_prior_distance(ego, n, priors) for n in ordered]
    )
    agents = sorted({ego, *priors, *(a for n in ordered for a in (n.i, n.j))})
    reached = _find_reached(ego, kept, priors)
    poses, covariance = _solve(ego, [a for a in agents if a in reached], kept, priors, huber)
    joined = {a for n in kept for a in (n.i, n.j)}
    isolated = tuple(sorted({a for n in rejected for a in (n.i, n.j)} - joined - {ego}))
    return PoseGraphResult(poses, covariance, tuple(kept), tuple(rejected), isolated)


def reject_inconsistent_edges(
    edges: Sequence[RelativePoseEdge], max_cycle_chi2: float, prior_distances: Sequence[float] = ()
) -> tuple[list[RelativePoseEdge], list[RelativePoseEdge]]:
    """Split edges into consistent and rejected ones; the edge in most failing triangles is rejected first.

    prior_distances: squared distance of each edge from the priors, which decides where triangles do not, as in a single one.
    """
    kept, rejected = list(range(len(edges))), []
    distances = list(prior_distances) or [0.0] * len(edges)
    lengths = {triple: cycle_distance(*(edges[n] for n in triple)) for triple in _triangles(edges)}
    while True:
        failing = [0.0] * len(edges)
        closing = [0] * len(edges)
        for triple, length in lengths.items():
            for n in triple:
                failing[n] += min(length / max_cycle_chi2, 1e3) if length > max_cycle_chi2 else 0.0
                closing[n] += length <= max_cycle_chi2
        bad = [n for n in kept if failing[n] > 0]
        if not bad:
            break
        # An edge that some triangle confirms is kept before one that none confirms.
        worst = max(bad, key=lambda n: (-closing[n], round(failing[n], 9), distances[n], -n))
        kept.remove(worst)
        rejected.append(worst)
        lengths = {triple: length for triple, length in lengths.items() if worst not in triple}
    # The last edge of an agent with several rejected edges and no consistent triangle is rejected too.
    confirmed = {a for n in kept if closing[n] for a in (edges[n].i, edges[n].j)}
    contradicted = [a for n in rejected for a in (edges[n].i, edges[n].j)]
    unconfirmed = {a for a in contradicted if contradicted.count(a) > 1} - confirmed
    rejected += [n for n in kept if {edges[n].i, edges[n].j} & unconfirmed]
    return [edges[n] for n in kept if not {edges[n].i, edges[n].j} & unconfirmed], [edges[n] for n in rejected]


def _prior_distance(ego: int, edge: RelativePoseEdge, priors: Mapping[int, PosePrior]) -> float:
    """Return the squared Mahalanobis distance of an edge from the priors of both agents; 0 where one of them has none."""
    known = {**priors, ego: PosePrior.of(Transform.identity(), 0.0, 0.0)}
    if edge.i not in known or edge.j not in known:
        return 0.0
    one, two = known[edge.i], known[edge.j]
    expected = between(torch.from_numpy(one.pose), torch.from_numpy(two.pose)).numpy()
    c, s = np.cos(one.pose[2]), np.sin(one.pose[2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    lever = np.array([[1.0, 0.0, -expected[1]], [0.0, 1.0, expected[0]], [0.0, 0.0, 1.0]]) @ turn
    spread = edge.covariance + lever @ one.covariance @ lever.T + turn @ two.covariance @ turn.T
    delta = pose_difference(edge.pose, expected)
    return float(delta @ np.linalg.solve(spread, delta))


def cycle_distance(one: RelativePoseEdge, two: RelativePoseEdge, three: RelativePoseEdge) -> float:
    """Return the squared Mahalanobis length of the cycle of three edges that connect three agents."""
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


def _triangles(edges: Sequence[RelativePoseEdge]) -> list[tuple[int, int, int]]:
    """Return the positions of every three edges that connect three agents, in ascending order."""
    by_pair = defaultdict(list)
    neighbours = defaultdict(set)
    for n, edge in enumerate(edges):
        low, high = sorted((edge.i, edge.j))
        by_pair[low, high].append(n)
        neighbours[low].add(high)
    found = []
    for (a, b), first in by_pair.items():
        for c in neighbours[a] & neighbours[b]:
            found += [(*sorted(triple),) for triple in product(first, by_pair[a, c], by_pair[b, c])]
    return sorted(found)


def _from(edge: RelativePoseEdge, agent: int) -> tuple[Floats, Floats]:
    """Return the edge's pose and covariance, directed from one of its agents."""
    if edge.i == agent:
        return edge.pose, edge.covariance
    back = inverse(torch.from_numpy(edge.pose)).numpy()
    c, s = np.cos(edge.pose[2]), np.sin(edge.pose[2])
    by = np.array([[-c, -s, back[1]], [s, -c, -back[0]], [0.0, 0.0, -1.0]])
    return back, by @ edge.covariance @ by.T


def _compose_jacobians(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Derivatives (3, 3), (3, 3) of compose(a, b) in x, y, yaw of a and of b."""
    c, s = np.cos(a[2]), np.sin(a[2])
    by_a = np.array([[1.0, 0.0, -s * b[0] - c * b[1]], [0.0, 1.0, c * b[0] - s * b[1]], [0.0, 0.0, 1.0]])
    by_b = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return by_a, by_b


def _find_reached(ego: int, edges: Sequence[RelativePoseEdge], priors: Mapping[int, PosePrior]) -> set[int]:
    """Agents that edges or priors connect to the ego."""
    reached = {ego, *priors}
    while True:
        more = {a for n in edges if {n.i, n.j} & reached for a in (n.i, n.j)} - reached
        if not more:
            return reached
        reached |= more


def _solve(
    ego: int,
    agents: list[int],
    relative_edges: Sequence[RelativePoseEdge],
    agent_priors: Mapping[int, PosePrior],
    huber: float,
) -> tuple[dict[int, Floats], dict[int, Floats]]:
    row = {a: n for n, a in enumerate(agents)}
    start = _initial_poses(ego, agents, relative_edges, agent_priors)
    used = [n for n in relative_edges if n.i in row and n.j in row]
    priors = [
        (ego, a, agent_priors[a].pose, agent_priors[a].covariance) for a in agents if a in agent_priors and a != ego
    ]
    rows = [(n.i, n.j, n.pose, n.covariance) for n in used] + priors
    if not rows:
        return {ego: np.zeros(3)}, {ego: np.zeros((3, 3))}
    edges = PoseGraphEdges(
        torch.tensor([row[r[0]] for r in rows]),
        torch.tensor([row[r[1]] for r in rows]),
        torch.from_numpy(np.array([r[2] for r in rows])),
        torch.from_numpy(np.array([_information(r[2], r[3]) for r in rows])),
    )
    found = solve_pose_graph(start, edges, torch.tensor([a == ego for a in agents]), huber)
    covariance = found.covariance.numpy()
    poses = {a: found.poses[n].numpy() for a, n in row.items()}
    return poses, {a: covariance[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] for a, n in row.items()}


def _information(pose: Floats, covariance: Floats) -> Floats:
    """Inverse covariance of a small motion on the right of the measured pose; an exact prior has a sigma of 0.1 mm."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(np.linalg.inv(turn @ covariance @ turn.T + 1e-8 * np.eye(3)), np.float64)


def _initial_poses(
    ego: int, agents: list[int], edges: Sequence[RelativePoseEdge], priors: Mapping[int, PosePrior]
) -> torch.Tensor:
    """Initial poses: composed along the edges from the ego, else the priors."""
    known = {ego: torch.zeros(3, dtype=torch.float64)}
    pending = list(edges)
    while pending:
        usable = [n for n in pending if (n.i in known) != (n.j in known)]
        if not usable:
            rest = [a for a in agents if a not in known and a in priors and any(a in (n.i, n.j) for n in pending)]
            if not rest:
                break
            known[rest[0]] = torch.from_numpy(priors[rest[0]].pose)
            continue
        edge = usable[0]
        pose = torch.from_numpy(edge.pose)
        if edge.i in known:
            known[edge.j] = compose(known[edge.i], pose)
        else:
            known[edge.i] = compose(known[edge.j], inverse(pose))
        pending = [n for n in pending if n.i not in known or n.j not in known]
    return torch.stack([known[a] if a in known else torch.from_numpy(priors[a].pose) for a in agents])
