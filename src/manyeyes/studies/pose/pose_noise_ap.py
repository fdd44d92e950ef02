# SPDX-License-Identifier: Apache-2.0
"""AP against errors of claimed poses, for each way to fuse and each corrector before it: FeaKM, Tables 1 and 2.

--checkpoints name=weights.safetensors adds baseline fusions without pose correction: the paper's rows F-Cooper (preset
ablation/se-dast, the maximum) and V2X-ViT (ablation/v2x-vit). Buckets are of evaluated frames, by the minimum number of objects
that the ego shares with an agent in communication range: these are what the corrector can match. No fusion receives nothing and
is run once. "identity" keeps every prior; with true poses it is the reference of AP drops. --perturbations selects levels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.datasets.base import Recording
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS
from manyeyes.evaluation.detection.average_precision import FrameMatch
from manyeyes.evaluation.pose.accuracy import count_common_objects
from manyeyes.evaluation.statistics.bootstrap import Interval, compare_to_margin, paired_difference, scenario_interval
from manyeyes.evaluation.statistics.significance import MarginTest
from manyeyes.evaluation.study import Condition, ResultGrid, ResultKey
from manyeyes.pose.registry import load_corrector
from manyeyes.studies.detection.ablation import parse_checkpoints
from manyeyes.studies.detection.perturbations import Perturbation, select_perturbations
from manyeyes.studies.running import (
    NO_FUSION,
    OURS,
    make_margin_table,
    prepare_study,
    run_study,
    with_replay,
    write_study_report,
)
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.study_table import StudyTable, format_difference, format_interval

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

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
MAX_AP_DROP = {COMMON_OBJECT_RANGES[1]: 0.04, COMMON_OBJECT_RANGES[2]: 0.01}
ALL_LEVELS = (*LEVELS, *SINGLE_ERROR_LEVELS)
LISTED_LEVELS = (CLEAN, LEVELS[4], LEVELS[-1])
"""Levels whose frames are listed by objects in common."""
MAX_SINGLE_ERROR_AP_DROP = dict(zip(SINGLE_ERROR_LEVELS, (0.054, 0.044)))
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


def run(options: Options, console: Console) -> None:
    """Run the study of AP under pose noise and write its report."""
    context = prepare_study(options, console)
    names, levels = (
        options.correctors or (IDENTITY, DEFAULT_CORRECTOR),
        select_perturbations(options.perturbations, ALL_LEVELS),
    )
    for name in names:
        load_corrector(name)
    collaborative = tuple(m for m in context.base.methods if m != NO_FUSION)
    conditions = [
        Condition(
            condition_name(name, level), make_configurator(level, name)(replace(context.base, methods=collaborative))
        )
        for name in names
        for level in levels
        if collaborative
    ]
    baselines = parse_checkpoints(options.checkpoints, "pose-noise-ap") if options.checkpoints else {}
    for baseline, weights in baselines.items():
        base = replace(context.base, methods=(OURS,), weights=weights)
        conditions += [Condition(condition_name(baseline, level), level.apply_to(base)) for level in levels]
    if NO_FUSION in context.base.methods:
        conditions.append(Condition(NO_FUSION, CLEAN.apply_to(replace(context.base, methods=(NO_FUSION,)))))
    results = run_study(context, conditions)
    common_objects_by_frame = count_common_objects_by_frame(
        context.base.filter_recording(context.opener()), context.base.replay.comm_range_m
    )
    result_rows, margin_tests = (
        make_rows(results, names, common_objects_by_frame, tuple(baselines)),
        check_margins(results, names, common_objects_by_frame),
    )
    tables = [_make_ap_table(f"AP@{iou:g}", result_rows, k) for k, iou in enumerate(IOU_THRESHOLDS)]
    tables += [
        _make_common_objects_table(result_rows),
        make_margin_table(margin_tests),
        *(_make_paper_table(k) for k in range(len(IOU_THRESHOLDS))),
    ]
    payload: dict[str, object] = {
        "rows": result_rows,
        "margin_tests": margin_tests,
        "frames": {
            _format_range(b): sum(b[0] <= n <= b[1] for n in common_objects_by_frame.values())
            for b in COMMON_OBJECT_RANGES
        },
        "paper": {"note": PAPER_NOTE, "rows": PAPER_AP},
    }
    write_study_report(context, payload, tables, make_panels(result_rows), conditions, (PAPER_NOTE,))


def make_configurator(level: Perturbation, name: str) -> Callable:
    """A configuration under a level of error, with a corrector before every fusion."""
    correction = None if name == IDENTITY else PoseCorrection(name)
    return lambda config: with_replay(level.apply_to(config), pose_correction=correction)


def condition_name(name: str, level: Perturbation) -> str:
    """The name of a condition."""
    return f"{name}: {level.name}"


def count_common_objects_by_frame(recording: Recording, max_range_m: float) -> dict[tuple[str, int], int]:
    """How many objects the ego has in common with others, by scenario and index."""
    return {
        (scenario, index): count_common_objects(recording.snapshot(scenario, index), max_range_m)
        for scenario in recording.scenarios
        for index in recording.eval_indices(scenario)
    }


def make_rows(
    results: ResultGrid,
    names: Sequence[str],
    common_objects_by_frame: dict[tuple[str, int], int],
    baselines: Sequence[str] = (),
) -> tuple[PoseNoiseRow, ...]:
    """The table, corrector by corrector, method by method, level by level; then baseline fusions without correction."""
    out = []
    for name in names:
        methods = [method for condition, method in results.results if condition == condition_name(name, CLEAN)]
        for method in methods:
            clean_key = (condition_name(IDENTITY, CLEAN), method)
            for level in _select_evaluated(results, name, method):
                key = (condition_name(name, level), method)
                out.append(_make_row(results, name, level, key, clean_key, common_objects_by_frame))
    for baseline in baselines:
        for level in _select_evaluated(results, baseline, OURS):
            key, clean_key = ((condition_name(baseline, row_level), OURS) for row_level in (level, CLEAN))
            out.append(
                replace(_make_row(results, IDENTITY, level, key, clean_key, common_objects_by_frame), method=baseline)
            )
    return tuple(out)


def _select_evaluated(results: ResultGrid, name: str, method: str) -> tuple[Perturbation, ...]:
    return tuple(level for level in ALL_LEVELS if (condition_name(name, level), method) in results.results)


def _make_row(
    results: ResultGrid,
    name: str,
    level: Perturbation,
    key: ResultKey,
    clean_key: ResultKey,
    common_objects_by_frame: dict[tuple[str, int], int],
) -> PoseNoiseRow:
    no_fusion_key = (NO_FUSION, NO_FUSION)
    return PoseNoiseRow(
        name,
        key[1],
        level,
        (results.bootstrap_ap(key, 0), results.bootstrap_ap(key, 1)),
        (results.paired_difference(clean_key, key, 0), results.paired_difference(clean_key, key, 1))
        if clean_key in results.results
        else None,
        (results.paired_difference(key, no_fusion_key, 0), results.paired_difference(key, no_fusion_key, 1))
        if no_fusion_key in results.results
        else None,
        tuple(
            scenario_interval(_select_frames(results, key, bucket, common_objects_by_frame), protocol=results.protocol)
            for bucket in COMMON_OBJECT_RANGES
        ),
        results.results[key].bytes_per_message,
    )


def _select_frames(
    results: ResultGrid,
    key: ResultKey,
    bucket: tuple[int, int],
    common_objects_by_frame: dict[tuple[str, int], int],
    iou: int = 0,
) -> list[FrameMatch]:
    """The frames of a cell with so many objects in common."""
    selected = [
        m
        for m in results.results[key].matches[iou]
        if bucket[0] <= common_objects_by_frame[m.scenario, m.index] <= bucket[1]
    ]
    return selected


def check_margins(
    results: ResultGrid, names: Sequence[str], common_objects_by_frame: dict[tuple[str, int], int]
) -> tuple[MarginTest, ...]:
    """What is claimed of correctors before the project's own fusion, of those that were played."""
    if (condition_name(IDENTITY, CLEAN), OURS) not in results.results:
        return ()
    return tuple(
        margin_test
        for name in names
        if name != IDENTITY
        for margin_test in _check_corrector(results, name, common_objects_by_frame)
    )


def _check_corrector(
    results: ResultGrid, name: str, common_objects_by_frame: dict[tuple[str, int], int]
) -> Iterator[MarginTest]:
    """Nothing is lost where claims are true, little where heading or place alone is off; at the worst, little where enough
    objects are shared; and at no level is no fusion better.
    """
    clean_key, corrector_name, evaluated = (
        (condition_name(IDENTITY, CLEAN), OURS),
        Path(name).stem,
        _select_evaluated(results, name, OURS),
    )
    max_drops = {CLEAN: 0.002, **MAX_SINGLE_ERROR_AP_DROP}
    for level in evaluated:
        if level in max_drops:
            paired_drop = results.paired_difference((condition_name(name, level), OURS), clean_key, 0)
            yield _check_margin(
                f"{corrector_name}, {level.name}: corrected - true claims", paired_drop, -max_drops[level]
            )
    for bucket in COMMON_OBJECT_RANGES:
        frames_by_level = {
            level: _select_frames(results, (condition_name(name, level), OURS), bucket, common_objects_by_frame)
            for level in evaluated
        }
        if not frames_by_level[CLEAN]:
            continue
        if bucket in MAX_AP_DROP and LEVELS[-1] in frames_by_level:
            paired_drop = paired_difference(
                frames_by_level[LEVELS[-1]],
                _select_frames(results, clean_key, bucket, common_objects_by_frame),
                protocol=results.protocol,
            )
            description = (
                f"{corrector_name}, {LEVELS[-1].name}, {_format_range(bucket)} in common: corrected - true claims"
            )
            yield _check_margin(description, paired_drop, -MAX_AP_DROP[bucket])
        if (NO_FUSION, NO_FUSION) in results.results:
            no_fusion_frames = _select_frames(results, (NO_FUSION, NO_FUSION), bucket, common_objects_by_frame)
            gains = {
                level: paired_difference(frames, no_fusion_frames, protocol=results.protocol)
                for level, frames in frames_by_level.items()
            }
            worst_level = min(gains, key=lambda level: gains[level].value)
            description = (
                f"{corrector_name}, worst level ({worst_level.name}), {_format_range(bucket)} in common: "
                "corrected - none"
            )
            yield _check_margin(description, gains[worst_level], 0.0)


def _check_margin(description: str, difference: Interval, margin: float) -> MarginTest:
    has_several_scenarios = difference.num_scenarios > 1
    verdict = compare_to_margin(margin, difference.low, difference.high) if has_several_scenarios else "inconclusive"
    return MarginTest(description, IOU_THRESHOLDS[0], difference, margin, verdict)


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
            format_difference(row.ap_drop[0]) if row.ap_drop else "",
            format_difference(row.gain_over_no_fusion[0]) if row.gain_over_no_fusion else "",
        )
        for row in listed
    )
    buckets = tuple(f"{_format_range(b)} in common" for b in COMMON_OBJECT_RANGES)
    return StudyTable(
        "AP@0.5 by objects in common", ("corrector", "fusion", "errors", *buckets, "lost", "over no fusion"), lines
    )


def _make_paper_table(iou: int) -> StudyTable:
    lines = tuple((name, *(f"{v:.3f}" for v in aps[iou])) for name, *aps in PAPER_AP)
    title = f"FeaKM's Table {iou + 1}, AP@{IOU_THRESHOLDS[iou]:g}: another data set"
    return StudyTable(title, ("method", *(level.name for level in LEVELS)), lines)


def make_panels(result_rows: Sequence[PoseNoiseRow]) -> list[CurvePanel]:
    """AP against sigma at both IoUs, a line for each corrector and fusion."""
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
        out.append(CurvePanel("Errors of claimed poses", "sigma, metres and degrees", f"AP@{threshold:g}", curves))
    return out
