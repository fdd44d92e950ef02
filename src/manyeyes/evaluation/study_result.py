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
from manyeyes.evaluation.detection.accumulator import IOUS, Tally
from manyeyes.evaluation.detection.average_precision import FrameMatch
from manyeyes.evaluation.detection.communication import Communication

Speeds = tuple[float, float]
"""A class of speeds, m/s: from the first, below the second."""


@dataclass(frozen=True)
class Volume:
    """Bytes handed to the bus. largest: one agent's at one instant; instant: of all senders together, mean and most.

    Where the first agent alone is judged, its own message is none that it could hear and is not counted.
    """

    largest: int
    instant_mean: float
    instant_most: int


@dataclass(frozen=True)
class Cell:
    """A method in a condition. matches: every judged frame at each of IOUS; speeds: (G,) m/s of each frame's true boxes."""

    method: str
    matches: tuple[tuple[FrameMatch, ...], ...]
    speeds: tuple[Tensor, ...]
    communication: Communication
    volume: Volume
    age_ms: float

    @property
    def bytes_per_message(self) -> float:
        """The mean length of what another agent sent for an ego's frame; 0 for who says nothing."""
        return self.communication.bytes_per_message if self.communication.messages else 0.0

    def frames(
        self, iou: int, scenarios: Collection[str] | None = None, speeds: Speeds | None = None
    ) -> list[FrameMatch]:
        """The frames matched at IOUS[iou]: of these scenarios alone, of one class of speeds alone."""
        pairs = zip(self.matches[iou], self.speeds)
        kept = [(match, v) for match, v in pairs if scenarios is None or match.scenario in scenarios]
        return [match if speeds is None else of_speed(match, v, speeds) for match, v in kept]


def of_speed(match: FrameMatch, speed: Tensor, speeds: Speeds) -> FrameMatch:
    """The frame with the true boxes (G,) of one class of speeds alone."""
    inside = (speed >= speeds[0]) & (speed < speeds[1])
    # A row of -1 looks at the last entry: a false positive stays one.
    counts = torch.cat((inside, torch.ones(1, dtype=torch.bool)))[match.truth_row]
    return FrameMatch(match.scenario, match.index, match.score[counts], match.truth_row[counts], int(inside.sum()))


def cell_of(tally: Tally) -> Cell:
    """What a tally counted."""
    sent = {(m.scenario, m.index, m.sender): m.bytes for m in tally.messages}
    instants: dict[tuple[str, int], int] = {}
    for (scenario, index, _), size in sent.items():
        instants[scenario, index] = instants.get((scenario, index), 0) + size
    judged = len({(frame.scenario, frame.index) for frame in tally.frames})
    volume = Volume(
        max(sent.values(), default=0),
        sum(instants.values()) / judged if judged else math.nan,
        max(instants.values(), default=0),
    )
    return Cell(tally.method, tally.matches(), tuple(tally.speeds), tally.communication(), volume, tally.age_ms())


def write_cell(path: Path, cell: Cell) -> None:
    """The cell as one .npz file, whole or not at all."""
    first = cell.matches[0]
    about = {
        "method": cell.method,
        "communication": dataclasses.asdict(cell.communication),
        "volume": dataclasses.asdict(cell.volume),
        "age_ms": cell.age_ms,
    }
    out = io.BytesIO()
    np.savez_compressed(
        out,
        about=np.array(json.dumps(about)),
        scenario=np.array([m.scenario for m in first], dtype=np.str_),
        index=np.array([m.index for m in first], dtype=np.int64),
        found=np.array([len(m.score) for m in first], dtype=np.int64),
        true=np.array([m.n_gt for m in first], dtype=np.int64),
        score=_joined([m.score for m in first]),
        speed=_joined(list(cell.speeds)),
        row=np.stack([_joined([m.truth_row for m in matches]).astype(np.int16) for matches in cell.matches]),
    )
    atomic_write(path, out.getvalue())


def read_cell(path: Path) -> Cell | None:
    """A kept cell; None where there is none, or one that was spoilt."""
    try:
        with np.load(path, allow_pickle=False) as held:
            arrays = {name: held[name] for name in held.files}
        about = json.loads(str(arrays["about"]))
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
        if len(matches) != len(IOUS):
            return None
        return Cell(
            about["method"],
            matches,
            speeds,
            Communication(**about["communication"]),
            Volume(**about["volume"]),
            about["age_ms"],
        )
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None


def _joined(parts: list[Tensor]) -> np.ndarray:
    return torch.cat(parts).numpy() if parts else np.zeros(0)
