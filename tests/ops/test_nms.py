# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from manyeyes.datatypes import ShapeError
from manyeyes.ops.box_iou import pairwise_iou
from manyeyes.ops.nms import find_kept, rotated_nms


def slow_nms(boxes, score, threshold, pre=1000):
    order = sorted(range(len(boxes)), key=lambda i: (-score[i].item(), i))[:pre]
    iou = pairwise_iou(boxes, boxes).tolist()
    kept = []
    for i in order:
        if all(iou[i][j] <= threshold for j in kept):
            kept.append(i)
    return kept


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("threshold", [0.0, 0.15, 0.6])
def test_equals_its_slow_twin(seed, threshold):
    g = torch.Generator().manual_seed(seed)
    boxes = torch.rand(60, 5, generator=g, dtype=torch.float64) * torch.tensor([20, 20, 5, 3, 6.0]).double() + 0.5
    score = (torch.rand(60, generator=g) * 10).round() / 10  # ties
    kept = rotated_nms(boxes, score, threshold)
    assert kept.dtype == torch.int64
    assert kept.tolist() == slow_nms(boxes, score, threshold)
    assert rotated_nms(boxes, score, threshold, max_candidates=7).tolist() == slow_nms(boxes, score, threshold, pre=7)


def test_equal_boxes_of_equal_score_keep_the_first():
    boxes = torch.tensor([[0.0, 0, 4, 2, 0.3]]).repeat(5, 1)
    assert rotated_nms(boxes, torch.ones(5), 0.15).tolist() == [0]


def test_a_suppressed_box_suppresses_no_other():
    boxes = torch.tensor([[0.0, 0, 4, 2, 0], [2, 0, 4, 2, 0], [4, 0, 4, 2, 0]])  # IoU 1/3, 1/3, 0
    assert rotated_nms(boxes, torch.tensor([0.9, 0.8, 0.7]), 0.15).tolist() == [0, 2]


def test_iou_equal_to_the_threshold_survives():
    boxes = torch.tensor([[0.0, 0, 4, 2, 0], [2, 0, 4, 2, 0]], dtype=torch.float64)
    overlap = pairwise_iou(boxes[:1], boxes[1:]).item()
    assert rotated_nms(boxes, torch.tensor([0.9, 0.8]), overlap).tolist() == [0, 1]
    assert rotated_nms(boxes, torch.tensor([0.9, 0.8]), overlap - 1e-12).tolist() == [0]


def test_empty_and_misshapen_input():
    assert rotated_nms(torch.zeros(0, 5), torch.zeros(0), 0.15).shape == (0,)
    with pytest.raises(ShapeError, match=r"score \(N,\)"):
        rotated_nms(torch.zeros(2, 5), torch.zeros(3), 0.15)


@pytest.mark.slow
def test_rectangles_that_share_sides_and_corners():
    g = torch.Generator().manual_seed(1)
    place = torch.randint(0, 4, (200, 2), generator=g).double() * torch.tensor([2.0, 1.0]).double()
    quarter = torch.randint(0, 4, (200, 1), generator=g) * (torch.pi / 2)
    boxes = torch.cat((place, torch.tensor([[4.0, 2.0]]).double().expand(200, 2), quarter + 0.4), 1)
    score = torch.rand(200, generator=g)
    assert rotated_nms(boxes, score, 0.34).tolist() == slow_nms(boxes, score, 0.34)


@pytest.mark.parametrize("max_kept", [1, 5, 17, 1000])
def test_a_search_for_the_first_few_keeps_the_first_of_all(max_kept: int) -> None:
    g = torch.Generator().manual_seed(7)
    boxes = torch.rand(90, 5, generator=g, dtype=torch.float64) * torch.tensor([20, 20, 5, 3, 6.0]).double()
    boxes[::9, 2] = 0.0
    boxes[4] = torch.nan
    every = find_kept(boxes.numpy(), 0.15, len(boxes)).nonzero()[0]
    assert 17 < len(every) < 90
    assert find_kept(boxes.numpy(), 0.15, max_kept).nonzero()[0].tolist() == every[:max_kept].tolist()
