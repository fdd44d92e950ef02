# SPDX-License-Identifier: Apache-2.0
"""Simulate scenes from a seed, in OPV2V's or DAIR-V2X's layout, with counts and hashes; the same bytes at any worker count."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from manyeyes._bounds import InputPath, OutputFolder, Seed, WorkerCount
from manyeyes._text import count_noun


@dataclass(frozen=True)
class Options:
    """What to make, and where."""

    preset: str = "carla-towns-small"
    """Which set of scenarios; an unknown name lists the known ones."""
    out: OutputFolder | None = None
    """Folder for the splits and the manifest, data/PRESET or data/PRESET-cameras; a run that was stopped goes on there."""
    splits: tuple[str, ...] = ()
    """Only these splits, such as test; by default all. A later run with others adds them to the folder."""
    seed: Seed = 0
    """Another seed, other scenes."""
    workers: WorkerCount = os.cpu_count() or 1
    """How many processes share the work."""
    towns: InputPath | None = None
    """A folder, a wheel of py123d or a CARLA installation with the towns' .xodr files; else the usual places."""
    cameras: bool = False
    """Pictures too: four cameras a vehicle and one a pole, beside the clouds."""
    repair: bool = False
    """Simulate again the files of finished scenarios that are missing or altered; without it they are named and nothing is done."""


def main(options: Options) -> None:
    """Simulate scenes of a preset."""
    import json

    from rich.console import Console

    from manyeyes.datasets.missing import FileProblem
    from manyeyes.simulator.presets import RecordedContent, simulate, simulation_preset
    from manyeyes.simulator.record import RecordingProgress
    from manyeyes.studies import provenance
    from manyeyes.viz.progress import make_progress_bars

    preset = simulation_preset(options.preset)
    out = options.out or Path("data") / f"{options.preset}{'-cameras' if options.cameras else ''}"
    total = sum(part.count for part in preset.splits if not options.splits or part.split in options.splits)
    console = Console()
    with make_progress_bars(console) as progress:
        task = progress.add_task("Simulating", total=total)

        def report(at: RecordingProgress) -> None:
            progress.update(task, completed=at.done, total=at.total)

        def report_repair(problem: FileProblem) -> None:
            console.print(f"simulated again: {problem}", highlight=False, markup=False, soft_wrap=True)

        on_repair = report_repair if options.repair else None
        content = RecordedContent(options.splits, options.cameras)
        manifest = simulate(
            options.preset, out, options.seed, options.workers, report, options.towns, content, on_repair
        )
    held = json.loads(manifest.read_text(encoding="utf-8"))["scenarios"]
    provenance.write_json(
        out / "simulate.json",
        {"scenarios": len(held), "frames": sum(entry["frames"] for entry in held), "manifest": manifest.name},
        {"options": options, "preset": preset},
        options.seed,
    )
    console.print(
        f"{count_noun(len(held), 'scenario')} in {out}; {manifest} lists counts and hashes",
        highlight=False,
        soft_wrap=True,
    )
