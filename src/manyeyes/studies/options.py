# SPDX-License-Identifier: Apache-2.0
"""Options of evaluations and studies, made of shared parts; without heavy imports, so that --help is quick."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from manyeyes._bounds import (
    AngleDeg,
    ByteCount,
    DurationS,
    Fraction,
    LengthM,
    OutputFolder,
    PositiveInt,
    Seed,
    TrialCount,
    WorkerCount,
)
from manyeyes.studies.pose_error_options import PoseErrorOptions
from manyeyes.studies.replay_options import BOTH_FORMS, FileChecks, ReplayOptions

ClassName = Literal["vehicle", "pedestrian", "cyclist"]
"""A name of ``datatypes.CLASSES``, written out so that --help imports nothing heavy."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Options of every study."""

    out: OutputFolder = Path("out/study")
    """Folder for the results as .json, .md and .png; finished cells are kept there, and a stopped study goes on."""


@dataclass(frozen=True, kw_only=True)
class RecordingStudyOptions(StudyOptions):
    """Options of what is evaluated on a recording."""

    data: Path
    """A data set, a folder of scenarios, or one scenario: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader."""
    split: str | None = None
    """Which split of a data set, such as test: a folder inside it; with DAIR-V2X one of its split file."""
    frame_stride: PositiveInt = 1
    """Evaluate every n-th of the frames that the recording evaluates."""
    scenario_stride: PositiveInt = 1
    """Only every n-th scenario."""
    seed: Seed = 0
    """Of losses, jitter and pose errors."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions(RecordingStudyOptions):
    """Options of what replays a recording with fusion methods."""

    protocol: str = "global-sort"
    """Evaluation protocol: global-sort, opencood, coalign, sparsealign; on OPV2V also coalign-opv2v, heal-opv2v; on DAIR-V2X
    dair, dair-3d, heal-dair, costr-dair, costr-dair-centred, sparsealign-dair."""
    object_class: ClassName | None = None
    """The class whose numbers are computed; by default all that the weights detect in 'evaluate', the first of them in a study."""
    workers: WorkerCount = os.cpu_count() or 1
    """How many processes share the scenarios; results do not depend on it."""
    replay_options: ReplayOptions = field(default_factory=ReplayOptions)
    """How agents collaborate."""
    pose_errors: PoseErrorOptions = field(default_factory=PoseErrorOptions)
    """Of what kind pose errors are."""


@dataclass(frozen=True, kw_only=True)
class RobustnessOptions(EvaluationOptions):
    """Options of the study robustness."""

    perturbations: tuple[str, ...] = ()
    """Perturbations by the names of the tables, such as "0.4 s" "30 % loss"; by default all."""
    checkpoints: tuple[str, ...] = ()
    """Baselines beside the methods, as name=weights.safetensors."""


@dataclass(frozen=True, kw_only=True)
class MainTableOptions(EvaluationOptions):
    """Options of the study main-table; channels and correctors replace --channel, --latency-budget-ms, --pose-correction."""

    replay_options: ReplayOptions = field(default_factory=lambda: ReplayOptions(methods=BOTH_FORMS))
    """How agents collaborate."""
    channels: tuple[str, ...] = ("its-g5-6", "ideal")
    """Channels, one table each; the ego waits 100 ms for messages, on the ideal one 0."""
    perturbations: tuple[str, ...] = ()
    """Perturbations by the names of the tables, such as clean "0.8 m"; by default clean, 0.4 s, 0.8°, 0.8 m, 30 % loss, all
    together."""
    correctors: tuple[str, ...] = ("off", "voting")
    """Pose correctors, each with every perturbation; off: none."""
    checkpoints: tuple[str, ...] = ()
    """Baselines with weights of their own, as NAME=weights.safetensors[@STRATEGY[@CORRECTOR]], in the forms of intermediate."""
    rows: tuple[str, ...] = ()
    """Only these rows, by the names of methods and baselines."""


@dataclass(frozen=True, kw_only=True)
class ByteCurvesOptions(EvaluationOptions):
    """Options of the study byte-curves; its budgets take the place of --budget-bytes."""

    replay_options: ReplayOptions = field(default_factory=lambda: ReplayOptions(methods=BOTH_FORMS))
    """How agents collaborate."""
    budgets: tuple[str, ...] = ()
    """Most bytes of a message, and "all" for no budget; by default those of the study for tokens, boxes and points."""
    checkpoints: tuple[str, ...] = ()
    """Baselines with weights of their own, as NAME=weights.safetensors[@STRATEGY[@CORRECTOR]], in the forms of intermediate."""
    rows: tuple[str, ...] = ()
    """Only these methods and baselines, by name."""


@dataclass(frozen=True, kw_only=True)
class SensorsOptions(EvaluationOptions):
    """Options of the study sensors."""

    other_data: tuple[Path, ...] = ()
    """Recordings of the same scenes with other sensors, such as carla-beams-32, in the same split; tables name them by folder."""
    laws: tuple[str, ...] = ("material", "carla", "constant", "zero", "shuffled", "low-gain-8bit")
    """Intensity laws, of recordings with material intensity; none: that of the recording alone."""
    sweeps: tuple[Literal[1, 2], ...] = (2, 1)
    """Numbers of sweeps that a detector is given."""
    tilts_deg: tuple[AngleDeg, ...] = (0.0,)
    """Tilts of all sensors, degrees, with each law and number of sweeps."""


@dataclass(frozen=True, kw_only=True)
class StrataOptions(EvaluationOptions):
    """Options of the study strata."""

    strata: tuple[str, ...] = ()
    """Splits of the data set, which are reported apart; by default all folders with scenarios."""


@dataclass(frozen=True, kw_only=True)
class AttacksOptions(EvaluationOptions):
    """Options of the study attacks."""

    replay_options: ReplayOptions = field(
        default_factory=lambda: ReplayOptions(
            methods=("late", "late-temporal", "intermediate", "intermediate-temporal"),
            channel="its-g5-6",
            budget_bytes=4096,
        )
    )
    """How agents collaborate."""
    attacks: tuple[str, ...] = ()
    """Attacks by name, the first one also with the other numbers of malicious agents; by default all."""
    defences: tuple[str, ...] = ("ray-evidence",)
    """Misbehaviour detectors by name, beside none and an oracle."""
    counts: tuple[TrialCount, ...] = (1, 2)
    """Numbers of malicious agents of the first attack; all others have their own."""
    egos: PositiveInt = 1
    """How many agents of a scenario are the ego in turn, with malicious agents around it."""
    position_sigma_m: LengthM = 0.4
    """Standard deviation of the prior positions of senders, metres."""
    heading_sigma_deg: AngleDeg = 0.4
    """Standard deviation of the prior headings of senders, degrees."""


@dataclass(frozen=True, kw_only=True)
class FalseAccusationsOptions(StudyOptions):
    """Options of the study false-accusations."""

    weights: str = "costr-small"
    """Shipped weights by name, or a .safetensors file."""
    method: str = "late"
    """Strategy of all agents."""
    defences: tuple[str, ...] = ("ray-evidence",)
    """Misbehaviour detectors by name."""
    sight: bool = False
    """Send with each message how far the space around the sender's LiDAR is free, 248 bytes, by which two trusted senders refute
    what the ego cannot see."""
    variants: tuple[Literal["clean", "glass", "rain"], ...] = ("clean", "glass", "rain")
    """Returns as simulated, through glass, or in rain."""
    towns: tuple[str, ...] = ("Town07",)
    """Towns of the drives, in turn; those of training or validation."""
    drives: TrialCount = 30
    """Number of drives; each is simulated, and no cloud is stored."""
    seconds: DurationS = 60.0
    """Length of a drive, seconds."""
    position_sigma_m: LengthM = 0.4
    """Standard deviation of the prior positions of senders, metres."""
    heading_sigma_deg: AngleDeg = 0.4
    """Standard deviation of the prior headings of senders, degrees."""
    seed: Seed = 0
    """Of scenes, pose errors, losses and returns."""
    workers: WorkerCount = 1
    """Processes that share the drives; results do not depend on it."""


@dataclass(frozen=True, kw_only=True)
class SharedBandwidthOptions(EvaluationOptions):
    """Options of the study shared-bandwidth."""

    budgets: tuple[ByteCount, ...] = ()
    """Budgets in bytes, of one message (bandwidth) or of all messages of a snapshot (shared-bandwidth); by default the study's."""
    token_selection: tuple[str, ...] = ()
    """Methods that select tokens; by default intermediate-temporal, intermediate-confidence-temporal,
    intermediate-random-temporal."""


@dataclass(frozen=True, kw_only=True)
class BandwidthOptions(SharedBandwidthOptions):
    """Options of the study bandwidth."""

    token_encodings: tuple[str, ...] = ()
    """Token encodings; by default all that the weights have."""


@dataclass(frozen=True, kw_only=True)
class AblationOptions(EvaluationOptions):
    """Options of the study ablation."""

    checkpoints: tuple[str, ...] = ()
    """Weights that are compared, as name=weights.safetensors[@BYTES], in the order of the table."""


@dataclass(frozen=True, kw_only=True)
class PoseNoiseApOptions(RobustnessOptions):
    """Options of the study pose-noise-ap."""

    correctors: tuple[str, ...] = ()
    """Pose correctors, among them feakm or a file of its weights; by default identity and voting."""


@dataclass(frozen=True, kw_only=True)
class PoseEstimationOptions(RecordingStudyOptions):
    """Options of the study pose-estimation."""

    weights: str = "costr-small"
    """Weights that detect objects: a shipped name or a .safetensors file."""
    correctors: tuple[str, ...] = ()
    """Pose correctors, among them feakm or a file of its weights; by default six."""


@dataclass(frozen=True, kw_only=True)
class FeakmOptions(RecordingStudyOptions):
    """Options of the study feakm."""

    protocol: str = "global-sort"
    """Evaluation protocol, as in 'manyeyes evaluate'."""
    weights: str = "costr-small"
    """Weights over whose detection range the protocol global-sort evaluates."""
    checkpoints: tuple[str, ...] = ()
    """Variants, as name=detector.safetensors,net.safetensors[@8]."""


@dataclass(frozen=True, kw_only=True)
class FleetStudyOptions(StudyOptions):
    """Options of studies of simulated fleets."""

    seeds: TrialCount = 3
    """Number of seeds."""
    workers: WorkerCount = 2
    """Processes that share the trials; results do not depend on it."""


@dataclass(frozen=True, kw_only=True)
class MapFusionStudyOptions(FleetStudyOptions):
    """Options of studies that compare map fusion methods."""

    methods: tuple[str, ...] = ()
    """Map fusion methods; by default all."""
    oracles: bool = False
    """Add the oracle rows: truth cut again, true poses, known association at prior and at jointly estimated poses."""


@dataclass(frozen=True, kw_only=True)
class FleetPoseNoiseOptions(MapFusionStudyOptions):
    """Options of the study fleet-pose-noise."""

    places: tuple[str, ...] = ()
    """Places; by default the four test places."""


@dataclass(frozen=True, kw_only=True)
class FusionOptions(FleetPoseNoiseOptions):
    """Options of the study fusion."""

    places: tuple[str, ...] = ()
    """Places; by default the four test places, and two of another shape in tables of their own."""
    observation_counts: tuple[TrialCount, ...] = ()
    """Counts of observations; by default 20, 60, 200."""


@dataclass(frozen=True, kw_only=True)
class AdversarialOptions(FleetStudyOptions):
    """Options of the study adversarial."""

    places: tuple[str, ...] = ()
    """Places; by default the four test places."""


@dataclass(frozen=True, kw_only=True)
class MaliciousAgentsOptions(AdversarialOptions):
    """Options of the study malicious-agents."""

    fractions: tuple[Fraction, ...] = (0.1, 0.2, 0.3, 0.4)
    """Fractions of agents that are malicious."""
    offsets_m: tuple[LengthM, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    """Metres by which they displace what they observe."""


@dataclass(frozen=True, kw_only=True)
class TuningOptions(StudyOptions):
    """Options of the study tuning."""

    methods: tuple[str, ...] = ()
    """Map fusion methods; by default all."""
    workers: WorkerCount = 2
    """Processes that share the trials; results do not depend on it."""


@dataclass(frozen=True, kw_only=True)
class MapModelOptions(FleetStudyOptions):
    """Options of studies of the map model."""

    data: Path
    """A dataset of towns, as of 'manyeyes simulate'."""
    split: str = "test"
    """Which split of it: towns outside the training set."""
    weights: tuple[str, ...] = ()
    """Map models, one a set of sensors: shipped names or .safetensors files; by default all that ship."""
    scenario_stride: PositiveInt = 1
    """Only every n-th scenario."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


@dataclass(frozen=True, kw_only=True)
class LocalMapOptions(MapModelOptions):
    """Options of the study local."""

    roadside_weights: tuple[str, ...] = ()
    """Map models of roadside units, where they have their own; those of --weights then predict for vehicles alone."""


@dataclass(frozen=True, kw_only=True)
class FullMapOptions(MapModelOptions):
    """Options of the study full-map."""

    methods: tuple[str, ...] = ()
    """Map fusion methods; by default all."""


@dataclass(frozen=True, kw_only=True)
class MapPoseNoiseOptions(MapModelOptions):
    """Options of the study map-pose-noise."""

    pose_correction: str = "voting"
    """Pose corrector, by name."""
