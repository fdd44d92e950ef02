# SPDX-License-Identifier: Apache-2.0
"""Options of commands that train: where and how steps are computed, and what is written for TensorBoard."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from manyeyes._bounds import BatchSize, LoaderCount


@dataclass(frozen=True)
class ComputeOptions:
    """Where and how steps are computed."""

    device: str = "auto"
    """auto: a GPU where torch finds one, else the CPU; cpu; cuda or cuda:N. A run can go on on another device."""
    workers: LoaderCount = 0
    """Processes that draw samples ahead of the steps; 0 draws them between steps. The result is the same at any number."""
    micro_batch: BatchSize | None = None
    """Samples that a process holds in memory together; gradients accumulate over the parts of its batch. Batch norms see one part
    at a time, so that the result differs from that of the whole batch."""
    precision: Literal["float32", "bfloat16"] | None = None
    """Of products in convolutions and attention, instead of the preset's; bfloat16 is for GPUs, and gains nothing on the CPU."""
    tensorboard: bool = False
    """Writes scalars of every step, and pictures at every validation, to the folder tensorboard of a stage (extra train)."""
