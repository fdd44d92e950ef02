# SPDX-License-Identifier: Apache-2.0
"""AP against errors of claimed poses, for each way to fuse and each corrector before it: FeaKM, Tables 1 and 2.

--branches name=weights.safetensors adds rival fusions, which believe every claim: the paper's rows F-Cooper (preset
branch-se-dast, the maximum) and V2X-ViT (branch-v2x-vit). Buckets are of judged frames, by the fewest objects that the ego shares
with any agent within reach of its radio: the corrector has that much to go by. Ego alone hears nobody and is played once. "given"
believes every claim; with true ones it is the oracle that losses are taken from. --disturbances plays some levels alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes.agents.pose_correction import Aligner
from manyeyes.datasets.base import Recording
from manyeyes.evaluation.detection.accumulator import IOUS
from manyeyes.evaluation.detection.average_precision import FrameMatch
from manyeyes.evaluation.pose.accuracy import common_objects
from manyeyes.evaluation.statistics.bootstrap import Interval, paired_difference, resolved, scenario_interval
from manyeyes.evaluation.statistics.significance import Claim
from manyeyes.evaluation.study import Condition, Place, Sweep
from manyeyes.pose.registry import corrector
from manyeyes.studies.detection.ablation import branches_of
from manyeyes.studies.detection.perturbations import Disturbance, chosen
from manyeyes.studies.running import ALONE, OURS, carry_out, claims_sheet, publish, start, with_replay
from manyeyes.viz.curves import Curve, Panel
from manyeyes.viz.study_table import Sheet, change, value

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

GIVEN, DEFAULT = "given", "vote"
SIGMAS = (0.0, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0)
CLEAN = Disturbance()
LEVELS = (
    CLEAN,
    Disturbance(heading_deg=0.2),
    *(Disturbance(heading_deg=s, position_m=s) for s in SIGMAS[1:]),
)
"""FeaKM's columns: metres and degrees alike, but for its second."""
APART = (Disturbance(heading_deg=0.8), Disturbance(position_m=0.8))
COMMON = ((0, 3), (4, 7), (8, 10**9))
LOSES_AT_MOST = {COMMON[1]: 0.04, COMMON[2]: 0.01}
ALL = (*LEVELS, *APART)
SHOWN = (CLEAN, LEVELS[4], LEVELS[-1])
"""Levels whose frames are listed by objects in common."""
APART_AT_MOST = dict(zip(APART, (0.054, 0.044)))
PAPER = "The last tables are FeaKM's own: DAIR-V2X, CoAlign's protocol; they are no bar and no rival."
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
class Row:
    """A way to fuse (a method, or a rival's weights) behind a corrector, under a level of error. ap: at each IoU; lost: AP less
    than the same way to fuse has with true poses and no corrector; over_alone: more than ego alone. by_common: AP@0.5 of each
    bucket of COMMON.
    """

    corrector: str
    method: str
    level: Disturbance
    ap: tuple[Interval, Interval]
    lost: tuple[Interval, Interval] | None
    over_alone: tuple[Interval, Interval] | None
    by_common: tuple[Interval, ...]
    bytes_per_message: float


def run(options: Options, console: Console) -> None:
    """The study."""
    begun = start(options, console)
    names, levels = options.correctors or (GIVEN, DEFAULT), chosen(options.disturbances, ALL)
    for name in names:
        corrector(name)
    hearing = tuple(m for m in begun.base.methods if m != ALONE)
    conditions = [
        Condition(place_name(name, level), aligned(level, name)(replace(begun.base, methods=hearing)))
        for name in names
        for level in levels
        if hearing
    ]
    rivals = branches_of(options.branches, "pose") if options.branches else {}
    for rival, weights in rivals.items():
        base = replace(begun.base, methods=(OURS,), weights=weights)
        conditions += [Condition(place_name(rival, level), level.on(base)) for level in levels]
    if ALONE in begun.base.methods:
        conditions.append(Condition(ALONE, CLEAN.on(replace(begun.base, methods=(ALONE,)))))
    done = carry_out(begun, conditions)
    common = shared(begun.base.view(begun.opener()), begun.base.replay.reach_m)
    table, held = rows(done, names, common, tuple(rivals)), claims(done, names, common)
    sheets = [_sheet(f"AP@{iou:g}", table, k) for k, iou in enumerate(IOUS)]
    sheets += [_by_common(table), claims_sheet(held), *(_paper(k) for k in range(len(IOUS)))]
    payload: dict[str, object] = {
        "rows": table,
        "claims": held,
        "frames": {_bucket(b): sum(b[0] <= n <= b[1] for n in common.values()) for b in COMMON},
        "paper": {"note": PAPER, "rows": PAPER_AP},
    }
    publish(begun, payload, sheets, panels(table), conditions, (PAPER,))


def aligned(level: Disturbance, name: str) -> Callable:
    """A configuration under a level of error, with a corrector before every fusion."""
    aligner = None if name == GIVEN else Aligner(name)
    return lambda config: with_replay(level.on(config), aligner=aligner)


def place_name(name: str, level: Disturbance) -> str:
    """The name of a condition."""
    return f"{name}: {level.name}"


def shared(recording: Recording, reach_m: float) -> dict[tuple[str, int], int]:
    """How many objects the ego has in common with others, by scenario and index."""
    return {
        (scenario, index): common_objects(recording.snapshot(scenario, index), reach_m)
        for scenario in recording.scenarios
        for index in recording.judged(scenario)
    }


def rows(
    done: Sweep, names: Sequence[str], common: dict[tuple[str, int], int], rivals: Sequence[str] = ()
) -> tuple[Row, ...]:
    """The table, corrector by corrector, method by method, level by level; then rival fusions, which believe every claim."""
    out = []
    for name in names:
        methods = [method for condition, method in done.cells if condition == place_name(name, CLEAN)]
        for method in methods:
            clean = (place_name(GIVEN, CLEAN), method)
            for level in _played(done, name, method):
                place = (place_name(name, level), method)
                out.append(_row(done, name, level, place, clean, common))
    for rival in rivals:
        for level in _played(done, rival, OURS):
            place, clean = ((place_name(rival, at), OURS) for at in (level, CLEAN))
            out.append(replace(_row(done, GIVEN, level, place, clean, common), method=rival))
    return tuple(out)


def _played(done: Sweep, name: str, method: str) -> tuple[Disturbance, ...]:
    return tuple(level for level in ALL if (place_name(name, level), method) in done.cells)


def _row(
    done: Sweep, name: str, level: Disturbance, place: Place, clean: Place, common: dict[tuple[str, int], int]
) -> Row:
    alone = (ALONE, ALONE)
    return Row(
        name,
        place[1],
        level,
        (done.ap(place, 0), done.ap(place, 1)),
        (done.less(clean, place, 0), done.less(clean, place, 1)) if clean in done.cells else None,
        (done.less(place, alone, 0), done.less(place, alone, 1)) if alone in done.cells else None,
        tuple(scenario_interval(_some(done, place, bucket, common), protocol=done.protocol) for bucket in COMMON),
        done.cells[place].bytes_per_message,
    )


def _some(
    done: Sweep, place: Place, bucket: tuple[int, int], common: dict[tuple[str, int], int], iou: int = 0
) -> list[FrameMatch]:
    """The frames of a cell with so many objects in common."""
    kept = [m for m in done.cells[place].matches[iou] if bucket[0] <= common[m.scenario, m.index] <= bucket[1]]
    return kept


def claims(done: Sweep, names: Sequence[str], common: dict[tuple[str, int], int]) -> tuple[Claim, ...]:
    """What is claimed of correctors before the project's own fusion, of those that were played."""
    if (place_name(GIVEN, CLEAN), OURS) not in done.cells:
        return ()
    return tuple(found for name in names if name != GIVEN for found in _claims_of(done, name, common))


def _claims_of(done: Sweep, name: str, common: dict[tuple[str, int], int]) -> Iterator[Claim]:
    """Nothing is lost where claims are true, little where heading or place alone is off; at the worst, little where enough
    objects are shared; and at no level does it pay to hear nobody.
    """
    clean, who, played = (place_name(GIVEN, CLEAN), OURS), Path(name).stem, _played(done, name, OURS)
    most = {CLEAN: 0.002, **APART_AT_MOST}
    for level in played:
        if level in most:
            less = done.less((place_name(name, level), OURS), clean, 0)
            yield _claim(f"{who}, {level.name}: corrected - true claims", less, -most[level])
    for bucket in COMMON:
        some = {level: _some(done, (place_name(name, level), OURS), bucket, common) for level in played}
        if not some[CLEAN]:
            continue
        if bucket in LOSES_AT_MOST and LEVELS[-1] in some:
            less = paired_difference(some[LEVELS[-1]], _some(done, clean, bucket, common), protocol=done.protocol)
            what = f"{who}, {LEVELS[-1].name}, {_bucket(bucket)} in common: corrected - true claims"
            yield _claim(what, less, -LOSES_AT_MOST[bucket])
        if (ALONE, ALONE) in done.cells:
            alone = _some(done, (ALONE, ALONE), bucket, common)
            gains = {level: paired_difference(frames, alone, protocol=done.protocol) for level, frames in some.items()}
            least = min(gains, key=lambda level: gains[level].value)
            what = f"{who}, worst level ({least.name}), {_bucket(bucket)} in common: corrected - alone"
            yield _claim(what, gains[least], 0.0)


def _claim(what: str, difference: Interval, bar: float) -> Claim:
    several = difference.scenarios > 1
    verdict = resolved(bar, difference.low, difference.high) if several else "not resolved"
    return Claim(what, IOUS[0], difference, bar, verdict)


def _bucket(bucket: tuple[int, int]) -> str:
    return f"{bucket[0]} and more" if bucket[1] >= 10**9 else f"{bucket[0]} to {bucket[1]}"


def _sheet(title: str, table: Sequence[Row], iou: int) -> Sheet:
    by_place = {(row.corrector, row.method, row.level): row for row in table}
    levels = [level for level in ALL if any(row.level == level for row in table)]
    lines = tuple(
        (name, method, *(value(by_place[name, method, level].ap[iou]) for level in levels))
        for name, method in dict.fromkeys((row.corrector, row.method) for row in table)
    )
    return Sheet(title, ("corrector", "fusion", *(level.name for level in levels)), lines)


def _by_common(table: Sequence[Row]) -> Sheet:
    shown = [row for row in table if row.level in SHOWN]
    lines = tuple(
        (
            row.corrector,
            row.method,
            row.level.name,
            *map(value, row.by_common),
            change(row.lost[0]) if row.lost else "",
            change(row.over_alone[0]) if row.over_alone else "",
        )
        for row in shown
    )
    buckets = tuple(f"{_bucket(b)} in common" for b in COMMON)
    return Sheet(
        "AP@0.5 by objects in common", ("corrector", "fusion", "errors", *buckets, "lost", "over alone"), lines
    )


def _paper(iou: int) -> Sheet:
    lines = tuple((name, *(f"{v:.3f}" for v in aps[iou])) for name, *aps in PAPER_AP)
    title = f"FeaKM's Table {iou + 1}, AP@{IOUS[iou]:g}: another data set"
    return Sheet(title, ("method", *(level.name for level in LEVELS)), lines)


def panels(table: Sequence[Row]) -> list[Panel]:
    """AP against sigma at both IoUs, a line for each corrector and fusion."""
    by_place = {(row.corrector, row.method, row.level): row for row in table}
    played = {row.level for row in table}
    levels = [level for level in LEVELS if level.position_m == level.heading_deg and level in played]
    sigmas = tuple(level.position_m for level in levels)
    out = []
    for iou, threshold in enumerate(IOUS):
        curves = tuple(
            Curve(f"{method}, {name}", tuple(by_place[name, method, level].ap[iou] for level in levels), sigmas)
            for name, method in dict.fromkeys((row.corrector, row.method) for row in table)
        )
        out.append(Panel("Errors of claimed poses", "sigma, metres and degrees", f"AP@{threshold:g}", curves))
    return out
