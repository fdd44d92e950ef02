# SPDX-License-Identifier: Apache-2.0
"""A malicious agent with a message of two cars and their tokens, and an ego 20 m away; all drawn by hand."""

from dataclasses import replace

import numpy as np
import torch

from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, Message, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.studies.attacks.interface import AttackInput, AttackKey, Victim

GRID = BevGrid(-51.2, -51.2, -3.0, 51.2, 51.2, 1.0, pillar=0.4, stride=2)
CHANNELS = 8
CARS = ((10.0, 4.0), (-12.0, -6.0))
KEY = AttackKey(0, "drive", 1)
EGO_POSE = Transform.from_xyz_yaw(20.0, 0.0, 0.0, 0.3).double()


def make_tokens(places: tuple[tuple[float, float], ...] = CARS) -> SparseBev:
    """Three tokens on neighbouring cells of each place; proposals state the place, the middle one with most confidence."""
    rows, cells = [], []
    generator = torch.Generator().manual_seed(3)
    for x, y in places:
        middle = GRID.cells(torch.tensor([[x, y]]))[0]
        for column in (-1, 0, 1):
            yx = middle + torch.tensor([0, column])
            proposal = torch.zeros(PROPOSAL_DIM)
            proposal[BOX_LAYOUT.heatmap_logit] = 2.0 if column == 0 else 0.0
            proposal[BOX_LAYOUT.offset] = (torch.tensor([x, y]) - GRID.centers(yx[None])[0]) / GRID.cell_size_m
            proposal[BOX_LAYOUT.axis] = torch.tensor([1.0, 0.0])
            proposal[BOX_LAYOUT.direction] = torch.tensor([3.0, 0.0])
            rows.append(torch.cat((torch.randn(CHANNELS, generator=generator), proposal)))
            cells.append(yx)
    return SparseBev.from_cells(torch.stack(rows), torch.stack(cells), GRID)


def make_boxes(places: tuple[tuple[float, float], ...] = CARS) -> Boxes:
    center = torch.tensor([[x, y, 0.8] for x, y in places])
    return Boxes.of(center, torch.tensor([[4.5, 1.9, 1.6]]).expand(len(places), 3), torch.zeros(len(places)))


def make_message(agent_id: int = 1, timestamp_ns: int = 0, x: float = 0.0) -> Message:
    """An agent at x on the road; its cars are fixed in its frame."""
    tokens = make_tokens()
    score = torch.linspace(0.2, 0.9, len(tokens.sites))
    pose = Transform.from_xyz_yaw(x, 0.0).double()
    boxes = make_boxes()
    boxes = replace(boxes, score=torch.tensor([0.8, 0.6]))
    return Message(
        agent_id, timestamp_ns, pose, torch.zeros(3, 3), tokens=tokens, token_score=score, objects=boxes,
        descriptors=torch.zeros(2, 32),
    )  # fmt: skip


def road() -> np.ndarray:
    """Ground within 40 m, dense, and a wall behind it, so that rays of a sensor at 1.9 m cross what stands on the road."""
    angle, radius = np.meshgrid(np.linspace(-np.pi, np.pi, 360, endpoint=False), np.linspace(2, 45, 22))
    ground = np.stack((radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(radius)), -1).reshape(-1, 3)
    heights = np.linspace(0.2, 3.0, 12)
    wall = [np.stack((50 * np.cos(angle[0]), 50 * np.sin(angle[0]), np.full(360, z)), -1) for z in heights]
    return np.concatenate((ground, *wall)).astype(np.float32)


def make_input(instant: int = 0, message: Message | None = None, white: bool = True) -> AttackInput:
    """Instants are 0.1 s apart; the sender stands."""
    stamp = instant * 100_000_000
    message = make_message(timestamp_ns=stamp) if message is None else message
    frame = AgentFrame.of(road(), message.world_from_agent, message.agent_id, stamp)
    ego_frame = AgentFrame.of(road(), EGO_POSE, 0, stamp)
    empty = replace(make_message(0, stamp), world_from_agent=EGO_POSE, tokens=None, objects=None, descriptors=None)
    victim = Victim(ego_frame, empty, (), lambda messages: None) if white else None  # type: ignore[arg-type,return-value]
    return AttackInput(frame, message, (), EGO_POSE, instant, victim=victim)


def same_tokens(a: Message, b: Message) -> bool:
    assert a.tokens is not None and b.tokens is not None
    return torch.equal(a.tokens.sites.key, b.tokens.sites.key) and torch.equal(a.tokens.features, b.tokens.features)


def same_objects(a: Message, b: Message) -> bool:
    assert a.objects is not None and b.objects is not None
    return all(torch.equal(getattr(a.objects, name), getattr(b.objects, name)) for name in vars(a.objects))
