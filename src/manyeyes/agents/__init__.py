# SPDX-License-Identifier: Apache-2.0
"""The share and perceive steps of one agent, and replays of recordings with many agents."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.agents.agent import Agent as Agent, Perception as Perception
    from manyeyes.agents.map_perception import MapModelPredictor as MapModelPredictor, MapShareConfig as MapShareConfig
    from manyeyes.agents.map_replay import MapReplay as MapReplay
    from manyeyes.agents.map_server import MapServer as MapServer
    from manyeyes.agents.perception_cache import PerceptionCache as PerceptionCache
    from manyeyes.agents.pose_correction import PoseCorrection as PoseCorrection
    from manyeyes.agents.replay import (
        DetectionReplay as DetectionReplay,
        ReplayConfig as ReplayConfig,
        ReplayStep as ReplayStep,
    )
    from manyeyes.agents.strategies.registry import (
        FusionStrategy as FusionStrategy,
        get_strategy as get_strategy,
        list_strategies as list_strategies,
        register_strategy as register_strategy,
    )

__getattr__, __dir__ = attach(__name__)
