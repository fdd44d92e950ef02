# SPDX-License-Identifier: Apache-2.0
"""Local map prediction of one agent, from its own features alone or fused with received ones, as a section of a message.

Sources: CrowdMap sections 2.2 and 3.1. A local map covers the area ahead, 30 m by 30 m for a vehicle and 50 m by 30 m for a
roadside unit. A semi-global map covers the tile of 120 m by 60 m around the agent, from its own and received features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.fusion_selection import busy_rejection
from manyeyes.agents.isolation import content_error, isolate_failing
from manyeyes.agents.map_features import decode_map_features, encode_map_features, find_token_refusal, predict_tile
from manyeyes.agents.pose_plausibility import find_pose_fault
from manyeyes.agents.strategies.message_header import make_header
from manyeyes.comms import wire
from manyeyes.comms.inbox import Rejection, token_rejection
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.datatypes import AgentFrame, ConfigError, Message, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.datatypes.message import LocalMap
from manyeyes.maps.elements.observation import is_simple_ring
from manyeyes.maps.fusion.crossings import compute_convex_hull
from manyeyes.models.maps.map_model import MapModel
from manyeyes.ops.clip import clip_line, clip_ring, ring_area
from manyeyes.ops.polyline import simplify

Floats = NDArray[np.float64]
Window = tuple[float, float, float, float]
MapPredictor = Callable[[AgentFrame, Sequence[Message]], LocalMap | None]
"""Predict a local map from an agent's frame and received messages with map features; None without a map."""


@dataclass(frozen=True)
class MapShareConfig:
    """Settings of the local map that an agent sends.

    vehicle_window, roadside_window: predicted area, x_min, y_min, x_max, y_max metres in the agent's frame. use_neighbours: fuse
    received features too. min_score: of a sent element; min_length_m, min_area_m2: of a line and of a crossing.
    simplify_tolerance_m: maximum deviation of a sent line from the predicted one.
    """

    vehicle_window: Window = (0.0, -15.0, 30.0, 15.0)
    roadside_window: Window = (0.0, -15.0, 50.0, 15.0)
    use_neighbours: bool = False
    min_score: float = 0.3
    min_length_m: float = 2.0
    min_area_m2: float = 4.0
    simplify_tolerance_m: float = 0.03

    def window(self, frame: AgentFrame) -> Window:
        """Return the predicted area around this agent."""
        return self.roadside_window if frame.is_infrastructure else self.vehicle_window


_TILE = (-60.0, -30.0, 60.0, 30.0)
MAP_MODES = {"local": MapShareConfig(), "semi-global": MapShareConfig(_TILE, _TILE, use_neighbours=True)}


def get_map_share_config(name: str) -> MapShareConfig:
    """Return the settings of a map mode; ConfigError lists the known modes."""
    if name not in MAP_MODES:
        raise ConfigError(f"No map mode is called {name!r}; known: {', '.join(MAP_MODES)}.")
    return MAP_MODES[name]


@dataclass(frozen=True)
class MapPrediction:
    """A local map, None without any features, and the senders whose features are excluded, with the reason."""

    local_map: LocalMap | None
    rejected: tuple[Rejection, ...] = ()


@dataclass(frozen=True)
class MapModelPredictor:
    """A map model applied to frames; predictions are clipped to the covered area and filtered."""

    model: MapModel
    config: MapShareConfig = MapShareConfig()

    def __call__(self, frame: AgentFrame, received: Sequence[Message] = ()) -> LocalMap | None:
        """Return the elements in the agent's frame; None without own or received features."""
        return self.predict(frame, received).local_map

    def predict(self, frame: AgentFrame, received: Sequence[Message] = ()) -> MapPrediction:
        """Return the local map, and the rejected senders: those of another token format, of an implausible pose, or with features
        that make the prediction fail.
        """
        own = decode_map_features(encode_map_features(self.model, frame), self.model)
        usable, rejected = self._select(frame, received) if self.config.use_neighbours else ({}, [])
        if own is None and not usable:
            return MapPrediction(None, tuple(rejected))
        x, y, _ = frame.world_from_agent.translation.tolist()
        world_from_tile = Transform.from_xyz_yaw(x, y, 0.0, float(frame.world_from_agent.yaw))

        def predict(senders: Sequence[int]) -> LocalMap:
            messages = [*([] if own is None else [own]), *(usable[sender] for sender in senders)]
            view = self._view(frame, [world_from_tile.inverse() @ message.world_from_agent for message in messages])
            predicted = predict_tile(self.model, messages, world_from_tile)
            kept = predicted.take(predicted.score >= self.config.min_score)
            return LocalMap(clip_to_view(kept, view, self.config), view)

        try:
            return MapPrediction(predict([*usable]), tuple(rejected))
        except Exception as error:
            if not usable:
                raise
            isolated = isolate_failing(predict, [*usable], error)
            errors = [content_error(sender, cause) for sender, cause in sorted(isolated.errors.items())]
            return MapPrediction(isolated.result, (*rejected, *errors))

    def _select(self, frame: AgentFrame, received: Sequence[Message]) -> tuple[dict[int, Message], list[Rejection]]:
        """Return the messages that can be fused, by sender, and the rejections of the others that have tokens."""
        limits, usable, rejected = ReceiverLimits(), dict[int, Message](), list[Rejection]()
        for message in received:
            if message.tokens is None:
                continue
            refusal = find_token_refusal(message, self.model)
            fault = find_pose_fault(frame, message, None, limits)
            if refusal is not None:
                rejected.append(token_rejection(message.agent_id, refusal))
            elif fault is not None:
                rejected.append(Rejection(message.agent_id, "pose", fault))
            elif len(usable) == limits.max_fused_senders:
                rejected.append(busy_rejection(message.agent_id, limits))
            else:
                usable[message.agent_id] = message
        return usable, rejected

    def _view(self, frame: AgentFrame, tile_from_sender: Sequence[Transform]) -> Floats:
        """Return the convex hull of the covered ground, clipped to the agent's window: an open ring, anticlockwise."""
        grid = self.model.token_grid
        corners = rectangle((grid.x_min, grid.y_min, grid.x_max, grid.y_max))
        placed = [corners @ _rotation_2d(float(m.yaw)).T + m.translation[:2].numpy() for m in tile_from_sender]
        return clip_ring(compute_convex_hull(np.concatenate(placed)), rectangle(self.config.window(frame)))


def clip_to_view(elements: MapElements, view: Floats, config: MapShareConfig) -> MapElements:
    """Clip predicted elements to a convex, anticlockwise view (K, 2), simplify them and drop short ones.

    Crossings whose ring intersects itself are dropped.
    """
    rows: list[int] = []
    parts: list[Floats] = []
    for row in range(len(elements)):
        points = elements.polyline(row)
        if elements.closed[row]:
            ring = clip_ring(points, view)
            ring = simplify(np.concatenate((ring, ring[:1])), config.simplify_tolerance_m)[:-1]
            found = [ring] if abs(ring_area(ring)) >= config.min_area_m2 and is_simple_ring(ring) else []
        else:
            cut = [simplify(part, config.simplify_tolerance_m) for part in clip_line(points, view)]
            found = [part for part in cut if np.hypot(*np.diff(part, axis=0).T).sum() >= config.min_length_m]
        rows += [row] * len(found)
        parts += found
    index = np.array(rows, np.int64)
    mean = np.bincount(elements.element_of_point, elements.sigma, len(elements)) / np.maximum(elements.counts, 1)
    sigma = np.repeat(mean[index], [len(part) for part in parts]) if parts else 0.0
    return MapElements.of(parts, elements.kind[index], elements.score[index], sigma, elements.style[index])


def encode_map_message(
    frame: AgentFrame, local_map: LocalMap, fingerprint: bytes = bytes(8), mtu: int = wire.DEFAULT_MTU
) -> list[bytes]:
    """Return packets of a message with a local map only; fingerprint: of the weights that predicted it."""
    return wire.encode(replace(make_header(frame, fingerprint), local_map=local_map), mtu=mtu)


def rectangle(window: Window) -> Floats:
    """Return (4, 2) the corners of a window, anticlockwise."""
    x0, y0, x1, y1 = window
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _rotation_2d(yaw: float) -> Floats:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
