# SPDX-License-Identifier: Apache-2.0
"""Average precision of cooperative detection. This text is the definition of the metric.

**Frame.** Detections and truth are in the ego's own, physical frame (x forward, y left, z = 0 on the road). Errors of
prior poses displace the content of collaborators' messages; they never move the truth.

**Class.** Every metric is of one class of ``datatypes.CLASSES``: boxes of other classes do not count on both sides, suppress
nothing and match nothing. Several classes are several metrics, never pooled.

**Truth of an ego** (:func:`select_ego_truth`): the union of the boxes listed by every agent whose *true* position lies within
``com_range_m`` of the ego's (in the plane, the ego included), one box per id, without the ego's own body, moved into the
ego's frame by its *true* pose, within the range. With ``agent_range``, of each agent's list only the boxes in that range of its own
true frame.

**Detections that count** (:func:`filter_detections`), in this order: score > ``score_threshold``; optionally dropped when
their axis-aligned extent exceeds ``drop_large_axis_aligned_m``; optionally all corners within ``z_filter``; greedy
rotated NMS that suppresses IoU > ``nms_iou`` among the best ``nms_pre``; within the range.

**Range** (:func:`is_in_range`): by the centre, by all corners, or by any corner, in the plane or with z; closed.

**Match** (:func:`match_frame`): IoU is that of the rotated rectangles on the ground (``bev``), or of the upright boxes in space
(``3d``), in float64. Detections are walked by falling score. With ``matching="remaining"`` each takes the arg-max IoU among the
truth boxes still free and is a true positive when that IoU >= the threshold: equality counts, and a detection whose best box is
taken falls back to the next best. With ``"best"`` the arg-max is over all truth boxes and a box already taken makes a false
positive (the rule of PASCAL VOC). With ``"truth_first"`` each truth box, in its order, takes the free detection of the greatest
IoU, of equal ones the last (DAIR-V2X).

**Ties.** With ``ties="together"`` detections of equal score form one step of the curve, and in a frame they are matched
together, the pair of the greatest IoU first: their order changes nothing. With ``"numpy"`` scores are float32 and sorted by
numpy's default ``argsort``, in each frame and in the list, as OpenCOOD's code does: the sort is not stable, and the order of
ties is that of the installed numpy and processor. With ``"hits_first"`` sorts are stable, and the true positives of a frame
precede its false ones (DAIR-V2X).

**AP**: with tp, fp cumulated along the list of detections, r = tp / n_gt and p = tp / (tp + fp), p made non-increasing
from the right, AP = sum of (r_i - r_{i-1}) p_i (all points, VOC 2010). ``ap_global`` orders the list by falling score;
``ap_legacy`` leaves it as the concatenation of frames, which is what much of the field's literature
reports: it is no precision-recall curve, tends to recall x precision, and hence depends on the score threshold, which
must be quoted with it. Frames are taken in the order (scenario, index), whatever order they come in; frames that tie
keep theirs. Without any truth, AP and recall are NaN, not 0; without any detection, precision is NaN and AP is 0.

The primary protocol ``global-sort`` judges by box centres in the plane on both sides. All others: :mod:`.protocols`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, RecordingError, Snapshot
from manyeyes.evaluation.detection.frame_match import (
    FrameIou,
    FrameMatch,
    FrameResult,
    Order,
    count_truth,
    rank_matches,
    sort_by_frame,
    sum_groups,
)
from manyeyes.evaluation.detection.protocols import PROTOCOLS, DetectionProtocol, RangeMode, get_protocol
from manyeyes.ops.box_iou import pairwise_iou, pairwise_iou_3d
from manyeyes.ops.nms import rotated_nms

__all__ = [
    "PROTOCOLS", "ApResult", "DetectionProtocol", "FrameIou", "FrameMatch", "FrameResult", "average_precision",
    "average_precisions", "compute_ap", "compute_frame_iou", "compute_frame_ious", "count_truth", "filter_detections",
    "get_protocol", "is_in_range", "match_frame", "select_ego_truth", "sort_by_frame",
]  # fmt: skip

MIN_OVERLAP_IOU = 0.1
"""Minimum IoU of a detection with the truth box that it is a detection of, correct or not."""


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
            f"{snapshot.scenario} #{snapshot.index} has no truth; only recordings with labels are evaluated. "
            "'manyeyes view' draws one without."
        )
    truth = truth.of_classes(protocol.classes)
    position = truth.world_from_agent.translation[:, :2]
    near = (position - position[ego]).norm(dim=-1) <= protocol.com_range_m
    seen = truth.seen if protocol.agent_range is None else truth.seen & _is_in_agent_range(truth, protocol)
    listed = seen[near].any(0) & (truth.boxes.id != snapshot.frames[ego].agent_id)
    if protocol.min_points_in_gt > 0:
        listed &= _count_points(snapshot.frames, truth, near) >= protocol.min_points_in_gt
    boxes = truth.boxes[_select_unique_ids(truth.boxes.id, listed)]
    boxes = boxes.to(torch.float64).transform(truth.world_from_agent[ego].inverse())
    return boxes[is_in_range(boxes, protocol, protocol.gt_range_mode)]


def _is_in_agent_range(truth: GroundTruth, protocol: DetectionProtocol) -> Tensor:
    """Return (agents, N) bool: which boxes lie in the range around each agent, by the mode of the truth."""
    around = replace(protocol, gt_range=protocol.agent_range or protocol.gt_range)
    boxes = truth.boxes.to(torch.float64)
    rows = [
        is_in_range(boxes.transform(truth.world_from_agent[row].inverse()), around, protocol.gt_range_mode)
        for row in range(len(truth.seen))
    ]
    return torch.stack(rows) if rows else truth.seen


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
    """Return (N,) bool: which boxes lie in the protocol's range by centre, all or any corners, with or without z; closed."""
    axes = 2 if mode.endswith("_xy") else 3
    shift = torch.tensor([0.0, 0.0, protocol.z_origin_m], dtype=torch.float64)
    low, high = torch.tensor(protocol.gt_range, dtype=torch.float64).view(2, 3) + shift
    points = (boxes.center[:, None] if mode.startswith("center") else boxes.corners()).double()[..., :axes]
    inside = ((points >= low[:axes]) & (points <= high[:axes])).all(-1)
    return inside.any(-1) if mode == "any_corner" else inside.all(-1)


def filter_detections(boxes: Boxes, protocol: DetectionProtocol) -> Boxes:
    """Return the detections of the protocol's one class that count, in descending score, ties by its rule, float64."""
    boxes = boxes.of_classes((protocol.class_name,)).to(torch.float64)
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
    if protocol.ties == "together":
        boxes = boxes[_order_canonically(boxes)]
    boxes = boxes[rotated_nms(boxes.bev(), boxes.score, protocol.nms_iou, protocol.nms_pre)]
    boxes = boxes[is_in_range(boxes, protocol, protocol.pred_range_mode)]
    if protocol.ties == "numpy":
        return boxes[torch.from_numpy(np.argsort(-boxes.score.float().numpy()))]
    return boxes


def _order_canonically(boxes: Boxes) -> Tensor:
    """Return rows (N,) by falling score, equal scores by position, size and heading: no order of the input is left."""
    columns = torch.cat((boxes.center, boxes.size, boxes.yaw[:, None]), 1).numpy().T
    return torch.from_numpy(np.lexsort((*columns[::-1], -boxes.score.numpy())))


def compute_frame_iou(result: FrameResult, protocol: DetectionProtocol) -> FrameIou:
    """Filter both sides by the protocol (truth by range), which has one class, and compute their IoU once for every threshold."""
    found = filter_detections(result.detections, protocol)
    truth = result.truth.of_classes(protocol.classes).to(torch.float64)
    truth = truth[is_in_range(truth, protocol, protocol.gt_range_mode)]
    iou = pairwise_iou_3d(found, truth) if protocol.iou_kind == "3d" else pairwise_iou(found.bev(), truth.bev())
    return FrameIou(result.scenario, result.index, found.score, iou, protocol.class_name)


def compute_frame_ious(result: FrameResult, protocol: DetectionProtocol) -> tuple[FrameIou, ...]:
    """Compute the same of each class of the protocol by itself, in their order."""
    return tuple(compute_frame_iou(result, protocol.with_classes((name,))) for name in protocol.classes)


def match_frame(frame: FrameResult | FrameIou, iou: float, protocol: DetectionProtocol) -> FrameMatch:
    """Return which detections of a frame are true positives at an IoU threshold."""
    if isinstance(frame, FrameResult):
        frame = compute_frame_iou(frame, protocol)
    table, score = frame.iou.numpy(), frame.score.numpy()
    truth_row = np.full(table.shape[0], -1)
    if protocol.matching == "truth_first":
        # Each truth box prefers the last of equals: rows of detections in reverse.
        pairs = _match_greedily(table[::-1].T, iou, allow_taken=False)
        truth_row[len(table) - 1 - pairs[:, 1]] = pairs[:, 0]
    else:
        match = _match_tied_together if protocol.ties == "together" and _has_ties(score) else _match_in_order
        pairs = match(table, score, iou, protocol.matching == "best")
        truth_row[pairs[:, 0]] = pairs[:, 1]
    best = table.argmax(1) if table.shape[1] else np.zeros(len(table), dtype=np.int64)
    overlaps = table.max(1, initial=0.0) >= MIN_OVERLAP_IOU
    return FrameMatch(
        frame.scenario,
        frame.index,
        frame.score,
        torch.from_numpy(truth_row),
        table.shape[1],
        frame.class_name,
        torch.from_numpy(np.where(overlaps, best, -1)),
    )


def _has_ties(score: NDArray[np.float64]) -> bool:
    """Return whether any of the scores (D,), which are sorted, are equal."""
    return bool((score[1:] == score[:-1]).any())


def _match_in_order(
    table: NDArray[np.float64], score: object, threshold: float, allow_taken: bool
) -> NDArray[np.int64]:
    """Match rows one after another, whatever their scores."""
    return _match_greedily(table, threshold, allow_taken)


def _match_greedily(table: NDArray[np.float64], threshold: float, allow_taken: bool) -> NDArray[np.int64]:
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


def _match_tied_together(
    table: NDArray[np.float64], score: NDArray[np.float64], threshold: float, allow_taken: bool
) -> NDArray[np.int64]:
    """Return the pairs of :func:`_match_greedily`, where of rows of equal score the one with the greatest IoU comes first."""
    pairs: list[tuple[int, int]] = []
    free = np.ones(table.shape[1], dtype=bool)
    starts = np.flatnonzero(np.diff(score, prepend=np.inf))
    for rows in np.split(np.arange(len(score)), starts[1:]) if table.shape[1] else []:
        waiting = rows
        while len(waiting):
            overlaps = table[waiting] if allow_taken else np.where(free, table[waiting], -1.0)
            at, column = np.unravel_index(int(np.argmax(overlaps)), overlaps.shape)
            if overlaps[at, column] < threshold:
                break
            if free[column]:
                free[column] = False
                pairs.append((int(waiting[at]), int(column)))
            waiting = np.delete(waiting, at)
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
    """Return AP of frames that are already matched, all of one class."""
    matches = sort_by_frame(matches)
    n_gt = sum(count_truth(match, protocol) for match in matches)
    ap_global, ap_legacy = (_compute_area(matches, n_gt, protocol, order) for order in ("global", "concatenated"))
    num_hits, num_found = sum(int(m.tp.sum()) for m in matches), sum(len(m.score) for m in matches)
    return ApResult(
        ap=ap_global if protocol.ap_order == "global" else ap_legacy,
        ap_global=ap_global,
        ap_legacy=ap_legacy,
        recall=num_hits / n_gt if n_gt else math.nan,
        precision=num_hits / num_found if num_found else math.nan,
        n_gt=n_gt,
        n_detections=num_found,
        frames=tuple(matches),
    )


def _compute_area(matches: Sequence[FrameMatch], n_gt: int, protocol: DetectionProtocol, order: Order) -> float:
    """Return the area under precision made monotone over recall, for the detections of frames in an order."""
    if n_gt == 0:
        return math.nan
    ranked = rank_matches(matches, protocol, order)
    gain = sum_groups(ranked.tp.astype(np.float64), ranked.group_start)
    num_seen = np.cumsum(sum_groups(np.ones(len(ranked.tp)), ranked.group_start))
    envelope = np.maximum.accumulate((np.cumsum(gain) / np.maximum(num_seen, 1))[::-1])[::-1]
    return float((gain * envelope)[1 if protocol.drop_first_segment else 0 :].sum() / n_gt)
