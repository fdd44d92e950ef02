# SPDX-License-Identifier: Apache-2.0
"""BEV feature messages of the map model: an agent's frame to packets, and packets of many frames to the elements of a tile.

Features are exchanged as packets only, those of an agent's own frames too. Source: CrowdMap section 2.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch

from manyeyes.comms import wire
from manyeyes.comms.token_format import TokenFormat, TokenRefusal
from manyeyes.comms.token_selection import select_within_budget
from manyeyes.comms.wire import TokenEncoding
from manyeyes.datatypes import AgentFrame, Boxes, Message, Sites, SparseBev, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.models.maps.head import decode_elements
from manyeyes.models.maps.map_model import MapModel

DEFAULT_BUDGET_BYTES = 1 << 17


def encode_map_features(
    model: MapModel,
    frame: AgentFrame,
    token_encoding: TokenEncoding = "int8",
    budget_bytes: int | None = DEFAULT_BUDGET_BYTES,
    objects: Boxes | None = None,
) -> list[bytes]:
    """Return packets of the features of one frame, cells by falling score; an empty list without features.

    objects: detections in the agent's frame, for pose correction at the receiver; they are not part of the budget.
    """
    sensors = model.config.bev.sensors
    with torch.inference_mode():
        features = model.extract_features(
            [frame.points] if "lidar" in sensors else (), [frame.images] if "camera" in sensors else ()
        ).to(frame.points.xyz.device)
    clamped = features.tokens.with_features(make_map_token_format(model).clamp(features.tokens.features))
    tokens, score = select_within_budget(clamped, features.cell_score, budget_bytes, token_encoding)
    if not len(tokens.sites):
        return []
    message = Message(
        frame.agent_id,
        frame.timestamp_ns,
        frame.world_from_agent,
        frame.pose_covariance,
        model.fingerprint,
        frame.is_infrastructure,
        tokens=tokens,
        token_score=score,
        objects=objects,
    )
    return wire.encode(message, token_encoding=token_encoding)


def make_map_token_format(model: MapModel) -> TokenFormat:
    """Return the format of the tokens of a map model."""
    return TokenFormat(model.fingerprint, model.token_grid, model.config.token_channels, peaks=model.token_peaks)


def decode_map_features(packets: Iterable[bytes], model: MapModel) -> Message | None:
    """Return the message of the received packets of one frame; None without tokens that these weights can fuse."""
    fragments = [wire.decode_packet(packet) for packet in packets]
    if not fragments:
        return None
    message = wire.assemble(fragments)
    return message if is_compatible(message, model) else None


def is_compatible(message: Message, model: MapModel) -> bool:
    """Return whether a message has tokens of these weights, on their grid, of their width and within their range."""
    return message.tokens is not None and find_token_refusal(message, model) is None


def find_token_refusal(message: Message, model: MapModel) -> TokenRefusal | None:
    """Return why the tokens of a message are not of these weights; None where they are, or where it has none."""
    if message.tokens is None:
        return None
    if message.fingerprint != model.fingerprint:
        return "wrong_model"
    return make_map_token_format(model).check_tokens(message.tokens)


def predict_tile(model: MapModel, messages: Sequence[Message], world_from_tile: Transform) -> MapElements:
    """Return the elements of one tile, in its frame, by falling score, from messages with tokens; without any, from empty
    features.
    """
    grid = model.token_grid
    tile_from_world = world_from_tile.inverse()
    tokens = [message.tokens for message in messages if message.tokens is not None]
    poses = [tile_from_world @ m.world_from_agent for m in messages if m.tokens is not None] or [Transform.identity()]
    with torch.inference_mode():
        batch = _batch(tokens, grid_cells=grid.shape[0] * grid.shape[1]) if tokens else _empty_batch(model)
        features = model.fuse(batch, Transform.stack(poses), torch.zeros(len(poses), dtype=torch.int64), 1)
        raw = model.predict_elements(features)[-1]
    return decode_elements(raw, model.config.tile, model.config.head)[0]


def _batch(tokens: Sequence[SparseBev], grid_cells: int) -> SparseBev:
    """Return tokens of several messages as a batch of grids."""
    key = torch.cat([one.sites.key + i * grid_cells for i, one in enumerate(tokens)])
    return SparseBev(torch.cat([one.features for one in tokens]), Sites(key, tokens[0].grid, len(tokens)))


def _empty_batch(model: MapModel) -> SparseBev:
    empty = torch.zeros(0, model.config.token_channels)
    return SparseBev(empty, Sites(torch.zeros(0, dtype=torch.int64), model.token_grid, 1))
