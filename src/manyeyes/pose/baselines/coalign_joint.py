# SPDX-License-Identifier: Apache-2.0
"""CoAlign's agent-object pose graph of all agents at once (Lu et al., ICRA 2023): ``coalign`` joins one pair of agents.

Boxes of different agents that the prior poses bring together are one object; all agents and objects are vertices of one graph, in
which the ego is fixed. Two agents without a common object may thus be tied through a third. A cluster holds one box of each agent,
headings are compared modulo pi, and the information of an edge is that of the stated errors, as in ``coalign``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.ops.se2 import PoseGraphEdges, solve_pose_graph
from manyeyes.pose.baselines._common import match_mutual_nearest
from manyeyes.pose.baselines.coalign import CoalignConfig
from manyeyes.pose.corrector import mahalanobis_squared
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_joint_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, lift_to_se3, no_estimate

Floats = NDArray[np.float64]
Box = tuple[int, int]
"""Number of an agent, and row of one of its landmarks."""


@dataclass(frozen=True)
class _Graph:
    """What the priors bring together: poses (N, 3) of agents in the ego's frame, and boxes of the same object, one an agent."""

    agents: Sequence[Landmarks]
    start: Floats
    clusters: Sequence[Sequence[Box]]


@register_joint_corrector("coalign")
def correct_jointly(
    agents: Sequence[Landmarks], priors: Sequence[PosePrior | None], config: CoalignConfig | None = None
) -> list[PoseEstimate]:
    """Return the poses of all agents but the first, the ego, in its frame; priors: of them, in their order.

    An agent without prior, or without a path of common objects to the ego, has NO_MATCH.
    """
    config = config or CoalignConfig()
    known = [0, *(n for n, prior in enumerate(priors, 1) if prior is not None)]
    start = np.zeros((len(agents), 3))
    for n, prior in enumerate(priors, 1):
        start[n] = np.zeros(3) if prior is None else prior.pose
    clusters = _cluster([(n, agents[n].transform(start[n])) for n in known], config.max_distance_m)
    graph = _Graph(agents, start, clusters)
    hard = [_yaw_variance(graph, cluster) > config.max_yaw_variance_rad2 for cluster in clusters]
    if len(clusters) <= config.min_objects or 2 * sum(hard) >= len(clusters):
        return [no_estimate(prior) for prior in priors]
    connected = _connect_to_ego([c for c, is_hard in zip(clusters, hard) if not is_hard])
    if not connected:
        return [no_estimate(prior) for prior in priors]
    poses, covariances = _optimize(_Graph(agents, start, connected))
    tied = {agent for cluster in connected for agent, _ in cluster}
    return [
        _estimate(n, poses[n], covariances[n], prior, connected) if n in tied else no_estimate(prior)
        for n, prior in enumerate(priors, 1)
    ]


def _cluster(placed: Sequence[tuple[int, Landmarks]], max_distance_m: float) -> list[list[Box]]:
    """Return boxes of one object, nearest pairs of agents first; a cluster never holds two boxes of one agent."""
    pairs: list[tuple[float, Box, Box]] = []
    for at, (a, mine) in enumerate(placed):
        for b, theirs in placed[at + 1 :]:
            for i, k in match_mutual_nearest(mine.xy, theirs.xy, max_distance_m).tolist():
                pairs.append((float(np.hypot(*(mine.xy[i] - theirs.xy[k]))), (a, i), (b, k)))
    cluster_of: dict[Box, list[Box]] = {}
    for _, one, other in sorted(pairs):
        first, second = cluster_of.setdefault(one, [one]), cluster_of.setdefault(other, [other])
        if first is second or {agent for agent, _ in first} & {agent for agent, _ in second}:
            continue
        first.extend(second)
        cluster_of.update(dict.fromkeys(second, first))
    return [sorted(boxes) for boxes in {id(c): c for c in cluster_of.values()}.values() if len(boxes) > 1]


def _turns(graph: _Graph, cluster: Sequence[Box]) -> Floats:
    """Return the differences of headings from that of the first box, radians modulo pi, in [-pi / 2, pi / 2)."""
    yaw = np.array([graph.agents[a].yaw[row] + graph.start[a, 2] for a, row in cluster])
    return (yaw - yaw[0] + np.pi / 2) % np.pi - np.pi / 2


def _yaw_variance(graph: _Graph, cluster: Sequence[Box]) -> float:
    return float(_turns(graph, cluster).var())


def _connect_to_ego(clusters: Sequence[Sequence[Box]]) -> list[Sequence[Box]]:
    """Return the clusters that a path of common objects ties to the ego, agent 0."""
    reached, found = {0}, list[Sequence[Box]]()
    left = list(clusters)
    while near := [cluster for cluster in left if reached & {agent for agent, _ in cluster}]:
        found += near
        left = [cluster for cluster in left if cluster not in near]
        reached |= {agent for cluster in near for agent, _ in cluster}
    return found


def _optimize(graph: _Graph) -> tuple[Floats, Floats]:
    """Return poses (N, 3) of all agents and their covariances (N, 3, 3) in the ego's axes."""
    count, objects = len(graph.agents), list[Floats]()
    sources, targets, measured, sigmas = list[int](), list[int](), list[Floats](), list[Floats]()
    for number, cluster in enumerate(graph.clusters):
        turns = _turns(graph, cluster)
        for (agent, row), turn in zip(cluster, turns):
            marks, at = graph.agents[agent], graph.start[agent]
            moved = marks.transform(at)
            if len(objects) == number:
                objects.append(np.array([*moved.xy[row], moved.yaw[row]]))
            # A box turned by pi is the same object: its heading is the one nearer to that of the first box.
            yaw = objects[number][2] + turn - at[2]
            sources.append(agent)
            targets.append(count + number)
            measured.append(np.array([*marks.xy[row], yaw]))
            sigmas.append(np.array([marks.sigma_xy[row], marks.sigma_xy[row], marks.sigma_yaw[row]]))
    edges = PoseGraphEdges(
        torch.tensor(sources),
        torch.tensor(targets),
        torch.from_numpy(np.stack(measured)),
        torch.from_numpy(np.stack(sigmas) ** -2.0).diag_embed(),
    )
    # Agents without an object stay where their prior puts them: nothing ties them.
    fixed = torch.tensor([n == 0 or n not in sources for n in range(count)] + [False] * len(objects))
    solution = solve_pose_graph(torch.from_numpy(np.concatenate((graph.start, np.stack(objects)))), edges, fixed)
    poses = solution.poses[:count].numpy()
    blocks = solution.covariance.view(len(fixed), 3, len(fixed), 3).numpy()
    turned = []
    for n, pose in enumerate(poses):
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]]
        turned.append(turn @ blocks[n, :, n] @ turn.T)
    return poses, np.stack(turned)


def _estimate(
    n: int, pose: Floats, covariance: Floats, prior: PosePrior | None, clusters: Sequence[Sequence[Box]]
) -> PoseEstimate:
    """Return the estimate of agent n; its pairs are those with the ego."""
    rows = [dict(cluster) for cluster in clusters]
    pairs = np.array([(r[0], r[n]) for r in rows if 0 in r and n in r], np.int64).reshape(-1, 2)
    distance = float("nan") if prior is None else mahalanobis_squared(pose, covariance, prior)
    at = lift_to_se3(pose, prior)
    inliers = sum(n in r for r in rows)
    return PoseEstimate(at, covariance, PoseStatus.CORRECTED, inliers, 0, 0.0, pairs, pose, covariance, distance)
