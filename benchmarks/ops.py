# SPDX-License-Identifier: Apache-2.0
"""Sparse against dense convolution at the occupancies of a five-agent scene; both in turn in one process, medians.

python benchmarks/ops.py [--rounds 5] [--threads 1] [--no-backward] [--levels 1x 4x]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

from manyeyes.datatypes import BevGrid, Sites, SparseBev
from manyeyes.ops.sparse_conv import same_sites_map, submanifold_conv

AGENTS = 5
GROUND = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0)


class Level(NamedTuple):
    name: str
    stride: int
    occupancy: float
    channels: int


LEVELS = (
    Level("1x", 1, 0.055, 64),
    Level("2x", 2, 0.14, 128),
    Level("4x", 4, 0.25, 128),
    Level("8x", 8, 0.41, 256),
    Level("8x pruned", 8, 0.07, 256),
)


def scene(level: Level) -> SparseBev:
    """Occupied cells in clumps, as returns of a LiDAR are: a smooth random field cut at the wanted occupancy."""
    random = torch.Generator().manual_seed(0)
    grid = GROUND.at(level.stride)
    field = avg_pool2d(torch.randn(AGENTS, 1, *grid.shape, generator=random), 3, 1, 1)
    key = (field.flatten() > field.quantile(1 - level.occupancy)).nonzero()[:, 0]
    features = torch.randn(len(key), level.channels, generator=random)
    return SparseBev(features, Sites(key, grid, AGENTS))


def in_turn(first: Callable[[], object], second: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Median milliseconds of two functions, called alternately after one round to warm up."""
    spent: tuple[list[float], list[float]] = ([], [])
    for i in range(rounds + 1):
        for function, times in zip((first, second), spent, strict=True):
            start = time.perf_counter()
            function()
            if i:
                times.append(1e3 * (time.perf_counter() - start))
    return median(spent[0]), median(spent[1])


def steps(level: Level, with_backward: bool) -> tuple[Callable[[], object], Callable[[], object], SparseBev]:
    x = scene(level)
    weight = torch.randn(level.channels, level.channels, 3, 3, generator=torch.Generator().manual_seed(1)) * 0.05
    dense = x.dense().contiguous(memory_format=torch.channels_last)
    dense_weight = weight.contiguous(memory_format=torch.channels_last)
    same_sites_map(x.sites, 3)
    leaves = [t.clone().requires_grad_(with_backward) for t in (x.features, weight)]
    dense_leaves = [
        t.clone(memory_format=torch.preserve_format).requires_grad_(with_backward) for t in (dense, dense_weight)
    ]

    def finish(out: Tensor) -> None:
        if with_backward:
            out.backward(torch.ones_like(out))

    def sparse_step() -> None:
        finish(submanifold_conv(x.with_features(leaves[0]), leaves[1]).features)

    def dense_step() -> None:
        finish(conv2d(dense_leaves[0], dense_leaves[1], padding=1))

    return sparse_step, dense_step, x


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--backward", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--levels", nargs="*", default=[level.name for level in LEVELS])
    wanted = parser.parse_args()
    torch.set_num_threads(wanted.threads)
    print(f"torch {torch.__version__}, {wanted.threads} thread(s), {AGENTS} agents, medians of {wanted.rounds}")
    print(
        f"{'level':<10} {'C':>4} {'sites':>6} {'occupied':>8} {'pass':>8} {'sparse ms':>10} {'dense ms':>9} {'ratio':>6}"
    )
    for level in (lv for lv in LEVELS if lv.name in wanted.levels):
        for with_backward in (False, True)[: 1 + wanted.backward]:
            sparse_step, dense_step, x = steps(level, with_backward)
            sparse_ms, dense_ms = in_turn(sparse_step, dense_step, wanted.rounds)
            n = len(x.sites)
            occupancy = n / (AGENTS * x.grid.shape[0] * x.grid.shape[1])
            print(
                f"{level.name:<10} {level.channels:>4} {n:>6} {occupancy:>8.1%} {'fwd+bwd' if with_backward else 'fwd':>8} "
                f"{sparse_ms:>10.1f} {dense_ms:>9.1f} {dense_ms / sparse_ms:>5.1f}x"
            )


if __name__ == "__main__":
    main()
