# SPDX-License-Identifier: Apache-2.0
"""Recordings that map models are trained and evaluated on, and the true maps of their towns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from manyeyes.datasets.base import Recording, RecordingReader
    from manyeyes.datatypes.map_element import MapElements


def open_sensor_recording(data: Path, split: str | None, sensors: Sequence[str]) -> RecordingReader:
    """Return the recording with what these sensors took: pictures are read where a model has cameras, and must then be there."""
    from manyeyes.datasets.registry import open_recording

    recording = open_recording(data, split, images="camera" in sensors)
    if "camera" in sensors:
        check_images(recording, str(data))
    return recording


def check_images(recording: Recording, data: str) -> None:
    """Refuse a recording without pictures; data: its name for the error.

    Raises:
        ConfigError: no agent of the first snapshot has pictures.
    """
    from manyeyes.datatypes import ConfigError

    if not has_images(recording):
        raise ConfigError(
            f"{data}: no pictures in {recording.scenarios[0]}, and the model has cameras; give a recording of 'manyeyes simulate "
            "--preset carla-maps-camera' (or any preset with --cameras), or a model of agents with LiDAR."
        )


def has_images(recording: Recording) -> bool:
    """Return whether any agent of the first snapshot has; the recording reads them."""
    return any(frame.images for frame in recording.snapshot(recording.scenarios[0], 0).frames)


def load_true_maps(recording: Recording) -> dict[str, MapElements]:
    """Return the true map of every town that the recording's scenarios are named after, in its world frame.

    Edges are the pavement's, and go on around the corners of junctions: sweeps and images do not show where a junction begins.
    """
    from manyeyes.maps.roads.ground_truth import GroundTruthPolicy, build_ground_truth_map
    from manyeyes.simulator.scene.towns import GENERATED, TOWNS, load_town

    town_by_lower_name = {town.lower(): town for town in TOWNS}
    named = sorted({scenario.rsplit("_", 1)[0] for scenario in recording.scenarios})
    towns = [name if name.startswith(GENERATED) else town_by_lower_name.get(name, name) for name in named]
    policy = GroundTruthPolicy(boundary="pavement", boundary_cut="none")
    return {town: build_ground_truth_map(load_town(town), policy) for town in towns}
