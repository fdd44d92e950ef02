# SPDX-License-Identifier: Apache-2.0
"""Plays one drive with every method and shows it: table, pictures of one instant, animation, report, JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from manyeyes._io import atomic_write_text
from manyeyes.agents.replay import ReplayConfig, ReplayStep, replay
from manyeyes.agents.strategies.names import TEMPORAL
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.evaluation.detection.accumulator import MetricAccumulator
from manyeyes.evaluation.detection.benchmark import find_thresholds, make_own_protocol
from manyeyes.evaluation.detection.protocols import DetectionProtocol
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.models.score_calibration import default_drawing_score
from manyeyes.studies import provenance
from manyeyes.studies.replay_options import Excerpt
from manyeyes.viz.animation import save_animation, stack_images
from manyeyes.viz.birds_eye import draw_scene, make_scene, save_png
from manyeyes.viz.help_chapter import make_help_chapter
from manyeyes.viz.pose_summary import HEADINGS, PoseCorrectionSummary
from manyeyes.viz.progress import make_progress_bars
from manyeyes.viz.reliability import make_reliability_chapter
from manyeyes.viz.report import Chapter, HtmlReport, ReportImage, save_report
from manyeyes.viz.results import MethodComparison, print_comparison, summarize_comparison
from manyeyes.viz.scene_recorder import SceneRecorder
from manyeyes.viz.table import format_markdown

if TYPE_CHECKING:
    from PIL.Image import Image

REPORT = "report.html"
WIDTH, FILM_WIDTH, FILM_FRAME_MS, MAX_FILM_IMAGES = 1280, 800, 200, 13
TITLES = {
    "no-fusion": "No fusion",
    "no-fusion-temporal": "No fusion, with the last two frames",
    "late": "Late fusion: boxes are shared",
    "late-temporal": "Late fusion: boxes are shared, with the last two frames",
    "late-weighted": "Late fusion: boxes are shared and averaged",
    "intermediate": "Intermediate fusion: tokens are shared",
    "intermediate-temporal": "Intermediate fusion: tokens are shared, with the last two frames",
    "early": "Early fusion: all points are shared",
    "early-temporal": "Early fusion: all points are shared, with the last two frames",
}


@dataclass(frozen=True)
class ReportSpec:
    """What is shown and where it goes.

    min_score: of drawn boxes; None: that of the weights. frame: index of the pictured instant, None: the middle one. missing: files
    of the drive.
    """

    out: Path
    title: str
    lead: str
    methods: tuple[str, ...]
    replay: ReplayConfig
    weights: str
    min_score: float | None = None
    frame: int | None = None
    animate: bool = True
    facts: tuple[tuple[str, str], ...] = ()
    commands: tuple[str, ...] = ()
    missing: MissingFiles = NONE_MISSING


@dataclass
class _Film:
    """Pictures of the drive, the methods that matter most above each other."""

    methods: tuple[str, ...]
    pending: dict[str, Image] = field(default_factory=dict)
    images: list[Image] = field(default_factory=list)

    def add(self, method: str, image: Image) -> None:
        """One method's picture; the last method's completes an instant."""
        self.pending[method] = image
        if len(self.pending) == len(self.methods):
            self.images.append(stack_images([self.pending[name] for name in self.methods]))
            self.pending = {}


def replay_and_report(drive: Excerpt, detector: BoxDetector, spec: ReportSpec, console: Console) -> HtmlReport:
    """Play the drive and write everything under showing.out; the report as it was saved, to which chapters can be added."""
    eval_indices = drive.eval_indices(drive.scenario)
    pictured_index = _find_pictured_index(eval_indices, drive.scenario, spec.frame)
    grid, protocol = detector.detection_range, make_own_protocol(detector)
    min_scores = {name: find_min_score(detector, name, spec.min_score) for name in spec.methods}
    metrics = {name: MetricAccumulator(name, protocol) for name in spec.methods}
    film = _Film(_select_animated(spec.methods) if spec.animate else ())
    filmed = eval_indices[:: -(-len(eval_indices) // MAX_FILM_IMAGES)]
    recorder = SceneRecorder(protocol, spec.methods, TITLES, min_scores, eval_indices)
    pictured_steps: list[ReplayStep] = []
    pose_summaries = {name: PoseCorrectionSummary() for name in spec.methods}
    with make_progress_bars(console) as progress:
        task = progress.add_task("Playing", total=len(eval_indices) * len(spec.methods))
        for step in replay(drive, drive.scenario, detector, spec.methods, spec.replay):
            metrics[step.method].add(step)
            recorder.add(step)
            pose_summaries[step.method].add(step.snapshot.index, step.perception.corrections)
            if step.snapshot.index == pictured_index:
                pictured_steps.append(step)
            if step.method in film.methods and step.snapshot.index in filmed:
                film.add(step.method, _draw_step(step, grid, _make_caption(step), min_scores[step.method], FILM_WIDTH))
            progress.advance(task)
    results = [r for name, tally in metrics.items() for r in tally.compute_results(find_thresholds(detector, name))]
    comparison = summarize_comparison(results, protocol, spec.missing)
    print_comparison(console, comparison, spec.title)
    pose_chapters = _make_pose_chapters(pose_summaries)
    reliability = {name: accumulator.compute_reliability() for name, accumulator in metrics.items()}
    reliability_chapter = make_reliability_chapter(reliability, spec.out / "reliability.png")
    for chapter, summary in zip(pose_chapters, (p for p in pose_summaries.values() if p.senders)):
        for warning in summary.make_warnings():
            console.print(f"{chapter.title}: {warning}", highlight=False, soft_wrap=True)
    _save_animation(film, spec.out)
    pictures = _save_pictures(pictured_steps, comparison, grid, spec.out, min_scores)
    player, shown = recorder.finish(pictured_index), _select_shown(spec.methods)
    help_chapter = make_help_chapter(player, shown)
    report = HtmlReport(
        title=spec.title,
        lead=spec.lead,
        rows=comparison.rows,
        pictures=pictures,
        facts=_make_facts(drive, detector, spec),
        commands=spec.commands,
        notes=(*((comparison.footer,) if comparison.footer else ()), *_make_notes(protocol, spec.replay)),
        player=player,
        story=() if help_chapter is None else (help_chapter,),
        shown=shown,
        chapters=(*pose_chapters, reliability_chapter),
        provenance=_write_results(comparison, detector, spec),
    )
    save_report(report, spec.out / REPORT)
    return report


def _find_pictured_index(eval_indices: range, scenario: str, frame: int | None) -> int:
    """Return the index of the pictured frame: the chosen one, else the middle one."""
    index = eval_indices[len(eval_indices) // 2] if frame is None else frame
    if index not in eval_indices:
        valid_range = f"{eval_indices.start} to {eval_indices[-1]}"
        raise ConfigError(f"Frame {index} of {scenario} is not evaluated; choose one of {valid_range}.")
    return index


def _write_results(comparison: MethodComparison, detector: BoxDetector, spec: ReportSpec) -> dict[str, Any]:
    """Write results.json and results.md; returns where they come from."""
    config = {
        "spec": spec,
        "detector": detector.config if isinstance(detector, Detector) else type(detector).__qualname__,
    }
    origin = provenance.write_json(spec.out / "results.json", comparison, config, spec.replay.seed)
    atomic_write_text(
        spec.out / "results.md",
        format_markdown(comparison.rows) + (f"\n{comparison.footer}\n" if comparison.footer else ""),
    )
    return origin


def _make_pose_chapters(pose_summaries: Mapping[str, PoseCorrectionSummary]) -> tuple[Chapter, ...]:
    """What was found of senders' prior poses, for each method that aligns."""
    text = (
        "Before fusion, the ego matches objects that both agents detect. Prior poses that contradict the match are replaced; "
        "messages without a usable pose are left out; drifting priors are listed."
    )
    return tuple(
        Chapter(f"Pose correction, {name}", text, table=(HEADINGS, *summary.make_rows()))
        for name, summary in pose_summaries.items()
        if summary.senders
    )


def find_min_score(detector: BoxDetector, method: str, chosen: float | None = None) -> float:
    """Return the score from which boxes of a method are drawn: the chosen one, else that of the weights."""
    return default_drawing_score(detector, get_strategy(method).score_form) if chosen is None else chosen


def _select_animated(methods: Sequence[str]) -> tuple[str, ...]:
    """Return the two methods of one form whose difference is the point, or as many of them as were run."""
    pairs = (("no-fusion" + form, "intermediate" + form) for form in ("", TEMPORAL))
    chosen = [tuple(name for name in pair if name in methods) for pair in pairs]
    return max(chosen, key=len) or tuple(methods[:1])


def _select_shown(methods: Sequence[str]) -> str:
    """Return the method that the report explains: the last animated one."""
    return _select_animated(methods)[-1]


def _draw_step(step: ReplayStep, grid: BevGrid, caption: str, min_score: float, width: int) -> Image:
    title = TITLES.get(step.method, step.method)
    received_ids = {reception.message.agent_id for reception in step.perception.received}
    missing_ids = {frame.agent_id for frame in step.snapshot.frames} - received_ids
    view = make_scene(step.snapshot, step.boxes, step.ego, missing_ids)
    return draw_scene(view, grid, title, caption, width, min_score)


def _make_caption(step: ReplayStep) -> str:
    """What one instant cost."""
    ego = step.snapshot.frames[step.ego].agent_id
    sent = [s.num_bytes for s in step.sent if s.num_packets and s.agent_id != ego]
    moment = f"frame {step.snapshot.index}"
    if not sent:
        return f"{moment} · nothing is sent"
    age = f" · {1e3 * sum(step.ages_s) / len(step.ages_s):.0f} ms old" if step.ages_s else " · nothing has arrived"
    return f"{moment} · {len(sent)} messages of {sum(sent) / len(sent) / 1e3:,.1f} kB{age}"


def _save_animation(film: _Film, out: Path) -> None:
    if film.images:
        save_animation(film.images, out / "drive.gif", FILM_FRAME_MS)


def _save_pictures(
    steps: Sequence[ReplayStep],
    comparison: MethodComparison,
    grid: BevGrid,
    folder: Path,
    min_scores: Mapping[str, float],
) -> tuple[ReportImage, ...]:
    """Return one bird's-eye picture a method, of the same instant."""
    rows = {row.method: row for row in reversed(comparison.rows)}
    out = []
    for step in steps:
        ap = rows[step.method].ap50
        caption = f"{_make_caption(step)} · AP@0.5 of the drive {ap.value:.3f}" if ap else _make_caption(step)
        path = folder / f"{step.method}.png"
        save_png(_draw_step(step, grid, caption, min_scores[step.method], WIDTH), path)
        out.append(ReportImage(path, f"{TITLES.get(step.method, step.method)}; {caption}"))
    return tuple(out)


def _make_facts(drive: Excerpt, detector: BoxDetector, spec: ReportSpec) -> tuple[tuple[str, str], ...]:
    return (
        *spec.facts,
        ("Scenario", drive.scenario),
        ("Evaluated frames", str(len(drive.eval_indices(drive.scenario)))),
        ("Agents", str(len(drive.agents(drive.scenario)))),
        ("Channel", spec.replay.radio.name),
        ("The ego waits", f"{1e3 * spec.replay.latency_budget_s:.0f} ms"),
        ("Weights", f"{spec.weights} · {detector.fingerprint.hex()}"),
    )


def _make_notes(protocol: DetectionProtocol, config: ReplayConfig) -> tuple[str, ...]:
    x0, y0, _, x1, y1, _ = protocol.gt_range
    place = f"x from {x0:g} to {x1:g} m, y from {y0:g} to {y1:g} m around the ego"
    text = (
        f"The vehicles that the LiDAR of any agent hit are evaluated, {place}. This is one drive: its numbers show what "
        "happened here, and resolve no difference between methods; 'manyeyes evaluate' does, over many."
    )
    wait = (
        f"After its own sweep the ego waits {1e3 * config.latency_budget_s:.0f} ms for messages; the channel's time is part "
        "of this wait. Compute times are of this machine, whatever else it did."
    )
    return text, wait
