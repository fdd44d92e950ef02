# SPDX-License-Identifier: Apache-2.0
"""Claims of tokens and of objects: the compiled path states what the general one states."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.agents.trust._claim_kernels import place_claims
from manyeyes.datatypes import BevGrid, Boxes, Sites, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT, DecodeConfig, RawBoxes, decode, decode_rows

GRID = BevGrid(-51.2, -51.2, -3.0, 51.2, 51.2, 1.0, 0.4, 4)


def test_decoded_rows_are_those_of_the_general_decoder():
    generator = torch.Generator().manual_seed(1)
    rows, keys = torch.randn(300, BOX_LAYOUT.total, generator=generator), torch.arange(0, 3_000, 10)
    config, sites = DecodeConfig(score_threshold=0.3), Sites(keys, GRID)
    boxes, found = decode(RawBoxes.of(rows, sites), config)[0], decode_rows(rows, sites, config)
    assert len(boxes) > 20
    for name in ("center", "size", "yaw", "score", "velocity", "sigma_xy"):
        assert np.array_equal(getattr(boxes, name).numpy(), getattr(found, name)), name


@pytest.mark.parametrize("max_claims", [3, 100])
def test_placed_claims_are_those_of_transforms_of_boxes(max_claims):
    generator = torch.Generator().manual_seed(2)
    n, seconds, min_score = 12, 0.1, 0.3
    draw = torch.randn(n, 12, generator=generator, dtype=torch.float64)
    score = torch.rand(n, generator=generator, dtype=torch.float64)
    boxes = Boxes.of(20 * draw[:, :3], draw[:, 3:6].abs() + 1, draw[:, 6], score, velocity=5 * draw[:, 7:9])
    boxes = replace(boxes, sigma_xy=draw[:, 9].abs())
    boxes.center[4, 0] = math.nan
    ego_from_other = Transform.from_xyz_yaw(3.0, -2.0, 0.5, 0.7).double()
    numbers = np.array([seconds, 0.04, 0.0025, min_score])
    arrays = (boxes.center, boxes.size, boxes.yaw, boxes.velocity, boxes.score, boxes.sigma_xy)
    columns, velocity, scores, sigma_m, stated_xy = place_claims(
        *(array.numpy() for array in arrays),
        ego_from_other.rotation.numpy(),
        ego_from_other.translation.numpy(),
        numbers,
        max_claims,
    )
    order = score.argsort(descending=True)[:max_claims]
    expected = boxes[order[(score[order] >= min_score) & (order != 4)]]
    moved = expected.after(seconds).transform(ego_from_other)
    assert len(expected) == len(columns) > 2
    assert columns[:, :3] == pytest.approx(moved.center.numpy()) and columns[:, 3:6] == pytest.approx(
        moved.size.numpy()
    )
    turn = columns[:, 6] - moved.yaw.numpy()
    assert np.cos(turn) == pytest.approx(np.ones(len(turn)))
    assert velocity == pytest.approx(moved.velocity.numpy()) and scores == pytest.approx(expected.score.numpy())
    assert stated_xy == pytest.approx(expected.center[:, :2].numpy())
    variance = 0.04 + 0.0025 * (expected.center[:, :2] ** 2).sum(1) + expected.sigma_xy**2
    assert sigma_m == pytest.approx(variance.sqrt().numpy())
