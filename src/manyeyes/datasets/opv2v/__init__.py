# SPDX-License-Identifier: Apache-2.0
"""OPV2V and V2XSet: reader and writer. Importing the package registers the reader, so its names are imported at once."""

from manyeyes.datasets.opv2v.reader import Opv2vRecording
from manyeyes.datasets.opv2v.writer import Opv2vWriter

__all__ = ["Opv2vRecording", "Opv2vWriter"]
