# SPDX-License-Identifier: Apache-2.0
"""Bring a detector of your own: points in, boxes out. This one fits boxes to clusters of occupied cells."""

import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

from manyeyes import BevGrid, BoxDetector, Boxes, PointCloud, benchmark, open_recording, register_detector
from manyeyes.simulator.presets import simulate


@register_detector("clusters")
class ClusterDetector(BoxDetector):
    """Boxes along the principal axes of connected cells with points above the road."""

    grid = BevGrid(-70.4, -38.4, 0.3, 70.4, 38.4, 2.5)  # metres around the agent: x, y, z minima, then maxima

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        xy = points.xyz[self.grid.contains(points.xyz), :2]
        cells = tuple(self.grid.cells(xy).T.numpy())
        occupied = np.zeros(self.grid.shape, bool)
        occupied[cells] = True
        clusters = torch.from_numpy(ndimage.label(occupied, np.ones((3, 3)))[0][cells])
        fitted = [fit_box(xy[clusters == number]) for number in clusters.unique()]
        rows = torch.tensor([row for row in fitted if row]).view(-1, 8)
        return Boxes.of(rows[:, :3], rows[:, 3:6], rows[:, 6], score=rows[:, 7])


def fit_box(xy: torch.Tensor) -> list[float]:
    """Centre, size, yaw and score of a car around points (N, 2); nothing if they are few, or of another size."""
    axes = torch.linalg.svd(xy - xy.mean(0), full_matrices=False).Vh
    low, high = (xy @ axes.T).aminmax(dim=0)
    if len(xy) < 5 or not 1.0 < high[0] - low[0] < 6.0 or high[1] - low[1] > 3.0:
        return []
    center, length = ((low + high) / 2 @ axes).tolist(), max(4.2, float(high[0] - low[0]))
    return [*center, 0.8, length, 1.9, 1.6, float(torch.atan2(axes[0, 1], axes[0, 0])), len(xy) / (len(xy) + 20)]


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "drive"
    if not folder.exists():
        simulate("smoke-opv2v", folder)
    print(benchmark(open_recording(folder, "test"), ClusterDetector(), methods=["no-fusion", "late", "early"]))
