# SPDX-License-Identifier: Apache-2.0
"""OPV2V's cameras: ``<stem>_camera0.png`` … beside the clouds, and their calibration in the agent's yaml.

A camera there has ``cords`` [x, y, z, roll, yaw, pitch] in CARLA's world, ``extrinsic``, which takes points of the LiDAR to the
camera, both in Unreal's axes (x ahead, y to the right, z up), and ``intrinsic``. Read are cords and intrinsic, in files of
others too; the picture's size is that of the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from manyeyes.datasets.formats.cache import ArrayCache
from manyeyes.datasets.formats.image_io import read_image
from manyeyes.datasets.opv2v.carla import carla_from_transform, transform_from_carla
from manyeyes.datasets.opv2v.metadata import load_yaml
from manyeyes.datatypes import Camera, CameraImage, RecordingError, Transform
from manyeyes.datatypes.errors import shorten

_KIND, _COLUMNS = "opv2v-cameras1", 16
_MIRROR = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
# From a camera's frame (right, down, ahead) to the same with x ahead, y to the left and z up.
_BODY_FROM_CAMERA = Transform(
    torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
)


@dataclass(frozen=True)
class CameraRecord:
    """The yaml entry of camera ``number``: cords [x, y, z, roll, yaw, pitch] in metres and degrees, intrinsic (3, 3)."""

    number: int
    cords: tuple[float, ...]
    intrinsic: np.ndarray


def image_path(folder: Path, stem: str, number: int) -> Path:
    """Return the path of a camera's picture of one instant."""
    return folder / f"{stem}_camera{number}.png"


def camera_yaml(
    number: int, camera: Camera, world_from_agent: Transform, world_from_lidar: Transform
) -> dict[str, object]:
    """Return the camera's entry of the agent's yaml, by its key, in plain numbers."""
    world_from_body = world_from_agent @ camera.agent_from_camera @ _BODY_FROM_CAMERA.inverse()
    body_from_lidar = (world_from_body.inverse() @ world_from_lidar).matrix()
    return {
        f"camera{number}": {
            "cords": list(carla_from_transform(world_from_body)),
            "extrinsic": (_MIRROR @ body_from_lidar @ _MIRROR).tolist(),
            "intrinsic": camera.intrinsic.tolist(),
        }
    }


def read_images(yaml: Path, world_from_agent: Transform, cache: ArrayCache | None = None) -> tuple[CameraImage, ...]:
    """Read the pictures of the yaml's instant in the order of their cameras' numbers; those without a file are left out."""
    images = []
    for record in read_cameras(yaml, cache):
        path = image_path(yaml.parent, yaml.stem, record.number)
        if not path.is_file():
            continue
        rgb = read_image(path)
        world_from_camera = transform_from_carla(record.cords) @ _BODY_FROM_CAMERA
        place = world_from_agent.inverse() @ world_from_camera
        intrinsic = torch.from_numpy(record.intrinsic)
        images.append(CameraImage(Camera(intrinsic, place, rgb.shape[2], rgb.shape[1]), rgb))
    return tuple(images)


def read_cameras(yaml: Path, cache: ArrayCache | None = None) -> tuple[CameraRecord, ...]:
    """Return the cameras of one agent's yaml, from the cache where it has been read before."""
    kept = cache.load(yaml, _KIND) if cache is not None and yaml.is_file() else None
    if kept is None or kept.ndim != 2 or kept.shape[1] != _COLUMNS:
        content = load_yaml(yaml)
        numbers = sorted(int(str(k)[6:]) for k in content if str(k).startswith("camera") and str(k)[6:].isdecimal())
        rows = [[n, *_row(yaml, f"camera{n}", content[f"camera{n}"])] for n in numbers]
        kept = np.array(rows, np.float64).reshape(len(rows), _COLUMNS)
        if cache is not None:
            cache.store(yaml, _KIND, kept)
    return tuple(CameraRecord(int(row[0]), tuple(row[1:7].tolist()), row[7:].reshape(3, 3).copy()) for row in kept)


def _row(path: Path, key: str, entry: object) -> list[float]:
    found = entry if isinstance(entry, Mapping) else {}
    try:
        rows = (found["cords"], *found["intrinsic"])
        values = [float(v) for row in rows for v in row] if [len(row) for row in rows] == [6, 3, 3, 3] else []
    except (KeyError, TypeError, ValueError, OverflowError):
        values = []
    if len(values) != _COLUMNS - 1 or not np.isfinite(values).all():
        raise RecordingError(
            f"{path}: expected six numbers at '{key}.cords' and nine at '{key}.intrinsic', found {shorten(entry)}; "
            "copy or download the file again."
        )
    return values


def find_missing_images(files: Sequence[Path], stems: Sequence[str]) -> dict[int, list[str]]:
    """Return the stems that a camera lacks while it has pictures of others, by the camera's number; a camera without any is
    absent.
    """
    there = {p.name for p in files if p.suffix == ".png"}
    numbers = sorted(
        {int(n.rsplit("_camera", 1)[1][:-4]) for n in there if n.rsplit("_camera", 1)[-1][:-4].isdecimal()}
    )
    lacking = {n: [stem for stem in stems if f"{stem}_camera{n}.png" not in there] for n in numbers}
    return {number: found for number, found in lacking.items() if found}


def describe_missing_images(files: Sequence[Path], stems: Sequence[str]) -> list[str]:
    """Return one line for each camera that has pictures of some of an agent's frames and lacks those of others."""
    return [
        f"{len(lacking)} of {len(stems)} frames lack the picture of camera {number}, the first is {lacking[0]}; "
        "it is left out there"
        for number, lacking in find_missing_images(files, stems).items()
    ]
