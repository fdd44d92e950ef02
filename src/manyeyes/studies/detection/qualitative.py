# SPDX-License-Identifier: Apache-2.0
"""One frame under errors, methods side by side: CoSTr, Fig. 4, at 0.1 s, 0.2 degrees, 0.2 m.

The frame is the middle one of the first scenario that has the maximum number of agents; it is not selected by results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from manyeyes.agents.replay import ReplayStep, replay
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.evaluation.detection.accumulator import MetricAccumulator
from manyeyes.evaluation.detection.benchmark import load_detector, resolve_protocol
from manyeyes.evaluation.detection.protocols import DetectionProtocol
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.models.score_calibration import default_drawing_score
from manyeyes.studies.detection.perturbations import COMBINED
from manyeyes.studies.engine.replay_study import prepare_study
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import EvaluationOptions
from manyeyes.studies.replay_options import make_excerpt
from manyeyes.viz.birds_eye import draw_scene, make_scene, save_png
from manyeyes.viz.canvas import import_pillow
from manyeyes.viz.study_table import StudyTable, format_number

if TYPE_CHECKING:
    from PIL.Image import Image

WIDTH, COLUMNS = 960, 2


@dataclass(frozen=True)
class QualitativeRow:
    """A method in the frame: true boxes, those found at IoU 0.5 and 0.7, and what was neither, of drawn scores."""

    method: str
    num_true: int
    num_found: tuple[int, int]
    num_false: tuple[int, int]
    bytes_per_message: float


def run(options: EvaluationOptions, context: StudyContext) -> None:
    """Run the qualitative study and write its image."""
    study = prepare_study(options, context)
    config, recording = COMBINED.apply_to(study.base, study.pose_noise), study.opener()
    scenario = max(recording.scenarios, key=lambda name: len(recording.agents(name)))
    eval_indices = recording.eval_indices(scenario)
    frame_index = eval_indices[len(eval_indices) // 2]
    drive = make_excerpt(recording, scenario, eval_indices.index(frame_index) + 1)
    detector, protocol = load_detector(config.weights), resolve_protocol(config)
    steps = [
        step
        for step in replay(
            drive,
            scenario,
            detector,
            config.methods,
            config.replay,
            config.make_perturbation(),
            feature_cache={},
        )
        if step.snapshot.index == frame_index
    ]
    result_rows = [_make_row(step, protocol, _find_min_score(detector, step.method)) for step in steps]
    images = [_draw_image(step, row, detector) for step, row in zip(steps, result_rows)]
    results_table = _make_results_table(f"{scenario}, frame {frame_index}, {COMBINED.name}", result_rows)
    payload: dict[str, object] = {"scenario": scenario, "frame": frame_index, "rows": result_rows}
    save_picture = partial(save_png, _tile_images(images))
    study.context.write_report(study.title, payload, [results_table], save_picture, config={"conditions": [config]})


def _find_min_score(detector: BoxDetector, method: str) -> float:
    return default_drawing_score(detector, get_strategy(method).score_form)


def _make_row(step: ReplayStep, protocol: DetectionProtocol, min_score: float) -> QualitativeRow:
    accumulator = MetricAccumulator(step.method, protocol)
    accumulator.add(step)
    half, seven = (matches[0] for matches in accumulator.match_frames())
    confident = half.score >= min_score
    num_found = (int((half.tp & confident).sum()), int((seven.tp & confident).sum()))
    sent = accumulator.summarize_communication()
    size = sent.bytes_per_message if sent.num_messages else 0.0
    return QualitativeRow(
        step.method,
        half.n_gt,
        num_found,
        (int(confident.sum()) - num_found[0], int(confident.sum()) - num_found[1]),
        size,
    )


def _draw_image(step: ReplayStep, row: QualitativeRow, detector: BoxDetector) -> Image:
    received_ids = {reception.message.agent_id for reception in step.perception.received}
    missing_ids = {frame.agent_id for frame in step.snapshot.frames} - received_ids
    view = make_scene(step.snapshot, step.boxes, step.ego, missing_ids)
    sent = f" · {row.bytes_per_message / 1e3:,.1f} kB a message" if row.bytes_per_message else ""
    caption = (
        f"{COMBINED.name} · {row.num_found[0]} of {row.num_true} found at IoU 0.5, {row.num_found[1]} at 0.7{sent}"
    )
    min_score = _find_min_score(detector, step.method)
    return draw_scene(view, detector.detection_range, step.method, caption, WIDTH, min_score)


def _tile_images(images: Sequence[Image]) -> Image:
    """Pictures of one size, two to a row."""
    wide, high = images[0].size
    columns = min(COLUMNS, len(images))
    out = import_pillow().Image.new("RGB", (columns * wide, -(-len(images) // columns) * high), "white")
    for index, image in enumerate(images):
        out.paste(image, (index % columns * wide, index // columns * high))
    return out


def _make_results_table(title: str, result_rows: Sequence[QualitativeRow]) -> StudyTable:
    headings = ("method", "true", "found @0.5", "false @0.5", "found @0.7", "false @0.7", "bytes/message")
    lines = tuple(
        (
            row.method,
            str(row.num_true),
            str(row.num_found[0]),
            str(row.num_false[0]),
            str(row.num_found[1]),
            str(row.num_false[1]),
            format_number(row.bytes_per_message),
        )
        for row in result_rows
    )
    return StudyTable(title, headings, lines)
