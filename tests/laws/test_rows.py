# SPDX-License-Identifier: Apache-2.0
"""Types of N rows are tables: slices joined are the whole, a choice of rows keeps every column, ``to`` changes the dtype alone."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, strategies as st

from manyeyes.datatypes import Boxes, MapElements, PointCloud, SparseBev
from manyeyes.datatypes.keypoints import Keypoints

SPLITS = st.integers(0, 12)


@given(st.from_type(Boxes) | st.from_type(PointCloud), SPLITS)
def test_slices_joined_are_the_whole(assert_same, rows, split) -> None:
    parts = [rows[:split], rows[split:]]
    assert sum(map(len, parts)) == len(rows)
    assert_same(type(rows).cat(parts), rows)


@given(st.from_type(Boxes) | st.from_type(PointCloud) | st.from_type(Keypoints), st.randoms(use_true_random=False))
def test_a_permutation_and_its_inverse_cancel(assert_same, rows, random) -> None:
    order = torch.tensor(random.sample(range(len(rows)), len(rows)), dtype=torch.int64)
    assert_same(rows[order][order.argsort()], rows)
    mask = order < len(rows) // 2
    assert_same(rows[mask], rows[mask.nonzero()[:, 0]])


@given(st.from_type(MapElements), SPLITS, st.randoms(use_true_random=False))
def test_elements_taken_and_joined_are_the_whole(assert_same, elements, split, random) -> None:
    rows = np.arange(len(elements))
    assert_same(MapElements.cat([elements.take(rows[:split]), elements.take(rows[split:])]), elements)
    order = np.array(random.sample(range(len(elements)), len(elements)), dtype=np.int64)
    assert_same(elements.take(order).take(np.argsort(order)), elements)
    mask = order < len(elements) // 2
    assert_same(elements.take(mask), elements.take(np.flatnonzero(mask)))


@given(boxes=...)
def test_another_dtype_and_back_is_the_same(assert_same, boxes: Boxes) -> None:
    assert_same(boxes.to(torch.float64).to(boxes.center.dtype), boxes)
    assert_same(boxes.to(boxes.center.dtype), boxes)
    single = boxes.to(torch.float32)
    assert single.center.dtype == single.yaw.dtype == torch.float32
    assert single.label.dtype == single.id.dtype == torch.int64


@given(tokens=...)
def test_cells_kept_by_a_mask_are_those_of_the_dense_tensor(assert_same, tokens: SparseBev) -> None:
    mask = tokens.features[:, 0] > 0
    kept, rest = tokens.keep(mask), tokens.keep(~mask)
    assert len(kept.sites) + len(rest.sites) == len(tokens.sites)
    assert_same(kept.dense() + rest.dense(), tokens.dense())
    reverse = SparseBev.from_cells(tokens.features.flip(0), tokens.sites.yx.flip(0), tokens.grid)
    assert_same(reverse, tokens)
    assert_same(tokens.grid.cells(tokens.sites.xy), tokens.sites.yx)
