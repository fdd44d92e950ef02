# SPDX-License-Identifier: Apache-2.0
"""Studies that replay a recording: the setting that their conditions change, and the run of all conditions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from manyeyes._text import count_noun
from manyeyes.agents.strategies.names import TEMPORAL
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.datasets.base import RecordingReader
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, check_class, list_classes, load_detector
from manyeyes.studies.engine.conditions import Condition, ResultGrid, run_conditions
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import EvaluationOptions, RecordingStudyOptions
from manyeyes.studies.recordings import adapt_to_dataset, check_files
from manyeyes.studies.replay_options import display_name
from manyeyes.viz.curves import CurvePanel, save_curves
from manyeyes.viz.progress import track
from manyeyes.viz.study_table import StudyTable

NO_FUSION, OURS, UPPER_BOUND = "no-fusion", "intermediate", "early"
OURS_TEMPORAL = OURS + TEMPORAL
FORMS = ("", TEMPORAL)
"""Ends of names of methods without and with memory; differences are of one form."""
OURS_BY_FORM = tuple(OURS + form for form in FORMS)
ALONE = tuple(NO_FUSION + form for form in FORMS)
"""What receives nothing, and hence is the same under every perturbation."""
TOKEN_SELECTION_METHODS = (OURS_TEMPORAL, "intermediate-confidence-temporal", "intermediate-random-temporal")
PAPER_NOTE = (
    'The column "paper" holds CoSTr\'s own figures: another data set (OPV2V), unknown protocol; they are '
    "for reference only."
)


@dataclass(frozen=True)
class ReplayStudy:
    """A study of a recording.

    base: the configuration that conditions change. pose_noise: the kind of their pose errors. object_class: None is the first of
    the weights.
    """

    context: StudyContext
    opener: Callable[[], RecordingReader]
    base: BenchmarkConfig
    workers: int = 1
    pose_noise: PoseNoise = PoseNoise()
    object_class: str | None = None

    @property
    def title(self) -> str:
        """Weights, data, and how many frames."""
        return self._make_title(())

    def _make_title(self, conditions: Sequence[Condition]) -> str:
        """Return the title; where no condition has the weights of the study, it counts those that conditions have."""
        options, recording = self.context.options, self.base.filter_recording(self.opener())
        assert isinstance(options, RecordingStudyOptions)
        own, used = str(self.base.weights), {str(condition.config.weights) for condition in conditions}
        weights = f"{len(used)} weights" if used and own not in used else display_name(own)
        frames = sum(len(recording.eval_indices(name)) for name in recording.scenarios)
        data_name = f"{options.data.name}{f'/{options.split}' if options.split else ''}"
        size = f"{count_noun(len(recording.scenarios), 'scenario')}, {count_noun(frames, 'frame')}"
        class_name = f", {self.object_class}" if self.object_class else ""
        return f"{weights} on {data_name}: {size}{class_name}"

    def run(self, conditions: Sequence[Condition]) -> ResultGrid:
        """Run all conditions; stored results are not computed again."""
        with track(self.context.console, "Evaluating") as report:
            return run_conditions(self.opener, conditions, self.context.store, self.workers, report, self.object_class)

    def write_report(
        self,
        payload: dict[str, object],
        tables: Sequence[StudyTable],
        panels: Sequence[CurvePanel],
        conditions: Sequence[Condition] = (),
        notes: Sequence[str] = (),
    ) -> None:
        """Write the report, with curves as its picture; a note states the kind of pose errors."""
        options, title = self.context.options, self._make_title(conditions)
        if isinstance(options, EvaluationOptions):
            notes = (*notes, options.pose_errors.describe(options.seed))
        save_picture = partial(save_curves, panels) if panels else None
        self.context.write_report(title, payload, tables, save_picture, notes, {"conditions": conditions})


def open_study(options: RecordingStudyOptions, context: StudyContext, config: BenchmarkConfig) -> ReplayStudy:
    """Open the recording of a study, and check its files."""
    opener = partial(open_recording, options.data, options.split)
    missing = check_files(opener(), options.checks, context.console)
    context = replace(context, missing=missing, seed=options.seed)
    strides = {"frame_stride": options.frame_stride, "scenario_stride": options.scenario_stride}
    return ReplayStudy(context, opener, replace(config, **strides))


def prepare_study(options: EvaluationOptions, context: StudyContext, all_egos: bool = False) -> ReplayStudy:
    """Make the setting without any perturbation; names that are unknown are refused here, before any work."""
    replay_options = options.replay_options
    replay = replay_options.make_replay_config(options.seed, all_egos)
    config = BenchmarkConfig(replay_options.weights, replay_options.methods, options.protocol, replay)
    study = open_study(options, context, config)
    replay = adapt_to_dataset(replay, replay_options, study.opener())
    errors, classes = options.pose_errors, list_classes(load_detector(study.base.weights))
    check_class(options.object_class, classes)
    return replace(
        study,
        base=replace(study.base, replay=replay, odometry_drift=errors.make_odometry_drift(options.seed)),
        workers=options.workers,
        pose_noise=errors.make_pose_noise(options.seed),
        object_class=options.object_class or (classes[0] if len(classes) > 1 else None),
    )


def resolve_token_selection(names: Sequence[str]) -> tuple[str, ...]:
    """Return the methods of token selection that are compared: those asked for, or those of TOKEN_SELECTION_METHODS that there
    are.
    """
    for name in names:
        get_strategy(name)
    return tuple(names) or tuple(name for name in TOKEN_SELECTION_METHODS if name in list_strategies())


def parse_checkpoints(words: Sequence[str], study: str, files: str = "weights.safetensors") -> dict[str, str]:
    """Return names and files of ``name=weights.safetensors``, or whatever files the study takes."""
    pairs = [word.partition("=") for word in words]
    invalid = [word for word, (name, _, path) in zip(words, pairs) if not name or not path]
    names = [name for name, _, _ in pairs]
    if invalid or not words or len(set(names)) < len(names):
        raise ConfigError(
            f"The study '{study}' takes --checkpoints name={files} ..., each name once; got {' '.join(words) or 'none'}."
        )
    return {name: path for name, _, path in pairs}


def with_replay(config: BenchmarkConfig, **changes: object) -> BenchmarkConfig:
    """Return the configuration with some fields of its replay changed."""
    return replace(config, replay=replace(config.replay, **changes))  # pyright: ignore[reportArgumentType]
