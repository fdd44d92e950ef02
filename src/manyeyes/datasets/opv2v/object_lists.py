# SPDX-License-Identifier: Apache-2.0
"""The objects that all agents list at one instant, each once, in the right-handed world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from manyeyes.datasets.opv2v.dialect import Dialect
from manyeyes.datasets.opv2v.metadata import KMH_PER_MPS, AgentRecord
from manyeyes.datatypes import Boxes

_FIRST_LINKED_ID, _FIRST_OWN_ID = 100, 1_000_000_000


@dataclass(frozen=True)
class MergedList:
    """The union of all agents' lists by id, first agent's copy, in the order of ids, as arrays of V objects.

    seen: (agents, V). center: (V, 3), size: (V, 3), yaw, label, id: (V,), velocity: (V, 2), as in Boxes.
    """

    seen: np.ndarray
    center: np.ndarray
    size: np.ndarray
    yaw: np.ndarray
    label: np.ndarray
    id: np.ndarray
    velocity: np.ndarray

    def copy(self) -> tuple[Boxes, Tensor]:
        """Return the boxes, and who lists them, in memory of their own."""
        names = ("center", "size", "yaw", "label", "id", "velocity")
        boxes = Boxes.of(**{name: torch.from_numpy(getattr(self, name).copy()) for name in names})
        return boxes, torch.from_numpy(self.seen.copy())


def merge_lists(records: Sequence[AgentRecord], agent_ids: Sequence[int], dialect: Dialect) -> MergedList:
    """Merge what the agents list; an agent's own body and objects of unknown types are left out."""
    listed = [_list_boxes(record, agent, dialect) for record, agent in zip(records, agent_ids)]
    both = Boxes.cat(listed)
    id, first = np.unique(both.id.numpy(), return_index=True)
    boxes = both[torch.from_numpy(first)]
    seen = np.stack([np.isin(id, mine.id.numpy()) for mine in listed])
    if dialect.is_right_handed:
        id = _mark_own_bodies(boxes, records, agent_ids, dialect)
    return MergedList(
        seen,
        boxes.center.numpy(),
        boxes.size.numpy(),
        boxes.yaw.numpy(),
        boxes.label.numpy(),
        id,
        boxes.velocity.numpy(),
    )


def _list_boxes(record: AgentRecord, agent: int, dialect: Dialect) -> Boxes:
    """Return what one agent lists in the right-handed world, float64."""
    id = _list_ids(agent, record) if dialect.are_boxes_local else record.id
    rows = np.where((id != agent) & (record.label >= 0))[0]

    def column(name: str) -> Tensor:
        return torch.from_numpy(getattr(record, name)[rows])

    side = 1 if dialect.is_right_handed else -1
    center = column("location") + column("center")
    center[:, 1] *= side
    yaw = side * column("angle")[:, 1] * (math.pi / 180)
    velocity = torch.stack((yaw.cos(), yaw.sin()), 1) * (column("speed") / KMH_PER_MPS)[:, None]
    boxes = Boxes.of(center, 2 * column("extent"), yaw, None, column("label"), torch.from_numpy(id[rows]), velocity)
    return boxes.transform(dialect.world_from_lidar(record.lidar_pose)) if dialect.are_boxes_local else boxes


def _list_ids(agent: int, record: AgentRecord) -> np.ndarray:
    """Return ids (N,): of linked objects the same in all lists, of others the agent's own; none is that of an agent."""
    return np.where(record.link >= 0, _FIRST_LINKED_ID + record.link, _FIRST_OWN_ID * (abs(agent) + 1) + record.id)


def _mark_own_bodies(
    boxes: Boxes, records: Sequence[AgentRecord], agent_ids: Sequence[int], dialect: Dialect
) -> np.ndarray:
    """Return ids (V,): a box that stands around a vehicle's LiDAR has the id of the vehicle, so that it is not evaluated."""
    id = boxes.id.clone()
    for record, agent in zip(records, agent_ids):
        lidar = dialect.world_from_lidar(record.lidar_pose).translation[None]
        flat = Boxes.of(torch.cat((boxes.center[:, :2], lidar[:, 2:].expand(len(boxes), 1)), 1), boxes.size, boxes.yaw)
        if len(boxes) and not record.is_infrastructure:
            id[flat.contains(lidar)[:, 0] & (boxes.class_rows() >= 0)] = agent
    return id.numpy()
