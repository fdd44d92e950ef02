# SPDX-License-Identifier: Apache-2.0
"""Train FeaKM's network to match the keypoints of two agents: ground truth, loss, augmentation, and the loop.

Ground truth is geometric: the other agent's keypoints are transformed by the true pose. Mutual nearest neighbours
within match_radius_m
match; keypoints without neighbour within unmatched_radius_m are unmatched; others are ignored. The loss averages -log
P of the matches
and of the unmatched points with weight one half each, over all layers. The learning rate grows linearly and follows a
cosine to zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models import checkpoint
from manyeyes.models.pose.feakm import FEAKM_PAPER, FEAKM_SMALL, FORMAT, FeakmConfig, FeakmNet
from manyeyes.models.pose.keypoint_net import DetectorView
from manyeyes.models.pose.matcher import Assignment, KeypointBatch, find_mutual_matches
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.training.checkpointing import RunState, warmup_cosine
from manyeyes.training.pose.feakm_cache import FeatureCache, ViewPair


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
class FeakmTrainConfig:
    """Settings of a training run.

    Attributes:
        net: configuration of the network.
        batch: pairs of views per step.
        warmup_steps: steps of linear growth of the learning rate.
        max_grad_norm: at which gradients are clipped.
        ema_decay: decay of the averaged weights, which are saved.
        match_radius_m: maximum distance of matching keypoints.
        unmatched_radius_m: minimum distance of an unmatched keypoint to every other.
    """

    net: FeakmConfig
    steps: int
    batch: int = 16
    learning_rate: float = 2e-4
    weight_decay: float = 1e-2
    warmup_steps: int = 100
    max_grad_norm: float = 5.0
    ema_decay: float = 0.999
    save_every: int = 200
    match_radius_m: float = 2.4
    unmatched_radius_m: float = 2.4
    augment: KeypointAugmentConfig = field(default_factory=KeypointAugmentConfig.none)

    def __post_init__(self) -> None:
        if not 0 < self.match_radius_m <= self.unmatched_radius_m or self.steps < 1 or self.batch < 1:
            raise ConfigError(
                "FeakmTrainConfig needs 0 < match_radius_m <= unmatched_radius_m, steps >= 1 and batch >= 1."
            )


FEAKM_TRAINING_PRESETS: dict[str, FeakmTrainConfig] = {
    "feakm-small": FeakmTrainConfig(
        FEAKM_SMALL,
        steps=6000,
        batch=16,
        learning_rate=1e-3,
        match_radius_m=1.5,
        unmatched_radius_m=2.4,
        augment=KeypointAugmentConfig(),
    ),
    "feakm-paper": FeakmTrainConfig(FEAKM_PAPER, steps=15000, batch=16, learning_rate=2e-4, weight_decay=0.0),
}
"""feakm-small: the shipped weights. feakm-paper: 15 M parameters, as published but for the schedule's shape."""


@dataclass(frozen=True, eq=False)
class GroundTruthMatches:
    """Ground truth of B pairs of views. pairs: (B, N, M) bool, matches; unmatched_a: (B, N), unmatched_b: (B, M)
    bool.
    """

    pairs: Tensor
    unmatched_a: Tensor
    unmatched_b: Tensor


def match_ground_truth(
    a: Sequence[Keypoints],
    b: Sequence[Keypoints],
    a_from_b: Sequence[Transform],
    match_radius_m: float,
    unmatched_radius_m: float,
) -> GroundTruthMatches:
    """Return the ground truth matches, padded to the longest list on either side."""
    shape = len(a), max(map(len, a)), max(map(len, b))
    pairs = torch.zeros(shape, dtype=torch.bool)
    unmatched_a, unmatched_b = torch.zeros(shape[:2], dtype=torch.bool), torch.zeros(shape[::2], dtype=torch.bool)
    for i, (ego, other, motion) in enumerate(zip(a, b, a_from_b)):
        n, m = len(ego), len(other)
        unmatched_a[i, :n], unmatched_b[i, :m] = True, True
        if n and m:
            moved = motion.apply(other.boxes.center.double())[:, :2]
            away = torch.cdist(ego.xy.double(), moved)
            nearest, back = away.argmin(1), away.argmin(0)
            rows = (back[nearest] == torch.arange(n)) & (away.amin(1) < match_radius_m)
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


@dataclass(frozen=True)
class MatchProgress:
    """Progress of one step: one line of the log; recall and precision are of this step's batch."""

    step: int
    steps: int
    loss: float
    recall: float
    precision: float
    learning_rate: float
    seconds: float

    def to_record(self) -> dict[str, float]:
        """Return the line of log.jsonl."""
        record = {"step": self.step, "loss": round(self.loss, 5), "lr": self.learning_rate}
        return record | {"recall": round(self.recall, 4), "precision": round(self.precision, 4)}


class FeakmRun:
    """A resumable training run on cached views in a folder."""

    def __init__(self, config: FeakmTrainConfig, cache: FeatureCache, folder: Path, seed: int) -> None:
        self.config, self.cache, self.seed = config, cache, seed
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            model = FeakmNet(config.net)
        self.state = RunState(model, config, seed, folder, config.weight_decay)

    def advance(self) -> MatchProgress:
        """Run one optimiser step."""
        config, state = self.config, self.state
        state.model.train()
        numbers = state.sample_numbers(config.batch)
        first = numbers.start
        pairs = [self.cache.draw(self.seed, number) for number in numbers]
        ego, other, motions = self._keypoints(pairs, first)
        truth = match_ground_truth(ego, other, motions, config.match_radius_m, config.unmatched_radius_m)
        ego, other = (self._perturb(side, name, first) for side, name in ((ego, "ego"), (other, "other")))
        layers = state.model.matcher(KeypointBatch.of(ego), KeypointBatch.of(other))
        loss = matching_loss(layers, truth)
        rate = config.learning_rate * warmup_cosine(config.warmup_steps, state.step, config.steps)
        state.backward(loss)
        state.optimiser_step(rate, config.max_grad_norm, config.ema_decay)
        recall, precision = matching_recall_precision(layers[-1], truth, config.net.matcher.min_match_prob)
        return MatchProgress(state.step, config.steps, float(loss.detach()), recall, precision, rate, state.seconds)

    def _keypoints(
        self, pairs: Sequence[ViewPair], first: int
    ) -> tuple[list[Keypoints], list[Keypoints], list[Transform]]:
        """Describe keypoints with flipped headings and dropout, in the frames of the true transforms."""
        augment = self.config.augment
        views = []
        for i, both in enumerate(pairs):
            rng = keyed_generator("feakm flip", self.seed, first + i)
            views += [_flip_headings(view, augment.flip_prob, rng) for view in (both.ego, both.other)]
        described = self.state.model.describe(views, group_size=2)
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


def train_feakm(
    config: FeakmTrainConfig,
    cache: FeatureCache,
    folder: Path,
    seed: int = 0,
    card: dict[str, Any] | None = None,
    report: Callable[[MatchProgress], None] = lambda progress: None,
) -> Path:
    """Train, or resume the run in folder; returns the file of averaged weights.

    Writes last.pt (training state), log.jsonl (one object per step) and weights.safetensors (float16).
    """
    run = FeakmRun(config, cache, folder, seed)
    state = run.state
    state.run_to_end(config.steps, config.save_every, run.advance, report)
    weights = folder / "weights.safetensors"
    if not state.rank:
        about = {"seed": seed, "steps": config.steps, "train_seconds": round(state.seconds), "config": asdict(config)}
        checkpoint.save(state.average, weights, {**about, **(card or {})}, half=True, format=FORMAT)
    return weights
