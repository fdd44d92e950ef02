# SPDX-License-Identifier: Apache-2.0
"""A simulated map model: the true map as observed from true poses, with the errors of a simulated fleet.

Elements are missing, invented, cut, bent and noisy (``simulator.fleet``). Errors of reported poses and occlusion are not
simulated here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import STYLES, MapElements
from manyeyes.datatypes.message import LocalMap
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.simulator.fleet.config import CrowdConfig
from manyeyes.simulator.fleet.observation_model import (
    COLUMN_KIND,
    COLUMN_SCORE,
    COLUMN_SIGMA,
    MAX_ELEMENTS,
    MapModelNoise,
    OutputBuffers,
    build_map_index,
    observe_map,
)

Floats = NDArray[np.float64]


class SimulatedMapPredictor:
    """Predict local maps of one true map, in whose frame the poses are; equal inputs give equal outputs."""

    def __init__(self, truth: MapElements, config: CrowdConfig, seed: int = 0) -> None:
        self._config, self._seed = config, seed
        lines = [truth.polyline(row) for row in range(len(truth))]
        style = truth.style.argmax(1).astype(np.int64) if len(truth) else np.zeros(0, np.int64)
        self._map_index = build_map_index(lines, truth.kind, style, np.arange(len(truth)))
        self._buffers = OutputBuffers(
            np.empty((MAX_ELEMENTS, config.points_per_element, 2)),
            np.empty((MAX_ELEMENTS, 4)),
            np.empty((MAX_ELEMENTS, len(STYLES))),
        )

    def predict(self, pose: Floats, window: tuple[float, float, float, float], *noise_key: int | str) -> LocalMap:
        """Predict the map from a true pose (3,) x, y, yaw within x_min, y_min, x_max, y_max of the agent's frame.

        noise_key: names of the observation, which alone determine its errors.
        """
        x0, y0, x1, y1 = window
        errors = {name: float(getattr(self._config, name)) for name in MapModelNoise._fields[4:]}
        key = np.uint64(int(keyed_uniform((1,), self._seed, "eyewitness", *noise_key)[0] * 2.0**52))
        num_found = observe_map(
            self._map_index,
            MapModelNoise(x0, x1, y0, y1, **errors),
            np.asarray(pose),
            np.zeros((0, 4, 2)),
            key,
            self._buffers,
        )
        count, (points, columns, style) = self._config.points_per_element, self._buffers
        elements = MapElements(
            kind=columns[:num_found, COLUMN_KIND].astype(np.int64),
            offsets=np.arange(num_found + 1, dtype=np.int64) * count,
            points=points[:num_found].reshape(-1, 2).copy(),
            score=columns[:num_found, COLUMN_SCORE].copy(),
            sigma=np.repeat(np.maximum(columns[:num_found, COLUMN_SIGMA], 0.01), count),
            style=style[:num_found].copy(),
        )
        return LocalMap(elements, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
