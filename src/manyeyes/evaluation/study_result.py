# SPDX-License-Identifier: Apache-2.0
"""One cell of a study: what one method did in one condition, in the little that its tables need, and the same as a file.

AP of a speed class counts the true boxes of that class; a detection that was matched to a box of another class is left out,
neither right nor wrong; one that matched nothing is false in every class.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import zipfile
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from manyeyes._io import atomic_write
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS, MetricAccumulator
from manyeyes.evaluation.detection.average_precision import FrameMatch
from manyeyes.evaluation.detection.communication import Communication

SpeedRange = tuple[float, float]
"""A class of speeds, m/s: from the first, below the second."""


@dataclass(frozen=True)
class BusVolume:
    """Bytes handed to the bus. max_message_bytes: one agent's at one instant; instant: of all senders together, mean and most.

    Where the first agent alone is judged, its own message is not received by it and is not counted.
    """

    max_message_bytes: int
    mean_snapshot_bytes: float
    max_snapshot_bytes: int


@dataclass(frozen=True)
class StudyResult:
    """A method in a condition. matches: every judged frame at each of IOUS; speeds: (G,) m/s of each frame's true boxes."""

    method: str
    matches: tuple[tuple[FrameMatch, ...], ...]
    speeds: tuple[Tensor, ...]
    communication: Communication
    volume: BusVolume
    age_ms: float

    @property
    def bytes_per_message(self) -> float:
        """The mean length of another agent's message for an ego's frame; 0 without messages."""
        return self.communication.bytes_per_message if self.communication.num_messages else 0.0

    def select_matches(
        self, iou: int, scenarios: Collection[str] | None = None, speed_range: SpeedRange | None = None
    ) -> list[FrameMatch]:
        """The frames matched at IOUS[iou]: of these scenarios alone, of one class of speeds alone."""
        pairs = zip(self.matches[iou], self.speeds)
        kept = [(match, v) for match, v in pairs if scenarios is None or match.scenario in scenarios]
        return [match if speed_range is None else filter_by_speed(match, v, speed_range) for match, v in kept]


def filter_by_speed(match: FrameMatch, speed: Tensor, speed_range: SpeedRange) -> FrameMatch:
    """The frame with the true boxes (G,) of one class of speeds alone."""
    inside = (speed >= speed_range[0]) & (speed < speed_range[1])
    # Row -1 indexes the last entry, which is kept: a false positive stays one.
    mask = torch.cat((inside, torch.ones(1, dtype=torch.bool)))[match.truth_row]
    return FrameMatch(match.scenario, match.index, match.score[mask], match.truth_row[mask], int(inside.sum()))


def make_study_result(metrics: MetricAccumulator) -> StudyResult:
    """What a tally counted."""
    sent = {(m.scenario, m.index, m.sender): m.num_bytes for m in metrics.messages}
    snapshot_bytes: dict[tuple[str, int], int] = {}
    for (scenario, index, _), size in sent.items():
        snapshot_bytes[scenario, index] = snapshot_bytes.get((scenario, index), 0) + size
    num_snapshots = len({(frame.scenario, frame.index) for frame in metrics.frames})
    volume = BusVolume(
        max(sent.values(), default=0),
        sum(snapshot_bytes.values()) / num_snapshots if num_snapshots else math.nan,
        max(snapshot_bytes.values(), default=0),
    )
    return StudyResult(
        metrics.method,
        metrics.match_frames(),
        tuple(metrics.speeds),
        metrics.summarize_communication(),
        volume,
        metrics.mean_age_ms(),
    )


def write_result(path: Path, result: StudyResult) -> None:
    """The cell as one .npz file, whole or not at all."""
    first = result.matches[0]
    header = {
        "method": result.method,
        "communication": dataclasses.asdict(result.communication),
        "volume": dataclasses.asdict(result.volume),
        "age_ms": result.age_ms,
    }
    out = io.BytesIO()
    np.savez_compressed(
        out,
        about=np.array(json.dumps(header)),
        scenario=np.array([m.scenario for m in first], dtype=np.str_),
        index=np.array([m.index for m in first], dtype=np.int64),
        found=np.array([len(m.score) for m in first], dtype=np.int64),
        true=np.array([m.n_gt for m in first], dtype=np.int64),
        score=_concatenate([m.score for m in first]),
        speed=_concatenate(list(result.speeds)),
        row=np.stack([_concatenate([m.truth_row for m in matches]).astype(np.int16) for matches in result.matches]),
    )
    atomic_write(path, out.getvalue())


def read_result(path: Path) -> StudyResult | None:
    """A kept cell; None where there is none, or one that was spoilt."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(str(arrays["about"]))
        ends = np.cumsum(arrays["found"])[:-1]
        scores = [torch.from_numpy(part) for part in np.split(arrays["score"], ends)]
        names = arrays["scenario"].tolist()
        matches = tuple(
            tuple(
                FrameMatch(name, int(index), score, torch.from_numpy(part.astype(np.int64)), int(true))
                for name, index, score, part, true in zip(
                    names, arrays["index"], scores, np.split(row, ends), arrays["true"]
                )
            )
            for row in arrays["row"]
        )
        speeds = tuple(map(torch.from_numpy, np.split(arrays["speed"], np.cumsum(arrays["true"])[:-1])))
        if len(matches) != len(IOU_THRESHOLDS):
            return None
        return StudyResult(
            header["method"],
            matches,
            speeds,
            Communication(**header["communication"]),
            BusVolume(**header["volume"]),
            header["age_ms"],
        )
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None


def _concatenate(parts: list[Tensor]) -> np.ndarray:
    return torch.cat(parts).numpy() if parts else np.zeros(0)
