# SPDX-License-Identifier: Apache-2.0
"""Judging at the time of the answer: the ego answers when it has waited for messages and computed, and the world has moved on.

Time of the answer = the ego's sweep + its wait + its compute time. The wait is the latency budget; a method that fuses no messages
does not wait. The compute time is a constant of each method (``compute_times``). Boxes of the ego are moved by their velocity over
that time; a method without velocities leaves them where they were. The truth is that of the answer (``truth_motion``): objects, and
the ego's own pose, in whose frame boxes and truth are judged. The ego's own motion since its sweep is known to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from manyeyes.agents.replay import ReplayStep
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import Boxes, Snapshot
from manyeyes.evaluation.detection.compute_times import compute_time_s
from manyeyes.evaluation.detection.truth_motion import move_truth


@dataclass(frozen=True)
class Answer:
    """What an ego answers, and when. boxes: in its true frame at that time. snapshot: with the truth of that time; ego: its row."""

    boxes: Boxes
    snapshot: Snapshot
    ego: int
    seconds: float


def answer_of(step: ReplayStep, recording: Recording, compute_s: float | None = None) -> Answer:
    """Return the answer of a step; recording: that of the step, without perturbations.

    compute_s: of the ego's step; None: the constant of its method.
    """
    frame = step.snapshot.frames[step.ego]
    seconds = step.wait_s + (compute_time_s(step.method) if compute_s is None else compute_s)
    moved = move_truth(recording, step.snapshot, frame.agent_id, frame.timestamp_ns + round(seconds * 1e9))
    ego = next(row for row, other in enumerate(moved.frames) if other.agent_id == frame.agent_id)
    assert step.snapshot.truth is not None and moved.truth is not None
    now_from_sweep = moved.truth.world_from_agent[ego].inverse() @ step.snapshot.truth.world_from_agent[step.ego]
    boxes = step.boxes.to(torch.float64).after(seconds).transform(now_from_sweep)
    return Answer(boxes, moved, ego, seconds)
