# SPDX-License-Identifier: Apache-2.0
"""Training of detectors, map models and pose matchers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.training.detector.task import DetectorTask as DetectorTask, DetectorTrainConfig as DetectorTrainConfig
    from manyeyes.training.maps.task import MapTask as MapTask, MapTrainConfig as MapTrainConfig
    from manyeyes.training.monitor import Progress as Progress
    from manyeyes.training.pose.feakm import FeakmTask as FeakmTask, FeakmTrainConfig as FeakmTrainConfig
    from manyeyes.training.trainer import Task as Task, TrainConfig as TrainConfig, Trainer as Trainer

__getattr__, __dir__ = attach(__name__)
