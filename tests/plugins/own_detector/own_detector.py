# SPDX-License-Identifier: Apache-2.0
"""A detector without learning: one box of a car around each cluster of occupied cells."""

import numpy as np
import torch
from scipy import ndimage

from manyeyes import BevGrid, BoxDetector, Boxes, PointCloud, register_detector


@register_detector("clusters")
class ClusterDetector(BoxDetector):
    """Connected cells with points above the road."""

    grid = BevGrid(-70.4, -38.4, 0.3, 70.4, 38.4, 2.5)

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        """Boxes of 4.5 m by 1.9 m along x; the score grows with the number of points."""
        xyz = points.xyz[self.grid.contains(points.xyz)]
        cells = tuple(self.grid.cells(xyz[:, :2]).T.numpy())
        occupied = np.zeros(self.grid.shape, bool)
        occupied[cells] = True
        clusters = torch.from_numpy(ndimage.label(occupied)[0][cells]).long()
        count = torch.bincount(clusters)[1:]
        total = torch.zeros(len(count) + 1, 3).index_add(0, clusters, xyz)[1:]
        size = torch.tensor([[4.5, 1.9, 1.6]]).expand(len(count), 3)
        return Boxes.of(total / count[:, None], size, torch.zeros(len(count)), score=count / (count + 20))
