# SPDX-License-Identifier: Apache-2.0
"""Estimate the poses of agents relative to the first from what each detects; evaluate prior and corrected poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from manyeyes._bounds import AngleDeg, Fraction, LengthM, OutputFolder, PositiveInt, Seed
from manyeyes.studies.replay_options import FileChecks, display_name, make_excerpt

if TYPE_CHECKING:
    from manyeyes.agents.perception_cache import PerceptionCache
    from manyeyes.datasets.perturbation import PoseNoise
    from manyeyes.datatypes import Snapshot
    from manyeyes.evaluation.pose.metrics import PoseEvaluation, PoseScore
    from manyeyes.pose.pose_monitor import PoseReport
    from manyeyes.pose.types import PoseEstimate, PosePrior
    from manyeyes.studies.replay_options import Excerpt


HEADINGS = (
    "corrector",
    "within 1 m, 1° [%]",
    "within 2 m, 2° [%]",
    "coverage [%]",
    "precision [%]",
    "false accepts [%]",
    "error [m]",
    "error [°]",
    "object error [m]",
)
"""Rates and errors of ``evaluation.pose.metrics``; errors are medians, that of objects a mean."""


@dataclass(frozen=True)
class Options:
    """Which drive, which correctors, and the noise of prior poses."""

    recording: tyro.conf.Positional[Path]
    """A data set, a folder of scenarios, or one scenario: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader."""
    split: str | None = None
    """Which split of a data set, such as test: a folder inside it; with DAIR-V2X one of its split file."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frames: PositiveInt = 60
    """At most so many evaluated frames."""
    correctors: tuple[str, ...] = ("identity", "voting")
    """Any of voting, learned-voting, identity, coalign, fpv-rcnn, feaco, icp, vips, clipper, max-clique, v2x-reg-odist,
    v2x-reg-oiou, mash, feakm, or a .safetensors file of FeaKM; of whole clouds scan-registration and gicp."""
    noise_xy_m: LengthM = 0.0
    """Standard deviation of errors of collaborators' prior positions."""
    noise_yaw_deg: AngleDeg = 0.0
    """Standard deviation of errors of collaborators' prior headings, degrees."""
    prior: bool = True
    """Correctors get the prior pose."""
    min_score: Fraction = 0.3
    """Detections below this score are no landmarks."""
    weights: str = "costr-small"
    """Shipped weights by name, or a .safetensors file of 'manyeyes train'."""
    seed: Seed = 0
    """Of the noise."""
    out: OutputFolder = Path("out/pose")
    """Folder for pose.json."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


@dataclass(frozen=True)
class CorrectorResult:
    """One corrector's estimate for one agent in one frame; num_landmarks: of ego and agent, or of points where clouds are compared;
    evaluation is None where the recording has no ground truth.
    """

    frame: int
    time_s: float
    agent_id: int
    corrector: str
    num_landmarks: tuple[int, int]
    prior: PosePrior | None
    estimate: PoseEstimate
    evaluation: PoseEvaluation | None


def main(options: Options) -> None:
    """Evaluate pose correction on a recording."""
    from manyeyes._lock import hold_folder

    with hold_folder(options.out):
        _evaluate_poses(options)


def _evaluate_poses(options: Options) -> None:
    from rich.console import Console

    from manyeyes.agents.perception_cache import PerceptionCache
    from manyeyes.datasets.perturbation import PoseNoise
    from manyeyes.datasets.registry import open_recording
    from manyeyes.datatypes import ConfigError
    from manyeyes.evaluation.pose.metrics import summarize_evaluations
    from manyeyes.models import pretrained
    from manyeyes.pose.registry import find_corrector
    from manyeyes.studies import provenance
    from manyeyes.studies.recordings import check_evaluated_frames, check_files, select_checked_scenarios
    from manyeyes.viz.table import make_table, missing_footer

    console = Console()
    if not options.correctors:
        raise ConfigError("--correctors takes at least one name; got none.")
    for name in options.correctors:
        find_corrector(name)
    sigma_yaw_rad = math.radians(options.noise_yaw_deg)
    noise = PoseNoise("collaborators", options.noise_xy_m, sigma_yaw_rad, options.seed, "independent", "true")
    recording = open_recording(options.recording, options.split)
    drive = make_excerpt(recording, options.scenario, options.frames)
    check_evaluated_frames(drive, drive.scenarios)
    if len(drive.agents(drive.scenario)) < 2:
        raise ConfigError(
            f"{options.recording}: '{drive.scenario}' has one agent, poses are corrected between two; choose another."
        )
    scenarios = select_checked_scenarios(recording, drive.scenario, options.scenario)
    missing = check_files(recording, options.checks, console, scenarios)
    cache = PerceptionCache(pretrained.load(options.weights))
    results = list(_run_correctors(drive, cache, options, noise))
    evaluations = {
        name: [f.evaluation for f in results if f.corrector == name and f.evaluation] for name in options.correctors
    }
    scores = {name: summarize_evaluations(frames) for name, frames in evaluations.items() if frames}
    if scores:
        title = f"{display_name(options.weights)} on {drive.scenario}: {len(results) // len(options.correctors)} pairs of agents"
        console.print(make_table(title, HEADINGS, [_format_scores(name, score) for name, score in scores.items()]))
    if missing.count:
        console.print(missing_footer(missing.count, "pose.json"), highlight=False, soft_wrap=True)
    health = run_pose_monitor([f for f in results if f.corrector == "voting"])
    for agent, report in health.items():
        console.print(
            f"agent {agent}: prior pose {report.health.value} over {report.num_frames} frames", highlight=False
        )
    provenance.write_json(
        options.out / "pose.json",
        {
            "scores": {name: asdict(s) for name, s in scores.items()},
            "health": {str(agent): report.health.value for agent, report in health.items()},
            "estimates": [_to_json(f) for f in results],
            "missing": missing,
        },
        {"options": options},
        options.seed,
    )
    console.print(f"\nAll estimates are in {options.out / 'pose.json'}", highlight=False, soft_wrap=True)


def _run_correctors(
    drive: Excerpt, cache: PerceptionCache, options: Options, noise: PoseNoise
) -> Iterator[CorrectorResult]:
    """Yield every corrector's estimate of the pose of every collaborator in every evaluated frame."""
    from manyeyes.agents.level_frame import SnapshotLeveller
    from manyeyes.agents.pose_correction import PoseCorrection
    from manyeyes.pose.registry import find_corrector
    from manyeyes.pose.types import PosePrior

    names, level = options.correctors, SnapshotLeveller()
    correctors = {name: find_corrector(name) for name in names}
    aligners = {n: PoseCorrection(n, options.min_score) for n, c in correctors.items() if c.kind == "landmarks"}
    for index in drive.eval_indices(drive.scenario):
        snapshot = level(drive.snapshot(drive.scenario, index))
        perturbed = noise.apply(snapshot, 0)
        inputs: dict[str, list[Any]] = {
            name: [
                aligners[name].extract_own_landmarks(f, cache) if name in aligners else f.points
                for f in snapshot.frames
            ]
            for name in names
        }
        for row in range(1, len(perturbed.frames)):
            prior = PosePrior.between(perturbed.frames[0], perturbed.frames[row]) if options.prior else None
            for name, agent_inputs in inputs.items():
                estimate = correctors[name].function(agent_inputs[0], agent_inputs[row], prior)
                counts, other = (len(agent_inputs[0]), len(agent_inputs[row])), perturbed.frames[row]
                evaluation, time_s = _evaluate(estimate, snapshot, row), other.timestamp_ns * 1e-9
                yield CorrectorResult(index, time_s, other.agent_id, name, counts, prior, estimate, evaluation)


def _evaluate(estimate: PoseEstimate, snapshot: Snapshot, row: int) -> PoseEvaluation | None:
    from manyeyes.evaluation.pose.metrics import evaluate_pose
    from manyeyes.pose.types import project_to_se2

    truth = snapshot.truth
    if truth is None:
        return None
    truth = truth.of_classes()
    ego_from_world = truth.world_from_agent[0].inverse()
    both = truth.boxes.center[truth.seen[0] & truth.seen[row]].double()
    common = ego_from_world.apply(both)[:, :2].numpy()
    return evaluate_pose(estimate, project_to_se2(ego_from_world @ truth.world_from_agent[row]), common)


def run_pose_monitor(results: list[CorrectorResult]) -> dict[int, PoseReport]:
    """Run the pose monitor of each agent up to its last frame."""
    from manyeyes.pose.pose_monitor import PoseMonitorState, update_monitor

    states: dict[int, PoseMonitorState] = {}
    reports: dict[int, PoseReport] = {}
    for result in results:
        state = states.get(result.agent_id, PoseMonitorState.new())
        states[result.agent_id], reports[result.agent_id] = update_monitor(
            state, result.estimate, result.prior, result.time_s
        )
    return reports


def _format_scores(name: str, s: PoseScore) -> tuple[str, ...]:
    """Format the cells of a corrector under HEADINGS."""
    rates = (*s.success_rate[:2], s.coverage, s.precision, s.false_accept_rate)
    errors = (s.median_translation_error_m, s.median_rotation_error_deg, s.mean_displacement_m)
    return (name, *(f"{100 * rate:.1f}" for rate in rates), *(f"{error:.2f}" for error in errors))


def _to_json(result: CorrectorResult) -> dict[str, object]:
    estimate, evaluation = result.estimate, result.evaluation
    return {
        "frame": result.frame,
        "agent": result.agent_id,
        "corrector": result.corrector,
        "landmarks": result.num_landmarks,
        "status": estimate.status.value,
        "ego_from_other": None if estimate.pose is None else estimate.pose.tolist(),
        "covariance": estimate.covariance.tolist(),
        "inliers": estimate.inliers,
        "runner_up": estimate.runner_up,
        "margin": estimate.margin,
        "distance": estimate.mahalanobis_squared,
        "error_m": None if evaluation is None else evaluation.translation_error_m,
        "error_deg": None if evaluation is None else evaluation.rotation_error_deg,
        "common": None if evaluation is None else evaluation.num_common,
    }
