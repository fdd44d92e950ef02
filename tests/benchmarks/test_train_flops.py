# SPDX-License-Identifier: Apache-2.0
"""The estimate of a training step's operations: layers on a block of cells, counted by hand."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

from manyeyes.datatypes import BevGrid, Sites, SparseBev
from manyeyes.models.detector.layers import DownLayer, SubmanifoldLayer
from manyeyes.models.detector.transformer import AttentionConfig, WindowBlock

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


def load(name: str):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


ESTIMATE = load("train_flops")
GRID = BevGrid(-3.2, -3.2, -1.0, 3.2, 3.2, 1.0)
# Two rows of two cells: (2, 2), (2, 3), (3, 2), (3, 3) of 16 columns.
BLOCK = torch.tensor([34, 35, 50, 51])


def count(layer: nn.Module, *inputs) -> dict[str, float]:
    counter = ESTIMATE.WorkCounter(nn.ModuleDict({"part": layer}))
    with torch.no_grad():
        layer(*inputs)
    return counter.flop


def test_each_cell_of_a_block_meets_all_four():
    x = SparseBev(torch.randn(4, 8), Sites(BLOCK, GRID, 1))
    assert count(SubmanifoldLayer(8, 16), x) == {"part": 2 * 16 * 8 * 16}
    assert count(SubmanifoldLayer(8, 16, kernel=1), x) == {"part": 2 * 4 * 8 * 16}


def test_a_coarse_cell_meets_what_is_in_its_window():
    # Coarse cell (1, 1) is centred on (2, 2) and its 3x3 window holds the whole block.
    x = SparseBev(torch.randn(4, 8), Sites(BLOCK, GRID, 1))
    assert count(DownLayer(8, 16, dilating=False), x) == {"part": 2 * 4 * 8 * 16}


def test_attention_counts_pairs_within_windows_and_its_linear_layers():
    block = WindowBlock(16, AttentionConfig(window=8, heads=4, expansion=2), shifted=False)
    xy = torch.tensor([[-3.0, -3.0], [-2.9, -2.9], [-3.1, -3.0], [3.0, 3.0]])
    linear = 2 * 4 * (4 * 16 * 16 + 2 * 16 * 32)
    assert count(block, torch.randn(4, 16), xy, torch.zeros(4, dtype=torch.int64), GRID) == {
        "part": pytest.approx(linear + 4 * 16 * (3**2 + 1))
    }
