# SPDX-License-Identifier: Apache-2.0
"""OPV2V and V2XSet: reader and writer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.datasets.opv2v.reader import Opv2vRecording as Opv2vRecording
    from manyeyes.datasets.opv2v.writer import Opv2vWriter as Opv2vWriter

__getattr__, __dir__ = attach(__name__)
