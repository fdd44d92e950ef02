# SPDX-License-Identifier: Apache-2.0
"""Judges methods on a split: AP with 95 % intervals over scenarios, bytes, age, time, and paired differences with verdicts.

--study NAME runs a study instead: robustness (delay, errors of pose, lost packets), budget (AP against bytes), agents (one to
five), ablation (branches of a training), system (every agent as ego, one budget for the channel), pose and pose-accuracy
(correctors of claimed poses: AP, and the poses themselves), feakm (branches of that paper's net), picture (one frame).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from manyeyes.studies.options import Options
from manyeyes.studies.replay_options import excerpt, weights_name

if TYPE_CHECKING:
    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.datasets.base import Recording
    from manyeyes.evaluation.detection.accumulator import MethodResult
    from manyeyes.models.detector.detector import Detector


def main(options: Options) -> None:
    """The verb."""
    from rich.console import Console

    from manyeyes._io import atomic_write_text
    from manyeyes.datasets.perturbation import PoseNoise
    from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, benchmark, judging_protocol
    from manyeyes.models import pretrained
    from manyeyes.studies import provenance
    from manyeyes.studies.recordings import check_files, open_recording, suited_to
    from manyeyes.viz.progress import bars
    from manyeyes.viz.results import outcome_of, show
    from manyeyes.viz.table import DIFFERENCE_HEADINGS, difference_cells, markdown, markdown_lines

    console = Console()
    if options.study is not None:
        from manyeyes.studies import study

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
    protocol, detector = judging_protocol(config), pretrained.load(config.weights)
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
    atomic_write_text(options.out / "results.md", text)
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
