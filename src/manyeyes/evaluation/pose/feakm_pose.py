# SPDX-License-Identifier: Apache-2.0
"""Pose errors of FeaKM and of correctors that use boxes only, on the same keypoints and prior poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import torch

from manyeyes.datatypes import Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.evaluation.pose.metrics import PoseEvaluation, PriorNoise, evaluate_pose
from manyeyes.models.pose.feakm import FeakmNet
from manyeyes.models.pose.keypoint_net import DetectorView
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseCorrector, project_to_se2


def evaluate_correctors(
    pairs: Iterable[tuple[Keypoints, Keypoints, Transform]],
    correctors: Mapping[str, PoseCorrector],
    noise: PriorNoise,
    max_distance_m: float = 1.5,
) -> dict[str, list[PoseEvaluation]]:
    """Return every corrector's answers on the same pairs of views (ego, other, true ego_from_other), judged
    (evaluation/pose/metrics.py).

    Objects in common are those that both detect: mutual nearest within near_m under the true pose.
    """
    evaluations: dict[str, list[PoseEvaluation]] = {name: [] for name in correctors}
    for scene, (ego, other, truth) in enumerate(pairs):
        prior, pose = noise.make_prior(project_to_se2(truth), scene), project_to_se2(truth)
        common = ego.xy[_find_common(ego, other, truth, max_distance_m)].double().numpy()
        landmarks = Landmarks.of_keypoints(ego), Landmarks.of_keypoints(other)
        for name, correct in correctors.items():
            evaluations[name].append(evaluate_pose(correct(*landmarks, prior), pose, common))
    return evaluations


def _find_common(ego: Keypoints, other: Keypoints, ego_from_other: Transform, max_distance_m: float) -> torch.Tensor:
    if not len(ego) or not len(other):
        return torch.zeros(len(ego), dtype=torch.bool)
    distance = torch.cdist(ego.xy.double(), ego_from_other.apply(other.boxes.center.double())[:, :2])
    is_mutual = distance.argmin(0)[distance.argmin(1)] == torch.arange(len(ego))
    return is_mutual & (distance.amin(1) < max_distance_m)


def describe_pairs(
    net: FeakmNet, pairs: Iterable[tuple[DetectorView, DetectorView, Transform]]
) -> Iterator[tuple[Keypoints, Keypoints, Transform]]:
    """Yield pairs of views as keypoints."""
    for ego, other, truth in pairs:
        with torch.no_grad():
            points = net.describe([ego, other])
        yield points[0], points[1], truth
