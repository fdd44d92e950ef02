# SPDX-License-Identifier: Apache-2.0
"""manyeyes: cooperative perception of many agents within a byte budget."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

__version__ = "0.2.0"

if TYPE_CHECKING:
    from manyeyes.agents.agent import Agent as Agent, Perception as Perception
    from manyeyes.agents.strategies.registry import (
        FusionStrategy as FusionStrategy,
        get_strategy as get_strategy,
        list_strategies as list_strategies,
        register_strategy as register_strategy,
    )
    from manyeyes.comms.inbox import Inbox as Inbox
    from manyeyes.datasets.argoverse2 import Argoverse2Recording as Argoverse2Recording
    from manyeyes.datasets.base import Recording as Recording, RecordingReader as RecordingReader
    from manyeyes.datasets.dair_v2x.reader import DairRecording as DairRecording
    from manyeyes.datasets.opv2v.reader import Opv2vRecording as Opv2vRecording
    from manyeyes.datasets.registry import open_recording as open_recording, register_dataset as register_dataset
    from manyeyes.datatypes.boxes import Boxes as Boxes
    from manyeyes.datatypes.errors import ManyeyesError as ManyeyesError
    from manyeyes.datatypes.grid import BevGrid as BevGrid
    from manyeyes.datatypes.map_element import MapElements as MapElements
    from manyeyes.datatypes.message import Message as Message
    from manyeyes.datatypes.point_cloud import PointCloud as PointCloud
    from manyeyes.datatypes.snapshot import AgentFrame as AgentFrame, Snapshot as Snapshot
    from manyeyes.datatypes.sparse_bev import SparseBev as SparseBev
    from manyeyes.datatypes.transform import Transform as Transform
    from manyeyes.evaluation.detection.benchmark import (
        BenchmarkConfig as BenchmarkConfig,
        BenchmarkResult as BenchmarkResult,
        benchmark as benchmark,
        run_benchmark as run_benchmark,
    )
    from manyeyes.maps.elements.observation import Observation as Observation
    from manyeyes.maps.elements.observation_file import read_observations as read_observations
    from manyeyes.maps.elements.vector_map import VectorMap as VectorMap
    from manyeyes.maps.registry import (
        fuse_maps as fuse_maps,
        list_map_fusions as list_map_fusions,
        register_map_fusion as register_map_fusion,
    )
    from manyeyes.models.detector.protocols import BoxDetector as BoxDetector, TokenDetector as TokenDetector
    from manyeyes.models.fusion.registry import (
        list_fusion_modules as list_fusion_modules,
        register_fusion as register_fusion,
    )
    from manyeyes.models.pretrained import (  # noqa: F401
        list_detectors as list_detectors,
        load as load_detector,
        register_detector as register_detector,
    )
    from manyeyes.pose.registry import (
        correct_pose as correct_pose,
        list_correctors as list_correctors,
        register_pose_corrector as register_pose_corrector,
    )
    from manyeyes.pose.types import PoseEstimate as PoseEstimate, PosePrior as PosePrior

__getattr__, __dir__ = attach(__name__)
