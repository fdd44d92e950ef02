# SPDX-License-Identifier: Apache-2.0
"""One instant from above, in the ego's frame: points by agent, true boxes, detections, who stands where.

The ego's forward direction is right; its left is up. Points are moved by the poses that the agents claim, true boxes by the ego's
true pose, so a pose error shows as it is.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from manyeyes._io import atomic_write
from manyeyes.datatypes import BevGrid, Boxes, PointCloud, Snapshot, Transform
from manyeyes.viz.canvas import Colour, Pen, Viewport, draw_points

if TYPE_CHECKING:
    from PIL.Image import Image

BACKGROUND: Colour = (255, 255, 255)
INK: Colour = (38, 50, 56)
FAINT: Colour = (144, 164, 174)
TRUE: Colour = (27, 158, 62)
UNSEEN: Colour = (129, 199, 132)
FOUND: Colour = (214, 39, 40)
AGENT_COLOURS: tuple[Colour, ...] = (
    (69, 90, 100),
    (25, 118, 210),
    (245, 140, 0),
    (142, 36, 170),
    (0, 150, 136),
    (121, 85, 72),
)
MAX_GROUND_HEIGHT_M = 0.3
GROUND_INK, POINT_INK, MISSING_INK_FACTOR = 0.12, 0.9, 0.2
HEADER_HEIGHT, FOOTER_HEIGHT = 58, 44
MARGIN, LEGEND_GAP, LEGEND_LINE_HEIGHT = 16.0, 19.0, 18.0
LEGEND_SIZES = (12, 10, 8)
"""Sizes of the legend's letters, pixels: the first with which it takes at most two lines, else the last."""


@dataclass(frozen=True)
class SceneAgent:
    """One agent as the picture shows it; cloud and ego_from_agent are in the ego's frame.

    has_message: whether the ego received a message of it; points of other agents are pale.
    """

    agent_id: int
    is_ego: bool
    is_infrastructure: bool
    ego_from_agent: Transform
    cloud: PointCloud
    has_message: bool = True

    @property
    def name(self) -> str:
        """What the legend calls it."""
        return "ego" if self.is_ego else f"{'pole' if self.is_infrastructure else 'vehicle'} {self.agent_id}"


@dataclass(frozen=True)
class BirdsEyeScene:
    """What one picture shows, everything in the ego's frame. seen: (N,) bool for the N true boxes."""

    agents: tuple[SceneAgent, ...]
    truth: Boxes
    seen: Tensor
    detections: Boxes


def make_scene(snapshot: Snapshot, detections: Boxes, ego: int = 0, missing_ids: Collection[int] = ()) -> BirdsEyeScene:
    """Return a snapshot as the frame number ``ego`` of it saw it; detections are in that frame already.

    missing_ids: ids of agents of which the ego had nothing.
    """
    ego_from_world = snapshot.frames[ego].world_from_agent.inverse()
    agents = []
    for index, frame in enumerate(snapshot.frames):
        ego_from_agent = ego_from_world @ frame.world_from_agent
        cloud = frame.points.transform(ego_from_agent)
        has_message = index == ego or frame.agent_id not in missing_ids
        agents.append(
            SceneAgent(frame.agent_id, index == ego, frame.is_infrastructure, ego_from_agent, cloud, has_message)
        )
    if snapshot.truth is None:
        return BirdsEyeScene(tuple(agents), Boxes.empty(), torch.zeros(0, dtype=torch.bool), detections)
    # The ego's own box is not evaluated: its marker stands for it.
    truth = snapshot.truth.of_classes()
    others = truth.boxes.id != snapshot.frames[ego].agent_id
    true_boxes = truth.boxes[others].transform(truth.world_from_agent[ego].inverse())
    return BirdsEyeScene(tuple(agents), true_boxes, truth.seen.any(0)[others], detections)


def make_viewport(grid: BevGrid, width: int = 1280, margin_m: float = 4.0) -> Viewport:
    """Return the window that shows a grid's whole range, with room for a header and a footer."""
    return Viewport(
        grid.x_min - margin_m,
        grid.y_min - margin_m,
        grid.x_max + margin_m,
        grid.y_max + margin_m,
        width,
        HEADER_HEIGHT,
        FOOTER_HEIGHT,
    )


def draw_scene(
    scene: BirdsEyeScene, grid: BevGrid, title: str = "", caption: str = "", width: int = 1280, min_score: float = 0.0
) -> Image:
    """Return a picture of the scene; title and caption stand above it, detections below min_score are left out."""
    viewport = make_viewport(grid, width)
    layers = []
    for index, agent in enumerate(scene.agents):
        xyz = agent.cloud.xyz.numpy()
        ink = np.where(xyz[:, 2] > MAX_GROUND_HEIGHT_M, POINT_INK, GROUND_INK)
        layers.append((xyz[:, :2], ink if agent.has_message else ink * MISSING_INK_FACTOR, _agent_colour(index)))
    pen = Pen(draw_points(viewport, layers, BACKGROUND))
    edges = np.array(
        [[grid.x_min, grid.y_min], [grid.x_max, grid.y_min], [grid.x_max, grid.y_max], [grid.x_min, grid.y_max]]
    )
    pen.dashed(viewport.to_pixels(edges), FAINT, 1.0)
    _draw_true_boxes(pen, viewport, scene)
    _draw_detections(pen, viewport, scene.detections[scene.detections.score >= min_score])
    for index, agent in enumerate(scene.agents):
        _draw_agent(pen, viewport, agent, _agent_colour(index))
    _draw_frame(pen, viewport, scene, title, caption)
    return pen.finish()


def save_png(image: Image, path: Path) -> None:
    """The picture as a PNG file, whole or not at all."""
    atomic_write(path, encode_png(image), durable=False)


def encode_png(image: Image) -> bytes:
    """Return the picture as the bytes of a PNG file."""
    out = io.BytesIO()
    image.save(out, "PNG")
    return out.getvalue()


def _agent_colour(index: int) -> Colour:
    return AGENT_COLOURS[index % len(AGENT_COLOURS)]


def _outlines(boxes: Boxes) -> np.ndarray:
    """Return ground corners (N, 4, 2): front left, front right, rear right, rear left."""
    return boxes.corners()[:, :4, :2].double().numpy()


def _draw_true_boxes(pen: Pen, viewport: Viewport, scene: BirdsEyeScene) -> None:
    for corners, seen in zip(_outlines(scene.truth), scene.seen.tolist()):
        outline = viewport.to_pixels(corners)
        if seen:
            pen.line(outline, TRUE, 2.0, closed=True)
        else:
            pen.dashed(outline, UNSEEN, 1.0, dash=2.5)


def _draw_detections(pen: Pen, viewport: Viewport, boxes: Boxes) -> None:
    """Red outlines, a tick from the centre through the front, and the score beside the box."""
    for corners, score in zip(_outlines(boxes), boxes.score.tolist()):
        pen.line(viewport.to_pixels(corners), FOUND, 1.5, closed=True)
        front, centre = corners[:2].mean(0), corners.mean(0)
        pen.line(viewport.to_pixels(np.stack((centre, front + 0.35 * (front - centre)))), FOUND, 1.5)
        at = viewport.to_pixels(corners)
        pen.text((float(at[:, 0].max()) + 2, float(at[:, 1].min()) - 2), f"{100 * score:.0f}", FOUND, 9, "lb", True)


def _draw_agent(pen: Pen, viewport: Viewport, agent: SceneAgent, colour: Colour) -> None:
    """A vehicle is an arrowhead along its heading, a roadside unit a diamond."""
    centre = viewport.to_pixels(agent.ego_from_agent.translation[:2].double().numpy())
    yaw = float(agent.ego_from_agent.yaw)
    angles, radius = ((0.0, 0.5, 1.0, 1.5), 8.0) if agent.is_infrastructure else ((0.0, 0.78, 1.0, 1.22), 11.0)
    reach = np.array([1.0, 1.0, 1.0, 1.0] if agent.is_infrastructure else [1.0, 0.85, 0.35, 0.85]) * radius
    turn = yaw + np.pi * np.asarray(angles)
    shape = centre + np.stack((np.cos(turn), -np.sin(turn)), -1) * reach[:, None]
    pen.polygon(shape, colour, BACKGROUND, 1.5)
    is_at_bottom = centre[1] + 27 > viewport.size[1] - viewport.bottom_margin
    pen.text(
        (float(centre[0]), float(centre[1]) + (-13 if is_at_bottom else 13)),
        agent.name,
        colour,
        12,
        "md" if is_at_bottom else "ma",
        True,
    )


def _draw_frame(pen: Pen, viewport: Viewport, scene: BirdsEyeScene, title: str, caption: str) -> None:
    """Title, caption and scale bar above, legend below; what reached out of the window is covered."""
    width, height = viewport.size
    for top, bottom in ((0, HEADER_HEIGHT), (height - FOOTER_HEIGHT, height)):
        pen.polygon(np.array([[0, top], [width, top], [width, bottom], [0, bottom]]), BACKGROUND)
    pen.text((MARGIN, 10), title, INK, 18)
    pen.text((MARGIN, 35), caption, (84, 110, 122), 13)
    _draw_legend(pen, viewport, scene)
    metres = 10 if viewport.x_max - viewport.x_min < 120 else 20
    end = width - MARGIN
    start, y = end - metres * viewport.scale, 22.0
    pen.line(np.array([[start, y - 4], [start, y + 4], [start, y], [end, y], [end, y - 4], [end, y + 4]]), INK, 1.5)
    pen.text((start - 8, y), f"{metres} m", INK, 12, "rm")


def _draw_legend(pen: Pen, viewport: Viewport, scene: BirdsEyeScene) -> None:
    """Kinds of boxes, then agents, in the footer; entries that do not fit into a line begin the next one."""
    width, height = viewport.size
    kinds = (
        (TRUE, "true, seen", bool(scene.seen.any())),
        (UNSEEN, "true, met by no agent", not bool(scene.seen.all())),
        (FOUND, "detection, score in %", len(scene.detections) > 0),
    )
    entries = [(text, colour, True) for colour, text, present in kinds if present]
    entries += [(agent.name, _agent_colour(index), False) for index, agent in enumerate(scene.agents)]
    layouts = [
        (
            size,
            place_legend(
                [(25 if is_box else 15) + pen.width(text, size) for text, _, is_box in entries], width - 2 * MARGIN
            ),
        )
        for size in LEGEND_SIZES
    ]
    size, places = next((layout for layout in layouts if max(layout[1])[0] <= 1), layouts[-1])
    num_lines = 1 + max(places)[0]
    for (text, colour, is_box), (line, left) in zip(entries, places):
        x, y = MARGIN + left, height - FOOTER_HEIGHT / 2 + LEGEND_LINE_HEIGHT * (line - (num_lines - 1) / 2)
        if is_box:
            pen.polygon(np.array([[x, y - 5], [x + 18, y - 5], [x + 18, y + 5], [x, y + 5]]), None, colour, 1.8)
        else:
            pen.disc(np.array([x + 5, y]), 5, colour, BACKGROUND, 1)
        pen.text((x + (25 if is_box else 15), y), text, INK, size, "lm")


def place_legend(lengths: Sequence[float], width: float) -> list[tuple[int, float]]:
    """Place entries of the given lengths in lines of a width: the line and the left end of each, pixels."""
    places, line, left = list[tuple[int, float]](), 0, 0.0
    for length in lengths:
        if left and left + length > width:
            line, left = line + 1, 0.0
        places.append((line, left))
        left += length + LEGEND_GAP
    return places
