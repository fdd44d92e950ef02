# SPDX-License-Identifier: Apache-2.0
"""How well FeaKM finds poses, beside correctors that look at boxes alone, on the same keypoints and claims."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

import torch

from manyeyes.alignment.estimate import PoseClaim, PoseEstimate, planar
from manyeyes.alignment.landmarks import Landmarks
from manyeyes.datatypes import Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.evaluation.pose import ClaimNoise, PoseFrame, judged
from manyeyes.models.feakm import FeakmNet
from manyeyes.models.keypoint_net import View

Finder = Callable[[Keypoints, Keypoints, "PoseClaim | None"], PoseEstimate]
"""A corrector on keypoints; see by_landmarks for those that look at boxes alone."""


def by_landmarks(correct: Callable[[Landmarks, Landmarks, PoseClaim | None], PoseEstimate]) -> Finder:
    """A corrector of another kind on the same keypoints, whose descriptors it does not read."""
    return lambda ego, other, claimed: correct(Landmarks.of_boxes(ego.boxes), Landmarks.of_boxes(other.boxes), claimed)


def pose_frames(
    described: Iterable[tuple[Keypoints, Keypoints, Transform]],
    finders: Mapping[str, Finder],
    noise: ClaimNoise,
    near_m: float = 1.5,
) -> dict[str, list[PoseFrame]]:
    """Every finder's answers on the same pairs of views (ego, other, true ego_from_other), judged (evaluation/pose.py).

    Objects in common are those that both detect: mutual nearest within near_m under the true pose.
    """
    found: dict[str, list[PoseFrame]] = {name: [] for name in finders}
    for scene, (ego, other, truth) in enumerate(described):
        claimed, pose = noise.claim(planar(truth), scene), planar(truth)
        common = ego.xy[_common(ego, other, truth, near_m)].double().numpy()
        for name, finder in finders.items():
            found[name].append(judged(finder(ego, other, claimed), pose, common))
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
