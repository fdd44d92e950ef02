# SPDX-License-Identifier: Apache-2.0
"""A look at the map, shared: an agent's frame to packets, and packets of many looks to the elements of a tile.

The only way from one to the other is bytes, for an agent's own looks too: a map is drawn by whoever collects them. Source:
CrowdMap section 2.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch

from manyeyes.comms import wire
from manyeyes.comms.token_format import TokenFormat, within_range
from manyeyes.comms.token_selection import within_budget
from manyeyes.comms.wire import Precision
from manyeyes.datatypes import AgentFrame, Boxes, Message, Sites, SparseBev, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.models.maps.head import decode
from manyeyes.models.maps.map_model import Mapper

DEFAULT_BUDGET = 1 << 17


def share_look(
    mapper: Mapper,
    frame: AgentFrame,
    precision: Precision = "int8",
    budget_bytes: int | None = DEFAULT_BUDGET,
    objects: Boxes | None = None,
) -> list[bytes]:
    """The packets that one look is worth, cells that most likely hold an element first; none if nothing was seen.

    objects: what the agent detected in its frame, for those who correct claimed poses by what both see; not in the budget.
    """
    sensors = mapper.config.bev.sensors
    with torch.inference_mode():
        look = mapper.see([frame.points] if "lidar" in sensors else (), [frame.images] if "camera" in sensors else ())
    told = look.tokens.with_features(within_range(look.tokens.features))
    tokens, worth = within_budget(told, look.worth, budget_bytes, precision)
    if not len(tokens.sites):
        return []
    message = Message(
        frame.agent_id,
        frame.timestamp_ns,
        frame.world_from_agent,
        frame.pose_covariance,
        mapper.fingerprint,
        frame.is_infrastructure,
        tokens=tokens,
        token_score=worth,
        objects=objects,
    )
    return wire.encode(message, precision=precision)


def receive(packets: Iterable[bytes], mapper: Mapper) -> Message | None:
    """The message of one look, as far as its packets came; None without tokens that these weights can fuse."""
    fragments = [wire.decode_packet(packet) for packet in packets]
    if not fragments:
        return None
    message = wire.assemble(fragments)
    return message if is_readable(message, mapper) else None


def is_readable(message: Message, mapper: Mapper) -> bool:
    """Whether a message has tokens of these weights, on their grid, of their width and within their range."""
    form = TokenFormat(mapper.fingerprint, mapper.token_grid, mapper.config.token_channels)
    if message.tokens is None or message.fingerprint != form.fingerprint:
        return False
    return form.refusal_of(message.tokens) is None


def draw_tile(mapper: Mapper, looks: Sequence[Message], world_from_tile: Transform) -> MapElements:
    """The elements of one tile, in its frame, best first, from messages with tokens; without any, what nobody's look suggests."""
    grid = mapper.token_grid
    tile_from_world = world_from_tile.inverse()
    tokens = [message.tokens for message in looks if message.tokens is not None]
    poses = [tile_from_world @ m.world_from_agent for m in looks if m.tokens is not None] or [Transform.identity()]
    with torch.inference_mode():
        batch = _batch(tokens, grid_cells=grid.shape[0] * grid.shape[1]) if tokens else _nothing(mapper)
        ground = mapper.fuse(batch, Transform.stack(poses), torch.zeros(len(poses), dtype=torch.int64), 1)
        raw = mapper.draw(ground)[-1]
    return decode(raw, mapper.config.tile, mapper.config.head)[0]


def _batch(tokens: Sequence[SparseBev], grid_cells: int) -> SparseBev:
    """Tokens of several looks on a batch of as many grids."""
    key = torch.cat([one.sites.key + i * grid_cells for i, one in enumerate(tokens)])
    return SparseBev(torch.cat([one.features for one in tokens]), Sites(key, tokens[0].grid, len(tokens)))


def _nothing(mapper: Mapper) -> SparseBev:
    empty = torch.zeros(0, mapper.config.token_channels)
    return SparseBev(empty, Sites(torch.zeros(0, dtype=torch.int64), mapper.token_grid, 1))
