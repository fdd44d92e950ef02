# SPDX-License-Identifier: Apache-2.0
"""Detections as KITTI's result files: one text file a frame, 16 columns a box.

Type, truncation, occlusion, alpha, image box (left, top, right, bottom), height, width, length, x, y, z, rotation_y and score.
x, y, z are the middle of the bottom in the rectified camera frame (x right, y down, z ahead); rotation_y turns about y, 0 along x;
alpha is rotation_y less the bearing of the box. Truncation and occlusion are -1: not estimated. An image box is -1 -1 -1 -1 where
no corner is in the image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from manyeyes._io import atomic_write_text
from manyeyes.datasets.kitti.text_files import parse_numbers, read_labels, read_matrix, read_text, to_motion
from manyeyes.datasets.object_types import find_label
from manyeyes.datatypes import LABELS, Boxes, Transform

TYPES = {
    "car": "Car", "van": "Van", "truck": "Truck", "bus": "Truck", "pedestrian": "Pedestrian", "cyclist": "Cyclist",
    "motorcyclist": "Cyclist",
}  # fmt: skip
"""KITTI's type of each of LABELS; it has none for buses and motorcyclists."""
_WIDTH, _HEIGHT = 1242, 375
_FOCAL, _MIDDLE = 721.5377, (609.5593, 172.8540)
_MIN_DEPTH_M = 0.1


@dataclass(frozen=True)
class KittiCalibration:
    """A rectified camera.

    camera_from_lidar: float64, between KITTI's frames; the origin of the LiDAR's frame is the LiDAR. projection: (3, 4) float64, to
    pixels of an image of width x height.
    """

    camera_from_lidar: Transform
    projection: Tensor
    width: int = _WIDTH
    height: int = _HEIGHT

    @classmethod
    def of_lidar(cls) -> KittiCalibration:
        """Return a camera that recordings without one are exported to: at the LiDAR, ahead, with intrinsics as in KITTI."""
        rotation = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
        projection = torch.zeros(3, 4, dtype=torch.float64)
        projection[0, 0] = projection[1, 1] = _FOCAL
        projection[:2, 2], projection[2, 2] = torch.tensor(_MIDDLE, dtype=torch.float64), 1.0
        return cls(Transform(rotation, torch.zeros(3, dtype=torch.float64)), projection)

    def camera_from_agent(self, sensor_height_m: float) -> Transform:
        """Return the motion from the frame of an agent, whose origin is on the road under its LiDAR."""
        return self.camera_from_lidar @ Transform.from_xyz_yaw(0, 0, -sensor_height_m)

    def to_text(self) -> str:
        """Return the content of a file of ``calib``."""
        motion = torch.cat((self.camera_from_lidar.rotation, self.camera_from_lidar.translation[:, None]), 1)
        rows = {f"P{n}": self.projection for n in range(4)} | {"R0_rect": torch.eye(3), "Tr_velo_to_cam": motion}
        return "".join(f"{key}: {' '.join(f'{v:.12e}' for v in row.flatten().tolist())}\n" for key, row in rows.items())


def read_calibration(path: Path) -> KittiCalibration:
    """Read a file of ``calib`` of KITTI's object detection; the projection is that of camera 2, to which labels belong.

    Raises:
        RecordingError: a line is missing or damaged.
    """
    return KittiCalibration(read_camera_pose(path), torch.from_numpy(read_matrix(path, "P2", "P0", shape=(3, 4))))


def read_camera_pose(path: Path) -> Transform:
    """Read rectified_camera_from_lidar, float64, of a file of ``calib``."""
    rectified, camera = np.eye(4), np.eye(4)
    rectified[:3, :3] = read_matrix(path, "R0_rect", "R_rect", shape=(3, 3))
    camera[:3] = read_matrix(path, "Tr_velo_to_cam", "Tr_velo_cam", shape=(3, 4))
    return to_motion(path, (rectified @ camera)[:3], "R0_rect Tr_velo_to_cam")


def write_results(path: Path, boxes: Boxes, calibration: KittiCalibration, sensor_height_m: float) -> None:
    """Write the boxes of one frame, given in the frame of the agent, by falling score; an empty file without boxes."""
    order = boxes.score.argsort(descending=True, stable=True)
    lines = format_results(boxes[order].to(torch.float64), calibration, sensor_height_m)
    atomic_write_text(path, "".join(f"{line}\n" for line in lines), durable=False)


def format_results(boxes: Boxes, calibration: KittiCalibration, sensor_height_m: float) -> list[str]:
    """Return the line of each box (N), float64, of the frame of the agent."""
    camera_from_agent = calibration.camera_from_agent(sensor_height_m)
    bottom = boxes.center.clone()
    bottom[:, 2] -= boxes.size[:, 2] / 2
    place = camera_from_agent.apply(bottom)
    ahead = torch.stack((boxes.yaw.cos(), boxes.yaw.sin(), torch.zeros_like(boxes.yaw)), 1)
    ahead = ahead @ camera_from_agent.rotation.mT
    rotation = torch.atan2(-ahead[:, 2], ahead[:, 0])
    bearing = torch.atan2(place[:, 0], place[:, 2])
    alpha = torch.remainder(rotation - bearing + math.pi, 2 * math.pi) - math.pi
    image = _image_boxes(camera_from_agent.apply(boxes.corners()), calibration)
    length, width, height = boxes.size.unbind(1)
    columns = torch.cat((alpha[:, None], image, torch.stack((height, width, length), 1), place, rotation[:, None]), 1)
    rows = zip(boxes.label.tolist(), columns.tolist(), boxes.score.tolist())
    return [_format_row(LABELS[label], row, score) for label, row, score in rows]


def _format_row(label: str, row: Sequence[float], score: float) -> str:
    """Return a line; row: (12,) alpha, image box, height, width, length, x, y, z, rotation_y."""
    numbers = f"{_join(row[:1], 6)} {_join(row[1:5], 2)} {_join(row[5:11], 4)} {_join(row[11:], 6)}"
    return f"{TYPES[label]} -1 -1 {numbers} {score:.6f}"


def read_results(path: Path, calibration: KittiCalibration, sensor_height_m: float) -> Boxes:
    """Read a result file back, float64, in the frame of the agent; ids are rows."""
    boxes = read_labels(path, calibration.camera_from_agent(sensor_height_m).inverse())
    rows = [line.split() for line in read_text(path).splitlines()]
    scores = [
        parse_numbers(path, " ".join(words[15:]), 1, f"column 16 of line {number}")[0]
        for number, words in enumerate(rows, 1)
        if words and find_label(words[0]) is not None
    ]
    return replace(boxes, score=torch.tensor(scores, dtype=torch.float64))


def _image_boxes(corners: Tensor, calibration: KittiCalibration) -> Tensor:
    """Return left, top, right and bottom (N, 4) of corners (N, 8, 3) of the camera frame, within the image; -1 outside."""
    homogeneous = torch.cat((corners, torch.ones_like(corners[..., :1])), -1) @ calibration.projection.mT
    is_ahead = homogeneous[..., 2:] > _MIN_DEPTH_M
    pixel = homogeneous[..., :2] / homogeneous[..., 2:].clamp_min(_MIN_DEPTH_M)
    last = torch.tensor([calibration.width - 1.0, calibration.height - 1.0], dtype=torch.float64)
    low = pixel.masked_fill(~is_ahead, math.inf).amin(1).clamp_min(0.0)
    high = torch.minimum(pixel.masked_fill(~is_ahead, -math.inf).amax(1), last)
    is_seen = (low < high).all(1, keepdim=True)
    return torch.cat((low, high), 1).where(is_seen, torch.tensor(-1.0, dtype=torch.float64))


def _join(values: Sequence[float], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
