# SPDX-License-Identifier: Apache-2.0
"""All studies by name: one literal table; a study's module is imported when it is run, not before."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from manyeyes.studies.options import StudyOptions


@dataclass(frozen=True)
class Study:
    """A study. module: below ``manyeyes.studies``, with ``run(options, context)``. options: a class of studies.options."""

    group: str
    summary: str
    module: str
    options: str


_DETECTION, _POSE = "detection (CoSTr)", "pose correction (FeaKM)"
_MODEL, _FLEET = "map model (CrowdMap)", "map fusion of simulated fleets"
STUDIES = {
    "main-table": Study(
        _DETECTION, "every method with and without memory, on a real and the ideal channel, each disturbance",
        "detection.main_table", "MainTableOptions"),
    "robustness": Study(
        _DETECTION, "delay, pose noise and packet loss, one at a time and combined (Table II)",
        "detection.robustness", "RobustnessOptions"),
    "bandwidth": Study(
        _DETECTION, "AP against bytes per message, by token selection and encoding (Fig. 3)",
        "detection.bandwidth", "BandwidthOptions"),
    "byte-curves": Study(
        _DETECTION, "AP against bytes per message, for every method and baseline (Fig. 3)",
        "detection.byte_curves", "ByteCurvesOptions"),
    "shared-bandwidth": Study(
        _DETECTION, "every agent as ego, one budget for the channel (Eq. 2)",
        "detection.shared_bandwidth", "SharedBandwidthOptions"),
    "sensors": Study(
        _DETECTION, "intensity laws, one or two sweeps, and tilt, on recordings of the same scenes",
        "detection.sensors", "SensorsOptions"),
    "attacks": Study(
        _DETECTION, "attacks of malicious agents, without and with misbehaviour detection",
        "attacks.study", "AttacksOptions"),
    "false-accusations": Study(
        _DETECTION, "honest senders named malicious, on long simulated drives, also through glass and in rain",
        "attacks.false_accusations", "FalseAccusationsOptions"),
    "strata": Study(
        _DETECTION, "AP of each split of a data set, such as the sealed one", "detection.strata", "StrataOptions"),
    "num-agents": Study(_DETECTION, "one agent to five", "detection.num_agents", "EvaluationOptions"),
    "ablation": Study(
        _DETECTION, "variants of a training, side by side (Table III)", "detection.ablation", "AblationOptions"),
    "qualitative": Study(
        _DETECTION, "one perturbed frame, methods side by side (Fig. 4)", "detection.qualitative", "EvaluationOptions"),
    "pose-noise-ap": Study(
        _POSE, "AP under pose noise, with and without a corrector (Tables 1 and 2)",
        "pose.pose_noise_ap", "PoseNoiseApOptions"),
    "pose-estimation": Study(
        _POSE, "errors of corrected poses, by corrector, noise and common objects",
        "pose.pose_estimation", "PoseEstimationOptions"),
    "feakm": Study(
        _POSE, "ablation of FeaKM: confidence map and fusion scales (Table 3)", "pose.feakm", "FeakmOptions"),
    "local": Study(_MODEL, "local maps of single agents (Table 1)", "maps.local", "LocalMapOptions"),
    "semi-global": Study(_MODEL, "tiles from one to ten frames (Table 2)", "maps.semi_global", "MapModelOptions"),
    "full-map": Study(
        _MODEL, "maps of whole towns, by map mode and fusion method (Table 3)", "maps.full_map", "FullMapOptions"),
    "map-pose-noise": Study(
        _MODEL, "tiles under pose noise, with and without pose correction", "maps.map_pose_noise", "MapPoseNoiseOptions"),
    "fusion": Study(_FLEET, "fusion methods on places that nothing was tuned on", "maps.fusion", "FusionOptions"),
    "fleet-pose-noise": Study(
        _FLEET, "fusion methods under pose noise of 0 to 1.5 m", "maps.fusion", "FleetPoseNoiseOptions"),
    "crowdmap-table3": Study(
        _FLEET, "two intersections, local and semi-global views (CrowdMap, Table 3)",
        "maps.fusion", "MapFusionStudyOptions"),
    "adversarial": Study(
        _FLEET, "displacement of the map by malicious agents", "maps.adversarial", "AdversarialOptions"),
    "malicious-agents": Study(
        _FLEET, "ROC of detecting malicious agents, by attack, fraction and offset",
        "maps.malicious_agents", "MaliciousAgentsOptions"),
    "tuning": Study(
        _FLEET, "hyperparameter search with equal budgets, on other places", "maps.tuning", "TuningOptions"),
}  # fmt: skip


def load_options(name: str) -> type[StudyOptions]:
    """Import the options class of a study."""
    return getattr(importlib.import_module("manyeyes.studies.options"), STUDIES[name].options)


def run_study(name: str, options: Any) -> None:
    """Run a study; stored results are not computed again."""
    from rich.console import Console

    from manyeyes._lock import share_folder
    from manyeyes.studies.engine.report import StudyContext

    module = importlib.import_module(f"manyeyes.studies.{STUDIES[name].module}")
    with share_folder(options.out, partial(_remove_unfinished_cells, options.out)):
        module.run(options, StudyContext(name, options, Console()))


def _remove_unfinished_cells(out: Path) -> None:
    from manyeyes._io import remove_unfinished

    for folder in (out, *out.glob("cells*")):
        remove_unfinished(folder, below=False)
