# SPDX-License-Identifier: Apache-2.0
"""The ablation of FeaKM's Table 3: with and without a confidence map, with one scale and with several.

A row for each branch and noise level: AP@0.5 and AP@0.7 of intermediate fusion by the poses that the branch's net finds,
under Gaussian errors of every agent's prior pose, the ego's among them, sigma in metres and degrees alike (the paper's
setting). A branch is a detector, whose fusion has one scale or several (Eq. 7), and a net taught on its views, with or without
a confidence map (DenseKeypoints.saliency). Frames, draws and truth are the same in all rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from manyeyes.agents.level_frame import SnapshotLeveller
from manyeyes.agents.own_detections import remove_own_body
from manyeyes.agents.perception_cache import PerceptionCache, TokenOutput
from manyeyes.datasets.base import Recording
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Snapshot
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS
from manyeyes.evaluation.detection.average_precision import (
    PROTOCOLS,
    DetectionProtocol,
    FrameMatch,
    FrameResult,
    compute_ap,
    compute_frame_iou,
    match_frame,
    select_ego_truth,
)
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.models.fusion.transform_tokens import AgentTokens, to_ego_frame
from manyeyes.models.pose.keypoint_net import DetectorView
from manyeyes.pose.feakm import FeakmCorrector
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PosePrior

SIGMAS = (0.0, 0.4, 0.8, 1.2)
"""Of the paper's Table 3, metres and degrees."""


@dataclass(frozen=True)
class FeakmVariant:
    """A line of the ablation: who sees and fuses, and who corrects."""

    name: str
    detector: BoxDetector
    corrector: FeakmCorrector

    def __post_init__(self) -> None:
        self.corrector.net.check_views(self.detector.fingerprint)


@dataclass(frozen=True)
class FeakmVariantRow:
    """One branch at one level. ap: at each of IOUS. num_frames: evaluated; num_collaborators: in them; found_fraction:
    the share of these whose pose was found.
    """

    variant: str
    sigma: float
    ap: tuple[float, ...]
    num_frames: int
    num_collaborators: int
    found_fraction: float


def run_ablation(
    recording: Recording,
    variants: Sequence[FeakmVariant],
    sigmas: Sequence[float] = SIGMAS,
    frame_stride: int = 1,
    protocol: DetectionProtocol = PROTOCOLS["global-sort"],
    seed: int = 0,
    report: Callable[[str, int], None] = lambda scenario, index: None,
) -> tuple[FeakmVariantRow, ...]:
    """Return the rows, branch by branch, over every so many evaluated frames of the recording; the first agent is the ego."""
    accumulators = {(variant.name, sigma): _VariantAccumulator() for variant in variants for sigma in sigmas}
    if len(accumulators) < len(variants) * len(sigmas):
        raise ConfigError(f"Branches have names of their own; got {', '.join(b.name for b in variants)}.")
    level = SnapshotLeveller()
    for scenario in recording.scenarios:
        for index in recording.eval_indices(scenario)[::frame_stride]:
            snapshots = [level(recording.snapshot(scenario, i)) for i in range(max(0, index - 1), index + 1)]
            truth = select_ego_truth(snapshots[-1], 0, protocol)
            for variant in variants:
                views = _CachedViews(variant, snapshots)
                for sigma in sigmas:
                    noise = PoseNoise("all_agents", sigma, math.radians(sigma), seed, "independent", "true")
                    boxes, is_found = views.fuse_with_poses(noise.apply(snapshots[-1], 0).frames)
                    overlap = compute_frame_iou(FrameResult(scenario, index, boxes, truth), protocol)
                    accumulator = accumulators[variant.name, sigma]
                    accumulator.matches.append(tuple(match_frame(overlap, iou, protocol) for iou in IOU_THRESHOLDS))
                    accumulator.is_found += is_found
            report(scenario, index)
    return tuple(accumulator.make_row(*name, protocol) for name, accumulator in accumulators.items())


class _VariantAccumulator:
    """What a row is made of."""

    def __init__(self) -> None:
        self.matches: list[tuple[FrameMatch, ...]] = []
        self.is_found: list[bool] = []

    def make_row(self, variant: str, sigma: float, protocol: DetectionProtocol) -> FeakmVariantRow:
        columns = list(zip(*self.matches)) or [()] * len(IOU_THRESHOLDS)
        found_fraction = sum(self.is_found) / len(self.is_found) if self.is_found else math.nan
        ap = tuple(compute_ap(column, protocol).ap for column in columns)
        return FeakmVariantRow(variant, sigma, ap, len(self.matches), len(self.is_found), found_fraction)


class _CachedViews:
    """What does not depend on the prior poses: every agent's view of the last snapshot, and its keypoints with the ego's.

    Of the others nothing is remembered: each would stand where another correction put it.
    """

    def __init__(self, variant: FeakmVariant, snapshots: Sequence[Snapshot]) -> None:
        self.variant = variant
        caches = {
            frame.agent_id: PerceptionCache(variant.detector) for snapshot in snapshots for frame in snapshot.frames
        }
        outputs: list[TokenOutput] = []
        for snapshot in snapshots:
            outputs = [caches[frame.agent_id].process_tokens(frame) for frame in snapshot.frames]
        self.ego_cache, self.outputs = caches[snapshots[-1].frames[0].agent_id], outputs
        self.past_tokens = self.ego_cache.previous_tokens(snapshots[-1].frames[0])
        views = [DetectorView.of(sight.shared_tokens, sight.boxes) for sight in outputs]
        with torch.no_grad():
            self.keypoints = [variant.corrector.net.describe([views[0], view]) for view in views[1:]]

    def fuse_with_poses(self, frames: Sequence[AgentFrame]) -> tuple[Boxes, list[bool]]:
        """Return boxes around the ego, and of which collaborators the pose was found."""
        own = self.outputs[0].shared_tokens
        parts, is_found = [AgentTokens(0, own.features, own.sites.xy)], []
        for output, frame, points in zip(self.outputs[1:], frames[1:], self.keypoints):
            ego, other = map(Landmarks.of_keypoints, points)
            estimate = self.variant.corrector(ego, other, PosePrior.between(frames[0], frame))
            is_found.append(estimate.status.has_estimate)
            if estimate.ego_from_other is not None:
                variances = estimate.covariance.diagonal().clip(0)
                features, xy = output.shared_tokens.features, output.shared_tokens.sites.xy
                sigma_xy_m, sigma_yaw_rad = math.sqrt(variances[:2].mean()), math.sqrt(variances[2])
                parts.append(AgentTokens(0, features, xy, estimate.ego_from_other, 0.0, sigma_xy_m, sigma_yaw_rad))
        past_cells = to_ego_frame(self.past_tokens, own.grid, 1) if self.past_tokens else None
        _, raw = self.ego_cache.fuse(to_ego_frame([*parts, *self.past_tokens], own.grid, 1), past_cells)
        return remove_own_body(self.ego_cache.decode(raw), frames[0]), is_found
