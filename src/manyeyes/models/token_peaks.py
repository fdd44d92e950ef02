# SPDX-License-Identifier: Apache-2.0
"""Largest magnitudes of a model's tokens by channel, measured at the end of training and kept in the card of its weights."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from manyeyes.datatypes import CheckpointError

CARD_KEY = "token_peaks"
NUM_SAMPLES = 16
"""Number of training samples whose tokens are measured."""


def measure_token_peaks(tokens: Iterable[Tensor], channels: int) -> list[float] | None:
    """Return the largest magnitude of each channel of tokens (N, channels); None without tokens."""
    peaks, count = torch.zeros(channels, device="cpu"), 0
    for features in tokens:
        count += len(features)
        if len(features):
            peaks = torch.maximum(peaks, features.detach().abs().amax(0).float().cpu())
    if not count:
        return None
    return [float(f"{peak:.4g}") for peak in peaks.tolist()]


def read_token_peaks(card: dict[str, Any], channels: int, path: Path) -> tuple[float, ...] | None:
    """Return the peaks of a card of weights; None where the card, of an earlier version, has none.

    Raises:
        CheckpointError: they are not one finite number of at least 0 for each channel.
    """
    peaks = card.get(CARD_KEY)
    if peaks is None:
        return None
    is_valid = isinstance(peaks, list) and len(peaks) == channels
    if not is_valid or not all(isinstance(p, int | float) and math.isfinite(p) and p >= 0 for p in peaks):
        raise CheckpointError(
            f"{path}: {CARD_KEY} of its card needs {channels} finite numbers of at least 0; copy or train it again."
        )
    return tuple(map(float, peaks))
