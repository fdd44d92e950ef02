# SPDX-License-Identifier: Apache-2.0
"""Golden cases of detection protocols, made by hand: boxes, expected results, and their drawings.

A case has panels, each under one protocol. ``test_protocol_cases`` asserts what a panel states, and
scripts/draw_protocol_cases.py draws it, so that the drawing and the test are of the same boxes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from manyeyes.datatypes import Boxes
from manyeyes.evaluation.detection.average_precision import FrameResult
from manyeyes.evaluation.detection.protocols import PROTOCOLS, DetectionProtocol

SIZE = (4.0, 2.0, 1.5)
Row = tuple[float, float, float, float]
"""x, y, height of the centre, score."""


@dataclass(frozen=True)
class Panel:
    """One protocol on some frames. kept: detections that count, frame by frame; hits: those that match, by falling score; ap: at
    the IoU threshold.
    """

    title: str
    protocol: DetectionProtocol
    kept: tuple[int, ...]
    hits: tuple[tuple[bool, ...], ...]
    ap: float
    iou: float = 0.5


@dataclass(frozen=True)
class ProtocolCase:
    """A drawing. found, truth: rows of each frame; axes: the plane of the drawing, "xy" or "xz"; view: its limits."""

    name: str
    found: tuple[tuple[Row, ...], ...]
    truth: tuple[tuple[Row, ...], ...]
    panels: tuple[Panel, ...]
    view: tuple[float, float, float, float]
    axes: str = "xy"

    def frames(self) -> list[FrameResult]:
        """Return the frames of the case."""
        return [
            FrameResult("case", k, make_boxes(found), make_boxes(truth))
            for k, (found, truth) in enumerate(zip(self.found, self.truth, strict=True))
        ]


def make_boxes(rows: tuple[Row, ...]) -> Boxes:
    """Return boxes of SIZE along x."""
    t = torch.tensor(rows, dtype=torch.float64).reshape(-1, 4)
    size = torch.tensor(SIZE, dtype=torch.float64).expand(len(t), 3)
    return Boxes.of(t[:, :3], size, torch.zeros(len(t), dtype=torch.float64), t[:, 3])


_DAIR = replace(PROTOCOLS["dair"], drop_first_segment=False)
_CENTER = replace(_DAIR, gt_range_mode="center", pred_range_mode="center")
_ALL = replace(_DAIR, gt_range_mode="corners", pred_range_mode="corners")
_OURS = replace(PROTOCOLS["global-sort"], nms_iou=1.0)

_EDGE: tuple[Row, ...] = (
    (90.0, 36.0, 0.75, 0.9),
    (99.0, 30.0, 0.75, 0.8),
    (101.5, 25.0, 0.75, 0.7),
    (103.0, 20.0, 0.75, 0.6),
)
ANY_CORNER = ProtocolCase(
    "protocol_any_corner",
    (_EDGE,),
    (_EDGE,),
    (
        Panel("dair: any corner in the range", _DAIR, (3,), ((True, True, True),), 1.0),
        Panel("by the centre", _CENTER, (2,), ((True, True),), 1.0),
        Panel("by all corners", _ALL, (1,), ((True,),), 1.0),
    ),
    (84, 108, 14, 42),
)  # fmt: skip
TIES = ProtocolCase(
    "protocol_ties",
    (((14.0, 0, 0.75, 0.5), (2.0, 0, 0.75, 0.5)), ((2.0, 0, 0.75, 0.5), (14.0, 0, 0.75, 0.5))),
    (((2.0, 0, 0.75, 1.0),), ((2.0, 0, 0.75, 1.0),)),
    (
        Panel("global-sort: one step of the curve", _OURS, (2, 2), ((True, False), (True, False)), 1 / 2),
        Panel("OpenCOOD: order of numpy's argsort", replace(_OURS, ties="numpy"), (2, 2), ((False, True), (True, False)), 2 / 3),
        Panel(
            "dair: hits of a frame first", replace(_OURS, ties="hits_first", matching="truth_first"),
            (2, 2), ((False, True), (True, False)), 5 / 6,
        ),
    ),
    (-2, 18, -3, 3),
)  # fmt: skip
VOLUME = ProtocolCase(
    "protocol_3d",
    (((2.0, 0, 0.75, 0.9), (12.0, 0, 1.5, 0.8), (22.5, 0, 1.05, 0.7)),),
    (((2.0, 0, 0.75, 1.0), (12.0, 0, 0.75, 1.0), (22.0, 0, 0.75, 1.0)),),
    (
        Panel("dair: IoU on the ground 1, 1, 0.78", _DAIR, (3,), ((True, True, True),), 1.0),
        Panel("dair-3d: IoU in space 1, 0.33, 0.54", replace(_DAIR, iou_kind="3d"), (3,), ((True, False, True),), (1 + 2 / 3) / 3),
    ),
    (-1, 26, -2.5, 4),
    "xz",
)  # fmt: skip
ALL_CASES = (ANY_CORNER, TIES, VOLUME)


def draw_cases(case: ProtocolCase, path: Path) -> None:
    """Draw a case: true boxes green, detections that count red, those that do not grey and dashed; needs matplotlib."""
    from matplotlib.figure import Figure

    from manyeyes.evaluation.detection.average_precision import average_precision, compute_frame_iou, filter_detections

    rows, columns = len(case.found), len(case.panels)
    height = 4.2 * (case.view[3] - case.view[2]) / (case.view[1] - case.view[0])
    figure = Figure(figsize=(4.2 * columns, 0.5 + min(height, 3.4) * rows + 0.5 * rows))
    for column, panel in enumerate(case.panels):
        frames = case.frames()
        ap = average_precision(frames, panel.iou, panel.protocol)
        for row, frame in enumerate(frames):
            axes: Any = figure.add_subplot(rows, columns, 1 + row * columns + column)
            kept = {tuple(c) for c in filter_detections(frame.detections, panel.protocol).center.tolist()}
            _draw_boxes(axes, case, frame.truth, "#2a8f2a", "-")
            for k in range(len(frame.detections)):
                counts = tuple(frame.detections.center[k].tolist()) in kept
                color, style = ("#c62828", "-") if counts else ("#888888", "--")
                _draw_boxes(axes, case, frame.detections[k : k + 1], color, style, f"row {k}: ")
            _draw_range(axes, case, panel.protocol)
            axes.set(xlim=case.view[:2], ylim=case.view[2:], aspect="equal")
            axes.set_xlabel(f"{case.axes[0]} [m]", fontsize=7)
            axes.set_ylabel(f"{case.axes[1]} [m]", fontsize=7)
            axes.tick_params(labelsize=7)
            hits = ap.frames[row].tp.tolist()
            title = f"{panel.title}\nAP@{panel.iou:g} {ap.ap:.3f}" if row == 0 else ""
            axes.set_title(title, fontsize=8)
            num_hits, num_truth = sum(hits), compute_frame_iou(frame, panel.protocol).iou.shape[1]
            text = f"{len(hits)} count, {num_hits} match, {num_truth} true"
            axes.text(0.02, 0.03, text, transform=axes.transAxes, fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _draw_boxes(axes: Any, case: ProtocolCase, boxes: Boxes, color: str, style: str, label: str | None = None) -> None:
    """Draw boxes; with a label the score of each is written behind it, without one they are filled."""
    from matplotlib.patches import Rectangle

    second = 1 if case.axes == "xy" else 2
    for center, size, score in zip(boxes.center.tolist(), boxes.size.tolist(), boxes.score.tolist()):
        corner = (center[0] - size[0] / 2, center[second] - size[second] / 2)
        face = {"facecolor": "#cdeccd"} if label is None else {"fill": False}
        axes.add_patch(
            Rectangle(corner, size[0], size[second], edgecolor=color, linestyle=style, linewidth=1.4, **face)
        )
        if label is not None:
            axes.text(corner[0] + 0.15, center[second] - 0.2, f"{label}{score:g}", fontsize=6, color=color)


def _draw_range(axes: Any, case: ProtocolCase, protocol: DetectionProtocol) -> None:
    """Draw the border of the range as a dotted line."""
    x0, y0, z0, x1, y1, z1 = protocol.gt_range
    low, high = (y0, y1) if case.axes == "xy" else (z0 + protocol.z_origin_m, z1 + protocol.z_origin_m)
    axes.plot([x0, x1, x1, x0, x0], [low, low, high, high, low], ":", color="#1f4e9c", linewidth=1)
