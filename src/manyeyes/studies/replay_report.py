# SPDX-License-Identifier: Apache-2.0
"""Plays one drive with every method and shows it: table, pictures of one instant, animation, report, JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from manyeyes._io import atomic_write_text
from manyeyes.agents.replay import ReplayConfig, Step, replay
from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.evaluation.detection.accumulator import Tally
from manyeyes.evaluation.detection.average_precision import Protocol, protocol_named
from manyeyes.models.detector.detector import Detector
from manyeyes.studies import provenance
from manyeyes.studies.replay_options import Excerpt
from manyeyes.viz.animation import save_animation, stack
from manyeyes.viz.birds_eye import draw, save_png, scene_of
from manyeyes.viz.pose_summary import HEADINGS, Whereabouts
from manyeyes.viz.progress import bars
from manyeyes.viz.report import Chapter, Picture, Report, save_report
from manyeyes.viz.results import Outcome, outcome_of, show
from manyeyes.viz.table import markdown

if TYPE_CHECKING:
    from PIL.Image import Image

REPORT = "report.html"
WIDTH, FILM_WIDTH, FILM_FRAME_MS = 1280, 800, 200
TITLES = {
    "alone": "Ego alone",
    "late": "Late fusion: boxes are shared",
    "late-remembering": "Late fusion: boxes are shared and remembered",
    "intermediate": "Intermediate fusion: tokens are shared",
    "early": "Early fusion: all points are shared",
}


@dataclass(frozen=True)
class Showing:
    """What is shown and where it goes. frame: index of the pictured instant, None: the middle one. missing: files of the drive."""

    out: Path
    title: str
    lead: str
    methods: tuple[str, ...]
    replay: ReplayConfig
    weights: str
    score_min: float = 0.4
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
            self.images.append(stack([self.pending[name] for name in self.methods]))
            self.pending = {}


def play(drive: Excerpt, detector: Detector, showing: Showing, console: Console) -> Report:
    """Play the drive and write everything under showing.out; the report as it was saved, to which chapters can be added."""
    judged = drive.judged(drive.scenario)
    instant = judged[len(judged) // 2] if showing.frame is None else showing.frame
    if instant not in judged:
        known = f"{judged.start} to {judged[-1]}"
        raise ConfigError(f"Frame {instant} of {drive.scenario} is not judged; choose one of {known}.")
    grid, protocol = detector.config.range, judging(detector)
    tallies = {name: Tally(name, protocol) for name in showing.methods}
    film = _Film(_filmed(showing.methods) if showing.animate else ())
    kept: list[Step] = []
    places = {name: Whereabouts() for name in showing.methods}
    with bars(console) as progress:
        task = progress.add_task("Playing", total=len(judged) * len(showing.methods))
        for step in replay(drive, drive.scenario, detector, showing.methods, showing.replay):
            tallies[step.method].add(step)
            places[step.method].add(step.snapshot.index, step.perception.verdicts)
            if step.snapshot.index == instant:
                kept.append(step)
            if step.method in film.methods:
                film.add(step.method, _picture(step, grid, _caption_of(step), showing.score_min, FILM_WIDTH))
            progress.advance(task)
    outcome = outcome_of([tally.result() for tally in tallies.values()], protocol, showing.missing)
    show(console, outcome, showing.title)
    where = _where(places)
    for chapter, found in zip(where, (p for p in places.values() if p.senders)):
        for warning in found.warnings():
            console.print(f"{chapter.title}: {warning}", highlight=False, soft_wrap=True)
    pictures = _film_picture(film, showing.out) + _still_pictures(kept, outcome, grid, showing)
    config = {"showing": showing, "detector": detector.config}
    origin = provenance.write_json(showing.out / "results.json", outcome, config, showing.replay.seed)
    atomic_write_text(
        showing.out / "results.md", markdown(outcome.rows) + (f"\n{outcome.footer}\n" if outcome.footer else "")
    )
    report = Report(
        title=showing.title,
        lead=showing.lead,
        rows=outcome.rows,
        pictures=pictures,
        facts=_facts(drive, detector, showing),
        commands=showing.commands,
        notes=(*((outcome.footer,) if outcome.footer else ()), *_notes(protocol)),
        chapters=where,
        provenance=origin,
    )
    save_report(report, showing.out / REPORT)
    return report


def _where(places: Mapping[str, Whereabouts]) -> tuple[Chapter, ...]:
    """What was found of senders' claimed poses, for each method that aligns."""
    text = (
        "Before it fuses, the ego compares where others say they are with what both detect. Claims that objects refute are "
        "replaced; messages that nobody can place are left out; a claim that moves off is named."
    )
    return tuple(
        Chapter(f"Who is where, {name}", text, table=(HEADINGS, *found.lines()))
        for name, found in places.items()
        if found.senders
    )


def judging(detector: Detector) -> Protocol:
    """The project's own protocol over the range that the detector sees."""
    grid = detector.config.range
    return protocol_named("manyeyes").within((grid.x_min, grid.y_min, grid.z_min, grid.x_max, grid.y_max, grid.z_max))


def _filmed(methods: Sequence[str]) -> tuple[str, ...]:
    """The two methods whose difference is the point, or as many of them as were run."""
    wanted = tuple(name for name in ("alone", "intermediate") if name in methods)
    return wanted or tuple(methods[:1])


def _picture(step: Step, grid: BevGrid, caption: str, score_min: float, width: int) -> Image:
    title = TITLES.get(step.method, step.method)
    heard = {reception.message.agent_id for reception in step.perception.heard}
    unheard = {frame.agent_id for frame in step.snapshot.frames} - heard
    scene = scene_of(step.snapshot, step.boxes, step.ego, unheard)
    return draw(scene, grid, title, caption, width, score_min)


def _caption_of(step: Step) -> str:
    """What one instant cost."""
    ego = step.snapshot.frames[step.ego].agent_id
    sent = [s.bytes for s in step.sent if s.packets and s.agent_id != ego]
    moment = f"frame {step.snapshot.index}"
    if not sent:
        return f"{moment} · nothing is sent"
    age = f" · {1e3 * sum(step.ages_s) / len(step.ages_s):.0f} ms old" if step.ages_s else " · nothing has arrived"
    return f"{moment} · {len(sent)} messages of {sum(sent) / len(sent) / 1e3:,.1f} kB{age}"


def _film_picture(film: _Film, out: Path) -> tuple[Picture, ...]:
    if not film.images:
        return ()
    save_animation(film.images, out / "drive.gif", FILM_FRAME_MS)
    names = ", below it ".join(TITLES.get(name, name).split(":")[0].lower() for name in film.methods)
    return (Picture(out / "drive.gif", f"The drive at half speed: {names}.", wide=True),)


def _still_pictures(steps: Sequence[Step], outcome: Outcome, grid: BevGrid, showing: Showing) -> tuple[Picture, ...]:
    """One bird's-eye picture a method, of the same instant."""
    rows = {row.method: row for row in outcome.rows}
    out = []
    for step in steps:
        ap = rows[step.method].ap50
        caption = f"{_caption_of(step)} · AP@0.5 of the drive {ap.value:.3f}" if ap else _caption_of(step)
        path = showing.out / f"{step.method}.png"
        save_png(_picture(step, grid, caption, showing.score_min, WIDTH), path)
        out.append(Picture(path, f"{TITLES.get(step.method, step.method)}; {caption}"))
    return tuple(out)


def _facts(drive: Excerpt, detector: Detector, showing: Showing) -> tuple[tuple[str, str], ...]:
    return (
        *showing.facts,
        ("Scenario", drive.scenario),
        ("Judged frames", str(len(drive.judged(drive.scenario)))),
        ("Agents", str(len(drive.agents(drive.scenario)))),
        ("Channel", showing.replay.radio.name),
        ("The ego waits", f"{1e3 * showing.replay.wait_s:.0f} ms"),
        ("Weights", f"{showing.weights} · {detector.fingerprint.hex()}"),
    )


def _notes(protocol: Protocol) -> tuple[str, ...]:
    x0, y0, _, x1, y1, _ = protocol.gt_range
    place = f"x from {x0:g} to {x1:g} m, y from {y0:g} to {y1:g} m around the ego"
    text = (
        f"Judged are the vehicles that any agent's LiDAR met, {place}. This is one drive: its numbers show what "
        "happened here, and resolve no difference between methods; 'manyeyes evaluate' does, over many."
    )
    return (text,)
