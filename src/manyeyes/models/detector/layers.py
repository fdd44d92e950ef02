# SPDX-License-Identifier: Apache-2.0
"""Layers on occupied cells: normalisation that accepts empty input, and sparse convolutions."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from manyeyes.datatypes import Sites, SparseBev
from manyeyes.ops.active_norm import RunningStatistics, norm_relu
from manyeyes.ops.folded_conv import FoldedConvs, FoldedUp, NormedConv, is_supported
from manyeyes.ops.sparse_conv import (
    inverse_conv,
    inverse_map,
    same_sites_map,
    strided_conv,
    strided_map,
    submanifold_conv,
)
from manyeyes.ops.sparse_index import Window


class ActiveNorm(nn.BatchNorm1d):
    """Batch normalisation over active rows (N, C); with fewer than two rows it uses its running statistics."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=1e-3, momentum=0.02)

    def forward(self, input: Tensor) -> Tensor:
        """Normalise features (N, C) to (N, C)."""
        if self.training and input.shape[0] < 2:
            return nn.functional.batch_norm(
                input, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps
            )
        return super().forward(input)

    def forward_relu(self, input: Tensor, skip: Tensor | None = None) -> Tensor:
        """Normalise features (N, C), add skip (N, C) and apply ReLU; input may be overwritten where no gradient needs it."""
        is_plain = input.device.type == "cpu" and input.dtype == self.weight.dtype == torch.float32
        if not (self.training and is_plain and input.shape[0] > 1):
            return _apply_relu(self.forward(input), skip)
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        self.num_batches_tracked.add_(1)
        running = RunningStatistics(self.running_mean, self.running_var, self.momentum)
        return norm_relu(input, skip, self.weight, self.bias, running, self.eps)


def fold_norm(weight: Tensor, norm: ActiveNorm) -> tuple[Tensor, Tensor]:
    """Fold the running statistics of the following norm into a linear weight (outputs, ...); returns weight and bias
    (outputs,).
    """
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return weight * scale.view(-1, *(1,) * (weight.dim() - 1)), norm.bias - norm.running_mean * scale


def conv_weight(outputs: int, inputs: int, kernel: int) -> nn.Parameter:
    """Make an (outputs, inputs, kernel, kernel) kernel with He initialisation over its inputs * kernel^2 inputs."""
    drawn = torch.randn(outputs, inputs, kernel, kernel, device="cpu")
    return _tap_by_tap(drawn * math.sqrt(2.0 / (inputs * kernel * kernel)))


def _tap_by_tap(weight: Tensor) -> nn.Parameter:
    """Reorder (outputs, inputs, k, k) in memory to one matrix per tap, so that no call copies it."""
    return nn.Parameter(weight.permute(2, 3, 1, 0).contiguous().permute(3, 2, 0, 1))


def _norm_relu(norm: nn.Module, y: Tensor, skip: Tensor | None) -> Tensor:
    """ReLU of the norm of y plus skip; the caller must own y."""
    return norm.forward_relu(y, skip) if isinstance(norm, ActiveNorm) else _apply_relu(norm(y), skip)


def _apply_relu(y: Tensor, skip: Tensor | None) -> Tensor:
    """ReLU of y plus skip, in place where no gradient needs y; the caller must own y."""
    if torch.is_grad_enabled():
        return torch.relu(y if skip is None else y + skip)
    return torch.relu_(y if skip is None else y.add_(skip))


class SparseConvLayer(nn.Module):
    """A layer with a sparse convolution. in_bfloat16: multiply in bfloat16, with float32 results, for training."""

    in_bfloat16: bool = False

    def round_input(self, x: SparseBev) -> SparseBev:
        """Return the input of the convolution, in bfloat16 where it multiplies so."""
        return x.with_features(x.features.to(torch.bfloat16)) if self.in_bfloat16 else x


class SubmanifoldLayer(SparseConvLayer):
    """Submanifold convolution, norm, optional skip connection, ReLU; the sites are unchanged.

    norm: ActiveNorm, or LayerNorm where inputs of different statistics share the weights (one agent, several agents).
    """

    bias: Tensor | None

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 3, norm: Callable[[int], nn.Module] = ActiveNorm
    ) -> None:
        super().__init__()
        self.weight, self.norm = conv_weight(outputs, inputs, kernel), norm(outputs)
        self.skip = inputs == outputs
        self.register_buffer("bias", None, persistent=False)
        self.folded: FoldedConvs | NormedConv | None = None

    def forward(self, x: SparseBev) -> SparseBev:
        """Map (N, inputs) to (N, outputs) on the same sites."""
        if self.folded is not None and is_supported(x.features):
            return x.with_features(self.folded(x.features, same_sites_map(x.sites, self.weight.shape[2])))
        y = submanifold_conv(self.round_input(x), self.weight, self.bias).features
        return x.with_features(_norm_relu(self.norm, y, x.features if self.skip else None))

    def fold(self, in_bfloat16: bool = False) -> None:
        """Fold the norm's running statistics into the weight, and the skip into its centre tap, permanently.

        A LayerNorm has no running statistics: it stays, in float32, and so does the skip after it, in the same compiled call.
        """
        if isinstance(self.norm, nn.LayerNorm):
            self.folded = NormedConv.of(self.weight, self.norm, self.skip)
        if isinstance(self.norm, ActiveNorm):
            weight, self.bias = fold_norm(self.weight.detach(), self.norm)
            self.weight, self.norm = nn.Parameter(weight, requires_grad=False), nn.Identity()
            if self.skip:
                middle = weight.shape[2] // 2
                self.weight[:, :, middle, middle] += torch.eye(len(weight), dtype=weight.dtype, device=weight.device)
                self.skip = False
            self.folded = FoldedConvs.of([self.weight], [self.bias], in_bfloat16=in_bfloat16)


class SubmanifoldStage(nn.Sequential):
    """A sequence of layers of equal width on the same sites."""

    def __init__(self, channels: int, layers: int) -> None:
        super().__init__(*(SubmanifoldLayer(channels, channels) for _ in range(layers)))
        self.folded: FoldedConvs | None = None

    def forward(self, input: SparseBev) -> SparseBev:
        """Map (N, channels) to (N, channels)."""
        if self.folded is not None and is_supported(input.features):
            return input.with_features(self.folded(input.features, same_sites_map(input.sites, kernel=3)))
        return super().forward(input)

    def fold(self, in_bfloat16: bool = False) -> None:
        """Fold every layer permanently into the weights of one compiled call."""
        layers = [layer for layer in self if isinstance(layer, SubmanifoldLayer)]
        for layer in layers:
            layer.fold()
            layer.folded = None
        self.folded = FoldedConvs.of(
            [layer.weight for layer in layers],
            [layer.bias for layer in layers if layer.bias is not None],
            in_bfloat16=in_bfloat16,
        )


class DownLayer(SparseConvLayer):
    """3x3 convolution of stride 2, norm, ReLU; ``dilating`` selects spconv's active set, else parents of active
    cells.
    """

    bias: Tensor | None

    def __init__(self, inputs: int, outputs: int, dilating: bool) -> None:
        super().__init__()
        self.weight, self.dilating = conv_weight(outputs, inputs, 3), dilating
        self.norm: nn.Module = ActiveNorm(outputs)
        self.register_buffer("bias", None, persistent=False)
        self.folded: FoldedConvs | None = None

    def forward(self, x: SparseBev) -> SparseBev:
        """Compute features at twice the stride."""
        if self.folded is not None and is_supported(x.features):
            sites, table = strided_map(x.sites, Window(3, 2, 1), self.dilating)
            return SparseBev(self.folded(x.features, table), sites)
        y = strided_conv(self.round_input(x), self.weight, self.bias, stride=2, padding=1, dilating=self.dilating)
        return y.with_features(_norm_relu(self.norm, y.features, None))

    def fold(self, in_bfloat16: bool = False) -> None:
        """Fold the norm's running statistics into the weight, permanently."""
        if isinstance(self.norm, ActiveNorm):
            weight, self.bias = fold_norm(self.weight.detach(), self.norm)
            self.weight, self.norm = nn.Parameter(weight, requires_grad=False), nn.Identity()
            self.folded = FoldedConvs.of([self.weight], [self.bias], in_bfloat16=in_bfloat16)


class UpLayer(SparseConvLayer):
    """Inverse convolution to finer sites, norm, added to a lateral projection, ReLU."""

    bias: Tensor | None

    def __init__(self, inputs: int, lateral: int, outputs: int) -> None:
        super().__init__()
        weight = torch.randn(inputs, outputs, 3, 3, device="cpu") * math.sqrt(2.0 / (inputs * 9 / 4))
        self.weight = nn.Parameter(_tap_by_tap(weight.transpose(0, 1)).data.transpose(0, 1))
        self.norm: nn.Module = ActiveNorm(outputs)
        self.lateral = nn.Linear(lateral, outputs, bias=False)
        self.register_buffer("bias", None, persistent=False)
        self.folded: FoldedUp | None = None

    def forward(self, coarse: SparseBev, fine: SparseBev) -> SparseBev:
        """Upsample coarse features to the sites of ``fine``."""
        sites: Sites = fine.sites
        if self.folded is not None and is_supported(coarse.features) and is_supported(fine.features):
            return fine.with_features(self.folded(coarse.features, fine.features, inverse_map(sites, coarse.sites)))
        y = inverse_conv(self.round_input(coarse), self.weight, sites, self.bias, stride=2, padding=1)
        return fine.with_features(_norm_relu(self.norm, y.features + self.lateral(fine.features), None))

    def fold(self, in_bfloat16: bool = False) -> None:
        """Fold the norm's running statistics into both weights, permanently."""
        if isinstance(self.norm, ActiveNorm):
            weight, self.bias = fold_norm(self.weight.detach().transpose(0, 1), self.norm)
            self.lateral.weight = nn.Parameter(fold_norm(self.lateral.weight.detach(), self.norm)[0], False)
            self.weight, self.norm = nn.Parameter(weight.transpose(0, 1), requires_grad=False), nn.Identity()
            self.folded = FoldedUp.of(weight, self.lateral.weight, self.bias, in_bfloat16)
