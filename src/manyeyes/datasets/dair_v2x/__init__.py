# SPDX-License-Identifier: Apache-2.0
"""DAIR-V2X-C and V2X-Seq: reader and writer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.datasets.dair_v2x.reader import DairRecording as DairRecording
    from manyeyes.datasets.dair_v2x.writer import DairWriter as DairWriter

__getattr__, __dir__ = attach(__name__)
