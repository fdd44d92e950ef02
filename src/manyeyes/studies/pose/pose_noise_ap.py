# SPDX-License-Identifier: Apache-2.0
"""AP against errors of prior poses, for each way to fuse and each corrector before it: FeaKM, Tables 1 and 2.

--checkpoints name=weights.safetensors adds baseline fusions without pose correction: the paper's rows F-Cooper (preset
fusion/max) and V2X-ViT (fusion/v2x-vit). Buckets are of evaluated frames, by the minimum number of objects that the ego shares
with an agent in communication range: these are what the corrector can match. No fusion receives nothing and is run once.
"identity" keeps every prior; with true poses it is the reference of AP drops. --perturbations selects levels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.strategies.names import form_of
from manyeyes.datasets.base import Recording
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.pose.accuracy import count_common_objects
from manyeyes.evaluation.statistics.bootstrap import BootstrapSamples, Interval, bootstrap
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.pose.registry import load_corrector
from manyeyes.studies.detection.perturbations import Perturbation, select_perturbations
from manyeyes.studies.engine.conditions import Condition, ResultGrid, ResultKey
from manyeyes.studies.engine.replay_study import (
    ALONE,
    FORMS,
    NO_FUSION,
    OURS,
    parse_checkpoints,
    prepare_study,
    with_replay,
)
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import PoseNoiseApOptions
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.study_table import StudyTable, format_difference, format_interval, make_comparison_table

IDENTITY, DEFAULT_CORRECTOR = "identity", "voting"
SIGMAS = (0.0, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0)
CLEAN = Perturbation()
LEVELS = (
    CLEAN,
    Perturbation(heading_sigma_deg=0.2),
    *(Perturbation(heading_sigma_deg=s, position_sigma_m=s) for s in SIGMAS[1:]),
)
"""FeaKM's columns: metres and degrees alike, but for its second."""
SINGLE_ERROR_LEVELS = (Perturbation(heading_sigma_deg=0.8), Perturbation(position_sigma_m=0.8))
COMMON_OBJECT_RANGES = ((0, 3), (4, 7), (8, 10**9))
ALL_LEVELS = (*LEVELS, *SINGLE_ERROR_LEVELS)
LISTED_LEVELS = (CLEAN, LEVELS[4], LEVELS[-1])
"""Levels whose frames are listed by objects in common."""
CommonObjects = dict[tuple[str, int], int]
"""How many objects the ego has in common with others, by scenario and index."""
PAPER_NOTE = "The last tables are FeaKM's own: DAIR-V2X, CoAlign's protocol; they are for reference only."
PAPER_AP = (
    ("MASH", (.400,) * 11, (.244,) * 11),
    ("F-Cooper", (.740, .723, .703, .693, .676, .672, .670, .662, .659, .658, .650),
     (.579, .572, .563, .555, .553, .546, .546, .542, .540, .534, .533)),
    ("V2X-ViT", (.713, .706, .693, .680, .670, .664, .654, .651, .643, .638, .637),
     (.544, .539, .536, .531, .526, .523, .522, .520, .516, .512, .510)),
    ("CoAlign", (.762, .746, .725, .701, .687, .680, .671, .664, .659, .658, .654),
     (.625, .596, .582, .575, .570, .567, .564, .559, .558, .557, .555)),
    ("FeaKM, 4 pairs", (.726, .718, .711, .703, .697, .697, .695, .694, .694, .694, .692),
     (.593, .579, .577, .573, .572, .572, .571, .571, .571, .571, .571)),
    ("FeaKM, 8 pairs", (.768, .753, .716, .705, .690, .686, .678, .673, .670, .667, .668),
     (.631, .601, .577, .573, .570, .566, .561, .563, .560, .558, .558)),
)  # fmt: skip


@dataclass(frozen=True)
class PoseNoiseRow:
    """A method, or a baseline's weights, with a corrector at a noise level. ap: at each IoU; ap_drop: AP less than with true poses
    and no corrector; gain_over_no_fusion: AP more than no fusion. ap_by_common_objects: AP@0.5 of each bucket of objects in common.
    """

    corrector: str
    method: str
    level: Perturbation
    ap: tuple[Interval, Interval]
    ap_drop: tuple[Interval, Interval] | None
    gain_over_no_fusion: tuple[Interval, Interval] | None
    ap_by_common_objects: tuple[Interval, ...]
    bytes_per_message: float


def run(options: PoseNoiseApOptions, context: StudyContext) -> None:
    """Run the study of AP under pose noise and write its report."""
    study = prepare_study(options, context)
    names = options.correctors or (IDENTITY, DEFAULT_CORRECTOR)
    levels = select_perturbations(options.perturbations, ALL_LEVELS)
    for name in names:
        load_corrector(name)
    collaborative = tuple(m for m in study.base.methods if m not in ALONE)
    base = replace(study.base, methods=collaborative)
    conditions = [
        Condition(condition_name(name, level), apply_level(base, level, name, study.pose_noise))
        for name in names
        for level in levels
        if collaborative
    ]
    baselines = parse_checkpoints(options.checkpoints, "pose-noise-ap") if options.checkpoints else {}
    for baseline, weights in baselines.items():
        base = replace(study.base, methods=(OURS,), weights=weights)
        conditions += [
            Condition(condition_name(baseline, level), level.apply_to(base, study.pose_noise)) for level in levels
        ]
    if alone := tuple(m for m in study.base.methods if m in ALONE):
        conditions.append(Condition(NO_FUSION, CLEAN.apply_to(replace(study.base, methods=alone))))
    results = study.run(conditions)
    recording = study.base.filter_recording(study.opener())
    common = count_common_objects_by_frame(recording, study.base.replay.comm_range_m)
    result_rows = make_rows(results, names, common, tuple(baselines))
    comparisons = make_comparisons(results, names, common)
    tables = [
        *(_make_ap_table(f"AP@{iou:g}", result_rows, k) for k, iou in enumerate(IOU_THRESHOLDS)),
        _make_common_objects_table(result_rows),
        make_comparison_table(comparisons),
        *(_make_paper_table(k) for k in range(len(IOU_THRESHOLDS))),
    ]
    payload: dict[str, object] = {
        "rows": result_rows,
        "comparisons": comparisons,
        "frames": {_format_range(b): sum(b[0] <= n <= b[1] for n in common.values()) for b in COMMON_OBJECT_RANGES},
        "paper": {"note": PAPER_NOTE, "rows": PAPER_AP},
    }
    study.write_report(payload, tables, make_panels(result_rows), conditions, (PAPER_NOTE,))


def apply_level(config: BenchmarkConfig, level: Perturbation, corrector: str, pose_noise: PoseNoise) -> BenchmarkConfig:
    """Apply a level of noise of that kind, with a corrector before every fusion."""
    correction = None if corrector == IDENTITY else PoseCorrection(corrector)
    return with_replay(level.apply_to(config, pose_noise), pose_correction=correction)


def condition_name(name: str, level: Perturbation) -> str:
    """Return the name of a condition."""
    return f"{name}: {level.name}"


def count_common_objects_by_frame(recording: Recording, max_range_m: float) -> CommonObjects:
    """Return how many objects the ego has in common with others, by scenario and index."""
    return {
        (scenario, index): count_common_objects(recording.snapshot(scenario, index), max_range_m)
        for scenario in recording.scenarios
        for index in recording.eval_indices(scenario)
    }


def make_rows(
    results: ResultGrid,
    names: Sequence[str],
    common: CommonObjects,
    baselines: Sequence[str] = (),
) -> tuple[PoseNoiseRow, ...]:
    """Return the table, corrector by corrector, method by method, level by level; then baseline fusions without correction."""
    out = []
    for name in names:
        methods = [method for condition, method in results.results if condition == condition_name(name, CLEAN)]
        for method in methods:
            clean_key = (condition_name(IDENTITY, CLEAN), method)
            for level in _select_evaluated(results, name, method):
                key = (condition_name(name, level), method)
                out.append(_make_row(results, name, level, key, clean_key, common))
    for baseline in baselines:
        for level in _select_evaluated(results, baseline, OURS):
            key, clean_key = ((condition_name(baseline, row_level), OURS) for row_level in (level, CLEAN))
            out.append(replace(_make_row(results, IDENTITY, level, key, clean_key, common), method=baseline))
    return tuple(out)


def _select_evaluated(results: ResultGrid, name: str, method: str) -> tuple[Perturbation, ...]:
    return tuple(level for level in ALL_LEVELS if (condition_name(name, level), method) in results.results)


def _make_row(
    results: ResultGrid,
    name: str,
    level: Perturbation,
    key: ResultKey,
    clean_key: ResultKey,
    common: CommonObjects,
) -> PoseNoiseRow:
    no_fusion_key = (NO_FUSION, NO_FUSION + form_of(key[1]))
    return PoseNoiseRow(
        name,
        key[1],
        level,
        results.ap_pair(key),
        results.difference_pair(clean_key, key),
        results.difference_pair(key, no_fusion_key),
        tuple(_bootstrap(results, key, bucket, common).interval() for bucket in COMMON_OBJECT_RANGES),
        results.results[key].bytes_per_message,
    )


def _bootstrap(results: ResultGrid, key: ResultKey, bucket: tuple[int, int], common: CommonObjects) -> BootstrapSamples:
    """Return AP@0.5 of a cell over the frames with so many common objects."""
    matches = results.results[key].matches[0]
    selected = [m for m in matches if bucket[0] <= common[m.scenario, m.index] <= bucket[1]]
    return bootstrap(selected, protocol=results.protocol)


def make_comparisons(results: ResultGrid, names: Sequence[str], common: CommonObjects) -> tuple[Comparison, ...]:
    """Compare each corrector before the project's own fusion with true poses and with no fusion of the same form; and the default
    corrector with each other one.
    """
    evaluated = [OURS + form for form in FORMS if (condition_name(IDENTITY, CLEAN), OURS + form) in results.results]
    correctors = [name for name in names if name != IDENTITY]
    others = [name for name in correctors if name != DEFAULT_CORRECTOR] if DEFAULT_CORRECTOR in names else []
    return tuple(
        c
        for ours in evaluated
        for part in (
            *(_compare_corrector(results, name, ours, common) for name in correctors),
            *(_compare_with_default(results, name, ours, common) for name in others),
        )
        for c in part
    )


def _compare_corrector(results: ResultGrid, name: str, ours: str, common: CommonObjects) -> Iterator[Comparison]:
    """Compare with true poses: without noise, under a single noise, and under the largest by common objects; and the worst level
    with no fusion.
    """
    clean_key, no_fusion_key = (condition_name(IDENTITY, CLEAN), ours), (NO_FUSION, NO_FUSION + form_of(ours))
    stem = Path(name).stem + form_of(ours)
    keys = {level: (condition_name(name, level), ours) for level in _select_evaluated(results, name, ours)}
    for level, key in keys.items():
        if level in (CLEAN, *SINGLE_ERROR_LEVELS):
            yield results.compare(f"{stem}, {level.name}: corrected - true poses", key, clean_key)
    for bucket in COMMON_OBJECT_RANGES:
        samples = {level: _bootstrap(results, key, bucket, common) for level, key in keys.items()}
        if not samples[CLEAN].names:
            continue
        which = f"{_format_range(bucket)} in common"
        if bucket != COMMON_OBJECT_RANGES[0] and LEVELS[-1] in samples:
            difference = samples[LEVELS[-1]].paired_difference(_bootstrap(results, clean_key, bucket, common))
            yield Comparison(f"{stem}, {LEVELS[-1].name}, {which}: corrected - true poses", "AP@0.5", difference)
        if no_fusion_key in results.results:
            no_fusion = _bootstrap(results, no_fusion_key, bucket, common)
            gains = {level: one.paired_difference(no_fusion) for level, one in samples.items()}
            worst = min(gains, key=lambda level: gains[level].value)
            description = f"{stem}, worst level ({worst.name}), {which}: corrected - no fusion"
            yield Comparison(description, "AP@0.5", gains[worst])


def _compare_with_default(results: ResultGrid, name: str, ours: str, common: CommonObjects) -> Iterator[Comparison]:
    """Compare the default corrector with another: at single errors, and without and with the largest error by common objects."""
    stem = f"{DEFAULT_CORRECTOR}{form_of(ours)} - {Path(name).stem}{form_of(ours)}"
    for level in _select_evaluated(results, name, ours):
        key, other = (condition_name(DEFAULT_CORRECTOR, level), ours), (condition_name(name, level), ours)
        if level in (CLEAN, *SINGLE_ERROR_LEVELS, LEVELS[-1]):
            yield results.compare(f"{stem}, {level.name}", key, other)
        for bucket in COMMON_OBJECT_RANGES if level in (CLEAN, LEVELS[-1]) else ():
            samples = _bootstrap(results, key, bucket, common)
            if samples.names:
                difference = samples.paired_difference(_bootstrap(results, other, bucket, common))
                yield Comparison(f"{stem}, {level.name}, {_format_range(bucket)} in common", "AP@0.5", difference)


def _format_range(bucket: tuple[int, int]) -> str:
    return f"{bucket[0]} and more" if bucket[1] >= 10**9 else f"{bucket[0]} to {bucket[1]}"


def _make_ap_table(title: str, result_rows: Sequence[PoseNoiseRow], iou: int) -> StudyTable:
    row_by_key = {(row.corrector, row.method, row.level): row for row in result_rows}
    levels = [level for level in ALL_LEVELS if any(row.level == level for row in result_rows)]
    lines = tuple(
        (name, method, *(format_interval(row_by_key[name, method, level].ap[iou]) for level in levels))
        for name, method in dict.fromkeys((row.corrector, row.method) for row in result_rows)
    )
    return StudyTable(title, ("corrector", "fusion", *(level.name for level in levels)), lines)


def _make_common_objects_table(result_rows: Sequence[PoseNoiseRow]) -> StudyTable:
    listed = [row for row in result_rows if row.level in LISTED_LEVELS]
    lines = tuple(
        (
            row.corrector,
            row.method,
            row.level.name,
            *map(format_interval, row.ap_by_common_objects),
            format_difference(-row.ap_drop[0]) if row.ap_drop else "",
            format_difference(row.gain_over_no_fusion[0]) if row.gain_over_no_fusion else "",
        )
        for row in listed
    )
    buckets = tuple(f"{_format_range(b)} in common" for b in COMMON_OBJECT_RANGES)
    return StudyTable(
        "AP@0.5 by common objects",
        ("corrector", "fusion", "noise", *buckets, "ΔAP vs. clean", "gain over no fusion"),
        lines,
    )


def _make_paper_table(iou: int) -> StudyTable:
    lines = tuple((name, *(f"{v:.3f}" for v in aps[iou])) for name, *aps in PAPER_AP)
    title = f"FeaKM's Table {iou + 1}, AP@{IOU_THRESHOLDS[iou]:g}: another data set"
    return StudyTable(title, ("method", *(level.name for level in LEVELS)), lines)


def make_panels(result_rows: Sequence[PoseNoiseRow]) -> list[CurvePanel]:
    """Return AP against sigma at both IoUs, a line for each corrector and fusion."""
    row_by_key = {(row.corrector, row.method, row.level): row for row in result_rows}
    evaluated = {row.level for row in result_rows}
    levels = [level for level in LEVELS if level.position_sigma_m == level.heading_sigma_deg and level in evaluated]
    sigmas = tuple(level.position_sigma_m for level in levels)
    out = []
    for iou, threshold in enumerate(IOU_THRESHOLDS):
        curves = tuple(
            Curve(f"{method}, {name}", tuple(row_by_key[name, method, level].ap[iou] for level in levels), sigmas)
            for name, method in dict.fromkeys((row.corrector, row.method) for row in result_rows)
        )
        out.append(CurvePanel("Pose noise", "sigma, metres and degrees", f"AP@{threshold:g}", curves))
    return out
