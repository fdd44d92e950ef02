# SPDX-License-Identifier: Apache-2.0
"""Train FeaKM's network to match the keypoints of two agents: ground truth, loss, augmentation, and the task.

Ground truth is geometric: the other agent's keypoints are transformed by the true pose. Mutual nearest neighbours within
match_radius_m match; keypoints without neighbour within unmatched_radius_m are unmatched; others are ignored. The loss averages
-log P of the matches and of the unmatched points with weight one half each, over all layers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models.pose.feakm import FEAKM_PAPER, FEAKM_PEAKS, FEAKM_SMALL, FORMAT, FeakmConfig, FeakmNet
from manyeyes.models.pose.keypoint_net import DetectorView
from manyeyes.models.pose.matcher import Assignment, KeypointBatch, find_mutual_matches
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.training.pose.feakm_cache import FeatureCache, ViewPair
from manyeyes.training.trainer import Task, TrainConfig


@dataclass(frozen=True)
class KeypointAugmentConfig:
    """Augmentation of keypoints.

    Attributes:
        random_yaw: rotate each agent's frame by a uniform angle.
        flip_prob: probability that a heading is turned by pi before description.
        max_drop_fraction: maximum fraction of dropped keypoints, uniform.
        sigma_xy_m: noise added to positions.
        sigma_yaw_rad: noise added to headings.
    """

    random_yaw: bool = True
    flip_prob: float = 0.03
    max_drop_fraction: float = 0.3
    sigma_xy_m: float = 0.15
    sigma_yaw_rad: float = 0.03

    @classmethod
    def none(cls) -> KeypointAugmentConfig:
        """Disable augmentation of the pairs."""
        return cls(False, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class FeakmTrainConfig(TrainConfig):
    """Settings of a training run of FeaKM's network.

    Attributes:
        net: configuration of the network.
        batch: pairs of views per step.
        match_radius_m: maximum distance of matching keypoints.
        unmatched_radius_m: minimum distance of an unmatched keypoint to every other.
    """

    net: FeakmConfig
    _: KW_ONLY
    batch: int = 16
    max_grad_norm: float = 5.0
    match_radius_m: float = 2.4
    unmatched_radius_m: float = 2.4
    augment: KeypointAugmentConfig = field(default_factory=KeypointAugmentConfig.none)

    def __post_init__(self) -> None:
        if not 0 < self.match_radius_m <= self.unmatched_radius_m or self.steps < 1 or self.batch < 1:
            raise ConfigError(
                "FeakmTrainConfig needs 0 < match_radius_m <= unmatched_radius_m, steps >= 1 and batch >= 1."
            )


_SMALL = FeakmTrainConfig(
    FEAKM_SMALL,
    steps=6000,
    batch=16,
    learning_rate=1e-3,
    match_radius_m=1.5,
    unmatched_radius_m=2.4,
    augment=KeypointAugmentConfig(),
)
FEAKM_TRAINING_PRESETS: dict[str, FeakmTrainConfig] = {
    "feakm-small": _SMALL,
    "feakm-peaks": replace(_SMALL, net=FEAKM_PEAKS),
    "feakm-paper": FeakmTrainConfig(FEAKM_PAPER, steps=15000, batch=16, learning_rate=2e-4, weight_decay=0.0),
}
"""feakm-small: the shipped weights. feakm-peaks: the same without a confidence map. feakm-paper: 15 M parameters, as published but
for the schedule's shape.
"""


@dataclass(frozen=True, eq=False)
class GroundTruthMatches:
    """Ground truth of B pairs of views. pairs: (B, N, M) bool, matches; unmatched_a: (B, N), unmatched_b: (B, M)
    bool.
    """

    pairs: Tensor
    unmatched_a: Tensor
    unmatched_b: Tensor

    def to(self, device: torch.device) -> GroundTruthMatches:
        """Return the same matches on a device."""
        return GroundTruthMatches(*(column.to(device) for column in vars(self).values()))


def match_ground_truth(
    a: Sequence[Keypoints],
    b: Sequence[Keypoints],
    a_from_b: Sequence[Transform],
    match_radius_m: float,
    unmatched_radius_m: float,
) -> GroundTruthMatches:
    """Return the ground truth matches, padded to the longest list on either side."""
    shape = len(a), max(map(len, a)), max(map(len, b))
    pairs = torch.zeros(shape, dtype=torch.bool, device="cpu")
    unmatched_a, unmatched_b = (torch.zeros(s, dtype=torch.bool, device="cpu") for s in (shape[:2], shape[::2]))
    for i, (ego, other, motion) in enumerate(zip(a, b, a_from_b)):
        n, m = len(ego), len(other)
        unmatched_a[i, :n], unmatched_b[i, :m] = True, True
        if n and m:
            moved = motion.apply(other.boxes.center.double())[:, :2]
            away = torch.cdist(ego.xy.double(), moved)
            nearest, back = away.argmin(1), away.argmin(0)
            rows = (back[nearest] == torch.arange(n, device=back.device)) & (away.amin(1) < match_radius_m)
            pairs[i, rows.nonzero()[:, 0], nearest[rows]] = True
            unmatched_a[i, :n], unmatched_b[i, :m] = (
                away.amin(1) > unmatched_radius_m,
                away.amin(0) > unmatched_radius_m,
            )
    return GroundTruthMatches(pairs, unmatched_a, unmatched_b)


def matching_loss(layers: Sequence[Assignment], truth: GroundTruthMatches) -> Tensor:
    """Return the mean -log P of matches and of unmatched keypoints, weight one half each, over layers; 0 where there
    is none.
    """
    total = layers[0].log_p.new_zeros(())
    for layer in layers:
        matched = _mean(-layer.log_p, truth.pairs)
        unmatched = _mean(
            -torch.cat((layer.log_unmatched_a, layer.log_unmatched_b), 1),
            torch.cat((truth.unmatched_a, truth.unmatched_b), 1),
        )
        total = total + (matched + unmatched).mean() / 2
    return total / len(layers)


def _mean(value: Tensor, mask: Tensor) -> Tensor:
    """Masked mean (B,) of values (B, ...)."""
    value, mask = value.flatten(1), mask.flatten(1)
    return torch.where(mask, value, 0.0).sum(1) / mask.sum(1).clamp_min(1)


@dataclass
class FeakmTask(Task[FeakmTrainConfig, FeakmNet, ViewPair]):
    """Train FeaKM's network on cached views; the log holds recall and precision of each step's batch."""

    format = FORMAT
    shown_terms = ("recall", "precision")

    config: FeakmTrainConfig
    cache: FeatureCache
    seed: int = 0

    def make_model(self) -> FeakmNet:
        """Make the network with random weights."""
        return FeakmNet(self.config.net)

    def draw(self, number: int) -> ViewPair:
        """Draw the pair of views of this number."""
        return self.cache.draw(self.seed, number)

    def loss(
        self, model: FeakmNet, samples: list[ViewPair], numbers: range, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the matching loss of augmented pairs."""
        config = self.config
        ego, other, motions = self._keypoints(model, samples, numbers.start)
        truth = match_ground_truth(ego, other, motions, config.match_radius_m, config.unmatched_radius_m)
        truth = truth.to(model.device)
        ego, other = (self._perturb(side, name, numbers.start) for side, name in ((ego, "ego"), (other, "other")))
        layers = model.assign(KeypointBatch.of(ego), KeypointBatch.of(other))
        measures = matching_recall_precision(layers[-1], truth, config.net.matcher.min_match_prob)
        return matching_loss(layers, truth), dict(
            zip(self.shown_terms, torch.tensor(measures, dtype=torch.float64, device="cpu"))
        )

    def _keypoints(
        self, model: FeakmNet, pairs: Sequence[ViewPair], first: int
    ) -> tuple[list[Keypoints], list[Keypoints], list[Transform]]:
        """Describe keypoints with flipped headings and dropout, in the frames of the true transforms."""
        augment = self.config.augment
        views = []
        for i, both in enumerate(pairs):
            rng = keyed_generator("feakm flip", self.seed, first + i)
            views += [_flip_headings(view, augment.flip_prob, rng) for view in (both.ego, both.other)]
        described = model.describe(views, group_size=2)
        kept = []
        for i, points in enumerate(described):
            rng = keyed_generator("feakm drop", self.seed, first * 2 + i)
            share = augment.max_drop_fraction * rng.random()
            kept.append(points[torch.from_numpy(rng.random(len(points)) >= share)])
        return kept[::2], kept[1::2], [both.ego_from_other for both in pairs]

    def _perturb(self, many: Sequence[Keypoints], side: str, first: int) -> list[Keypoints]:
        """Rotate the frames of keypoints and add noise to positions and headings."""
        augment = self.config.augment
        found = []
        for i, points in enumerate(many):
            rng = keyed_generator("feakm move", side, self.seed, first + i)
            angle = rng.uniform(-math.pi, math.pi) if augment.random_yaw else 0.0
            moved = points.transform(Transform.from_xyz_yaw(0.0, 0.0, 0.0, angle))
            error = torch.from_numpy(rng.standard_normal((len(points), 3))).to(moved.boxes.center.dtype)
            center = moved.boxes.center.clone()
            center[:, :2] += augment.sigma_xy_m * error[:, :2]
            yaw = moved.boxes.yaw + augment.sigma_yaw_rad * error[:, 2]
            found.append(replace(moved, boxes=replace(moved.boxes, center=center, yaw=yaw)))
        return found


def matching_recall_precision(
    assignment: Assignment, truth: GroundTruthMatches, threshold: float
) -> tuple[float, float]:
    """Return recall and precision of the matches of a batch; 1 without ground truth, or without matches."""
    correct = found = 0
    for (pairs, _), true in zip(find_mutual_matches(assignment, threshold), truth.pairs):
        found += len(pairs)
        correct += int(true[pairs[:, 0], pairs[:, 1]].sum())
    num_true = int(truth.pairs.sum())
    return correct / num_true if num_true else 1.0, correct / found if found else 1.0


def _flip_headings(view: DetectorView, share: float, rng: np.random.Generator) -> DetectorView:
    """Turn some headings by pi, as detectors err."""
    turned = torch.from_numpy(rng.random(len(view.boxes)) < share)
    return replace(view, boxes=replace(view.boxes, yaw=view.boxes.yaw + math.pi * turned))
