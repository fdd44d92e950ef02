# SPDX-License-Identifier: Apache-2.0
"""The request map that an agent sends with its tokens (``comms.request_map``)."""

from __future__ import annotations

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.comms.request_map import build_request_map
from manyeyes.datatypes import AgentFrame
from manyeyes.datatypes.message import RequestMap

REQUEST_MAP_STRIDE = 32
"""Pillars on an edge of a window of a request map."""


def make_request_map(cache: PerceptionCache, frame: AgentFrame) -> RequestMap:
    """Return the confidence of the agent's own objects, in windows of the coarsest stride."""
    boxes = cache.process(frame).boxes
    return build_request_map(boxes.center[:, :2], boxes.score, cache.detector.grid.at(REQUEST_MAP_STRIDE))
