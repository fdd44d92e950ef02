# SPDX-License-Identifier: Apache-2.0
"""The sparse encoder with folded norms as a chain of compiled calls on arrays: for inference on the CPU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, Sites, SparseBev
from manyeyes.models.detector.pruning import FocalPrune, PruneOutput
from manyeyes.ops._level_kernels import (
    BatchLattice,
    ConvWeights,
    Level,
    UpWeights,
    apply_down,
    apply_pointwise,
    apply_stage,
    apply_up,
    merge_levels,
    prune_level,
)
from manyeyes.ops.folded_conv import FoldedConvs, FoldedUp


@dataclass(frozen=True, eq=False)
class PruneWeights:
    """The linear layer of a ``FocalPrune``: weight (C,), and its bias."""

    weight: NDArray[np.float32]
    bias: np.float32

    @classmethod
    def of(cls, layer: FocalPrune) -> PruneWeights:
        """Return a copy of the weights."""
        weight, bias = (
            p.detach().float().cpu().flatten().numpy().copy() for p in (layer.score.weight, layer.score.bias)
        )
        return cls(weight, bias[0])


@dataclass(frozen=True, eq=False)
class FoldedEncoder:
    """Weights of a ``SparseEncoder``: first of kernel 1, then of each stride the layer that leads to it, if any, and its stage.

    prunes, ups: by stride, ups from the coarser to the finer one. project: the layer after the last of them.
    """

    strides: tuple[int, ...]
    first: ConvWeights
    downs: tuple[ConvWeights, ...]
    stages: tuple[ConvWeights | None, ...]
    prunes: dict[int, PruneWeights]
    after_merge: ConvWeights
    ups: dict[int, UpWeights]
    project: nn.Module

    @classmethod
    def of(
        cls,
        strides: Sequence[int],
        convs: Sequence[object],
        stages: Sequence[object],
        prunes: Mapping[int, object],
        ups: Mapping[int, object],
        project: nn.Module,
    ) -> FoldedEncoder | None:
        """Return the weights of folded layers; None where the loops do not know such.

        convs: FoldedConvs: the first, those that lead to the other strides, and the one after the merge. stages: FoldedConvs, or
        None of a stage without layers. prunes: FocalPrune, ups: FoldedUp, by stride.
        """
        known = [_conv_weights(conv) for conv in convs if isinstance(conv, FoldedConvs)]
        known_ups = {
            stride: UpWeights(up.weight.numpy(), up.lateral.numpy(), up.bias.numpy())
            for stride, up in ups.items()
            if isinstance(up, FoldedUp)
        }
        if len(known) < len(convs) or len(known_ups) < len(ups):
            return None
        stage_weights = tuple(_conv_weights(stage) if isinstance(stage, FoldedConvs) else None for stage in stages)
        weights = {stride: PruneWeights.of(layer) for stride, layer in prunes.items() if isinstance(layer, FocalPrune)}
        return cls(tuple(strides), known[0], tuple(known[1:-1]), stage_weights, weights, known[-1], known_ups, project)

    @torch.no_grad()
    def __call__(
        self, x: SparseBev, prune_threshold: float
    ) -> tuple[SparseBev, tuple[PruneOutput, ...], tuple[int, ...]]:
        """Encode pillars (N, C) to tokens; also the pruning decisions, and the number of sites at each stride."""
        batch_size, threshold = x.sites.batch_size, np.float32(prune_threshold)
        level = apply_pointwise(Level(x.sites.key.numpy(), x.features.contiguous().numpy()), self.first)
        levels, lattices, grids = dict[int, Level](), dict[int, BatchLattice](), dict[int, BevGrid]()
        pruned = list[PruneOutput]()
        for number, stride in enumerate(self.strides):
            if number:
                level = apply_down(level, lattices[stride // 2], self.downs[number - 1])
            grids[stride] = x.grid.at(stride)
            lattices[stride] = BatchLattice(*grids[stride].shape, batch_size)
            stage = self.stages[number]
            level = level if stage is None else apply_stage(level, lattices[stride], stage)
            if stride in self.prunes:
                prune, key = self.prunes[stride], level.key
                level, logit = prune_level(level, prune.weight, prune.bias, threshold)
                sites = Sites(torch.from_numpy(key), grids[stride], batch_size)
                pruned.append(PruneOutput(sites, torch.from_numpy(logit)))
            levels[stride] = level
        stride = 8
        if stride < self.strides[-1]:
            level = merge_levels(levels[8], levels[16], levels[32], lattices[8])
        level = apply_stage(level, lattices[8], self.after_merge)
        for stride, up in self.ups.items():
            level = apply_up(level, levels[stride], lattices[stride], up)
        sites = Sites(torch.from_numpy(level.key), grids[stride], batch_size)
        features: Tensor = self.project(torch.from_numpy(level.features))
        return SparseBev(features, sites), tuple(pruned), tuple(len(levels[s].key) for s in self.strides)


def _conv_weights(conv: FoldedConvs) -> ConvWeights:
    return ConvWeights(conv.weight.numpy(), conv.bias.numpy())
