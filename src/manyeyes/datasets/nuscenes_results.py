# SPDX-License-Identifier: Apache-2.0
"""Detections as a result file of nuScenes' detection task: one JSON of all samples, boxes in the world.

``meta`` states the inputs; ``results`` maps a sample token to at most 500 boxes: translation (x, y, z of the middle, metres), size
(width, length, height), rotation (quaternion w, x, y, z), velocity (x, y, m/s), detection_name, detection_score and attribute_name,
empty where it is not known.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from manyeyes._io import atomic_write_text, parse_json, read_file
from manyeyes.datasets.lidar_frame import rotation_of_quaternion
from manyeyes.datatypes import LABELS, Boxes, RecordingError

MAX_BOXES = 500
NAMES = {
    "car": "car", "van": "car", "truck": "truck", "bus": "bus", "pedestrian": "pedestrian", "cyclist": "bicycle",
    "motorcyclist": "motorcycle",
}  # fmt: skip
"""nuScenes' detection_name of each of LABELS."""
META = {"use_camera": False, "use_lidar": True, "use_radar": False, "use_map": False, "use_external": False}
_MOVING = {"pedestrian": "pedestrian.moving", "bicycle": "cycle.with_rider", "motorcycle": "cycle.with_rider"}
_MIN_SPEED_MPS = 0.5
_LABEL_OF_NAME = {name: LABELS.index(label) for label, name in reversed(NAMES.items())}


def make_sample_token(scenario: str, index: int) -> str:
    """Return the token of a snapshot, since recordings of other data sets have none: the scenario and six digits."""
    return f"{scenario}_{index:06d}"


def write_results(path: Path, results: Mapping[str, Boxes]) -> None:
    """Write the boxes, given in the world, of samples by their tokens; of more than 500 boxes the best."""
    samples = {token: _sample(token, boxes.to(torch.float64)) for token, boxes in results.items()}
    atomic_write_text(path, json.dumps({"meta": META, "results": samples}, indent=1, ensure_ascii=False) + "\n")


def _sample(token: str, boxes: Boxes) -> list[dict[str, Any]]:
    boxes = boxes[boxes.score.argsort(descending=True, stable=True)[:MAX_BOXES]]
    rows = zip(*(getattr(boxes, name).tolist() for name in ("center", "size", "yaw", "velocity", "score", "label")))
    found = []
    for center, (length, width, height), yaw, velocity, score, label in rows:
        name = NAMES[LABELS[label]]
        found.append(
            {
                "sample_token": token,
                "translation": center,
                "size": [width, length, height],
                "rotation": [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)],
                "velocity": velocity,
                "detection_name": name,
                "detection_score": score,
                "attribute_name": _attribute(name, math.hypot(*velocity)),
            }
        )
    return found


def _attribute(name: str, speed_mps: float) -> str:
    """Return the attribute of what moves, and of riders; without a velocity it is not known."""
    if name in ("bicycle", "motorcycle"):
        return _MOVING[name]
    return _MOVING.get(name, "vehicle.moving") if speed_mps >= _MIN_SPEED_MPS else ""


def read_results(path: Path) -> dict[str, Boxes]:
    """Read a result file: boxes in the world, float64, of each sample token; objects that are none of NAMES are left out.

    Raises:
        RecordingError: it cannot be read, or is no result file.
    """
    try:
        content = parse_json(read_file(path))["results"]
        return {
            token: _boxes([one for one in sample if one["detection_name"] in _LABEL_OF_NAME])
            for token, sample in content.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(
            f"{path}: expected a result file of nuScenes' detection task, found something else ({error}); write it again."
        ) from None


def _boxes(sample: list[dict[str, Any]]) -> Boxes:
    def column(name: str, width: int) -> torch.Tensor:
        return torch.tensor([one[name] for one in sample], dtype=torch.float64).reshape(-1, width)

    rotation, size = rotation_of_quaternion(column("rotation", 4)), column("size", 3)
    return Boxes.of(
        column("translation", 3),
        size[:, [1, 0, 2]],
        torch.atan2(rotation[:, 1, 0], rotation[:, 0, 0]),
        column("detection_score", 1)[:, 0],
        torch.tensor([_LABEL_OF_NAME[one["detection_name"]] for one in sample], dtype=torch.int64),
        velocity=column("velocity", 2),
    )
