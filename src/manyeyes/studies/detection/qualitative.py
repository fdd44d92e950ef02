# SPDX-License-Identifier: Apache-2.0
"""One frame under errors, methods side by side: CoSTr, Fig. 4, at 0.1 s, 0.2 degrees, 0.2 m.

The frame is the middle one of the first scenario that has the most agents: none is chosen for its looks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from manyeyes.agents.replay import Step, replay
from manyeyes.datatypes import BevGrid
from manyeyes.evaluation.detection.accumulator import Tally
from manyeyes.evaluation.detection.average_precision import Protocol
from manyeyes.evaluation.detection.benchmark import judging_protocol
from manyeyes.evaluation.study import Condition
from manyeyes.models import pretrained
from manyeyes.studies.detection.perturbations import JOINT
from manyeyes.studies.replay_options import excerpt
from manyeyes.studies.running import publish, start
from manyeyes.viz.birds_eye import draw, save_png, scene_of
from manyeyes.viz.canvas import pillow
from manyeyes.viz.study_table import Sheet, number

if TYPE_CHECKING:
    from PIL.Image import Image
    from rich.console import Console

    from manyeyes.studies.options import Options

WIDTH, COLUMNS, SCORE_MIN = 960, 2, 0.4


@dataclass(frozen=True)
class Row:
    """A method in the frame: true boxes, those found at IoU 0.5 and 0.7, and what was neither, with scores from SCORE_MIN."""

    method: str
    true: int
    found: tuple[int, int]
    false: tuple[int, int]
    bytes_per_message: float


def run(options: Options, console: Console) -> None:
    """The study."""
    begun = start(options, console)
    config, recording = JOINT.on(begun.base), begun.opener()
    scenario = max(recording.scenarios, key=lambda name: len(recording.agents(name)))
    judged = recording.judged(scenario)
    instant = judged[len(judged) // 2]
    drive = excerpt(recording, scenario, judged.index(instant) + 1)
    detector, protocol = pretrained.load(config.weights), judging_protocol(config)
    steps = [
        step
        for step in replay(
            drive,
            scenario,
            detector,
            config.methods,
            config.replay,
            lambda snapshot: config.noise.apply(snapshot, 0) if config.noise else snapshot,
            known={},
        )
        if step.snapshot.index == instant
    ]
    table = [_row(step, protocol) for step in steps]
    images = [_image(step, row, detector.config.range) for step, row in zip(steps, table)]
    save_png(_tiled(images), options.out / "picture.png")
    sheet = _sheet(f"{scenario}, frame {instant}, {JOINT.name}", table)
    condition = Condition(JOINT.name, config)
    payload: dict[str, object] = {"scenario": scenario, "frame": instant, "rows": table}
    publish(begun, payload, [sheet], [], [condition])


def _row(step: Step, protocol: Protocol) -> Row:
    tally = Tally(step.method, protocol)
    tally.add(step)
    half, seven = (matches[0] for matches in tally.matches())
    sure = half.score >= SCORE_MIN
    found = (int((half.tp & sure).sum()), int((seven.tp & sure).sum()))
    sent = tally.communication()
    size = sent.bytes_per_message if sent.messages else 0.0
    return Row(step.method, half.n_gt, found, (int(sure.sum()) - found[0], int(sure.sum()) - found[1]), size)


def _image(step: Step, row: Row, grid: BevGrid) -> Image:
    heard = {reception.message.agent_id for reception in step.perception.heard}
    unheard = {frame.agent_id for frame in step.snapshot.frames} - heard
    scene = scene_of(step.snapshot, step.boxes, step.ego, unheard)
    sent = f" · {row.bytes_per_message / 1e3:,.1f} kB a message" if row.bytes_per_message else ""
    caption = f"{JOINT.name} · {row.found[0]} of {row.true} found at IoU 0.5, {row.found[1]} at 0.7{sent}"
    return draw(scene, grid, step.method, caption, WIDTH, SCORE_MIN)


def _tiled(images: Sequence[Image]) -> Image:
    """Pictures of one size, two to a row."""
    wide, high = images[0].size
    columns = min(COLUMNS, len(images))
    out = pillow().Image.new("RGB", (columns * wide, -(-len(images) // columns) * high), "white")
    for place, image in enumerate(images):
        out.paste(image, (place % columns * wide, place // columns * high))
    return out


def _sheet(title: str, table: Sequence[Row]) -> Sheet:
    headings = ("method", "true", "found @0.5", "false @0.5", "found @0.7", "false @0.7", "bytes/message")
    lines = tuple(
        (
            row.method,
            str(row.true),
            str(row.found[0]),
            str(row.false[0]),
            str(row.found[1]),
            str(row.false[1]),
            number(row.bytes_per_message),
        )
        for row in table
    )
    return Sheet(title, headings, lines)
