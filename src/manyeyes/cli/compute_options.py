# SPDX-License-Identifier: Apache-2.0
"""Options of commands that train: where and how steps are computed."""

from __future__ import annotations

from dataclasses import dataclass

from manyeyes._bounds import BatchSize


@dataclass(frozen=True)
class ComputeOptions:
    """Where and how steps are computed."""

    device: str = "auto"
    """auto: a GPU where torch finds one, else the CPU; cpu; cuda or cuda:N. A run can go on on another device."""
    micro_batch: BatchSize | None = None
    """Samples that a process holds in memory together; gradients accumulate over the parts of its batch. Batch norms see one part
    at a time, so that the result differs from that of the whole batch."""
