# SPDX-License-Identifier: Apache-2.0
"""DAIR-V2X-C and V2X-Seq: reader and writer. Importing the package registers the reader, so its names are imported at once."""

from manyeyes.datasets.dair_v2x.index import DairOptions
from manyeyes.datasets.dair_v2x.reader import DairRecording
from manyeyes.datasets.dair_v2x.writer import DairWriter

__all__ = ["DairOptions", "DairRecording", "DairWriter"]
