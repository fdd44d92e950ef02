# SPDX-License-Identifier: Apache-2.0
"""Judges methods on a split: AP with 95 % intervals over scenarios, bytes, age, time, and paired differences with verdicts.

--study NAME runs a study instead: robustness (delay, errors of pose, lost packets), budget (AP against bytes), agents (one to
five), ablation (branches of a training), system (every agent as ego, one budget for the channel), pose and pose-accuracy
(correctors of claimed poses: AP, and the poses themselves), feakm (branches of that paper's net), picture (one frame).
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes.apps.playing import FileChecks, Playing, excerpt, weights_name

if TYPE_CHECKING:
    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.datasets.recording import Recording
    from manyeyes.evaluation.tally import MethodResult
    from manyeyes.models.detector import Detector


@dataclass(frozen=True)
class Options:
    """Which recording, which methods, whose rules."""

    data: Path
    """A dataset in OPV2V's layout, a folder of scenarios, or one scenario; or a root in DAIR-V2X's layout."""
    split: str | None = None
    """Which split of a dataset: a folder inside it, such as test; with DAIR-V2X one of its split file."""
    out: Path = Path("out/evaluate")
    """Folder for results.json and results.md."""
    protocol: str = "manyeyes"
    """Rules of the AP: manyeyes, opencood, coalign, sparsealign; on DAIR-V2X also dair, heal-dair, costr-dair, sparsealign-dair."""
    noise_xy_m: float = 0.0
    """Standard deviation of errors of collaborators' claimed positions."""
    noise_yaw_deg: float = 0.0
    """Standard deviation of errors of collaborators' claimed headings, degrees."""
    all_egos: bool = False
    """Judge every agent as ego, not only the first."""
    seed: int = 0
    """Of losses, jitter and pose errors."""
    workers: int = os.cpu_count() or 1
    """How many processes share the scenarios; results do not depend on it."""
    timed_frames: int = 10
    """Frames of the first scenario on which each method is timed by itself; 0 leaves times out."""
    playing: Playing = field(default_factory=Playing)
    """How agents collaborate."""
    every: int = 1
    """Judge each so many-th frame of those that the recording judges."""
    study: str | None = None
    """robustness, budget, agents, ablation, system, pose, pose-accuracy, feakm or picture; what is finished is kept under --out."""
    disturbances: tuple[str, ...] = ()
    """Those that the studies 'robustness' and 'pose' play, by the names of their tables, such as "0.4 s" "30 % lost"
    or "2°, 2 m" "0.8 m"; by default all."""
    budgets: tuple[int, ...] = ()
    """Bytes: of a message in the study 'budget', of all messages of an instant in 'system'; by default the study's own."""
    selectors: tuple[str, ...] = ()
    """Methods that choose tokens, in the studies 'budget' and 'system'; by default intermediate, confidence, random."""
    precisions: tuple[str, ...] = ()
    """Ways to write tokens, in the study 'budget'; by default all."""
    correctors: tuple[str, ...] = ()
    """Who corrects claimed poses, in the studies 'pose' and 'pose-accuracy', feakm or a file of its weights among them; by
    default the study's own."""
    branches: tuple[str, ...] = ()
    """Weights that the study 'ablation' compares, and rival fusions of 'robustness' and 'pose', each as name=weights.safetensors;
    of 'feakm' each as name=detector.safetensors,net.safetensors."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """The verb."""
    from rich.console import Console

    from manyeyes.apps import provenance
    from manyeyes.apps.outcome import outcome_of, show
    from manyeyes.apps.recordings import check_files, open_recording, suited_to
    from manyeyes.apps.showcase import bars, write_text
    from manyeyes.apps.viewer.table import DIFFERENCE_HEADINGS, difference_cells, markdown, markdown_lines
    from manyeyes.datasets.disturb import PoseNoise
    from manyeyes.evaluation.benchmark import BenchmarkConfig, benchmark, judging_protocol
    from manyeyes.models import zoo

    console = Console()
    if options.study is not None:
        from manyeyes.apps.studies import study

        study(options, console)
        return
    disturbed = options.noise_xy_m > 0 or options.noise_yaw_deg > 0
    noise = PoseNoise("collaborators_iid", options.noise_xy_m, math.radians(options.noise_yaw_deg), options.seed)
    config = BenchmarkConfig(
        weights=options.playing.weights,
        methods=options.playing.methods,
        protocol=options.protocol,
        replay=options.playing.replay_config(options.seed, options.all_egos),
        noise=noise if disturbed else None,
        every=options.every,
    )
    protocol, detector = judging_protocol(config), zoo.load(config.weights)
    opener = partial(open_recording, options.data, options.split)
    recording = opener()
    config = replace(config, replay=suited_to(config.replay, options.playing, recording))
    missing = check_files(recording, options.checks, console)
    with bars(console) as progress:
        task = progress.add_task("Judging", total=len(recording.scenarios))
        results = benchmark(opener, config, options.workers, lambda done, total: progress.update(task, completed=done))
    timed = [_timed(r, recording, detector, config.replay, options.timed_frames) for r in results]
    outcome = outcome_of(timed, protocol, missing)
    where = f"{options.data.name}{f'/{options.split}' if options.split else ''}"
    title = f"{weights_name(config.weights)} on {where}: {len(recording.scenarios)} scenarios, {protocol.name}"
    show(console, outcome, title)
    provenance.write_json(
        options.out / "results.json", outcome, {"options": options, "benchmark": config}, options.seed
    )
    text = f"{title}\n\n{markdown(outcome.rows)}"
    if outcome.differences:
        text += "\n" + markdown_lines([DIFFERENCE_HEADINGS, *map(difference_cells, outcome.differences)])
    if outcome.footer:
        text += f"\n{outcome.footer}\n"
    write_text(options.out / "results.md", text)
    console.print(
        f"\nNumbers, configuration and versions are in {options.out / 'results.json'}", highlight=False, soft_wrap=True
    )


def _timed(
    result: MethodResult, recording: Recording, detector: Detector, config: ReplayConfig, frames: int
) -> MethodResult:
    """The result with times of the method alone: while judging, methods look at each cloud once between them."""
    from manyeyes.agents.replay import replay

    if frames == 0:
        return replace(result, share_ms=math.nan, perceive_ms=math.nan)
    part = excerpt(recording, None, frames)
    steps = list(replay(part, part.scenario, detector, [result.method], config))
    share = [s.seconds for step in steps[1:] for s in step.sent if s.packets]
    perceive = [step.perceive_seconds for step in steps[1:]]
    return replace(result, share_ms=_mean_ms(share), perceive_ms=_mean_ms(perceive))


def _mean_ms(seconds: list[float]) -> float:
    return 1e3 * sum(seconds) / len(seconds) if seconds else math.nan
