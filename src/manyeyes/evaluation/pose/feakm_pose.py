# SPDX-License-Identifier: Apache-2.0
"""How well FeaKM finds poses, beside correctors that look at boxes alone, on the same keypoints and claims."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import torch

from manyeyes.datatypes import Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.evaluation.pose.metrics import ClaimNoise, PoseFrame, judged
from manyeyes.models.pose.feakm import FeakmNet
from manyeyes.models.pose.keypoint_net import View
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import Corrector, planar


def pose_frames(
    described: Iterable[tuple[Keypoints, Keypoints, Transform]],
    correctors: Mapping[str, Corrector],
    noise: ClaimNoise,
    near_m: float = 1.5,
) -> dict[str, list[PoseFrame]]:
    """Every corrector's answers on the same pairs of views (ego, other, true ego_from_other), judged (evaluation/pose/metrics.py).

    Objects in common are those that both detect: mutual nearest within near_m under the true pose.
    """
    found: dict[str, list[PoseFrame]] = {name: [] for name in correctors}
    for scene, (ego, other, truth) in enumerate(described):
        claimed, pose = noise.claim(planar(truth), scene), planar(truth)
        common = ego.xy[_common(ego, other, truth, near_m)].double().numpy()
        marks = Landmarks.of_keypoints(ego), Landmarks.of_keypoints(other)
        for name, correct in correctors.items():
            found[name].append(judged(correct(*marks, claimed), pose, common))
    return found


def _common(ego: Keypoints, other: Keypoints, ego_from_other: Transform, near_m: float) -> torch.Tensor:
    if not len(ego) or not len(other):
        return torch.zeros(len(ego), dtype=torch.bool)
    away = torch.cdist(ego.xy.double(), ego_from_other.apply(other.boxes.center.double())[:, :2])
    back = away.argmin(0)[away.argmin(1)] == torch.arange(len(ego))
    return back & (away.amin(1) < near_m)


def described(
    net: FeakmNet, pairs: Iterable[tuple[View, View, Transform]]
) -> Iterator[tuple[Keypoints, Keypoints, Transform]]:
    """Pairs of views as keypoints."""
    for ego, other, truth in pairs:
        with torch.no_grad():
            points = net.describe([ego, other])
        yield points[0], points[1], truth
