# SPDX-License-Identifier: Apache-2.0
"""Recordings on disk: one reader a layout; `Snapshot` comes out, and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.datasets.argoverse2 import Argoverse2Recording as Argoverse2Recording
    from manyeyes.datasets.base import Recording as Recording, RecordingReader as RecordingReader
    from manyeyes.datasets.dair_v2x.reader import DairRecording as DairRecording
    from manyeyes.datasets.dair_v2x.writer import DairWriter as DairWriter
    from manyeyes.datasets.missing import FileProblem as FileProblem, MissingFiles as MissingFiles
    from manyeyes.datasets.mixed import MixedRecording as MixedRecording, open_recordings as open_recordings
    from manyeyes.datasets.opv2v.reader import Opv2vRecording as Opv2vRecording
    from manyeyes.datasets.opv2v.writer import Opv2vWriter as Opv2vWriter
    from manyeyes.datasets.perturbation import FrameDelay as FrameDelay, PoseNoise as PoseNoise
    from manyeyes.datasets.registry import open_recording as open_recording, register_dataset as register_dataset

__getattr__, __dir__ = attach(__name__)
