# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch

from manyeyes.datatypes import Boxes, ShapeError
from manyeyes.ops.box_iou import aligned_iou, pairwise_iou, pairwise_iou_3d


def corners(box):
    x, y, length, w, yaw = box
    c, s = math.cos(yaw), math.sin(yaw)
    signs = ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))  # counter-clockwise
    return [(x + c * length * i - s * w * j, y + s * length * i + c * w * j) for i, j in signs]


def clip_iou(a, b):
    """The slow twin: Sutherland-Hodgman."""
    ring, clip = corners(a), corners(b)
    for (x0, y0), (x1, y1) in zip(clip, clip[1:] + clip[:1], strict=True):
        side = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x, y in ring]
        out = []
        for p, q, sp, sq in zip(ring, ring[1:] + ring[:1], side, side[1:] + side[:1], strict=True):
            out += [p] * (sp >= 0)
            if (sp >= 0) != (sq >= 0):
                t = sp / (sp - sq)
                out.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        ring = out
    area = sum(p[0] * q[1] - p[1] * q[0] for p, q in zip(ring, ring[1:] + ring[:1], strict=True)) / 2
    return area / (a[2] * a[3] + b[2] * b[3] - area)


def random_pairs(n, seed=0):
    g = torch.Generator().manual_seed(seed)
    a = torch.rand(n, 5, generator=g, dtype=torch.float64) * torch.tensor([8, 8, 6, 3, 7.0]).double()
    b = torch.rand(n, 5, generator=g, dtype=torch.float64) * torch.tensor([8, 8, 6, 3, 7.0]).double()
    return a, b


def test_ten_thousand_random_pairs_agree_with_shapely():
    shapely = pytest.importorskip("shapely")
    a, b = random_pairs(10_000)
    p, q = (shapely.polygons([corners(box) for box in boxes.tolist()]) for boxes in (a, b))
    shared = shapely.area(shapely.intersection(p, q))
    expected = torch.from_numpy(shared / (shapely.area(p) + shapely.area(q) - shared))
    assert (expected > 0.05).sum() > 1000
    assert (aligned_iou(a, b) - expected).abs().max() < 1e-10
    assert (aligned_iou(a.float(), b.float()) - expected).abs().max() < 1e-4


def test_agrees_with_its_slow_twin_value_and_gradient():
    a, b = random_pairs(200, seed=1)
    a.requires_grad_(True)
    aligned_iou(a, b).sum().backward()
    step = 1e-6
    for i in range(0, 200, 5):
        row, other = a[i].tolist(), b[i].tolist()
        assert aligned_iou(a[i : i + 1], b[i : i + 1]).item() == pytest.approx(clip_iou(row, other), abs=1e-9)
        for k in range(5):
            up, down = list(row), list(row)
            up[k] += step
            down[k] -= step
            slope = (clip_iou(up, other) - clip_iou(down, other)) / (2 * step)
            assert a.grad[i, k].item() == pytest.approx(slope, abs=1e-5)


def test_pairwise_is_aligned_of_every_pair():
    a, b = random_pairs(40, seed=2)
    table = pairwise_iou(a, b[:30])
    row, column = torch.meshgrid(torch.arange(40), torch.arange(30), indexing="ij")
    assert table.shape == (40, 30)
    torch.testing.assert_close(table.flatten(), aligned_iou(a[row.flatten()], b[column.flatten()]))


def box(*values):
    return torch.tensor([values], dtype=torch.float64)


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((0, 0, 4, 2, 0), (0, 0, 4, 2, 0), 1.0),
        ((3, 1, 4, 2, 0.7), (3, 1, 4, 2, 0.7), 1.0),
        ((3, 1, 4, 2, 0.7), (3, 1, 4, 2, 0.7 + math.pi), 1.0),
        ((0, 0, 4, 2, 0), (0, 0, 2, 4, math.pi / 2), 1.0),
        ((0, 0, 4, 2, 0), (4, 0, 4, 2, 0), 0.0),  # edges touch
        ((0, 0, 4, 2, 0), (4, 2, 4, 2, 0), 0.0),  # corners touch
        ((0, 0, 4, 2, 0.3), (0, 0, 2, 1, 0.3), 0.25),  # contained
        ((0, 0, 4, 4, 0), (0, 0, 1, 1, 0.9), 1 / 16),  # contained and turned
        ((0, 0, 2, 2, 0), (0, 0, 2, 2, math.pi / 4), 1 / math.sqrt(2)),  # the octagon: 8 corners
        ((0, 0, 4, 2, 0), (1, 0, 4, 2, 0), 0.6),
        ((0, 0, 4, 2, 0), (1, 0, 4, 2, 1e-9), 0.6),  # edges almost parallel
        ((0, 0, 4, 2, 0), (50, 0, 4, 2, 0), 0.0),
        ((0, 0, 0, 2, 0), (0, 0, 4, 2, 0), 0.0),
        ((0, 0, 0, 0, 0), (0, 0, 0, 0, 0), 0.0),
        ((0, 0, -4, 2, 0), (0, 0, 4, 2, 0), 0.0),
        ((math.nan, 0, 4, 2, 0), (0, 0, 4, 2, 0), 0.0),
        ((0, 0, 4, 2, math.nan), (0, 0, 4, 2, 0), 0.0),
        ((0, 0, math.inf, 2, 0), (0, 0, 4, 2, 0), 0.0),
    ],
)
def test_named_cases_both_ways_with_finite_gradients(a, b, expected):
    for first, second in ((a, b), (b, a)):
        first, second = box(*first).requires_grad_(True), box(*second).requires_grad_(True)
        value = pairwise_iou(first, second)
        assert value.item() == pytest.approx(expected, abs=1e-8)
        value.sum().backward()
        assert torch.isfinite(first.grad).all() and torch.isfinite(second.grad).all()


def test_moving_everything_far_away_changes_nothing():
    a, b = random_pairs(300, seed=3)
    shift = torch.tensor([250_000.0, -90_000.0, 0, 0, 0], dtype=torch.float64)
    assert (aligned_iou(a + shift, b + shift) - aligned_iou(a, b)).abs().max() < 1e-8
    turn = torch.tensor(0.8, dtype=torch.float64)
    rotation = torch.stack((torch.stack((turn.cos(), -turn.sin())), torch.stack((turn.sin(), turn.cos()))))
    a2, b2 = (torch.cat((v[:, :2] @ rotation.T, v[:, 2:4], v[:, 4:] + turn), 1) for v in (a, b))
    assert (aligned_iou(a2, b2) - aligned_iou(a, b)).abs().max() < 1e-10


def test_empty_and_misshapen_input():
    assert pairwise_iou(torch.zeros(0, 5), torch.zeros(3, 5)).shape == (0, 3)
    assert aligned_iou(torch.zeros(0, 5), torch.zeros(0, 5)).shape == (0,)
    with pytest.raises(ShapeError, match=r"\(N, 5\)"):
        pairwise_iou(torch.zeros(2, 7), torch.zeros(3, 5))
    with pytest.raises(ShapeError, match="2 and 3"):
        aligned_iou(torch.zeros(2, 5), torch.zeros(3, 5))


def test_an_iou_loss_pulls_a_box_onto_its_target():
    target = box(10, 5, 4.5, 1.9, 0.4)
    guess = (target + torch.tensor([[0.5, -0.3, 0.4, -0.2, 0.15]], dtype=torch.float64)).requires_grad_(True)
    optimiser = torch.optim.Adam([guess], lr=0.01)
    for _ in range(300):
        optimiser.zero_grad()
        (1 - aligned_iou(guess, target)).sum().backward()
        optimiser.step()
    assert aligned_iou(guess, target).item() > 0.95


def upright(rows):
    """Boxes from rows x, y, z, length, width, height, yaw."""
    t = torch.tensor(rows, dtype=torch.float64).reshape(-1, 7)
    return Boxes.of(t[:, :3], t[:, 3:6], t[:, 6])


def clip_iou_3d(a, b):
    """The slow twin: the clipped area times the shared height, and volumes."""
    flat_a, flat_b = ([r[0], r[1], r[3], r[4], r[6]] for r in (a, b))
    flat = clip_iou(flat_a, flat_b)
    area = flat / (1 + flat) * (a[3] * a[4] + b[3] * b[4])
    height = max(0.0, min(a[2] + a[5] / 2, b[2] + b[5] / 2) - max(a[2] - a[5] / 2, b[2] - b[5] / 2))
    shared = area * height
    return shared / (a[3] * a[4] * a[5] + b[3] * b[4] * b[5] - shared)


def random_upright(n, seed):
    g = torch.Generator().manual_seed(seed)
    scale = torch.tensor([5, 5, 1.5, 6, 3, 2, 7.0]).double()
    return (
        torch.rand(n, 7, generator=g, dtype=torch.float64) * scale + torch.tensor([0, 0, 0, 0.5, 0.5, 0.5, 0])
    ).tolist()


def test_volumes_agree_with_their_slow_twin():
    a, b = random_upright(20, 3), random_upright(25, 4)
    got = pairwise_iou_3d(upright(a), upright(b))
    expected = torch.tensor([[clip_iou_3d(p, q) for q in b] for p in a], dtype=torch.float64)
    assert (expected > 0.1).sum() > 50
    torch.testing.assert_close(got, expected, atol=1e-9, rtol=0)
    torch.testing.assert_close(pairwise_iou_3d(upright(b), upright(a)).T, got, atol=1e-12, rtol=0)


def test_volumes_by_hand():
    """The same rectangle half as high over half of the height: 1/3. Above each other: 0. Equal boxes: 1."""
    car = [0, 0, 1, 4, 2, 2, 0.3]
    others = [
        [0, 0, 2, 4, 2, 2, 0.3],
        [0, 0, 3.1, 4, 2, 2, 0.3],
        car,
        [0, 0, 0.5, 4, 2, 1, 0.3 + math.pi],
        [9, 9, 1, 4, 2, 2, 0],
    ]
    got = pairwise_iou_3d(upright([car]), upright(others))
    assert got[0].tolist() == pytest.approx([1 / 3, 0, 1, 1 / 2, 0], abs=1e-9)


def test_volumes_do_not_depend_on_where_the_boxes_stand():
    a, b = random_upright(8, 5), random_upright(8, 6)
    moved = [[[r[0] + 3000, r[1] - 500, r[2] + 7, *r[3:]] for r in rows] for rows in (a, b)]
    torch.testing.assert_close(
        pairwise_iou_3d(*map(upright, moved)), pairwise_iou_3d(upright(a), upright(b)), atol=1e-9, rtol=0
    )


def test_boxes_without_volume_share_none():
    flat = upright([[0, 0, 1, 4, 2, 0, 0], [0, 0, 1, 0, 2, 2, 0], [0, 0, math.nan, 4, 2, 2, 0]])
    assert pairwise_iou_3d(flat, upright([[0, 0, 1, 4, 2, 2, 0]])).tolist() == [[0], [0], [0]]
    assert pairwise_iou_3d(flat[:0], flat).shape == (0, 3)
