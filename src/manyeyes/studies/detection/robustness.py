# SPDX-License-Identifier: Apache-2.0
"""How much delay, errors of pose and lost packets cost each method: CoSTr, Table II, with loss and all together beside.

Oracle rows tell what is lost to geometry from what is lost to the model: of each joint disturbance, the row with true poses has
its delay and loss alone, the row without delay its errors of pose alone. Early fusion is the bound. No fusion receives nothing,
hence is the same under every perturbation: it is run once. Methods are compared within a form, without or with memory.
--checkpoints name=weights.safetensors adds baselines, such as variants of the ablation, in the forms in which intermediate fusion
is run; for a fair comparison --weights is then the variant of as many steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.strategies.names import TEMPORAL, form_of
from manyeyes.agents.strategies.registry import list_strategies
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.studies.detection.perturbations import (
    CLEAN,
    COMBINED,
    COMBINED_SEVERE,
    DELAYS,
    HEADINGS,
    LOSSES,
    POSITIONS,
    Perturbation,
    select_perturbations,
)
from manyeyes.studies.engine.conditions import Condition, ResultGrid, ResultKey
from manyeyes.studies.engine.replay_study import (
    ALONE,
    FORMS,
    NO_FUSION,
    OURS,
    PAPER_NOTE,
    UPPER_BOUND,
    parse_checkpoints,
    prepare_study,
)
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import RobustnessOptions
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.study_table import (
    StudyTable,
    format_difference,
    format_interval,
    format_number,
    make_comparison_table,
)
from manyeyes.viz.table import DATA_AGE

ORACLES = {
    replace(COMBINED, heading_sigma_deg=0, position_sigma_m=0): "true poses",
    replace(COMBINED, delay_s=0): "no delay",
    replace(COMBINED_SEVERE, heading_sigma_deg=0, position_sigma_m=0): "true poses",
    replace(COMBINED_SEVERE, delay_s=0): "no delay",
}
COMBINED_LEVELS = (COMBINED, *list(ORACLES)[:2], COMBINED_SEVERE, *list(ORACLES)[2:])
ALL_PERTURBATIONS = (CLEAN, *DELAYS, *HEADINGS, *POSITIONS, *LOSSES, *(d for d in COMBINED_LEVELS if d not in DELAYS))
SPEED_RANGES = {"still": (0.0, 0.1), "below 5 m/s": (0.1, 5.0), "from 5 m/s": (5.0, math.inf)}
LARGEST_SINGLE = (DELAYS[-1], HEADINGS[-1], POSITIONS[-1], LOSSES[-1])
PAPER_AP50 = {
    CLEAN: 0.946,
    **dict(zip(DELAYS, (0.937, 0.928, 0.917, 0.909))),
    **dict(zip(HEADINGS, (0.937, 0.921, 0.904, 0.892))),
    **dict(zip(POSITIONS, (0.941, 0.926, 0.913, 0.902))),
}


@dataclass(frozen=True)
class RobustnessRow:
    """A method under a disturbance. ap_drop: AP less than without any; gain_over_no_fusion: AP more than no fusion; two IoUs each.

    ap_by_speed: AP@0.5 of each class of SPEEDS, where messages are late. paper_ap: CoSTr's own AP@0.5.
    """

    perturbation: Perturbation
    oracle: str
    method: str
    ap: tuple[Interval, Interval]
    ap_drop: tuple[Interval, Interval] | None
    gain_over_no_fusion: tuple[Interval, Interval] | None
    bytes_per_message: float
    age_ms: float
    ap_by_speed: tuple[Interval, ...]
    paper_ap: float | None


def run(options: RobustnessOptions, context: StudyContext) -> None:
    """Run the robustness study and write its report."""
    study = prepare_study(options, context)
    methods = study.base.methods
    collaborative = tuple(m for m in methods if m not in ALONE)
    selected = select_perturbations(options.perturbations, ALL_PERTURBATIONS)
    conditions = [
        Condition(
            d.name, d.apply_to(replace(study.base, methods=methods if d == CLEAN else collaborative), study.pose_noise)
        )
        for d in selected
        if d == CLEAN or collaborative
    ]
    baselines = parse_checkpoints(options.checkpoints, "robustness") if options.checkpoints else {}
    if name_clashes := sorted(set(baselines) & set(list_strategies())):
        raise ConfigError(
            f"The study 'robustness' has methods of the names {', '.join(name_clashes)}; name these baselines otherwise."
        )
    forms = tuple(form for form in FORMS if OURS + form in methods)
    for baseline, weights in baselines.items() if forms else ():
        base = replace(study.base, methods=tuple(OURS + form for form in forms), weights=weights)
        conditions += [
            Condition(_result_key(d, baseline, (baseline,))[0], d.apply_to(base, study.pose_noise)) for d in selected
        ]
    results = study.run(conditions)
    rows_of_baselines = tuple(baseline + form for baseline in baselines for form in forms)
    result_rows, comparisons = make_rows(results, rows_of_baselines), make_comparisons(results, rows_of_baselines)
    tables = [
        _make_results_table(title, result_rows, group)
        for title, group in (
            ("Delay", DELAYS),
            ("Heading noise", HEADINGS),
            ("Position noise", POSITIONS),
            ("Packet loss", LOSSES),
            ("Combined", COMBINED_LEVELS),
        )
        if any(row.perturbation in group for row in result_rows)
    ]
    tables.append(make_comparison_table(comparisons))
    payload: dict[str, object] = {"rows": result_rows, "comparisons": comparisons, "paper": PAPER_NOTE}
    study.write_report(payload, tables, make_panels(result_rows), conditions, (PAPER_NOTE,))


def _result_key(perturbation: Perturbation, method: str, baselines: Sequence[str]) -> ResultKey:
    """Return the result key of a method, or of a baseline's weights, with memory if its name ends in ``-temporal``."""
    if method not in baselines:
        return perturbation.name, method
    return f"{method.removesuffix(TEMPORAL)}: {perturbation.name}", OURS + form_of(method)


def make_rows(results: ResultGrid, baselines: Sequence[str] = ()) -> tuple[RobustnessRow, ...]:
    """Return the table, ordered by perturbation."""
    return tuple(
        _make_row(results, d, method, baselines)
        for d in ALL_PERTURBATIONS
        for method in (*(m for name, m in results.results if name == d.name), *baselines)
        if _result_key(d, method, baselines) in results.results
    )


def _make_row(results: ResultGrid, perturbation: Perturbation, method: str, baselines: Sequence[str]) -> RobustnessRow:
    key, clean_key = (_result_key(d, method, baselines) for d in (perturbation, CLEAN))
    no_fusion_key = (CLEAN.name, NO_FUSION + form_of(method))
    result = results.results[key]
    has_delay = perturbation == CLEAN or perturbation.delay_s > 0
    return RobustnessRow(
        perturbation,
        ORACLES.get(perturbation, ""),
        method,
        results.ap_pair(key),
        results.difference_pair(clean_key, key),
        results.difference_pair(key, no_fusion_key) if method not in ALONE else None,
        result.bytes_per_message,
        result.age_ms,
        tuple(results.bootstrap_ap(key, 0, speed_range) for speed_range in SPEED_RANGES.values()) if has_delay else (),
        PAPER_AP50.get(perturbation) if method == OURS + form_of(method) else None,
    )


def make_comparisons(results: ResultGrid, checkpoints: Sequence[str] = ()) -> tuple[Comparison, ...]:
    """Compare our method with every other of its form but the upper bound at each level, and each single perturbation with none."""
    return tuple(c for form in FORMS for c in _compareform_of(results, checkpoints, form))


def _compareform_of(results: ResultGrid, checkpoints: Sequence[str], form: str) -> Iterator[Comparison]:
    ours = OURS + form
    if (CLEAN.name, ours) not in results.results:
        return
    methods = [method for name, method in results.results if name == CLEAN.name]
    baselines = [m for m in (*methods, *checkpoints) if form_of(m) == form and m not in (ours, UPPER_BOUND + form)]
    evaluated = [d for d in ALL_PERTURBATIONS if (d.name, ours) in results.results]
    for perturbation in evaluated:
        for baseline in baselines:
            other = _result_key(CLEAN if baseline in ALONE else perturbation, baseline, checkpoints)
            description = f"{ours} - {baseline}, {perturbation.name}"
            for iou in (0, 1):
                yield results.compare(description, (perturbation.name, ours), other, iou)
    for d in evaluated:
        if d in LARGEST_SINGLE:
            yield results.compare(f"{ours}, {d.name} - {CLEAN.name}", (d.name, ours), (CLEAN.name, ours))


def _make_results_table(title: str, result_rows: Sequence[RobustnessRow], group: Sequence[Perturbation]) -> StudyTable:
    """Tabulate one kind of perturbation, the clean row on top, oracle rows marked."""
    result_rows = [row for row in result_rows if row.perturbation in (CLEAN, *group)]
    headings = (
        "perturbation", "method", "AP@0.5", "AP@0.7", "ΔAP@0.5 vs. clean", "ΔAP@0.7 vs. clean", "gain over no fusion @0.5",
        "bytes/message", DATA_AGE,
    )  # fmt: skip
    has_speeds = any(row.ap_by_speed for row in result_rows if row.perturbation != CLEAN)
    lines = []
    for row in result_rows:
        name = row.perturbation.name + (f" ({row.oracle})" if row.oracle and COMBINED in group else "")
        is_clean = row.perturbation == CLEAN
        line = (
            name,
            row.method,
            *map(format_interval, row.ap),
            *("" if is_clean else format_difference(drop and -drop) for drop in row.ap_drop or (None, None)),
            format_difference(row.gain_over_no_fusion[0]) if row.gain_over_no_fusion else "",
            format_number(row.bytes_per_message),
            format_number(row.age_ms),
        )
        by_speed = tuple(format_interval(v) for v in row.ap_by_speed) or ("",) * len(SPEED_RANGES)
        paper = "" if row.paper_ap is None else f"{row.paper_ap:.3f}"
        lines.append((*line, *(by_speed if has_speeds else ()), paper))
    speed_headings = tuple(f"AP@0.5 {name}" for name in SPEED_RANGES) if has_speeds else ()
    return StudyTable(title, (*headings, *speed_headings, "paper"), tuple(lines))


def make_panels(result_rows: Sequence[RobustnessRow]) -> list[CurvePanel]:
    """Return AP@0.5 against each perturbation, and a panel of the combined ones."""
    ap_by_key = {(row.perturbation, row.method): row.ap[0] for row in result_rows}
    methods = list(dict.fromkeys(row.method for row in result_rows))
    out = []
    for title, xlabel, group, field_name in (
        ("Delay", "seconds", DELAYS, "delay_s"),
        ("Heading noise", "standard deviation, degrees", HEADINGS, "heading_sigma_deg"),
        ("Position noise", "standard deviation, m", POSITIONS, "position_sigma_m"),
        ("Packet loss", "fraction", LOSSES, "packet_loss"),
    ):
        levels = (CLEAN, *group)
        x = tuple(getattr(d, field_name) for d in levels)
        curves = (_make_curve(m, [ap_by_key.get((d, m)) for d in levels], x) for m in methods)
        out.append(CurvePanel(title, xlabel, "AP@0.5", tuple(c for c in curves if c)))
    x, levels = tuple(map(float, range(3))), (CLEAN, COMBINED, COMBINED_SEVERE)
    curves = (_make_curve(m, [ap_by_key.get((d, m)) for d in levels], x) for m in methods)
    out.append(CurvePanel("Combined", "", "AP@0.5", tuple(c for c in curves if c), ticks=tuple(d.name for d in levels)))
    return out


def _make_curve(method: str, y: Sequence[Interval | None], x: tuple[float, ...]) -> Curve | None:
    """Return a line through the evaluated levels, a constant where there is one level: no fusion."""
    known = [(v, x_value) for v, x_value in zip(y, x) if v is not None]
    values = tuple(v for v, _ in known)
    if len(known) > 1:
        return Curve(method, values, tuple(x_value for _, x_value in known))
    return Curve(method, values) if known else None
