# SPDX-License-Identifier: Apache-2.0
"""Neural networks: from point clouds and images to tokens, and from the tokens of several agents to boxes and map
elements.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.models.detector.detector import Detector as Detector, DetectorConfig as DetectorConfig
    from manyeyes.models.detector.protocols import BoxDetector as BoxDetector, TokenDetector as TokenDetector
    from manyeyes.models.fusion.registry import (
        list_fusion_modules as list_fusion_modules,
        register_fusion as register_fusion,
    )
    from manyeyes.models.maps.map_model import MapModel as MapModel, MapModelConfig as MapModelConfig
    from manyeyes.models.pretrained import (
        list_detectors as list_detectors,
        list_map_models as list_map_models,
        load_feakm as load_feakm,
        load_map_model as load_map_model,
        register_detector as register_detector,
    )

__getattr__, __dir__ = attach(__name__)
