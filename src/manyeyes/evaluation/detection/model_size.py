# SPDX-License-Identifier: Apache-2.0
"""Numbers of parameters that a method uses of its weights: of the fusion, and of the whole model."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import nn

from manyeyes.agents.strategies.names import TEMPORAL
from manyeyes.evaluation.detection.paper_bytes import TokenLattice
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.protocols import BoxDetector

WITHOUT_TOKEN_FUSION = frozenset(
    {"no-fusion", "late", "late" + TEMPORAL, "late-weighted", "late-weighted" + TEMPORAL, "early"}
)
"""Strategies that fuse no tokens, so that neither the fusion nor the refinement of fused boxes is part of their model."""


@dataclass(frozen=True)
class ModelSize:
    """Numbers of parameters; None where the detector is none of ours and does not tell."""

    fusion: int | None
    whole: int | None


def count_parameters(detector: BoxDetector, method: str) -> ModelSize:
    """Count the parameters that a strategy uses of a detector."""
    if not isinstance(detector, nn.Module):
        return ModelSize(None, None)
    whole, fusion = _count(detector), getattr(detector, "fusion", None)
    if method not in WITHOUT_TOKEN_FUSION:
        return ModelSize(_count(fusion) if isinstance(fusion, nn.Module) else None, whole)
    unused = (fusion, getattr(detector, "refine", None))
    return ModelSize(0, whole - sum(_count(module) for module in unused if isinstance(module, nn.Module)))


def describe_lattice(detector: BoxDetector) -> TokenLattice | None:
    """Describe the tokens of a detector of ours; None of another one."""
    if not isinstance(detector, Detector):
        return None
    rows, columns = detector.token_grid.shape
    code = detector.config.codebook
    code_bits = 0.0 if code is None else code.stages * math.log2(code.size)
    return TokenLattice(rows * columns, detector.encoder.out_channels, code_bits)


def _count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
