# SPDX-License-Identifier: Apache-2.0
"""Encode tokens in a few bytes: features by residual vector quantisation, proposals by fixed rules.

Each stage stores in one byte the index of the nearest centre to the residual of the stages before (Juang and Gray, ICASSP 1982).
The centres are fitted to tokens of training scenes (``training/detector/codebook.py``) and are part of the weights. The detector's
fingerprint covers them, so sender and receiver decode a byte alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from manyeyes._bounds import ChannelCount, StageCount
from manyeyes.datatypes import ConfigError, ShapeError
from manyeyes.models.detector._code_kernels import CentreTables, decode_rows, encode_features, encode_proposals
from manyeyes.models.detector.box_head import BOX_LAYOUT, axis_yaw
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.proposal_codes import (
    AXIS_STEP,
    PROPOSAL_CODES,
    make_code_rules,
    proposal_from_codes,
    proposal_to_codes,
)
from manyeyes.ops._sparse_conv_kernels import LANES, panels

FREQUENCY_TOTAL = 4096
"""Sum of the frequencies of one byte of a row, as required by ``comms.entropy``."""
_RULES = make_code_rules()


@dataclass(frozen=True)
class CodebookConfig:
    """stages: number of bytes of a token's features; size: number of centres per stage, at most 256."""

    stages: StageCount = 4
    size: ChannelCount = 256

    def __post_init__(self) -> None:
        if not (self.stages >= 1 and 1 <= self.size <= 256):
            raise ConfigError(f"CodebookConfig needs a stage and 1 to 256 centres; got {self}.")


class Codebook(nn.Module):
    """Quantiser of tokens to rows of W = stages + PROPOSAL_CODES bytes: the centre indices, then the proposal.

    centres: (stages, size, C). frequencies: (W, 256) int16, of each value of each byte, with sum 4,096 per byte.
    """

    centres: Tensor
    frequencies: Tensor

    def __init__(self, channels: int, config: CodebookConfig) -> None:
        super().__init__()
        self.width = config.stages + PROPOSAL_CODES
        self.register_buffer("centres", torch.zeros(config.stages, config.size, channels, device="cpu"))
        uniform = torch.full((self.width, 256), FREQUENCY_TOTAL // 256, dtype=torch.int16, device="cpu")
        self.register_buffer("frequencies", uniform)
        self.folded: CentreTables | None = None

    def fold(self, in_bfloat16: bool = False) -> None:
        """Copy the centres permanently to tables of compiled loops, in float32; encode uses these afterwards."""
        if self.centres.is_cuda or self.centres.shape[1] % LANES:
            return
        centres = self.centres.detach().float()
        columns = np.stack([panels(stage.T[None]) for stage in centres])
        self.folded = CentreTables(centres.numpy().copy(), centres.square().sum(2).numpy().copy(), columns)

    def encode(self, tokens: Tensor) -> Tensor:
        """Encode tokens (N, C + PROPOSAL_DIM) to codes (N, W) uint8."""
        features = tokens[:, :-PROPOSAL_DIM]
        if features.shape[1] != self.centres.shape[2]:
            raise ShapeError(f"This codebook is of {self.centres.shape[2]} features; got {features.shape[1]}.")
        if self.folded is not None and _is_plain(tokens):
            return _encode_in_loops(tokens, self.folded)
        quantised = residual_codes(features.to(self.centres.device), self.centres).to(tokens.device)
        return torch.cat((quantised, proposal_to_codes(tokens[:, -PROPOSAL_DIM:])), 1)

    def decode(self, codes: Tensor) -> Tensor:
        """Invert encode up to the quantisation error; any bytes (N, W) are valid."""
        if codes.shape[1] != self.width:
            raise ShapeError(f"This codebook reads rows of {self.width} bytes; got {codes.shape[1]}.")
        if codes.device.type == self.centres.device.type == "cpu" and self.centres.dtype == torch.float32:
            out = torch.zeros(len(codes), self.centres.shape[2] + PROPOSAL_DIM, device="cpu")
            decode_rows(codes.to(torch.uint8).contiguous().numpy(), self.centres.numpy(), _RULES, out.numpy())
            return out
        return self.decode_by_tensors(codes)

    def decode_by_tensors(self, codes: Tensor) -> Tensor:
        """Do the same on any device."""
        stages, size, _ = self.centres.shape
        # With fewer than 256 centres, higher byte values are never encoded, but must not break decoding.
        index = codes[:, :stages].long().clamp_max(size - 1).to(self.centres.device)
        features = self.centres[torch.arange(stages, device=index.device), index].sum(1).to(codes.device)
        return torch.cat((features, proposal_from_codes(codes[:, stages:])), 1)


def _is_plain(tokens: Tensor) -> bool:
    return tokens.device.type == "cpu" and tokens.dtype == torch.float32


def _encode_in_loops(tokens: Tensor, tables: CentreTables) -> Tensor:
    """Encode tokens (N, C + PROPOSAL_DIM) to codes (N, W) uint8, on the CPU."""
    stages, _, channels = tables.centres.shape
    tokens = tokens.detach()
    proposal = tokens[:, channels:]
    codes = torch.empty(len(tokens), stages + PROPOSAL_CODES, dtype=torch.uint8, device=tokens.device)
    # The arc tangent by the reference itself, so that yaws between two codes fall on the same side.
    yaw, rows, out = axis_yaw(proposal[:, BOX_LAYOUT.axis]).numpy(), tokens.contiguous().numpy(), codes.numpy()
    features = np.empty((len(rows), stages), np.uint8)
    encode_features(np.ascontiguousarray(rows[:, :channels]), tables, features)
    out[:, :stages] = features
    proposals, sent = np.ascontiguousarray(rows[:, channels:]), np.empty((len(rows), PROPOSAL_CODES), np.uint8)
    encode_proposals(proposals, yaw, _RULES, AXIS_STEP, sent)
    out[:, stages:] = sent
    return codes


def residual_codes(features: Tensor, centres: Tensor) -> Tensor:
    """Quantise features (N, C) to (N, stages) uint8: per stage the nearest of centres (stages, size, C) to the
    residual.
    """
    residual, codes = features, []
    for stage in centres:
        code = nearest_centre(residual, stage)
        residual = residual - stage[code]
        codes.append(code)
    return torch.stack(codes, 1).to(torch.uint8)


def nearest_centre(x: Tensor, centres: Tensor) -> Tensor:
    """Return the index (N,) int64 of the nearest of centres (K, C) to each row of x (N, C); the first of ties."""
    return torch.addmm(centres.square().sum(1), x, centres.T, alpha=-2).argmin(1)
