# SPDX-License-Identifier: Apache-2.0
"""What persists after the drive."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.maps.elements.observation import MapFrame as MapFrame, Observation as Observation
    from manyeyes.maps.elements.observation_file import (
        read_observations as read_observations,
        write_observations as write_observations,
    )
    from manyeyes.maps.elements.vector_map import VectorMap as VectorMap
    from manyeyes.maps.formats.export import export_map as export_map
    from manyeyes.maps.formats.geoparquet import read_map as read_map, write_map as write_map
    from manyeyes.maps.fusion.fuse import MapFusionConfig as MapFusionConfig
    from manyeyes.maps.fusion.incremental import IncrementalMap as IncrementalMap
    from manyeyes.maps.registry import (
        fuse_maps as fuse_maps,
        list_map_fusions as list_map_fusions,
        register_map_fusion as register_map_fusion,
    )
    from manyeyes.maps.roads.ground_truth import (
        GroundTruthPolicy as GroundTruthPolicy,
        build_ground_truth_map as build_ground_truth_map,
    )
    from manyeyes.maps.roads.road_network import RoadNetwork as RoadNetwork
    from manyeyes.maps.store.store import MapStore as MapStore

__getattr__, __dir__ = attach(__name__)
