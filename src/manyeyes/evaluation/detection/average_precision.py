# SPDX-License-Identifier: Apache-2.0
"""Average precision of cooperative detection. This text is the definition of the metric.

**Frame.** Detections and truth are in the ego's own, physical frame (x forward, y left, z = 0 on the road). Errors of
prior poses displace the content of collaborators' messages; they never move the truth.

**Truth of an ego** (:func:`select_ego_truth`): the union of the boxes listed by every agent whose *true* position lies within
``com_range_m`` of the ego's (in the plane, the ego included), one box per id, without the ego's own body, moved into the
ego's frame by its *true* pose, within the range. Boxes of other classes than the protocol's (vehicles) do not count, on both sides.

**Detections that count** (:func:`filter_detections`), in this order: score > ``score_threshold``; optionally dropped when
their axis-aligned extent exceeds ``drop_large_axis_aligned_m``; optionally all corners within ``z_filter``; greedy
rotated NMS that suppresses IoU > ``nms_iou`` among the best ``nms_pre``; within the range.

**Match** (:func:`match_frame`): IoU is that of the rotated rectangles on the ground, in float64; height never enters.
Detections are walked by (-score, row). With ``matching="remaining"`` each takes the arg-max IoU among the truth boxes
still free and is a true positive when that IoU >= the threshold: equality counts, and a detection whose best box is
taken falls back to the next best. With ``"best"`` the arg-max is over all truth boxes and a box already taken makes a
false positive (the rule of PASCAL VOC). With ``"truth_first"`` each truth box, in its order, takes the free detection
of the greatest IoU (DAIR-V2X).

**AP**: with tp, fp cumulated along the list of detections, r = tp / n_gt and p = tp / (tp + fp), p made non-increasing
from the right, AP = sum of (r_i - r_{i-1}) p_i (all points, VOC 2010). ``ap_global`` orders the list by (-score, frame,
row in the frame); ``ap_legacy`` leaves it as the concatenation of frames, which is what much of the field's literature
reports: it is no precision-recall curve, tends to recall x precision, and hence depends on the score threshold, which
must be quoted with it. Frames are taken in the order (scenario, index), whatever order they come in; frames that tie
keep theirs. Without any truth, AP and recall are NaN, not 0; without any detection, precision is NaN and AP is 0.

The primary protocol ``manyeyes`` judges by box centres in the plane on both sides. The others reproduce published
code, whose rules differ; where a source does not say (score thresholds of ``sparsealign`` and ``dair``, NMS of
``dair``), OpenCOOD's value stands in. Their z ranges are those of a LiDAR frame, hence ``z_origin_m``. Their cap of
100 truth boxes a frame is not reproduced. ``coalign`` is CoAlign's setting for DAIR-V2X, and ``dair`` that of its authors.
By the same rules as CoAlign, other ranges on DAIR-V2X: ``heal-dair`` (HEAL), ``sparsealign-dair`` (SparseAlign's rules and its
test range), and CoSTr's 102.4 m × 102.4 m, which the paper does not place: ``costr-dair`` ahead of the vehicle, where the original
labels are, ``costr-dair-centred`` around it; both by the legacy AP, which its published numbers suggest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import VEHICLES, AgentFrame, Boxes, ConfigError, GroundTruth, RecordingError, Snapshot
from manyeyes.ops.box_iou import pairwise_iou
from manyeyes.ops.nms import rotated_nms

RangeMode = Literal["center_xy", "center", "corners_xy", "corners"]


@dataclass(frozen=True)
class DetectionProtocol:
    """How a detection AP is computed; the module's text defines each field.

    gt_range: x, y, z minimum, then maximum, metres. *_range_mode: box centre or all corners, in the plane or with z.
    ap_order: which of the two APs is this protocol's own. z_origin_m: height above the road of the origin that the z values
    of gt_range and z_filter are relative to. min_points_in_gt: LiDAR returns of all agents in range that a truth box
    needs. count_frames_without_det: false leaves out the truth of frames without a detection (a known defect).
    drop_first_segment: the sum for AP starts at the first detection's recall (DAIR-V2X). classes: of ``datatypes.CLASSES``; boxes
    of others are neither truth nor detections.
    """

    name: str
    ap_order: Literal["global", "concatenated"] = "global"
    score_threshold: float = 0.05
    nms_iou: float = 0.15
    nms_pre: int = 1000
    gt_range: tuple[float, float, float, float, float, float] = (-140.0, -40.0, -3.0, 140.0, 40.0, 1.0)
    gt_range_mode: RangeMode = "center_xy"
    pred_range_mode: RangeMode = "center_xy"
    drop_large_axis_aligned_m: float | None = None
    z_filter: tuple[float, float] | None = None
    z_origin_m: float = 0.0
    com_range_m: float = 70.0
    min_points_in_gt: int = 0
    count_frames_without_det: bool = True
    matching: Literal["remaining", "best", "truth_first"] = "remaining"
    drop_first_segment: bool = False
    classes: tuple[str, ...] = VEHICLES

    def with_range(self, gt_range: tuple[float, float, float, float, float, float]) -> DetectionProtocol:
        """Return the same rules over another range."""
        return replace(self, gt_range=gt_range)


_OPENCOOD = DetectionProtocol(
    name="opencood",
    ap_order="concatenated",
    score_threshold=0.20,
    gt_range_mode="corners",
    pred_range_mode="corners_xy",
    drop_large_axis_aligned_m=6.0,
    z_filter=(-3.0, 1.0),
    z_origin_m=1.9,
)

_COALIGN = replace(
    _OPENCOOD,
    name="coalign",
    ap_order="global",
    gt_range=(-100.8, -40.0, -3.5, 100.8, 40.0, 1.5),
    gt_range_mode="corners_xy",
    pred_range_mode="corners",
    com_range_m=100.0,
)

_SPARSEALIGN = DetectionProtocol(
    name="sparsealign",
    score_threshold=0.20,
    nms_iou=0.01,
    nms_pre=500,
    gt_range_mode="center",
    pred_range_mode="center",
    z_origin_m=1.9,
    min_points_in_gt=4,
)

PROTOCOLS: dict[str, DetectionProtocol] = {
    p.name: p
    for p in (
        DetectionProtocol(name="global-sort"),
        _OPENCOOD,
        _COALIGN,
        _SPARSEALIGN,
        DetectionProtocol(
            name="dair",
            score_threshold=0.20,
            gt_range=(0.0, -39.68, -3.0, 100.0, 39.68, 1.0),
            gt_range_mode="center",
            pred_range_mode="center",
            z_origin_m=1.9,
            com_range_m=math.inf,
            matching="truth_first",
            drop_first_segment=True,
        ),
        replace(_COALIGN, name="heal-dair", gt_range=(-102.4, -51.2, -3.5, 102.4, 51.2, 1.5)),
        replace(_COALIGN, name="costr-dair", ap_order="concatenated", gt_range=(0.0, -51.2, -3.5, 102.4, 51.2, 1.5)),
        replace(
            _COALIGN, name="costr-dair-centred", ap_order="concatenated", gt_range=(-51.2, -51.2, -3.5, 51.2, 51.2, 1.5)
        ),
        replace(
            _SPARSEALIGN, name="sparsealign-dair", gt_range=(-100.0, -40.0, -3.0, 100.0, 40.0, 1.0), com_range_m=200.0
        ),
    )
}


def get_protocol(name: str) -> DetectionProtocol:
    """Return the protocol of that name."""
    if name not in PROTOCOLS:
        raise ConfigError(f"No evaluation protocol is called {name!r}; known: {', '.join(PROTOCOLS)}.")
    return PROTOCOLS[name]


@dataclass(frozen=True)
class FrameResult:
    """What one ego found in one frame, and what was there; both in the ego's true frame."""

    scenario: str
    index: int
    detections: Boxes
    truth: Boxes


@dataclass(frozen=True)
class FrameIou:
    """A frame ready to be matched at any threshold: score (D,) descending, iou (D, G), both float64."""

    scenario: str
    index: int
    score: Tensor
    iou: Tensor


@dataclass(frozen=True)
class FrameMatch:
    """A matched frame: score (D,) float64 descending; truth_row (D,) int64, the box taken, -1 a false positive."""

    scenario: str
    index: int
    score: Tensor
    truth_row: Tensor
    n_gt: int

    @property
    def tp(self) -> Tensor:
        """(D,) bool: which detections are true positives; the others are false positives."""
        return self.truth_row >= 0


@dataclass(frozen=True)
class ApResult:
    """AP at one IoU threshold. ap is the protocol's own of the two; recall and precision at its score threshold."""

    ap: float
    ap_global: float
    ap_legacy: float
    recall: float
    precision: float
    n_gt: int
    n_detections: int
    frames: tuple[FrameMatch, ...]


def select_ego_truth(snapshot: Snapshot, ego: int, protocol: DetectionProtocol) -> Boxes:
    """Return the truth that frames[ego] is evaluated by, in its true frame, float64; the rule is in the module's text."""
    truth = snapshot.truth
    if truth is None:
        raise RecordingError(
            f"{snapshot.scenario} #{snapshot.index} has no truth; only recordings with labels are evaluated."
        )
    truth = truth.of_classes(protocol.classes)
    position = truth.world_from_agent.translation[:, :2]
    near = (position - position[ego]).norm(dim=-1) <= protocol.com_range_m
    listed = truth.seen[near].any(0) & (truth.boxes.id != snapshot.frames[ego].agent_id)
    if protocol.min_points_in_gt > 0:
        listed &= _count_points(snapshot.frames, truth, near) >= protocol.min_points_in_gt
    boxes = truth.boxes[_select_unique_ids(truth.boxes.id, listed)]
    boxes = boxes.to(torch.float64).transform(truth.world_from_agent[ego].inverse())
    return boxes[is_in_range(boxes, protocol, protocol.gt_range_mode)]


def _count_points(frames: Sequence[AgentFrame], truth: GroundTruth, near: Tensor) -> Tensor:
    """Return (N,) int64: the returns of the agents that are near (agents,) in each truth box."""
    count = torch.zeros(len(truth.boxes), dtype=torch.int64)
    for row in near.nonzero()[:, 0].tolist():
        boxes = truth.boxes.transform(truth.world_from_agent[row].inverse())
        count += boxes.contains(frames[row].points.xyz.to(boxes.center.dtype)).sum(1)
    return count


def _select_unique_ids(ids: Tensor, listed: Tensor) -> Tensor:
    """Return rows (K,) that are listed (N,), the first of each id; -1 marks a box without id, which is always kept."""
    seen_ids: set[int] = set()
    rows: list[int] = []
    for row in listed.nonzero()[:, 0].tolist():
        box_id = int(ids[row])
        if box_id not in seen_ids:
            rows.append(row)
        if box_id != -1:
            seen_ids.add(box_id)
    return torch.tensor(rows, dtype=torch.int64)


def is_in_range(boxes: Boxes, protocol: DetectionProtocol, mode: RangeMode) -> Tensor:
    """Return (N,) bool: which boxes lie in the protocol's range by centre or by all corners, with or without z; closed."""
    axes = 2 if mode.endswith("_xy") else 3
    shift = torch.tensor([0.0, 0.0, protocol.z_origin_m], dtype=torch.float64)
    low, high = torch.tensor(protocol.gt_range, dtype=torch.float64).view(2, 3) + shift
    points = (boxes.center[:, None] if mode.startswith("center") else boxes.corners()).double()[..., :axes]
    return ((points >= low[:axes]) & (points <= high[:axes])).all(-1).all(-1)


def filter_detections(boxes: Boxes, protocol: DetectionProtocol) -> Boxes:
    """Return the detections that count, in descending score (ties in the order given), float64."""
    boxes = boxes.of_classes(protocol.classes).to(torch.float64)
    boxes = boxes[boxes.score > protocol.score_threshold]
    corners = boxes.corners()
    keep = torch.ones(len(boxes), dtype=torch.bool)
    if protocol.drop_large_axis_aligned_m is not None and len(boxes):
        extent = corners[..., :2].amax(1) - corners[..., :2].amin(1)
        keep &= (extent <= protocol.drop_large_axis_aligned_m).all(-1)
    if protocol.z_filter is not None:
        z, (low, high) = corners[..., 2] - protocol.z_origin_m, protocol.z_filter
        keep &= ((z >= low) & (z <= high)).all(-1)
    boxes = boxes[keep]
    boxes = boxes[rotated_nms(boxes.bev(), boxes.score, protocol.nms_iou, protocol.nms_pre)]
    return boxes[is_in_range(boxes, protocol, protocol.pred_range_mode)]


def compute_frame_iou(result: FrameResult, protocol: DetectionProtocol) -> FrameIou:
    """Filters both sides by the protocol (truth by range) and computes their IoU once, for every threshold."""
    found = filter_detections(result.detections, protocol)
    truth = result.truth.of_classes(protocol.classes).to(torch.float64)
    truth = truth[is_in_range(truth, protocol, protocol.gt_range_mode)]
    return FrameIou(result.scenario, result.index, found.score, pairwise_iou(found.bev(), truth.bev()))


def match_frame(frame: FrameResult | FrameIou, iou: float, protocol: DetectionProtocol) -> FrameMatch:
    """Return which detections of a frame are true positives at an IoU threshold."""
    if isinstance(frame, FrameResult):
        frame = compute_frame_iou(frame, protocol)
    table = frame.iou.numpy()
    truth_row = np.full(table.shape[0], -1)
    if protocol.matching == "truth_first":
        pairs = _match_greedily(table.T, iou, allow_taken=False)
        truth_row[pairs[:, 1]] = pairs[:, 0]
    else:
        pairs = _match_greedily(table, iou, allow_taken=protocol.matching == "best")
        truth_row[pairs[:, 0]] = pairs[:, 1]
    return FrameMatch(frame.scenario, frame.index, frame.score, torch.from_numpy(truth_row), table.shape[1])


def _match_greedily(table: np.ndarray, threshold: float, allow_taken: bool) -> np.ndarray:
    """Return pairs (K, 2) of row and column: each row in turn takes its best free column, where that is >= the threshold.

    allow_taken: a row considers taken columns too, and gets nothing when its best is one of them.
    """
    pairs: list[tuple[int, int]] = []
    free = np.ones(table.shape[1], dtype=bool)
    for row, overlap in enumerate(table if table.shape[1] else table[:0]):
        column = int(np.argmax(overlap if allow_taken else np.where(free, overlap, -1.0)))
        if free[column] and overlap[column] >= threshold:
            free[column] = False
            pairs.append((row, column))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def average_precision(frames: Sequence[FrameResult | FrameIou], iou: float, protocol: DetectionProtocol) -> ApResult:
    """Return AP of the frames at an IoU threshold."""
    return compute_ap([match_frame(frame, iou, protocol) for frame in frames], protocol)


def average_precisions(
    frames: Sequence[FrameResult | FrameIou], ious: Sequence[float], protocol: DetectionProtocol
) -> tuple[ApResult, ...]:
    """Return AP of the frames at each IoU threshold; boxes are filtered and overlapped once."""
    ready = [compute_frame_iou(frame, protocol) if isinstance(frame, FrameResult) else frame for frame in frames]
    return tuple(average_precision(ready, iou, protocol) for iou in ious)


def compute_ap(matches: Sequence[FrameMatch], protocol: DetectionProtocol) -> ApResult:
    """Return AP of frames that are already matched."""
    matches = sort_by_frame(matches)
    n_gt = sum(count_truth(match, protocol) for match in matches)
    score = np.concatenate([m.score.numpy() for m in matches]) if matches else np.zeros(0)
    tp = np.concatenate([m.tp.numpy() for m in matches]) if matches else np.zeros(0, dtype=bool)
    ranked = tp[np.argsort(-score, kind="stable")]
    ap_global = _compute_area(ranked, n_gt, protocol.drop_first_segment)
    ap_legacy = _compute_area(tp, n_gt, protocol.drop_first_segment)
    return ApResult(
        ap=ap_global if protocol.ap_order == "global" else ap_legacy,
        ap_global=ap_global,
        ap_legacy=ap_legacy,
        recall=float(tp.sum() / n_gt) if n_gt else math.nan,
        precision=float(tp.mean()) if len(tp) else math.nan,
        n_gt=n_gt,
        n_detections=len(tp),
        frames=tuple(matches),
    )


def sort_by_frame(matches: Sequence[FrameMatch]) -> list[FrameMatch]:
    """Return frames by (scenario, index); stable."""
    return sorted(matches, key=lambda match: (match.scenario, match.index))


def count_truth(match: FrameMatch, protocol: DetectionProtocol) -> int:
    """Return how many truth boxes of a frame the protocol counts."""
    return match.n_gt if len(match.score) or protocol.count_frames_without_det else 0


def _compute_area(tp: np.ndarray, n_gt: int, drop_first_segment: bool) -> float:
    """Return the area under precision made monotone over recall, for detections (D,) in their order."""
    if n_gt == 0:
        return math.nan
    hits = np.cumsum(tp)
    envelope = np.maximum.accumulate((hits / np.arange(1, len(tp) + 1))[::-1])[::-1]
    step = tp / n_gt
    return float((step * envelope)[1 if drop_first_segment else 0 :].sum())
