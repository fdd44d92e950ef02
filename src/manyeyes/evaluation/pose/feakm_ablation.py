# SPDX-License-Identifier: Apache-2.0
"""The ablation of FeaKM's Table 3: with and without a confidence map, with one scale and with several.

A row for each branch and noise level: AP@0.5 and AP@0.7 of intermediate fusion by the poses that the branch's net finds,
under Gaussian errors of every agent's claimed pose, the ego's among them, sigma in metres and degrees alike (the paper's
setting). A branch is a detector, whose fusion has one scale or several (Eq. 7), and a net taught on its views, with or without
a confidence map (DenseKeypoints.saliency). Frames, draws and truth are the same in all rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from manyeyes.agents.agent import OWN_BODY_M
from manyeyes.agents.perception_cache import Eyes, Sight
from manyeyes.datasets.base import Recording
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Snapshot
from manyeyes.evaluation.detection.accumulator import IOUS
from manyeyes.evaluation.detection.average_precision import (
    PROTOCOLS,
    FrameMatch,
    FrameResult,
    Protocol,
    ap_of_matches,
    ego_truth,
    match_frame,
    overlap_frame,
)
from manyeyes.models.detector.detector import Detector
from manyeyes.models.fusion.transform_tokens import Part, gather
from manyeyes.models.pose.keypoint_net import View
from manyeyes.pose.feakm import Feakm
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseClaim

SIGMAS = (0.0, 0.4, 0.8, 1.2)
"""Of the paper's Table 3, metres and degrees."""


@dataclass(frozen=True)
class Branch:
    """A line of the ablation: who sees and fuses, and who corrects."""

    name: str
    detector: Detector
    corrector: Feakm

    def __post_init__(self) -> None:
        self.corrector.net.check_views(self.detector.fingerprint)


@dataclass(frozen=True)
class BranchRow:
    """One branch at one level. ap: at each of IOUS. frames: judged; asked: collaborators in them; answered: the share of
    these whose pose was found.
    """

    branch: str
    sigma: float
    ap: tuple[float, ...]
    frames: int
    asked: int
    answered: float


def ablation(
    recording: Recording,
    branches: Sequence[Branch],
    sigmas: Sequence[float] = SIGMAS,
    every: int = 1,
    protocol: Protocol = PROTOCOLS["manyeyes"],
    seed: int = 0,
    report: Callable[[str, int], None] = lambda scenario, index: None,
) -> tuple[BranchRow, ...]:
    """The rows, branch by branch, over every so many judged frames of the recording; the first agent is the ego."""
    lines = {(branch.name, sigma): _Line() for branch in branches for sigma in sigmas}
    if len(lines) < len(branches) * len(sigmas):
        raise ConfigError(f"Branches have names of their own; got {', '.join(b.name for b in branches)}.")
    for scenario in recording.scenarios:
        for index in recording.judged(scenario)[::every]:
            snapshots = [recording.snapshot(scenario, i) for i in range(max(0, index - 1), index + 1)]
            truth = ego_truth(snapshots[-1], 0, protocol)
            for branch in branches:
                scene = _Scene(branch, snapshots)
                for sigma in sigmas:
                    noise = PoseNoise("all_agents_iid", sigma, math.radians(sigma), seed)
                    boxes, answers = scene.perceive(noise.apply(snapshots[-1], 0).frames)
                    overlap = overlap_frame(FrameResult(scenario, index, boxes, truth), protocol)
                    line = lines[branch.name, sigma]
                    line.matches.append(tuple(match_frame(overlap, iou, protocol) for iou in IOUS))
                    line.answers += answers
            report(scenario, index)
    return tuple(line.row(*name, protocol) for name, line in lines.items())


class _Line:
    """What a row is made of."""

    def __init__(self) -> None:
        self.matches: list[tuple[FrameMatch, ...]] = []
        self.answers: list[bool] = []

    def row(self, branch: str, sigma: float, protocol: Protocol) -> BranchRow:
        columns = list(zip(*self.matches)) or [()] * len(IOUS)
        share = sum(self.answers) / len(self.answers) if self.answers else math.nan
        ap = tuple(ap_of_matches(column, protocol).ap for column in columns)
        return BranchRow(branch, sigma, ap, len(self.matches), len(self.answers), share)


class _Scene:
    """What does not depend on the claimed poses: every agent's view of the last snapshot, and its keypoints with the ego's.

    Of the others nothing is remembered: each would stand where another correction put it.
    """

    def __init__(self, branch: Branch, snapshots: Sequence[Snapshot]) -> None:
        self.branch = branch
        eyes = {frame.agent_id: Eyes(branch.detector) for snapshot in snapshots for frame in snapshot.frames}
        sights: list[Sight] = []
        for snapshot in snapshots:
            sights = [eyes[frame.agent_id].see(frame) for frame in snapshot.frames]
        self.ego_eyes, self.sights = eyes[snapshots[-1].frames[0].agent_id], sights
        self.past = self.ego_eyes.past(snapshots[-1].frames[0])
        views = [View.of(sight.told, sight.boxes) for sight in sights]
        with torch.no_grad():
            self.points = [branch.corrector.net.describe([views[0], view]) for view in views[1:]]

    def perceive(self, frames: Sequence[AgentFrame]) -> tuple[Boxes, list[bool]]:
        """Boxes around the ego, and of which collaborators the pose was found."""
        own = self.sights[0].told
        parts, answers = [Part(0, own.features, own.sites.xy)], []
        for sight, frame, points in zip(self.sights[1:], frames[1:], self.points):
            ego, other = map(Landmarks.of_keypoints, points)
            said = self.branch.corrector(ego, other, PoseClaim.between(frames[0], frame))
            answers.append(said.status.answered)
            if said.ego_from_other is not None:
                doubt = said.covariance.diagonal().clip(0)
                told, xy = sight.told.features, sight.told.sites.xy
                across, turn = math.sqrt(doubt[:2].mean()), math.sqrt(doubt[2])
                parts.append(Part(0, told, xy, said.ego_from_other, 0.0, across, turn))
        looked_back = gather(self.past, own.grid, 1) if self.past else None
        boxes = self.ego_eyes.decode(self.ego_eyes.fuse(gather([*parts, *self.past], own.grid, 1), looked_back))
        apart = (boxes.center[:, 0].abs() > OWN_BODY_M[0]) | (boxes.center[:, 1].abs() > OWN_BODY_M[1])
        return boxes if frames[0].is_infrastructure else boxes[apart], answers
