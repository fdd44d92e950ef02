# SPDX-License-Identifier: Apache-2.0
"""Tables of true boxes in the world: ``timestamp_ns,id,label,x,y,z,length,width,height,yaw[,vx,vy]``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from manyeyes.datasets.object_types import find_label
from manyeyes.datasets.tables import Table
from manyeyes.datatypes import Boxes, RecordingError


@dataclass(frozen=True)
class BoxTable:
    """What one agent lists at all times: boxes (M) in the world, float64, and the time of each (M,)."""

    boxes: Boxes
    timestamp_ns: np.ndarray

    @classmethod
    def empty(cls) -> BoxTable:
        """Return a table without rows."""
        return cls(Boxes.empty(torch.float64), np.zeros(0, np.int64))

    @classmethod
    def read(cls, path: Path) -> BoxTable:
        """Read a table; objects of unknown types are left out.

        Raises:
            RecordingError: a column is absent, a value is no number, or a size is not above 0.
        """
        table = Table.read(path)
        table.require("timestamp_ns", "id", "label")
        time, id = table.integers("timestamp_ns"), table.integers("id")
        labels = [find_label(text) for text in table.texts("label")]
        rows = np.array([row for row, label in enumerate(labels) if label is not None], np.int64)
        values = torch.from_numpy(table.numbers("x", "y", "z", "length", "width", "height", "yaw")[rows])
        if len(rows) and float(values[:, 3:6].min()) <= 0:
            raise RecordingError(f"{path}: a box has a size of 0 or below, expected metres; correct it.")
        velocity = table.numbers("vx", "vy")[rows] if "vx" in table.names else np.zeros((len(rows), 2))
        label = torch.tensor([label for label in labels if label is not None], dtype=torch.int64)
        ids = torch.from_numpy(id[rows])
        boxes = Boxes.of(values[:, :3], values[:, 3:6], values[:, 6], None, label, ids, torch.from_numpy(velocity))
        return cls(boxes, time[rows])

    def at(self, timestamp_ns: int, agent_id: int) -> Boxes:
        """Return what is listed at a time, without the agent's own body."""
        here = torch.from_numpy(self.timestamp_ns == timestamp_ns) & (self.boxes.id != agent_id)
        return self.boxes[here]
