# SPDX-License-Identifier: Apache-2.0
"""Detections of a replay, step by step, to the files of KITTI and nuScenes; one folder a method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from manyeyes._io import atomic_write_text
from manyeyes.agents.replay import ReplayStep
from manyeyes.datasets import nuscenes_results
from manyeyes.datasets.base import Recording
from manyeyes.datasets.kitti import KittiRecording
from manyeyes.datasets.kitti.result_files import KittiCalibration, write_results
from manyeyes.datatypes import Boxes

NUSCENES_FILE = "results_nusc.json"


class KittiExport:
    """Writes ``<method>/[<scenario>/]data/<frame>.txt`` and, for recordings without KITTI's calibrations, ``calib`` beside it.

    Frames of KITTI's object detection keep their number, and lie in one folder. counts: boxes of each method.
    """

    def __init__(self, out: Path, methods: Sequence[str], recording: Recording) -> None:
        self.counts = dict.fromkeys(methods, 0)
        self._out, self._recording = out, recording

    def add(self, step: ReplayStep, boxes: Boxes) -> None:
        """Write the boxes of one frame, in the frame of the ego."""
        snapshot, frame = step.snapshot, step.snapshot.frames[step.ego]
        self.counts[step.method] += len(boxes)
        calibration = self._find_calibration(snapshot.scenario)
        folder, name = self._out / step.method, f"{snapshot.scenario}.txt"
        if calibration is None:
            calibration = KittiCalibration.of_lidar()
            folder, name = folder / snapshot.scenario, f"{snapshot.index:06d}.txt"
            atomic_write_text(folder / "calib" / name, calibration.to_text(), durable=False)
        write_results(folder / "data" / name, boxes, calibration, frame.sensor_height_m)

    def _find_calibration(self, scenario: str) -> KittiCalibration | None:
        recording = self._recording
        return recording.calibration(scenario) if isinstance(recording, KittiRecording) else None

    def close(self) -> None:
        """Do nothing: files are written frame by frame."""


class NuscenesExport:
    """Collects the boxes of all frames in the recording's world, and writes ``<method>/results_nusc.json`` at the end.

    counts: boxes of each method.
    """

    def __init__(self, out: Path, methods: Sequence[str]) -> None:
        self.counts = dict.fromkeys(methods, 0)
        self._out, self._samples = out, {name: dict[str, Boxes]() for name in methods}

    def add(self, step: ReplayStep, boxes: Boxes) -> None:
        """Keep the boxes of one frame, in the frame of the ego, by its prior pose."""
        snapshot, frame = step.snapshot, step.snapshot.frames[step.ego]
        token = nuscenes_results.make_sample_token(snapshot.scenario, snapshot.index)
        self._samples[step.method][token] = boxes.to(torch.float64).transform(frame.world_from_agent)
        self.counts[step.method] += min(len(boxes), nuscenes_results.MAX_BOXES)

    def close(self) -> None:
        """Write the files of all methods."""
        for method, samples in self._samples.items():
            nuscenes_results.write_results(self._out / method / NUSCENES_FILE, samples)
