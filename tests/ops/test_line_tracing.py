# SPDX-License-Identifier: Apache-2.0
"""Line tracing by hand and against a trace of one line at a time; resampling and distances against slow references."""

import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ShapeError
from manyeyes.ops.line_tracing import (
    MIN_STRIDES_TO_CLOSE,
    MIN_TURN_COSINE,
    TracingField,
    distance_to_lines,
    resample_evenly,
    trace_lines,
)
from manyeyes.ops.polyline import resample


def field_of(curve, rows, columns, reach=1.5):
    """The field of one curve (P, 2), densely sampled, in cells."""
    at = torch.stack(torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")[::-1], -1)
    away = torch.cdist(at.view(-1, 2), curve)
    near = away.argmin(1)
    tangent = (curve.roll(-1, 0) - curve.roll(1, 0))[near]
    tangent[near == 0] = (curve[1] - curve[0]).expand(int((near == 0).sum()), 2)
    tangent[near == len(curve) - 1] = (curve[-1] - curve[-2]).expand(int((near == len(curve) - 1).sum()), 2)
    sure = (away.amin(1) <= reach).float()
    way = tangent / tangent.norm(dim=1, keepdim=True)
    # Cells hold the direction with either sign.
    way = way * torch.where(torch.arange(len(way)) % 2 == 0, 1.0, -1.0)[:, None]
    return TracingField(
        sure.view(1, rows, columns), curve[near].view(1, rows, columns, 2), way.view(1, rows, columns, 2)
    )


def line(a, b, count=400):
    return torch.lerp(torch.tensor(a), torch.tensor(b), torch.linspace(0, 1, count)[:, None])


def trace_one_line(field, cell, min_confidence, stride, strides):
    """One line, one stride at a time, in plain numbers."""
    rows, columns = field.confidence.shape[1:]
    start = field.nearest_point[0, cell[0], cell[1]].tolist()
    both, closed = [], False
    for sign in (1, -1):
        at, heading, out = start, [sign * v for v in field.direction[0, cell[0], cell[1]].tolist()], []
        for k in range(0 if closed else strides):
            to = [at[0] + stride * heading[0], at[1] + stride * heading[1]]
            c, r = math.floor(to[0]), math.floor(to[1])
            if not (0 <= c < columns and 0 <= r < rows):
                out.append([min(max(to[0], 0), columns), min(max(to[1], 0), rows)])
                break
            way = field.direction[0, r, c].tolist()
            turn = way[0] * heading[0] + way[1] * heading[1]
            if float(field.confidence[0, r, c]) < min_confidence or abs(turn) < MIN_TURN_COSINE:
                out.append([(at[0] + to[0]) / 2, (at[1] + to[1]) / 2])
                break
            way = [-v for v in way] if turn < 0 else way
            side = [-way[1], way[0]]
            foot = field.nearest_point[0, r, c].tolist()
            off = (foot[0] - to[0]) * side[0] + (foot[1] - to[1]) * side[1]
            at, heading = [to[0] + off * side[0], to[1] + off * side[1]], way
            if k >= MIN_STRIDES_TO_CLOSE and math.hypot(at[0] - start[0], at[1] - start[1]) < stride:
                out.append(start)
                closed = True
                break
            out.append(at)
        both.append(out)
    return np.array([*both[1][::-1], start, *both[0]])


def unrepeated(points):
    kept = np.concatenate(([True], np.hypot(*np.diff(points, axis=0).T) > 1e-6))
    return points[kept]


ANGLES = torch.linspace(0, 2 * math.pi, 400)
CURVES = {
    "straight": (line([2.2, 3.3], [15.7, 8.9]), (4, 4)),
    "to the border": (line([-3.0, 6.2], [30.0, 7.9]), (7, 10)),
    "bent": (torch.stack((10 + 7 * (ANGLES / 4).cos(), 1.5 + 9 * (ANGLES / 4).sin()), -1), (8, 15)),
    "ring": (torch.stack((10 + 5 * ANGLES.cos(), 6 + 4 * ANGLES.sin()), -1), (6, 14)),
}


@pytest.mark.parametrize("name", CURVES)
def test_a_walk_is_the_walk_of_one_line_at_a_time(name):
    curve, cell = CURVES[name]
    field = field_of(curve, 12, 20)
    assert float(field.confidence[0, cell[0], cell[1]]) == 1
    walks = trace_lines(field, torch.zeros(2, dtype=torch.int64), torch.tensor([cell, cell]), 0.5, 1.2, 40)
    slow = trace_one_line(field, cell, 0.5, 1.2, 40)
    assert torch.equal(walks.points[0], walks.points[1])
    np.testing.assert_allclose(unrepeated(walks.points[0].numpy()), unrepeated(slow), atol=1e-4)


def test_walks_lie_on_their_lines_and_reach_their_ends():
    for name, (curve, cell) in CURVES.items():
        walks = trace_lines(field_of(curve, 12, 20), torch.tensor([0]), torch.tensor([cell]), 0.5, 1.2, 40)
        inside = curve[((curve >= 0) & (curve <= torch.tensor([20.0, 12.0]))).all(1)]
        # Cells beyond an end are confident as far as the field reaches, so that a walk goes on for that and half a stride.
        assert float(torch.cdist(walks.points[0], inside).amin(1).max()) < 2.2, name
        assert float(torch.cdist(inside, resample_evenly(walks.points[0], 200)).amin(1).max()) < 0.12, name
        went = walks.points[0].diff(dim=0).norm(dim=1).sum()
        length = inside.diff(dim=0).norm(dim=1).sum()
        # Round a ring once, not twice.
        assert float(length) - 0.2 < float(went) < float(length) + 4.2, name


def test_a_trace_ends_half_a_stride_beyond_the_last_confident_cell():
    field = field_of(line([0.0, 2.5], [20.0, 2.5]), 5, 20)
    field.confidence[0, :, 10:] = 0.1
    walks = trace_lines(field, torch.tensor([0]), torch.tensor([[2, 6]]), 0.5, 1.0, 30)
    # From the middle of column 6 to that of column 9, and half a cell on; the other way to the border.
    assert walks.points[0].amax(0).tolist() == pytest.approx([10.0, 2.5], abs=0.05)
    assert walks.points[0].amin(0).tolist() == pytest.approx([0.0, 2.5], abs=0.05)
    assert float(walks.confidence[0].sum()) == pytest.approx(10) and int((walks.confidence[0] > 0).sum()) == 10


def test_a_cell_below_the_confidence_starts_no_line():
    field = field_of(line([0.0, 2.5], [20.0, 2.5]), 8, 20)
    walks = trace_lines(field, torch.tensor([0]), torch.tensor([[6, 6]]), 0.5, 1.0, 30)
    assert float((walks.points - walks.points[:, :1]).abs().max()) == 0 and float(walks.confidence.sum()) == 0


def test_pictures_do_not_mix():
    across, along = field_of(line([3.5, 0.0], [3.5, 8.0]), 8, 20), field_of(line([0.0, 2.5], [20.0, 2.5]), 8, 20)
    field = TracingField(
        *(torch.cat((getattr(across, f), getattr(along, f))) for f in ("confidence", "nearest_point", "direction"))
    )
    walks = trace_lines(field, torch.tensor([1, 0]), torch.tensor([[2, 3], [2, 3]]), 0.5, 1.0, 30)
    assert float((walks.points[0, :, 1] - 2.5).abs().max()) < 0.05
    assert float((walks.points[1, :, 0] - 3.5).abs().max()) < 0.05


def test_even_spacing_is_that_of_polylines():
    rng = np.random.default_rng(0)
    lines = rng.uniform(0, 20, (3, 9, 2))
    lines[1, 4:7] = lines[1, 4]  # stood still
    lines[2, :3] = lines[2, 0]
    for own, even in zip(lines, resample_evenly(torch.from_numpy(lines).float(), 13)):
        slow = resample(own, np.array([0, 9]), np.array([13]))[0]
        np.testing.assert_allclose(even.numpy(), slow, atol=1e-3)
    nowhere = resample_evenly(torch.full((1, 5, 2), 3.0), 4)
    assert torch.equal(nowhere, torch.full((1, 4, 2), 3.0))


def test_distances_are_to_the_nearest_of_all_edges():
    generator = torch.Generator().manual_seed(3)
    places, lines = torch.rand(2, 5, 2, generator=generator), torch.rand(2, 4, 6, 2, generator=generator)
    lines[0, 0, 2:] = lines[0, 0, 2]
    dense = torch.lerp(lines[:, :, :-1, None], lines[:, :, 1:, None], torch.linspace(0, 1, 400)[:, None]).flatten(2, 3)
    slow = (dense[:, :, None] - places[:, None, :, None]).norm(dim=-1).amin(-1)
    assert torch.allclose(distance_to_lines(places, lines), slow, atol=5e-3)


def test_a_field_of_other_shapes_is_refused():
    with pytest.raises(ShapeError, match="TracingField needs"):
        TracingField(torch.zeros(1, 3, 4), torch.zeros(1, 3, 4), torch.zeros(1, 3, 4, 2))
