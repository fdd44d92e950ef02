# SPDX-License-Identifier: Apache-2.0
"""Tokens as a few bytes: features by residual vector quantisation, proposals by fixed rules.

Stage k names, in one byte, the centre nearest to what the stages before it left over (Juang and Gray, ICASSP 1982; on tokens:
detection.md A.12). The centres are fitted to tokens of training scenes (``training/detector/codebook.py``) and are part of the
weights: a detector's fingerprint names them, so sender and receiver mean the same by a byte.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from manyeyes.datatypes import ConfigError, ShapeError
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.proposal_codes import PROPOSAL_CODES, proposal_from_codes, proposal_to_codes

FREQUENCY_TOTAL = 4096
"""Sum of the frequencies of one byte of a row, as ``comms.entropy`` reads them."""


@dataclass(frozen=True)
class CodebookConfig:
    """stages: bytes for a token's features; size: centres a stage, at most 256."""

    stages: int = 4
    size: int = 256

    def __post_init__(self) -> None:
        if not (self.stages >= 1 and 1 <= self.size <= 256):
            raise ConfigError(f"CodebookConfig needs a stage and 1 to 256 centres; got {self}.")


class Codebook(nn.Module):
    """centres: (stages, size, C). frequencies: (W, 256) int16, how often each value of each byte of a row occurs, of 4,096.

    A row has W = stages + PROPOSAL_CODES bytes: the stages' centres, then the proposal.
    """

    centres: Tensor
    frequencies: Tensor

    def __init__(self, channels: int, config: CodebookConfig) -> None:
        super().__init__()
        self.width = config.stages + PROPOSAL_CODES
        self.register_buffer("centres", torch.zeros(config.stages, config.size, channels))
        uniform = torch.full((self.width, 256), FREQUENCY_TOTAL // 256, dtype=torch.int16)
        self.register_buffer("frequencies", uniform)

    def encode(self, tokens: Tensor) -> Tensor:
        """What is told, rows (N, C + PROPOSAL), as rows (N, W) uint8."""
        features = tokens[:, :-PROPOSAL_DIM]
        if features.shape[1] != self.centres.shape[2]:
            raise ShapeError(f"This codebook is of {self.centres.shape[2]} features; got {features.shape[1]}.")
        return torch.cat((residual_codes(features, self.centres), proposal_to_codes(tokens[:, -PROPOSAL_DIM:])), 1)

    def decode(self, codes: Tensor) -> Tensor:
        """The inverse of write, within the error of the centres; any bytes (N, W) can be read."""
        stages, size, _ = self.centres.shape
        if codes.shape[1] != self.width:
            raise ShapeError(f"This codebook reads rows of {self.width} bytes; got {codes.shape[1]}.")
        # Where there are fewer than 256 centres, nobody writes the bytes beyond, and they must not break the reader.
        index = codes[:, :stages].long().clamp_max(size - 1)
        features = self.centres[torch.arange(stages), index].sum(1)
        return torch.cat((features, proposal_from_codes(codes[:, stages:])), 1)


def residual_codes(features: Tensor, centres: Tensor) -> Tensor:
    """(N, C) to (N, stages) uint8: stage by stage the nearest of centres (stages, size, C) to what is left over."""
    residual, codes = features, []
    for stage in centres:
        code = nearest_centre(residual, stage)
        residual = residual - stage[code]
        codes.append(code)
    return torch.stack(codes, 1).to(torch.uint8)


def nearest_centre(x: Tensor, centres: Tensor) -> Tensor:
    """(N,) int64: which of centres (K, C) is nearest to each row of x (N, C), the first where two are."""
    return (centres.square().sum(1) - 2 * (x @ centres.T)).argmin(1)
