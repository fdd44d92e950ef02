# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import (
    CLASSES,
    LABELS,
    AgentFrame,
    Boxes,
    ConfigError,
    GroundTruth,
    PointCloud,
    RecordingError,
    Snapshot,
    Transform,
)
from manyeyes.evaluation.detection.average_precision import (
    PROTOCOLS,
    FrameResult,
    average_precision,
    average_precisions,
    compute_ap,
    compute_frame_iou,
    compute_frame_ious,
    filter_detections,
    get_protocol,
    match_frame,
    select_ego_truth,
)
from manyeyes.ops.box_iou import pairwise_iou

GLOBAL_SORT = PROTOCOLS["global-sort"]
NO_NMS = replace(GLOBAL_SORT, nms_iou=1.0)


def cars(*rows, size=(4.0, 2.0, 1.5), z=0.75):
    """Boxes from rows x, y, score."""
    xys = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
    center = torch.cat((xys[:, :2], torch.full((len(xys), 1), z, dtype=torch.float64)), 1)
    return Boxes.of(
        center, torch.tensor([size], dtype=torch.float64).repeat(len(xys), 1), torch.zeros(len(xys)).double(), xys[:, 2]
    )


def three_frames():
    return [
        FrameResult("a", 0, cars((0, 0, 0.9), (50, 0, 0.3)), cars((0, 0, 1), (20, 0, 1))),
        FrameResult("a", 1, cars((0, 0, 0.8), (20, 0, 0.6)), cars((20, 0, 1))),
        FrameResult("b", 0, cars((0, 0, 0.7)), cars((0, 0, 1))),
    ]


def test_three_frames_by_hand_sorted_and_concatenated():
    """By score: T F T T F, precision 1 1/2 2/3 3/4 3/5; concatenated: T F F T T, precision 1 1/2 1/3 1/2 3/5."""
    got = average_precision(three_frames(), 0.5, GLOBAL_SORT)
    assert got.ap_global == pytest.approx(0.25 + 0.25 * 0.75 + 0.25 * 0.75, abs=1e-15)
    assert got.ap_legacy == pytest.approx(0.25 + 0.25 * 0.6 + 0.25 * 0.6, abs=1e-15)
    assert (got.recall, got.precision, got.n_gt, got.n_detections) == (0.75, 0.6, 4, 5)
    assert got.ap == got.ap_global
    assert average_precision(three_frames(), 0.5, replace(GLOBAL_SORT, ap_order="concatenated")).ap == got.ap_legacy
    assert [m.tp.tolist() for m in got.frames] == [[True, False], [False, True], [True]]


def test_several_thresholds_at_once():
    frames = list(random_frames(5))
    together = average_precisions(frames, (0.3, 0.5, 0.7), GLOBAL_SORT)
    assert [r.ap_global for r in together] == [
        average_precision(frames, t, GLOBAL_SORT).ap_global for t in (0.3, 0.5, 0.7)
    ]
    assert together[0].ap_global > together[2].ap_global


def slow_matches(frame, thr):
    """(score, whether it is a hit) of each detection of a frame, by falling score; of equals the best pair is taken first."""
    found, truth, out = frame.detections, frame.truth, []
    left = list(range(len(truth)))
    for score in sorted(set(found.score.tolist()), reverse=True):
        waiting = [d for d in range(len(found)) if found.score[d].item() == score]
        while waiting:
            overlaps = {
                (d, g): pairwise_iou(found[d : d + 1].bev(), truth[g : g + 1].bev()).item()
                for d in waiting
                for g in left
            }
            best = max(overlaps, key=overlaps.__getitem__, default=None)
            hit = best is not None and overlaps[best] >= thr
            if hit:
                left.remove(best[1])
            waiting.remove(best[0] if hit else waiting[-1])
            out.append((score, hit))
    return out


def slow_ap(frames, thr, global_sort):
    """The slow twin, in plain loops, with the padded VOC area; equal scores (of one frame, unless sorted) are one step."""
    steps, n_gt = [], 0
    for k, frame in enumerate(sorted(frames, key=lambda f: (f.scenario, f.index))):
        n_gt += len(frame.truth)
        steps += [((0 if global_sort else k, -score), hit) for score, hit in slow_matches(frame, thr)]
    tp = fp = 0
    recall, precision = [0.0], [0.0]
    for key in sorted({key for key, _ in steps}):
        hits = [hit for other, hit in steps if other == key]
        tp, fp = tp + sum(hits), fp + len(hits) - sum(hits)
        recall.append(tp / n_gt)
        precision.append(tp / (tp + fp))
    recall.append(1.0)
    precision.append(0.0)
    for i in range(len(precision) - 2, -1, -1):
        precision[i] = max(precision[i], precision[i + 1])
    return sum((recall[i] - recall[i - 1]) * precision[i] for i in range(1, len(recall)))


def random_frames(n, per=8, seed=0, miss=0.25, clutter=3):
    g = torch.Generator().manual_seed(seed)
    for f in range(n):
        xy = torch.stack((torch.arange(per) * 12.0 - 40, torch.zeros(per)), 1) + torch.randn(per, 2, generator=g)
        size = torch.tensor([4.5, 1.9, 1.5]).repeat(per, 1)
        truth = Boxes.of(torch.cat((xy, torch.ones(per, 1)), 1), size, torch.randn(per, generator=g))
        found = truth[torch.rand(per, generator=g) > miss]
        found = replace(
            found,
            center=found.center + 0.3 * torch.randn(len(found), 3, generator=g),
            score=(0.5 + 0.45 * torch.rand(len(found), generator=g)).mul(50).round() / 50,
        )
        wrong = replace(
            truth[:clutter],
            center=truth.center[:clutter] + torch.tensor([0.0, 20, 0]),
            score=(0.06 + 0.8 * torch.rand(clutter, generator=g)).mul(50).round() / 50,
        )
        yield FrameResult(f"s{f // 10}", f % 10, Boxes.cat([found, wrong]), truth)


@pytest.mark.slow
@pytest.mark.parametrize("thr", [0.3, 0.5, 0.7])
def test_agrees_with_its_slow_twin(thr):
    frames = list(random_frames(12))
    got = average_precision(frames, thr, GLOBAL_SORT)
    assert got.ap_global == pytest.approx(slow_ap(frames, thr, True), abs=1e-12)
    assert got.ap_legacy == pytest.approx(slow_ap(frames, thr, False), abs=1e-12)
    assert 0.2 < got.ap_global < 0.95


def test_legacy_ap_tends_to_recall_times_precision():
    got = average_precision(list(random_frames(250, clutter=5)), 0.5, GLOBAL_SORT)
    assert got.ap_legacy == pytest.approx(got.recall * got.precision, abs=0.02)
    assert got.ap_global > got.ap_legacy + 0.1


def test_frames_without_detections_add_truth_and_frames_without_truth_add_false_positives():
    base = three_frames()
    plain = average_precision(base, 0.5, GLOBAL_SORT)
    silent = [*base, FrameResult("c", 0, Boxes.empty(), cars((0, 0, 1)))]
    got = average_precision(silent, 0.5, GLOBAL_SORT)
    assert got.n_gt == 5 and got.ap_global == pytest.approx(plain.ap_global * 4 / 5)
    skipped = average_precision(silent, 0.5, replace(GLOBAL_SORT, count_frames_without_det=False))
    assert skipped.n_gt == 4 and skipped.ap_global == plain.ap_global
    ghost = average_precision([*base, FrameResult("c", 0, cars((0, 0, 0.95)), Boxes.empty())], 0.5, GLOBAL_SORT)
    assert ghost.n_gt == 4 and ghost.precision == pytest.approx(3 / 6) and ghost.ap_global < plain.ap_global


def test_without_truth_ap_is_nan_and_without_detections_it_is_zero():
    nothing = average_precision([FrameResult("a", 0, cars((0, 0, 0.9)), Boxes.empty())], 0.5, GLOBAL_SORT)
    assert math.isnan(nothing.ap_global) and math.isnan(nothing.ap_legacy) and math.isnan(nothing.recall)
    assert nothing.precision == 0.0
    blind = average_precision([FrameResult("a", 0, Boxes.empty(), cars((0, 0, 1)))], 0.5, GLOBAL_SORT)
    assert (blind.ap_global, blind.ap_legacy, blind.recall) == (0.0, 0.0, 0.0) and math.isnan(blind.precision)
    assert math.isnan(average_precision([], 0.5, GLOBAL_SORT).ap_global)


def test_a_detection_whose_box_is_taken_takes_the_next_best_or_not():
    frame = FrameResult("a", 0, cars((0, 0, 0.9), (0.4, 0, 0.8)), cars((0, 0, 1), (1, 0, 1)))
    assert match_frame(frame, 0.5, NO_NMS).truth_row.tolist() == [0, 1]
    assert match_frame(frame, 0.5, replace(NO_NMS, matching="best")).truth_row.tolist() == [0, -1]
    assert match_frame(frame, 0.75, NO_NMS).truth_row.tolist() == [0, -1]


def test_truth_first_lets_each_box_choose():
    frame = FrameResult("a", 0, cars((0.4, 0, 0.9), (0, 0, 0.8)), cars((0, 0, 1), (1, 0, 1)))
    assert match_frame(frame, 0.7, NO_NMS).truth_row.tolist() == [0, -1]
    assert match_frame(frame, 0.7, replace(NO_NMS, matching="truth_first")).truth_row.tolist() == [1, 0]


def test_the_first_recall_segment_can_be_dropped():
    plain, dropped = (
        average_precision(three_frames(), 0.5, p) for p in (GLOBAL_SORT, replace(GLOBAL_SORT, drop_first_segment=True))
    )
    assert dropped.ap_global == pytest.approx(plain.ap_global - 0.25)


def test_iou_equal_to_the_threshold_is_a_true_positive():
    frame = FrameResult("a", 0, cars((1, 0, 0.9)), cars((0, 0, 1)))
    assert compute_frame_iou(frame, GLOBAL_SORT).iou.item() == 0.6
    assert match_frame(frame, 0.6, GLOBAL_SORT).tp.tolist() == [True]
    assert match_frame(frame, np.nextafter(0.6, 1), GLOBAL_SORT).tp.tolist() == [False]


def test_a_bus_is_dropped_by_the_six_metre_filter_alone():
    bus = cars((10, 0, 0.9), size=(11.0, 2.5, 1.5))
    assert len(filter_detections(bus, GLOBAL_SORT)) == 1
    assert len(filter_detections(bus, get_protocol("opencood"))) == 0
    frame = FrameResult("a", 0, bus, bus)
    assert average_precision([frame], 0.5, GLOBAL_SORT).ap_global == 1.0
    assert average_precision([frame], 0.5, PROTOCOLS["opencood"]).ap_global == 0.0
    turned = replace(cars((10, 0, 0.9), size=(4.5, 1.9, 1.5)), yaw=torch.tensor([math.pi / 4]).double())
    assert len(filter_detections(turned, PROTOCOLS["opencood"])) == 1


def test_range_by_centre_and_by_corners():
    edge = cars((139.5, 0, 0.9))  # its front is at 141.5
    for name, kept in (("global-sort", 1), ("opencood", 0), ("sparsealign", 1)):
        assert len(filter_detections(edge, PROTOCOLS[name])) == kept, name
        assert compute_frame_iou(FrameResult("a", 0, edge, edge), PROTOCOLS[name]).iou.shape == (kept, kept), name
    assert len(filter_detections(cars((0, 40, 0.9)), GLOBAL_SORT)) == 1  # closed
    assert len(filter_detections(cars((0, 40.001, 0.9)), GLOBAL_SORT)) == 0
    near = GLOBAL_SORT.with_range((-70.4, -38.4, -3.0, 70.4, 38.4, 1.0))
    assert len(filter_detections(cars((71, 20, 0.9), (70, 0, 0.8)), near)) == 1


def test_z_is_relative_to_the_lidar_and_used_by_legacy_protocols_only():
    tall = cars((0, 0, 0.9), size=(5.0, 2.5, 3.2), z=1.6)  # 3.2 m over the road, 1.3 m over a roof of 1.9 m
    truth = cars((0, 0, 1), size=(5.0, 2.5, 3.2), z=1.6)
    assert compute_frame_iou(FrameResult("a", 0, tall, truth), GLOBAL_SORT).iou.shape == (1, 1)
    assert compute_frame_iou(FrameResult("a", 0, tall, truth), PROTOCOLS["opencood"]).iou.shape == (0, 0)
    low = cars((0, 0, 0.9), size=(5.0, 2.5, 2.8), z=1.4)
    assert len(filter_detections(low, PROTOCOLS["opencood"])) == 1


def test_score_threshold_and_nms_of_each_protocol():
    weak = cars((0, 0, 0.2), (20, 0, 0.21), (40, 0, 0.05), (60, 0, 0.06))
    assert filter_detections(weak, GLOBAL_SORT).score.tolist() == [0.21, 0.2, 0.06]
    assert filter_detections(weak, PROTOCOLS["opencood"]).score.tolist() == [0.21]
    shifted = cars((0, 0, 0.9), (3.5, 0, 0.8))  # IoU 1/15
    assert len(filter_detections(shifted, GLOBAL_SORT)) == 2
    assert len(filter_detections(shifted, PROTOCOLS["sparsealign"])) == 1


def tied_frames():
    """Equal scores everywhere: a miss before a hit in frame 0, a hit before a miss in frame 1."""
    return [
        FrameResult("a", 0, cars((50, 0, 0.5), (0, 0, 0.5)), cars((0, 0, 1))),
        FrameResult("a", 1, cars((0, 0, 0.5), (50, 0, 0.5)), cars((0, 0, 1))),
    ]


def test_equal_scores_are_one_step():
    """All four detections at once: recall 1 at precision 1/2; frame by frame the same."""
    got = average_precision(tied_frames(), 0.5, GLOBAL_SORT)
    assert got.ap_global == got.ap_legacy == 0.5


def test_ties_of_dair_put_the_hits_of_a_frame_first():
    """H M | H M: precision 1 1/2 2/3 1/2; the first segment is dropped, so that 1/2 of recall at 2/3 is left."""
    dair = replace(NO_NMS, ties="hits_first", matching="truth_first")
    assert average_precision(tied_frames(), 0.5, dair).ap_global == pytest.approx(0.5 + 0.5 * 2 / 3)
    dropped = replace(dair, drop_first_segment=True)
    assert average_precision(tied_frames(), 0.5, dropped).ap_global == pytest.approx(0.5 * 2 / 3)


def test_ties_of_opencood_follow_numpy():
    """M H | H M, since numpy sorts few equal numbers stably: precision 0 1/2 2/3 1/2, made monotone 2/3 2/3 2/3 1/2."""
    assert np.argsort(np.full(4, -0.5)).tolist() == [0, 1, 2, 3]
    assert average_precision(tied_frames(), 0.5, replace(NO_NMS, ties="numpy")).ap_global == pytest.approx(2 / 3)
    many = replace(cars(*[(3 * k, 0, 0.5) for k in range(40)], size=(2.0, 2.0, 1.5)), id=torch.arange(40))
    got = filter_detections(many, replace(NO_NMS, ties="numpy"))
    assert got.id.tolist() == np.argsort(np.full(40, -0.5, dtype=np.float32)).tolist()


def test_the_order_of_ties_changes_nothing():
    """Coarse scores, rows of detections shuffled in every frame: the same AP to the bit, also where they compete for a box."""
    frames = [
        replace(f, detections=replace(f.detections, score=(4 * f.detections.score).round() / 4))
        for f in random_frames(6)
    ]
    frames.append(FrameResult("s9", 0, cars((0.4, 0, 0.5), (-0.4, 0, 0.5), (1, 0, 0.5)), cars((0, 0, 1), (1, 0, 1))))
    g = torch.Generator().manual_seed(1)
    shuffled = [replace(f, detections=f.detections[torch.randperm(len(f.detections), generator=g)]) for f in frames]
    assert any(not torch.equal(a.detections.center, b.detections.center) for a, b in zip(frames, shuffled))
    for protocol in (GLOBAL_SORT, NO_NMS, replace(NO_NMS, matching="best")):
        for iou in (0.5, 0.7):
            one, other = (average_precision(each, iou, protocol) for each in (frames, shuffled))
            assert (one.ap_global, one.ap_legacy, one.precision) == (other.ap_global, other.ap_legacy, other.precision)


def test_of_equal_scores_the_best_pair_is_matched_first():
    """Both of score 0.5; the one that lies exactly takes the box, whatever its row, and the other falls back to the second box."""
    truth = cars((0, 0, 1), (1, 0, 1))
    for rows in (((0.4, 0, 0.5), (0, 0, 0.5)), ((0, 0, 0.5), (0.4, 0, 0.5))):
        frame = compute_frame_iou(FrameResult("a", 0, cars(*rows), truth), NO_NMS)
        match = match_frame(frame, 0.7, NO_NMS)
        by_overlap = dict(zip(frame.iou[:, 0].round(decimals=3).tolist(), match.truth_row.tolist()))
        assert by_overlap == {1.0: 0, 0.818: 1}


def test_unknown_protocol_lists_the_known():
    with pytest.raises(ConfigError, match="global-sort, opencood, coalign, sparsealign, dair"):
        get_protocol("opencod")
    with pytest.raises(FrozenInstanceError):
        GLOBAL_SORT.score_threshold = 0.5  # pyright: ignore


# Truth of an ego.


def crossing(order=(0, 1, 2), move=None, prior_error=0.0):
    """Three agents 10, 11, 12 at x = 0, 60, 80; boxes of the agents and of four others, one with a repeated id.

    The boxes, by id: 10, 11, 12 the agents' own bodies, 1 seen by agent 10, 2 by 11 and 12, 3 by 12 only,
    2 again (another row, as a second listing would leave it).
    """
    agents = [(10, 0.0, 0.3), (11, 60.0, 0.2), (12, 80.0, -1.0)]
    ids = torch.tensor([10, 11, 12, 1, 2, 3, 2])
    x = torch.tensor([0.0, 60, 80, 20, 40, 90, 40.2]).double()
    seen = torch.tensor(
        [
            [0, 1, 0, 1, 0, 0, 0],
            [1, 0, 1, 0, 1, 0, 1],
            [0, 1, 0, 0, 1, 1, 0],
        ]
    ).bool()
    center = torch.stack((x, torch.arange(7).double(), torch.full((7,), 0.75).double()), 1)
    boxes = Boxes.of(
        center, torch.tensor([[4.0, 2, 1.5]]).double().repeat(7, 1), torch.linspace(0, 3, 7).double(), id=ids
    )
    move = move or Transform.identity()
    poses = [move @ Transform.from_xyz_yaw(px, 0.0, 0.0, yaw) for _, px, yaw in agents]
    points = [
        PointCloud.of(p.inverse().apply(center[[3, 4, 4, 4, 4]]).float())
        for p in (Transform.from_xyz_yaw(a[1], 0, 0, a[2]) for a in agents)
    ]
    wrong = [Transform.from_xyz_yaw((k + 1) * prior_error, 0) for k in range(3)]
    frames = [AgentFrame.of(points[k], wrong[k] @ poses[k], agents[k][0]) for k in order]
    truth = GroundTruth(boxes.transform(move), seen[list(order)], Transform.stack([poses[k] for k in order]))
    return Snapshot("crossing", 0, tuple(frames), truth)


def test_truth_is_the_union_of_agents_in_range_without_the_ego_and_without_repeats():
    """Agent 12 is 80 m from agent 10: what it alone sees (3) does not count for 10."""
    assert select_ego_truth(crossing(), 0, GLOBAL_SORT).id.tolist() == [11, 12, 1, 2]
    assert select_ego_truth(crossing(), 1, GLOBAL_SORT).id.tolist() == [10, 12, 1, 2, 3]
    far = replace(GLOBAL_SORT, com_range_m=100.0)
    assert select_ego_truth(crossing(), 0, far).id.tolist() == [11, 12, 1, 2, 3]
    assert select_ego_truth(crossing(), 0, replace(GLOBAL_SORT, com_range_m=1.0)).id.tolist() == [11, 1]


def test_truth_is_in_the_egos_true_frame():
    got = select_ego_truth(crossing(), 0, GLOBAL_SORT)
    assert got.center.dtype == torch.float64
    at = got.id.tolist().index(1)
    c, s = math.cos(0.3), math.sin(0.3)
    assert got.center[at].tolist() == pytest.approx([20 * c + 3 * s, -20 * s + 3 * c, 0.75])
    assert got.yaw[at].item() == pytest.approx(1.5 - 0.3)


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 2, 0), (0, 2, 1)])
def test_truth_does_not_depend_on_the_order_of_agents(order):
    one, other = (
        select_ego_truth(crossing(), 1, GLOBAL_SORT),
        select_ego_truth(crossing(order), order.index(1), GLOBAL_SORT),
    )
    assert torch.equal(one.center, other.center) and torch.equal(one.id, other.id)


def test_truth_does_not_depend_on_where_the_world_is():
    one = select_ego_truth(crossing(), 1, GLOBAL_SORT)
    other = select_ego_truth(crossing(move=Transform.from_xyz_yaw(3000, -500, 7, 2.2)), 1, GLOBAL_SORT)
    assert torch.equal(one.id, other.id)
    torch.testing.assert_close(one.center, other.center, atol=1e-9, rtol=0)


def test_agents_in_range_are_decided_by_true_poses():
    """Agent 12 is 80 m away and claims 50 m; agent 11 is 60 m away and claims 90 m."""
    for error in (-15.0, 30.0):
        one, other = (
            select_ego_truth(crossing(), 0, GLOBAL_SORT),
            select_ego_truth(crossing(prior_error=error), 0, GLOBAL_SORT),
        )
        assert torch.equal(one.id, other.id) and torch.equal(one.center, other.center)


def test_truth_respects_range_and_points():
    near = GLOBAL_SORT.with_range((-70.4, -38.4, -3.0, 25.0, 38.4, 1.0))
    assert select_ego_truth(crossing(), 0, near).id.tolist() == [1]
    # one point of box 1 and four of box 2 by each of the two agents in range; box 2's second row is its repeat
    assert select_ego_truth(crossing(), 0, replace(GLOBAL_SORT, min_points_in_gt=2)).id.tolist() == [1, 2]
    assert select_ego_truth(crossing(), 0, replace(GLOBAL_SORT, min_points_in_gt=3)).id.tolist() == [2]
    assert select_ego_truth(crossing(), 0, replace(GLOBAL_SORT, min_points_in_gt=9)).id.tolist() == []


def test_boxes_of_other_classes_are_neither_truth_nor_detections():
    """Two cars and a pedestrian; the pedestrian is found where it stands, and once beside a car."""
    scene = crossing()
    truth = replace(scene.truth.boxes, label=torch.full_like(scene.truth.boxes.label, LABELS.index("pedestrian")))
    walking = replace(scene, truth=replace(scene.truth, boxes=truth))
    assert len(select_ego_truth(walking, 0, GLOBAL_SORT)) == 0
    pedestrians = replace(GLOBAL_SORT, classes=("pedestrian",))
    assert select_ego_truth(walking, 0, pedestrians).id.tolist() == select_ego_truth(scene, 0, GLOBAL_SORT).id.tolist()
    both = cars((0, 0, 0.9), (20, 0, 0.8), (10, 0, 0.7))
    both = replace(both, label=torch.tensor([0, 3, LABELS.index("pedestrian")]))
    frame = FrameResult("s", 0, both, both)
    for protocol, count in ((GLOBAL_SORT, 2), (pedestrians, 1)):
        result = average_precision([frame], 0.5, protocol)
        assert (result.n_gt, result.n_detections, result.ap) == (count, count, 1.0)


def test_classes_are_never_matched_with_each_other():
    """A pedestrian is found as a car at the same place, and a car stands where a pedestrian was found: nothing matches."""
    pedestrian = LABELS.index("pedestrian")
    truth = replace(cars((0, 0, 1), (20, 0, 1)), label=torch.tensor([0, pedestrian]))
    found = replace(truth, label=torch.tensor([pedestrian, 0]), score=torch.tensor([0.9, 0.8]).double())
    frames = compute_frame_ious(FrameResult("s", 0, found, truth), GLOBAL_SORT.with_classes(CLASSES))
    assert [f.class_name for f in frames] == list(CLASSES)
    assert [tuple(f.iou.shape) for f in frames] == [(1, 1), (1, 1), (0, 0)]
    matches = [match_frame(f, 0.5, GLOBAL_SORT.with_classes((f.class_name,))) for f in frames]
    assert [m.tp.tolist() for m in matches] == [[False], [False], []]
    assert [compute_ap([m], GLOBAL_SORT).ap for m in matches[:2]] == [0.0, 0.0]
    with pytest.raises(ConfigError, match="of one class; the frames are of pedestrian, vehicle"):
        compute_ap(matches[:2], GLOBAL_SORT)
    with pytest.raises(ConfigError, match="of one class; protocol global-sort has vehicle, pedestrian, cyclist"):
        compute_frame_iou(FrameResult("s", 0, found, truth), GLOBAL_SORT.with_classes(CLASSES))


def test_no_class_suppresses_another():
    """A pedestrian beside a car within its box: both stay, in whatever order."""
    both = replace(cars((0, 0, 0.9), (0.5, 0, 0.8)), label=torch.tensor([0, LABELS.index("pedestrian")]))
    frames = compute_frame_ious(FrameResult("s", 0, both, both), GLOBAL_SORT.with_classes(CLASSES))
    assert [len(f.score) for f in frames] == [1, 1, 0]


def test_all_vehicles_are_one_class_also_for_dair():
    kinds = replace(cars(*((20 * k, 0, 0.9) for k in range(4))), label=torch.arange(4))
    assert [LABELS[k] for k in range(4)] == ["car", "van", "truck", "bus"]
    shown_as_cars = replace(kinds, label=torch.zeros(4, dtype=torch.int64))
    for name in ("dair", "dair-3d"):
        assert match_frame(FrameResult("s", 0, shown_as_cars, kinds), 0.5, PROTOCOLS[name]).tp.tolist() == [True] * 4


def test_a_snapshot_without_truth_is_refused():
    with pytest.raises(RecordingError, match="crossing #0 has no truth"):
        select_ego_truth(replace(crossing(), truth=None), 0, GLOBAL_SORT)


def test_ranges_on_dair_differ_where_their_sources_do() -> None:
    ranges = {
        name: PROTOCOLS[name].gt_range for name in ("dair", "coalign", "heal-dair", "costr-dair", "costr-dair-centred")
    }
    assert ranges["dair"] == (0.0, -39.68, -3.0, 100.0, 39.68, 1.0)
    assert ranges["coalign"] == (-100.8, -40.0, -3.5, 100.8, 40.0, 1.5)
    assert ranges["heal-dair"] == (-102.4, -51.2, -3.5, 102.4, 51.2, 1.5)
    for name in ("costr-dair", "costr-dair-centred"):
        x0, y0, _, x1, y1, _ = ranges[name]
        assert (x1 - x0, y1 - y0) == (102.4, 102.4) and PROTOCOLS[name].ap_order == "concatenated"
    assert ranges["costr-dair"][0] == 0.0
    assert PROTOCOLS["sparsealign-dair"].com_range_m == 200.0
    assert PROTOCOLS["sparsealign-dair"].min_points_in_gt == PROTOCOLS["sparsealign"].min_points_in_gt == 4


def test_any_corner_within_the_range_in_space_keeps_a_box():
    """Range of dair: x 0 to 100, y ±39.68 m, and in z from -1.1 to 2.9 m above the road, since its origin is 1.9 m high."""
    dair = PROTOCOLS["dair"]
    for at, z, kept in (
        ((-1.9, 0), 0.75, True),  # its front is at 0.1
        ((-2.1, 0), 0.75, False),
        ((101.9, 41.5), 0.75, False),  # a corner within x, another within y, none within both
        ((101.9, 40.6), 0.75, True),
        ((50, 0), 3.6, True),  # its underside is at 2.85
        ((50, 0), 3.7, False),
    ):
        box = cars((*at, 0.9), z=z)
        assert len(filter_detections(box, dair)) == kept, at
        assert compute_frame_iou(FrameResult("a", 0, box, box), dair).iou.shape == (kept, kept), at
        by_center = replace(dair, gt_range_mode="center", pred_range_mode="center")
        assert len(filter_detections(box, by_center)) <= kept


def test_an_overlap_on_the_ground_may_be_none_in_space():
    """The same rectangle 0.75 m higher, half of its height: 1 on the ground, 1/3 in space."""
    low, high = cars((20, 0, 0.9)), cars((20, 0, 1), z=1.5)
    frame = FrameResult("a", 0, low, high)
    for name, iou in (("dair", 1.0), ("dair-3d", 1 / 3)):
        assert compute_frame_iou(frame, PROTOCOLS[name]).iou.item() == pytest.approx(iou)
    assert average_precision([frame], 0.3, replace(PROTOCOLS["dair-3d"], drop_first_segment=False)).ap == 1.0
    assert average_precision([frame], 0.5, PROTOCOLS["dair-3d"]).ap == 0.0


def test_truth_lies_in_the_range_around_an_agent_that_lists_it():
    """Box 3 is listed by agent 12, from 10 m; box 2 by agents 11 and 12, from 20 m and 40 m; the others from 20 m too."""
    wide = replace(GLOBAL_SORT, com_range_m=100.0)
    for reach, ids in ((50.0, [11, 12, 1, 2, 3]), (21.0, [11, 12, 1, 2, 3]), (15.0, [3]), (5.0, [])):
        ranged = replace(wide, agent_range=(-reach, -reach, -3.0, reach, reach, 1.0))
        assert select_ego_truth(crossing(), 0, ranged).id.tolist() == ids


def test_opv2v_protocols_of_coalign_and_heal_differ_by_their_range_alone():
    coalign, heal = PROTOCOLS["coalign-opv2v"], PROTOCOLS["heal-opv2v"]
    assert (coalign.agent_range, heal.agent_range) == (coalign.gt_range, heal.gt_range)
    assert replace(heal, name="", gt_range=coalign.gt_range, agent_range=None) == replace(
        coalign, name="", agent_range=None
    )
    assert coalign.ap_order == "global" and coalign.score_threshold == 0.2 and heal.gt_range[3:5] == (102.4, 102.4)
