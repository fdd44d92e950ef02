# SPDX-License-Identifier: Apache-2.0
"""AP of weights on a small, fixed part of a recording during training: no fusion and intermediate fusion."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import torch

from manyeyes.agents.replay import DetectionReplay, ReplayConfig
from manyeyes.datasets.base import Recording
from manyeyes.datasets.holdout import RecordingPart
from manyeyes.evaluation.detection.benchmark import benchmark
from manyeyes.evaluation.detection.recording_filters import FrameStride
from manyeyes.models import pretrained
from manyeyes.viz.birds_eye import draw_scene, make_scene

if TYPE_CHECKING:
    from PIL.Image import Image

WARMUP_FRAMES = 2
"""Frames before the first evaluated one that fill the histories."""
MAX_STRIDE = 5
MIN_DRAWN_SCORE = 0.2
"""Of boxes in pictures: those of weights that have hardly been trained score low."""
PICTURE_WIDTH = 1024


def select_frames(recording: Recording, max_frames: int) -> Recording:
    """Return at most about max_frames evaluated frames, spread over scenarios; of one scenario the first, up to MAX_STRIDE apart.

    Frames between those that are evaluated are replayed too, so that the cost is bounded by MAX_STRIDE.
    """
    names = recording.scenarios
    count = min(len(names), max_frames)
    chosen = [names[((2 * k + 1) * len(names)) // (2 * count)] for k in range(count)]
    per_scenario = -(-max_frames // count)
    shortest = min(len(recording.eval_indices(name)) for name in chosen)
    stride = max(1, min(MAX_STRIDE, shortest // per_scenario))
    lengths = {name: _end(recording.eval_indices(name), per_scenario * stride) for name in chosen}
    return FrameStride(RecordingPart(recording, lengths, dict.fromkeys(chosen, 0)), stride)


def _end(indices: range, count: int) -> int:
    """Return the number of snapshots up to the last of the first indices."""
    kept = indices[:count]
    return kept[-1] + 1 if kept else 0


def measure_ap(weights: Path, recording: Recording) -> dict[str, float]:
    """Return AP@0.5 of a file of weights on the CPU: intermediate fusion with memory where there are several agents, then no
    fusion.
    """
    methods = _select_methods(recording)
    threads = torch.get_num_threads()
    try:
        replay = ReplayConfig(warmup_frames=WARMUP_FRAMES).adapt_to(recording)
        result = benchmark(recording, str(weights), tuple(methods.values()), replay=replay)
    finally:
        torch.set_num_threads(threads)  # evaluation sets its own
    return {f"ap50_{key}": float(result[name].intervals[0].value) for key, name in methods.items()}


def _select_methods(recording: Recording) -> dict[str, str]:
    """Return the evaluated methods by their names in logs and cards, which stored runs have."""
    has_several = any(len(recording.agents(name)) > 1 for name in recording.scenarios)
    return {**({"intermediate": "intermediate-temporal"} if has_several else {}), "none": "no-fusion"}


def draw_frame(weights: Path, recording: Recording) -> dict[str, Image]:
    """Draw the first evaluated frame from above, of the scenario in the middle: points, true boxes, and what each method detects.

    Returns:
        Pictures by method, on the CPU, as of measure_ap.
    """
    name = recording.scenarios[len(recording.scenarios) // 2]
    last = recording.eval_indices(name)[0]
    snapshots = [recording.snapshot(name, index) for index in range(max(0, last - WARMUP_FRAMES), last + 1)]
    detector, replay = pretrained.load(str(weights)), ReplayConfig().adapt_to(recording)
    pictures = {}
    for key, method in _select_methods(recording).items():
        player = DetectionReplay(method, detector, replay)
        boxes = [step.boxes for snapshot in snapshots for step in player.step(snapshot)][-1]
        scene, caption = make_scene(snapshots[-1], boxes), f"frame {last} · {method}"
        pictures[key] = draw_scene(scene, detector.detection_range, name, caption, PICTURE_WIDTH, MIN_DRAWN_SCORE)
    return pictures
