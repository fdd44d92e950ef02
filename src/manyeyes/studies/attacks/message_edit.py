# SPDX-License-Identifier: Apache-2.0
"""Edits of a message: an object inserted, removed or moved, in boxes and tokens alike.

An inserted object is a copy of an object that the sender detects: its box, and its tokens on the cells around the new place. Vector
channels and proposals are rotated as a receiver rotates them (``models.fusion.transform_tokens``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datatypes import Boxes, Message, SparseBev
from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT, RawBoxes, axis_yaw, heading_logit
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat, proposed_offset, turn_proposal
from manyeyes.models.fusion.transform_tokens import rotate_vectors

CAR_SIZE = (4.5, 1.9, 1.6)
OBJECT_RADIUS_M = 2.4
"""Tokens whose proposed centres are closer than this to the centre of an object belong to it."""
MAX_INSERTED_LOGIT = 8.0


@dataclass(frozen=True, eq=False)
class ObjectTemplate:
    """An object as a sender encodes it.

    box: one box in the sender's frame at the time of capture. tokens: (n, C + PROPOSAL_DIM) of it, (0, ...) where the message has
    none. offsets: (n, 2) metres from the centre to each token.
    """

    box: Boxes
    tokens: Tensor | None
    offsets: Tensor

    @property
    def yaw(self) -> float:
        """Yaw of the box in the sender's frame at the time of capture."""
        return float(self.box.yaw[0])


def proposed_xy(tokens: SparseBev) -> Tensor:
    """Return (N, 2) metres: the object centre that each token proposes, in the sender's frame."""
    return tokens.sites.xy + proposed_offset(tokens.features[:, -PROPOSAL_DIM:]) * tokens.grid.cell_size_m


def template_at(message: Message, box: Boxes) -> ObjectTemplate:
    """Return the object of one box (1) of a message's frame with the tokens that belong to it."""
    if message.tokens is None:
        return ObjectTemplate(box, None, torch.zeros(0, 2))
    centre = box.center[0, :2].float()
    near = (proposed_xy(message.tokens) - centre).norm(dim=1) < OBJECT_RADIUS_M
    return ObjectTemplate(box, message.tokens.features[near], message.tokens.sites.xy[near] - centre)


def find_template(message: Message) -> ObjectTemplate | None:
    """Return the most confident object of a message; a car without tokens where it has no tokens section; None without objects."""
    if message.tokens is None:
        return ObjectTemplate(_car(torch.zeros(2), 0.0), None, torch.zeros(0, 2))
    objects = list_objects(message)
    return template_at(message, objects[:1]) if len(objects) else None


def list_objects(message: Message, min_score: float = 0.3) -> Boxes:
    """Return the objects of a message by falling score, in its frame: its boxes, or cars as its tokens propose them.

    Proposals near a more confident one are the same object.
    """
    if message.objects is not None:
        objects = message.objects[message.objects.score.argsort(descending=True, stable=True)]
        return objects[objects.score >= min_score]
    if message.tokens is None:
        return Boxes.empty()
    proposals = message.tokens.features[:, -PROPOSAL_DIM:]
    score, xy = torch.sigmoid(proposed_heat(proposals)), proposed_xy(message.tokens)
    raw = RawBoxes.of(proposals, message.tokens.sites)
    yaw = axis_yaw(raw.axis)
    yaw = torch.where(heading_logit(raw) >= 0, yaw, yaw + math.pi)
    chosen: list[int] = []
    for row in score.argsort(descending=True, stable=True).tolist():
        if float(score[row]) < min_score:
            break
        if not chosen or float((xy[chosen] - xy[row]).norm(dim=1).min()) >= OBJECT_RADIUS_M:
            chosen.append(row)
    boxes = [
        replace(
            _car(xy[row], float(yaw[row])),
            score=score[row : row + 1],
            velocity=raw.velocity[row : row + 1] * SPEED_UNIT,
        )
        for row in chosen
    ]
    return Boxes.cat(boxes)


def _car(xy: Tensor, yaw: float) -> Boxes:
    """Return a car (1) on the ground at a place (2)."""
    center = torch.cat((xy.float(), torch.tensor([CAR_SIZE[2] / 2])))[None]
    return Boxes.of(center, torch.tensor([CAR_SIZE]), torch.tensor([yaw]))


def insert_object(message: Message, template: ObjectTemplate, box: Boxes) -> Message:
    """Return the message with an object, shaped as a template, at the place, yaw, velocity and score of a box (1).

    Existing tokens on the same cells are replaced; inserted tokens are the first to be selected.
    """
    if message.objects is not None:
        message = _add_box(message, box)
    tokens = message.tokens
    if tokens is None or template.tokens is None or not len(template.tokens):
        return message
    yaw = torch.tensor(float(box.yaw[0]) - template.yaw)
    cosine, sine = float(yaw.cos()), float(yaw.sin())
    turn = torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float32)
    centre = box.center[0, :2].float()
    xy = centre + template.offsets.float() @ turn.T
    inside = tokens.grid.contains(xy)
    rows, xy = template.tokens[inside], xy[inside]
    yx = tokens.grid.cells(xy)
    keys = yx[:, 0] * tokens.grid.shape[1] + yx[:, 1]
    # Of several tokens on one cell the one of highest heat is kept.
    order = proposed_heat(rows[:, -PROPOSAL_DIM:]).argsort(descending=True, stable=True)
    first = _first_of_each(keys[order])
    rows, yx = rows[order][first], yx[order][first]
    if not len(rows):
        return message
    features = rotate_vectors(rows[:, :-PROPOSAL_DIM], yaw)
    proposal = turn_proposal(rows[:, -PROPOSAL_DIM:], yaw.cos(), yaw.sin(), torch.zeros(len(rows)))
    proposal[:, BOX_LAYOUT.offset] = (centre - tokens.grid.centers(yx)) / tokens.grid.cell_size_m
    proposal[:, BOX_LAYOUT.velocity] = box.velocity[0].float() / SPEED_UNIT
    score = float(box.score[0])
    wanted = math.log(score / (1 - score)) if 0 < score < 1 else math.copysign(MAX_INSERTED_LOGIT, score - 0.5)
    heat = proposal[:, BOX_LAYOUT.heatmap_logit]
    proposal[:, BOX_LAYOUT.heatmap_logit] = heat + (wanted - heat.max())
    return add_tokens(message, torch.cat((features, proposal), 1), yx)


def add_tokens(message: Message, rows: Tensor, yx: Tensor) -> Message:
    """Return the message with token rows (n, C + PROPOSAL_DIM) on cells (n, 2), in place of those on the same cells."""
    tokens = message.tokens
    assert tokens is not None
    keys = yx[:, 0] * tokens.grid.shape[1] + yx[:, 1]
    kept = ~torch.isin(tokens.sites.key, keys)
    score = torch.ones(len(tokens.sites)) if message.token_score is None else message.token_score
    highest = float(score.max()) if len(score) else 0.0
    cells = torch.cat((tokens.sites.yx[kept], yx))
    order = (cells[:, 0] * tokens.grid.shape[1] + cells[:, 1]).argsort()
    features = torch.cat((tokens.features[kept], rows.to(tokens.features.dtype)))
    scores = torch.cat((score[kept], score.new_full((len(yx),), highest + 1.0)))
    return replace(message, tokens=SparseBev.from_cells(features, cells, tokens.grid), token_score=scores[order])


def remove_objects(message: Message, xy: Tensor, radius_m: float = OBJECT_RADIUS_M) -> Message:
    """Return the message without boxes, and without tokens that propose boxes, within a radius of places (M, 2)."""
    if message.objects is not None:
        message = keep_objects(message, ~_is_near(message.objects.center[:, :2].float(), xy, radius_m))
    if message.tokens is not None:
        message = keep_tokens(message, ~_is_near(proposed_xy(message.tokens), xy, radius_m))
    return message


def keep_objects(message: Message, mask: Tensor) -> Message:
    """Return the message with the boxes of a mask (N,), and their descriptors."""
    assert message.objects is not None
    descriptors = None if message.descriptors is None else message.descriptors[mask]
    return replace(message, objects=message.objects[mask], descriptors=descriptors)


def keep_tokens(message: Message, mask: Tensor) -> Message:
    """Return the message with the tokens of a mask (N,), and their scores."""
    assert message.tokens is not None
    score = None if message.token_score is None else message.token_score[mask]
    return replace(message, tokens=message.tokens.keep(mask), token_score=score)


def with_features(message: Message, features: Tensor) -> Message:
    """Return the message with other token rows on the same cells; proposals are those of the rows."""
    assert message.tokens is not None
    return replace(message, tokens=message.tokens.with_features(features))


def _add_box(message: Message, box: Boxes) -> Message:
    assert message.objects is not None
    objects = Boxes.cat([message.objects, box.to(message.objects.center.dtype)])
    descriptors = message.descriptors
    if descriptors is not None:
        descriptors = torch.cat((descriptors, descriptors.new_zeros(1, descriptors.shape[1])))
    return replace(message, objects=objects, descriptors=descriptors)


def _is_near(points: Tensor, xy: Tensor, radius_m: float) -> Tensor:
    """Return (N,) bool: which points (N, 2) lie within a radius of any of the places (M, 2)."""
    if not len(points) or not len(xy):
        return torch.zeros(len(points), dtype=torch.bool)
    return (torch.cdist(points.float(), xy.float()) < radius_m).any(1)


def _first_of_each(keys: Tensor) -> Tensor:
    """Return the rows of the first occurrence of each key (N,), ascending."""
    seen: set[int] = set()
    return torch.tensor(
        [row for row, key in enumerate(keys.tolist()) if not (key in seen or seen.add(key))], dtype=torch.int64
    )
