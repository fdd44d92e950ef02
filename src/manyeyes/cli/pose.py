# SPDX-License-Identifier: Apache-2.0
"""Finds where the agents of a recording are relative to the first, from what each detects; judges claims and corrections."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from manyeyes.studies.replay_options import FileChecks, excerpt, weights_name

if TYPE_CHECKING:
    from rich.table import Table

    from manyeyes.agents.perception_cache import Eyes
    from manyeyes.datasets.perturbation import PoseNoise
    from manyeyes.datatypes import Snapshot
    from manyeyes.evaluation.pose.metrics import PoseFrame, PoseScore
    from manyeyes.pose.pose_monitor import Report
    from manyeyes.pose.types import PoseClaim, PoseEstimate
    from manyeyes.studies.replay_options import Excerpt


@dataclass(frozen=True)
class Options:
    """Which drive, which correctors, how wrong the claims."""

    recording: tyro.conf.Positional[Path]
    """A dataset, a folder of scenarios, or one scenario, in OPV2V's layout; or a root in DAIR-V2X's."""
    split: str | None = None
    """Which split of a dataset: a folder inside it, such as test; with DAIR-V2X one of its split file."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frames: int = 60
    """At most so many judged frames."""
    correctors: tuple[str, ...] = ("given", "vote")
    """Any of vote, given, coalign, fpv-rcnn, feaco, icp, vips, v2x-reg-odist, v2x-reg-oiou, mash, feakm, or a .safetensors
    file of FeaKM; of whole clouds register and gicp."""
    noise_xy_m: float = 0.0
    """Standard deviation of errors of collaborators' claimed positions."""
    noise_yaw_deg: float = 0.0
    """Standard deviation of errors of collaborators' claimed headings, degrees."""
    unknown: bool = False
    """Claim nothing: correctors get no pose to start from."""
    score_min: float = 0.3
    """Detections below this score are no landmarks."""
    weights: str = "costr-small"
    """Shipped weights by name, or a .safetensors file of 'manyeyes train'."""
    seed: int = 0
    """Of pose errors."""
    out: Path = Path("out/align")
    """Folder for align.json."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


@dataclass(frozen=True)
class Found:
    """One corrector's answer about one agent in one frame; landmarks: how many each has, or points where clouds are compared;
    judged is None where the recording has no truth.
    """

    frame: int
    time_s: float
    agent: int
    corrector: str
    landmarks: tuple[int, int]
    claimed: PoseClaim | None
    estimate: PoseEstimate
    judged: PoseFrame | None


def main(options: Options) -> None:
    """The verb."""
    from rich.console import Console

    from manyeyes.agents.perception_cache import Eyes
    from manyeyes.datasets.perturbation import PoseNoise
    from manyeyes.evaluation.pose.metrics import score
    from manyeyes.models import pretrained
    from manyeyes.pose.registry import CLOUDS, corrector
    from manyeyes.studies import provenance
    from manyeyes.studies.recordings import check_files, open_recording, played_scenarios
    from manyeyes.viz.table import missing_footer

    console = Console()
    for name in options.correctors:
        if name not in CLOUDS:
            corrector(name)
    noise = PoseNoise("collaborators_iid", options.noise_xy_m, math.radians(options.noise_yaw_deg), options.seed)
    recording = open_recording(options.recording, options.split)
    drive = excerpt(recording, options.scenario, options.frames)
    played = played_scenarios(recording, drive.scenario, options.scenario)
    missing = check_files(recording, options.checks, console, played)
    eyes = Eyes(pretrained.load(options.weights))
    found = list(_answers(drive, eyes, options, noise))
    judged = {name: [f.judged for f in found if f.corrector == name and f.judged] for name in options.correctors}
    scores = {name: score(frames) for name, frames in judged.items() if frames}
    if scores:
        title = f"{weights_name(options.weights)} on {drive.scenario}: {len(found) // len(options.correctors)} pairs of agents"
        console.print(_table(scores, title))
    if missing.count:
        console.print(missing_footer(missing.count, "align.json"), highlight=False, soft_wrap=True)
    health = watched([f for f in found if f.corrector == "vote"])
    for agent, report in health.items():
        console.print(f"agent {agent}: {report.health.value} over {report.frames} frames", highlight=False)
    provenance.write_json(
        options.out / "align.json",
        {
            "scores": {name: asdict(s) for name, s in scores.items()},
            "health": {str(agent): report.health.value for agent, report in health.items()},
            "answers": [_plain(f) for f in found],
            "missing": missing,
        },
        {"options": options},
        options.seed,
    )
    console.print(f"\nEvery answer is in {options.out / 'align.json'}", highlight=False, soft_wrap=True)


def _answers(drive: Excerpt, eyes: Eyes, options: Options, noise: PoseNoise) -> Iterator[Found]:
    """Every corrector's answer about every collaborator in every judged frame."""
    from manyeyes.agents.pose_correction import Aligner
    from manyeyes.pose.registry import CLOUDS, corrector
    from manyeyes.pose.types import PoseClaim

    names = options.correctors
    aligners = {name: Aligner(name, options.score_min) for name in names if name not in CLOUDS}
    correctors: dict[str, Any] = {name: CLOUDS[name] if name in CLOUDS else corrector(name) for name in names}
    for index in drive.judged(drive.scenario):
        snapshot = drive.snapshot(drive.scenario, index)
        told = noise.apply(snapshot, 0)
        seen: dict[str, list[Any]] = {
            name: [aligners[name].own_landmarks(f, eyes) if name in aligners else f.points for f in snapshot.frames]
            for name in names
        }
        for row in range(1, len(told.frames)):
            claimed = None if options.unknown else PoseClaim.between(told.frames[0], told.frames[row])
            for name, views in seen.items():
                said = correctors[name](views[0], views[row], claimed)
                counts, other = (len(views[0]), len(views[row])), told.frames[row]
                judged, time_s = _judged(said, snapshot, row), other.timestamp_ns * 1e-9
                yield Found(index, time_s, other.agent_id, name, counts, claimed, said, judged)


def _judged(said: PoseEstimate, snapshot: Snapshot, row: int) -> PoseFrame | None:
    from manyeyes.evaluation.pose.metrics import judged
    from manyeyes.pose.types import planar

    truth = snapshot.truth
    if truth is None:
        return None
    ego_from_world = truth.world_from_agent[0].inverse()
    both = truth.boxes.center[truth.seen[0] & truth.seen[row]].double()
    common = ego_from_world.apply(both)[:, :2].numpy()
    return judged(said, planar(ego_from_world @ truth.world_from_agent[row]), common)


def watched(found: list[Found]) -> dict[int, Report]:
    """What a watchman says of each agent after its last frame."""
    from manyeyes.pose.pose_monitor import WatchState, watch

    states: dict[int, WatchState] = {}
    reports: dict[int, Report] = {}
    for answer in found:
        state = states.get(answer.agent, WatchState.new())
        states[answer.agent], reports[answer.agent] = watch(state, answer.estimate, answer.claimed, answer.time_s)
    return reports


def _table(scores: dict[str, PoseScore], title: str) -> Table:
    from rich.table import Table

    table = Table(title=title)
    for head in ("", "within 1 m, 1°", "2 m, 2°", "answered", "right", "wrong", "error m", "error °", "objects off m"):
        table.add_column(head, justify="right" if head else "left")
    for name, s in scores.items():
        shares = (*s.success[:2], s.coverage, s.precision, s.wrong_accepts)
        lengths = (s.median_metres, s.median_degrees, s.displacement)
        table.add_row(name, *(f"{100 * x:.1f} %" for x in shares), *(f"{x:.2f}" for x in lengths))
    return table


def _plain(found: Found) -> dict[str, object]:
    said, judged = found.estimate, found.judged
    return {
        "frame": found.frame,
        "agent": found.agent,
        "corrector": found.corrector,
        "landmarks": found.landmarks,
        "status": said.status.value,
        "ego_from_other": None if said.pose is None else said.pose.tolist(),
        "covariance": said.covariance.tolist(),
        "inliers": said.inliers,
        "runner_up": said.runner_up,
        "margin": said.margin,
        "distance": said.distance,
        "error_m": None if judged is None else judged.metres,
        "error_deg": None if judged is None else judged.degrees,
        "common": None if judged is None else judged.common,
    }
