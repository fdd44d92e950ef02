# SPDX-License-Identifier: Apache-2.0
"""Encoding and decoding of boxes at every head stride; decoding of unusual batches."""

import math
from dataclasses import fields, replace

import pytest
import torch

from manyeyes.datatypes import LABELS, VEHICLE_LABELS, BevGrid, Boxes, ConfigError, Sites, SparseBev
from manyeyes.models.detector import box_head
from manyeyes.models.detector.box_head import (
    BOX_LAYOUT,
    SPEED_UNIT,
    TYPICAL_SIZE,
    WIDTHS,
    BoxHead,
    DecodeConfig,
    RawBoxes,
    RefineHead,
    decode,
)
from manyeyes.ops.box_iou import pairwise_iou
from manyeyes.training.detector.targets import TargetConfig, assign_targets

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0)


def every_site(stride: int, batch_size: int = 1) -> Sites:
    grid = GRID.at(stride)
    return Sites(torch.arange(batch_size * grid.shape[0] * grid.shape[1]), grid, batch_size)


def some_boxes(n: int = 6, seed: int = 0) -> Boxes:
    random = torch.Generator().manual_seed(seed)
    angle = torch.arange(n) * 2 * math.pi / n
    center = torch.stack((angle.cos() * 17, angle.sin() * 17, torch.rand(n, generator=random) + 0.5), 1)
    size = torch.tensor(TYPICAL_SIZE) * (0.8 + 0.6 * torch.rand(n, 3, generator=random))
    yaw = torch.rand(n, generator=random) * 2 * math.pi - math.pi
    velocity = 12 * torch.randn(n, 2, generator=random)
    return Boxes.of(center, size, yaw, label=torch.arange(n) % len(VEHICLE_LABELS), velocity=velocity)


def encode(boxes: Boxes, sites: Sites) -> RawBoxes:
    """The raw boxes of a perfect head: the inverse of decode."""
    targets = assign_targets(sites, [boxes], TargetConfig(assign_radius_m=sites.grid.cell_size_m * 1.5))
    n, at, truth = len(sites), targets.positive.nonzero()[:, 0], boxes[targets.box[targets.positive]]
    values = [torch.zeros(n, w) for w in WIDTHS]
    values[0][:] = -20.0
    values[0][at] = 20.0
    values[1][at] = (truth.center[:, :2] - sites.xy[at]) / sites.grid.cell_size_m
    values[2][at] = truth.center[:, 2:]
    values[3][at] = (truth.size / torch.tensor(TYPICAL_SIZE)).log()
    values[4][at] = torch.stack(((2 * truth.yaw).cos(), (2 * truth.yaw).sin()), 1)
    values[5][at] = 8.0 * torch.stack((truth.yaw.cos(), truth.yaw.sin()), 1)
    values[6][at, truth.label] = 5.0
    values[7][at] = math.log(0.25)
    values[9][:] = 20.0
    values[10][at] = truth.velocity / SPEED_UNIT
    return RawBoxes.of(torch.cat(values, 1), sites)


@pytest.mark.parametrize("stride", (2, 4, 8))
def test_decode_inverts_encode(stride):
    boxes = some_boxes()
    (found,) = decode(encode(boxes, every_site(stride)), DecodeConfig())
    assert len(found) == len(boxes)
    order = torch.cdist(boxes.center[:, :2], found.center[:, :2]).argmin(1)
    found = found[order]
    assert torch.allclose(found.center, boxes.center, atol=1e-5)
    assert torch.allclose(found.size, boxes.size, atol=1e-5)
    turn = found.yaw - boxes.yaw
    assert torch.allclose(torch.atan2(turn.sin(), turn.cos()), torch.zeros(len(boxes)), atol=1e-5)
    assert torch.equal(found.label, boxes.label)
    assert torch.allclose(found.velocity, boxes.velocity, atol=1e-4) and float(boxes.velocity.norm(dim=1).min()) > 1
    assert torch.allclose(found.sigma_xy, torch.full((len(boxes),), 0.25))
    assert (found.p_flip < 1e-3).all() and (found.score > 0.99).all()


def test_half_cell_shift_of_centres_is_detected():
    # What the field often gets wrong: (o + 0.5) * stride * pillar. Were the grid to say so, boxes would move by 1.4 m.
    sites = every_site(8)
    wrong = GRID.x_min + (sites.yx[:, 1] + 0.5) * 8 * GRID.pillar
    assert torch.allclose(wrong - sites.xy[:, 0], torch.full((len(sites),), 1.4), atol=1e-4)


def test_opposite_heading_gives_same_rectangle_and_flip_probability():
    boxes = some_boxes()
    raw = encode(boxes, every_site(4))
    turned = replace(raw, direction=-raw.direction * 0.1)
    (found,), (back,) = decode(raw, DecodeConfig()), decode(turned, DecodeConfig())
    overlap = pairwise_iou(found.bev().double(), back.bev().double())
    assert torch.allclose(overlap.max(1).values, torch.ones(len(found)).double(), atol=1e-5)
    twin = back.yaw[overlap.argmax(1)] - found.yaw
    assert torch.allclose(twin.cos(), -torch.ones(len(found)), atol=1e-5)
    p_flip = 1 - 1 / (1 + math.exp(-0.8))
    assert torch.allclose(back.p_flip, torch.full((len(found),), p_flip), atol=1e-5)


def test_heading_is_continuous_at_ninety_degrees():
    """A hair of error in the axis at ±90 degrees turns its representative by pi; the heading stays."""
    for yaw in (math.pi / 2 - 1e-3, math.pi / 2 + 1e-3, -math.pi / 2 - 1e-3, -math.pi / 2 + 1e-3):
        box = Boxes.of(torch.tensor([[3.0, 4.0, 0.8]]), torch.tensor([[4.5, 1.9, 1.6]]), torch.tensor([yaw]))
        raw = encode(box, every_site(4))
        for error in (-4e-3, 4e-3):
            c, s = math.cos(error), math.sin(error)
            off = torch.stack((raw.axis[:, 0] * c - raw.axis[:, 1] * s, raw.axis[:, 0] * s + raw.axis[:, 1] * c), 1)
            (found,) = decode(replace(raw, axis=off), DecodeConfig())
            assert math.cos(float(found.yaw[0]) - yaw) > 0.999
            assert float(found.p_flip[0]) < 1e-3


def test_batch_with_none_few_and_too_many_boxes():
    sites = every_site(8, batch_size=3)
    per_grid = len(sites) // 3
    heat = torch.full((len(sites),), -20.0)
    heat[per_grid : per_grid + 2] = 4.0
    heat[2 * per_grid :] = 4.0
    zeros = [torch.zeros(len(sites), w).squeeze(1) for w in WIDTHS[1:]]
    raw = RawBoxes(sites, heat, *zeros)
    # Two cells of a row are 3.2 m apart: cars of 4.5 m on them share 1.3 of 7.7 m, an IoU of 0.169.
    none, few, many = decode(raw, DecodeConfig(nms_iou=0.18, max_boxes=50))
    assert (len(none), len(few), len(many)) == (0, 2, 50)
    assert len(decode(raw, DecodeConfig(nms_iou=0.16))[1]) == 1


def test_no_sites_no_boxes():
    head = BoxHead(8, 16).eval()
    raw = head(SparseBev(torch.zeros(0, 8), Sites(torch.zeros(0, dtype=torch.int64), GRID.at(4), 2)))
    assert [len(b) for b in decode(raw, DecodeConfig())] == [0, 0]


def test_scores_descend_and_combine_heatmap_with_iou():
    sites = every_site(8)
    raw = encode(some_boxes(), sites)
    heat = torch.where(raw.heatmap_logit > 0, torch.linspace(0.1, 2.0, len(sites)), raw.heatmap_logit)
    raw = replace(raw, heatmap_logit=heat, iou_logit=torch.zeros(len(sites)))
    (found,) = decode(raw, DecodeConfig(iou_score_weight=0.5))
    assert (found.score[:-1] >= found.score[1:]).all()
    best = torch.sigmoid(heat[raw.heatmap_logit > 0]).max()
    assert float(found.score[0]) == pytest.approx(float((best * 0.5) ** 0.5), abs=1e-6)


def test_untrained_head_predicts_few_boxes():
    torch.manual_seed(0)
    head = BoxHead(8, 16).eval()
    with torch.no_grad():
        raw = head(SparseBev(torch.randn(64, 8), Sites(torch.arange(64), GRID.at(8))))
    assert 0.05 < float(torch.sigmoid(raw.heatmap_logit).mean()) < 0.2


CLASSES_IN_ORDER = ("vehicle", "pedestrian", "cyclist")


def test_one_heat_map_per_class_gives_boxes_with_labels_and_suppresses_within_a_class() -> None:
    """A car and a pedestrian share a cell, and a cyclist stands elsewhere; a second pedestrian there is suppressed."""
    sites = every_site(1)
    boxes = Boxes.of([[3.0, 2.0, 0.8]], [[4.0, 1.8, 1.5]], [0.3], label=[2])
    raw = encode(boxes.to(torch.float32), sites)
    best = int(raw.heatmap_logit.argmax())
    heat = torch.full((len(sites), 3), -9.0)
    heat[best, 0], heat[best, 1], heat[best + 1, 1], heat[0, 2] = 2.0, 1.0, 0.5, 1.5
    several = replace(raw, class_heat=heat, classes=CLASSES_IN_ORDER, iou_logit=torch.full((len(sites),), 4.0))
    several = replace(several, offset=several.offset.clone())
    several.offset[best + 1] = several.offset[best] + (sites.xy[best] - sites.xy[best + 1]) / sites.grid.cell_size_m
    for name in ("z", "log_size", "axis", "direction", "class_logits"):
        value = getattr(several, name).clone()
        value[best + 1] = value[best]
        several = replace(several, **{name: value})
    (found,) = decode(several, DecodeConfig())
    assert [LABELS[label] for label in found.label.tolist()] == ["truck", "cyclist", "pedestrian"]
    assert found.score.tolist() == sorted(found.score.tolist(), reverse=True)
    torch.testing.assert_close(found.center[0], found.center[2])


def test_a_head_of_several_classes_shows_the_maximum_to_proposals_and_selection() -> None:
    torch.manual_seed(3)
    x = SparseBev(torch.randn(len(every_site(2)), 8), every_site(2))
    head, refine = BoxHead(8, 16, CLASSES_IN_ORDER).eval(), RefineHead(8, 16, CLASSES_IN_ORDER).eval()
    raw = head(x)
    assert raw.class_heat is not None and raw.class_heat.shape == (len(x.sites), 3)
    assert torch.equal(raw.heatmap_logit, raw.class_heat.amax(1)) and raw.to_rows().shape[1] == sum(WIDTHS)
    refined = refine(x, raw.to_rows())
    assert refined.class_heat is not None and refined.classes == CLASSES_IN_ORDER
    assert torch.equal(refined.class_heat, raw.heatmap_logit[:, None].expand(-1, 3))  # residuals begin at zero
    some = raw.select(torch.tensor([1, 3]))
    assert some.class_heat is not None and torch.equal(some.class_heat, raw.class_heat[[1, 3]])


def test_one_class_has_the_tensors_of_earlier_weights() -> None:
    assert {k: v.shape for k, v in BoxHead(8, 16).state_dict().items()} == {
        k: v.shape for k, v in BoxHead(8, 16, ("vehicle",)).state_dict().items()
    }
    assert BoxHead(8, 16).out.out_features == sum(WIDTHS) and BoxHead(8, 16, ("pedestrian",)).out.out_features == sum(
        WIDTHS
    )


@pytest.mark.parametrize("classes", [(), ("vehicle", "vehicle"), ("vehicle", "horse")])
def test_classes_that_cannot_be_are_refused(classes: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="class"):
        BoxHead(8, 16, classes)


def test_compiled_decoding_equals_decoding_by_tensors() -> None:
    """Two grids, boxes that overlap, equal scores, sizes beyond the clamp, and headings that turn round."""
    rng = torch.Generator().manual_seed(3)
    grid = BevGrid(-12.8, -12.8, -3.0, 12.8, 12.8, 5.0, 0.4, 4)
    keys = torch.arange(0, 2 * 256, 2)
    rows = 2 * torch.randn(len(keys), BOX_LAYOUT.total, generator=rng)
    rows[:, BOX_LAYOUT.log_size] *= 0.3
    rows[7, BOX_LAYOUT.log_size] = 9.0
    rows[20:23] = rows[20]
    raw = RawBoxes.of(rows, Sites(keys, grid, 2))
    configs = (
        DecodeConfig(),
        DecodeConfig(score_threshold=0.3, max_boxes=20),
        DecodeConfig(score_threshold=0.0),
        DecodeConfig(score_threshold=0.5, iou_score_weight=0.9, max_boxes=11),
        DecodeConfig(iou_score_weight=0.0),
    )
    for config in configs:
        for got, want in zip(decode(raw, config), box_head._decode_by_tensors(raw, raw.heatmap_logit, config)):
            assert 10 < len(want) == len(got)
            for field in fields(Boxes):
                a, b = getattr(got, field.name), getattr(want, field.name)
                assert a.dtype == b.dtype and torch.allclose(a.double(), b.double(), atol=1e-5, rtol=1e-5), field.name


def test_boxes_of_rows_give_back_these_rows_and_changed_ones_others() -> None:
    rows = torch.randn(3, BOX_LAYOUT.total)
    raw = RawBoxes.of(rows, Sites(torch.arange(3), BevGrid(-12.8, -12.8, -3.0, 12.8, 12.8, 5.0, 0.4, 4)))
    assert raw.to_rows() is rows
    changed = replace(raw, velocity=raw.velocity + 1).to_rows()
    assert torch.equal(changed[:, :-2], rows[:, :-2]) and torch.equal(changed[:, -2:], rows[:, -2:] + 1)
