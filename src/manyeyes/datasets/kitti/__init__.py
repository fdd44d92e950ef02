# SPDX-License-Identifier: Apache-2.0
"""KITTI's object detection, odometry and raw drives, read. Importing the package registers the reader."""

from manyeyes.datasets.kitti.reader import KittiRecording

__all__ = ["KittiRecording"]
