# SPDX-License-Identifier: Apache-2.0
"""One instant from above, in the ego's frame: points by agent, true boxes, detections, who stands where.

The ego looks to the right; its left is up. Points are moved by the poses that the agents claim, true boxes by the ego's
true pose, so a pose error shows as it is.
"""

from __future__ import annotations

import io
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from manyeyes._io import atomic_write
from manyeyes.datatypes import BevGrid, Boxes, PointCloud, Snapshot, Transform
from manyeyes.viz.canvas import Colour, Pen, View, splat

if TYPE_CHECKING:
    from PIL.Image import Image

PAPER: Colour = (255, 255, 255)
INK: Colour = (38, 50, 56)
FAINT: Colour = (144, 164, 174)
TRUE: Colour = (27, 158, 62)
UNSEEN: Colour = (129, 199, 132)
FOUND: Colour = (214, 39, 40)
AGENTS: tuple[Colour, ...] = (
    (69, 90, 100),
    (25, 118, 210),
    (245, 140, 0),
    (142, 36, 170),
    (0, 150, 136),
    (121, 85, 72),
)
GROUND_M = 0.3
GROUND_INK, POINT_INK, UNHEARD = 0.12, 0.9, 0.2
HEADER, FOOTER = 58, 44


@dataclass(frozen=True)
class SceneAgent:
    """One agent as the picture shows it; cloud and ego_from_agent are in the ego's frame.

    heard: whether the ego had anything of it; points that it never heard of are pale.
    """

    agent_id: int
    is_ego: bool
    is_infrastructure: bool
    ego_from_agent: Transform
    cloud: PointCloud
    heard: bool = True

    @property
    def name(self) -> str:
        """What the legend calls it."""
        return "ego" if self.is_ego else f"{'pole' if self.is_infrastructure else 'vehicle'} {self.agent_id}"


@dataclass(frozen=True)
class Scene:
    """What one picture shows, everything in the ego's frame. seen: (N,) bool for the N true boxes."""

    agents: tuple[SceneAgent, ...]
    truth: Boxes
    seen: Tensor
    detections: Boxes


def scene_of(snapshot: Snapshot, detections: Boxes, ego: int = 0, unheard: Collection[int] = ()) -> Scene:
    """A snapshot as the frame number ``ego`` of it saw it; detections are in that frame already.

    unheard: ids of agents of which the ego had nothing.
    """
    ego_from_world = snapshot.frames[ego].world_from_agent.inverse()
    agents = []
    for index, frame in enumerate(snapshot.frames):
        ego_from_agent = ego_from_world @ frame.world_from_agent
        cloud = frame.points.transform(ego_from_agent)
        heard = index == ego or frame.agent_id not in unheard
        agents.append(SceneAgent(frame.agent_id, index == ego, frame.is_infrastructure, ego_from_agent, cloud, heard))
    if snapshot.truth is None:
        return Scene(tuple(agents), Boxes.empty(), torch.zeros(0, dtype=torch.bool), detections)
    # Nobody is asked to find itself: its marker stands for the ego's own body.
    others = snapshot.truth.boxes.id != snapshot.frames[ego].agent_id
    true_boxes = snapshot.truth.boxes[others].transform(snapshot.truth.world_from_agent[ego].inverse())
    return Scene(tuple(agents), true_boxes, snapshot.truth.seen.any(0)[others], detections)


def view_of(grid: BevGrid, width: int = 1280, margin_m: float = 4.0) -> View:
    """The window that shows a grid's whole range, with room for a header and a footer."""
    return View(
        grid.x_min - margin_m,
        grid.y_min - margin_m,
        grid.x_max + margin_m,
        grid.y_max + margin_m,
        width,
        HEADER,
        FOOTER,
    )


def draw(
    scene: Scene, grid: BevGrid, title: str = "", caption: str = "", width: int = 1280, score_min: float = 0.0
) -> Image:
    """A picture of the scene; title and caption stand above it, detections below score_min are left out."""
    view = view_of(grid, width)
    layers = []
    for index, agent in enumerate(scene.agents):
        xyz = agent.cloud.xyz.numpy()
        ink = np.where(xyz[:, 2] > GROUND_M, POINT_INK, GROUND_INK)
        layers.append((xyz[:, :2], ink if agent.heard else ink * UNHEARD, _colour(index)))
    pen = Pen(splat(view, layers, PAPER))
    edges = np.array(
        [[grid.x_min, grid.y_min], [grid.x_max, grid.y_min], [grid.x_max, grid.y_max], [grid.x_min, grid.y_max]]
    )
    pen.dashed(view.pixels(edges), FAINT, 1.0)
    _true_boxes(pen, view, scene)
    _detections(pen, view, scene.detections[scene.detections.score >= score_min])
    for index, agent in enumerate(scene.agents):
        _agent(pen, view, agent, _colour(index))
    _frame(pen, view, scene, title, caption)
    return pen.finish()


def save_png(image: Image, path: Path) -> None:
    """The picture as a PNG file, whole or not at all."""
    atomic_write(path, png_bytes(image), durable=False)


def png_bytes(image: Image) -> bytes:
    """The picture as the bytes of a PNG file."""
    out = io.BytesIO()
    image.save(out, "PNG")
    return out.getvalue()


def _colour(index: int) -> Colour:
    return AGENTS[index % len(AGENTS)]


def _outlines(boxes: Boxes) -> np.ndarray:
    """Ground corners (N, 4, 2): front left, front right, rear right, rear left."""
    return boxes.corners()[:, :4, :2].double().numpy()


def _true_boxes(pen: Pen, view: View, scene: Scene) -> None:
    for corners, seen in zip(_outlines(scene.truth), scene.seen.tolist()):
        outline = view.pixels(corners)
        if seen:
            pen.line(outline, TRUE, 2.0, closed=True)
        else:
            pen.dashed(outline, UNSEEN, 1.0, dash=2.5)


def _detections(pen: Pen, view: View, boxes: Boxes) -> None:
    """Red outlines, a tick from the centre through the front, and the score beside the box."""
    for corners, score in zip(_outlines(boxes), boxes.score.tolist()):
        pen.line(view.pixels(corners), FOUND, 1.5, closed=True)
        front, centre = corners[:2].mean(0), corners.mean(0)
        pen.line(view.pixels(np.stack((centre, front + 0.35 * (front - centre)))), FOUND, 1.5)
        at = view.pixels(corners)
        pen.text((float(at[:, 0].max()) + 2, float(at[:, 1].min()) - 2), f"{100 * score:.0f}", FOUND, 9, "lb", True)


def _agent(pen: Pen, view: View, agent: SceneAgent, colour: Colour) -> None:
    """A vehicle is an arrowhead along its heading, a roadside unit a diamond."""
    centre = view.pixels(agent.ego_from_agent.translation[:2].double().numpy())
    yaw = float(agent.ego_from_agent.yaw)
    angles, radius = ((0.0, 0.5, 1.0, 1.5), 8.0) if agent.is_infrastructure else ((0.0, 0.78, 1.0, 1.22), 11.0)
    reach = np.array([1.0, 1.0, 1.0, 1.0] if agent.is_infrastructure else [1.0, 0.85, 0.35, 0.85]) * radius
    turn = yaw + np.pi * np.asarray(angles)
    shape = centre + np.stack((np.cos(turn), -np.sin(turn)), -1) * reach[:, None]
    pen.polygon(shape, colour, PAPER, 1.5)
    pen.text((float(centre[0]), float(centre[1]) + 13), agent.name, colour, 12, "ma", True)


def _frame(pen: Pen, view: View, scene: Scene, title: str, caption: str) -> None:
    """Title, caption and scale bar above, legend below; what reached out of the window is covered."""
    width, height = view.size
    for top, bottom in ((0, HEADER), (height - FOOTER, height)):
        pen.polygon(np.array([[0, top], [width, top], [width, bottom], [0, bottom]]), PAPER)
    pen.text((16, 10), title, INK, 18)
    pen.text((16, 35), caption, (84, 110, 122), 13)
    y = height - FOOTER / 2
    x = 16.0
    kinds = (
        (TRUE, "true, seen", bool(scene.seen.any())),
        (UNSEEN, "true, met by no agent", not bool(scene.seen.all())),
        (FOUND, "detection, score in %", len(scene.detections) > 0),
    )
    for colour, text in ((colour, text) for colour, text, present in kinds if present):
        pen.polygon(np.array([[x, y - 5], [x + 18, y - 5], [x + 18, y + 5], [x, y + 5]]), None, colour, 1.8)
        pen.text((x + 25, y), text, INK, 12, "lm")
        x += 25 + pen.width(text, 12) + 20
    for index, agent in enumerate(scene.agents):
        pen.disc(np.array([x + 5, y]), 5, _colour(index), PAPER, 1)
        pen.text((x + 15, y), agent.name, INK, 12, "lm")
        x += 15 + pen.width(agent.name, 12) + 18
    metres = 10 if view.x_max - view.x_min < 120 else 20
    end = width - 16.0
    start, y = end - metres * view.scale, 22.0
    pen.line(np.array([[start, y - 4], [start, y + 4], [start, y], [end, y], [end, y - 4], [end, y + 4]]), INK, 1.5)
    pen.text((start - 8, y), f"{metres} m", INK, 12, "rm")
