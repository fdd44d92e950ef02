# SPDX-License-Identifier: Apache-2.0
"""Attacks of malicious agents against methods and defences.

Each attack begins at the first evaluated frame, when the defence has received honest messages of the malicious agents. By default
one agent attacks, on a channel of ITS-G5 at 6 Mb/s with messages of at most 4,096 bytes; the ego waits 100 ms, and prior poses err
by 0.4 m and 0.4 degrees. Scenarios without an honest majority around the ego are left out, of all rows of that number alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.trust.registry import get_misbehaviour_detector
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.attacks.metrics import FIRST_FRAMES, Survival
from manyeyes.evaluation.detection.benchmark import resolve_protocol
from manyeyes.evaluation.statistics.bootstrap import Interval, exact_interval
from manyeyes.evaluation.statistics.proportion import Proportion
from manyeyes.studies.attacks.catalog import ATTACKS, get_attack
from manyeyes.studies.attacks.conditions import (
    NO_ATTACK,
    NO_DEFENCE,
    ORACLE,
    AttackScenarioJob,
    list_pairs,
)
from manyeyes.studies.attacks.rows import AttackResults, AttackRow, make_row
from manyeyes.studies.engine.cells import hash_recording
from manyeyes.studies.engine.replay_study import ReplayStudy, prepare_study
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import AttacksOptions
from manyeyes.viz.curves import Curve, CurvePanel, save_curves
from manyeyes.viz.study_table import StudyTable, format_difference, format_interval, format_number

NOTE = (
    "Named: malicious senders named within 5 and 10 frames of the attack, with Clopper-Pearson intervals. Survival: boxes of score "
    ">= 0.5 that rest on a false claim, of claims sent; checkable: at least 10 rays of an honest agent cross it in 3 of 5 frames; "
    "by the ego: rays of the ego itself do. "
    "Accusations: honest senders that become named, per sender-minute, with the one-sided 95 % upper bound."
)


def run(options: AttacksOptions, context: StudyContext) -> None:
    """Run the study and write its report."""
    study = _prepare(options, context)
    sends_sights = options.replay_options.sight
    usable = tuple(name for name, named in ATTACKS.items() if sends_sights or not named.needs_sights)
    pairs = list_pairs(options.attacks or usable, study.base.methods, options.defences, options.counts)
    recording = study.base.filter_recording(study.opener())
    scenarios = recording.scenarios
    digest = hash_recording(recording)
    jobs = [
        AttackScenarioJob(study.opener, study.base, name, pairs, options.egos, study.context.store, digest)
        for name in scenarios
    ]
    found = study.context.run_jobs(jobs, options.workers, "Scenarios")
    records = {pair: tuple(result[k] for result in found) for k, pair in enumerate(pairs)}
    protocol = resolve_protocol(study.base)
    protocol = protocol.with_classes((study.object_class or protocol.classes[0],))
    results = AttackResults(records, protocol)
    rows = tuple(make_row(results, pair) for pair in pairs if results.num_scenarios(pair))
    if not rows:
        raise ConfigError("No scenario has an ego with an honest majority around it; take scenarios of more agents.")
    title = f"{study.title}; {options.egos} ego(s) each"
    notes = (
        NOTE,
        f"Prior poses err by {options.position_sigma_m:g} m and {options.heading_sigma_deg:g} degrees. "
        f"{options.pose_errors.describe(options.seed)}",
    )
    study.context.write_report(
        title,
        {"rows": rows},
        make_tables(rows),
        partial(save_curves, make_panels(rows)),
        notes,
        {"base": study.base, "conditions": [condition for condition, _ in pairs]},
    )


def _prepare(options: AttacksOptions, context: StudyContext) -> ReplayStudy:
    """Open the recording, and refuse unknown names before any work."""
    for name in options.attacks:
        if get_attack(name).needs_sights and not options.replay_options.sight:
            raise ConfigError(f"--attacks: {name} alters the sights of messages; add --sight.")
    for name in options.defences:
        if name in (NO_DEFENCE, ORACLE):
            raise ConfigError(f"--defences: {name} is always a row; name misbehaviour detectors.")
        get_misbehaviour_detector(name)
    if options.replay_options.misbehaviour is not None:
        raise ConfigError("The study 'attacks' compares --defences; leave out --misbehaviour.")
    for method in options.replay_options.methods:
        if not get_strategy(method).waits_for_messages:
            raise ConfigError(f"{method} fuses no messages; the study 'attacks' adds it by itself.")
    study = prepare_study(options, context)
    noise = study.pose_noise.at_level(options.position_sigma_m, math.radians(options.heading_sigma_deg))
    return replace(study, base=replace(study.base, pose_noise=noise))


def make_tables(rows: Sequence[AttackRow]) -> list[StudyTable]:
    """Return a table of AP and a table of detection for each method, and one of what the defences cost without an attack."""
    tables = [_make_clean_table([row for row in rows if row.attack == NO_ATTACK])]
    for method in dict.fromkeys(row.method for row in rows if row.attack != NO_ATTACK):
        attacked = [row for row in rows if row.method == method and row.attack != NO_ATTACK]
        tables.append(_make_ap_table(f"{method}: AP under attack", attacked))
        defended = [row for row in attacked if row.defence != NO_DEFENCE]
        if defended:
            tables.append(_make_detection_table(f"{method}: detection of malicious senders", defended))
    return tables


def _make_clean_table(rows: Sequence[AttackRow]) -> StudyTable:
    headings = (
        "method",
        "defence",
        "excluded",
        "AP@0.5",
        "AP@0.7",
        "dAP@0.5 vs. no defence",
        "accusations/min",
        "perceive [ms]",
    )
    lines = tuple(
        (
            row.method,
            row.defence,
            str(row.num_malicious) if row.defence == ORACLE else "0",
            *map(format_interval, row.ap),
            format_difference(row.vs_clean[0]) if row.vs_clean else "",
            _format_accusations(row),
            format_number(row.perceive_ms, 1),
        )
        for row in rows
    )
    return StudyTable("Without an attack", headings, lines)


def _make_ap_table(title: str, rows: Sequence[AttackRow]) -> StudyTable:
    headings = (
        "attack", "knowledge", "malicious", "defence", "AP@0.5", "AP@0.7", "dAP@0.5 vs. clean", "vs. oracle", "vs. alone",
        "checkable claims/frame", "other claims/frame", "removed", "bytes/message",
    )  # fmt: skip
    lines = tuple(
        (
            row.attack,
            row.knowledge,
            str(row.num_malicious),
            row.defence,
            *map(format_interval, row.ap),
            *(format_difference(pair[0]) if pair else "" for pair in (row.vs_clean, row.vs_oracle, row.vs_alone)),
            format_number(row.seen.per_frame, 2),
            format_number(row.blind.per_frame, 2),
            _format_proportion(row.removed),
            format_number(row.mean_bytes),
        )
        for row in rows
    )
    return StudyTable(title, headings, lines)


def _make_detection_table(title: str, rows: Sequence[AttackRow]) -> StudyTable:
    headings = (
        "attack", "malicious", "defence", "named <= 5", "named <= 10", "checkable, <= 5", "checkable, <= 10",
        "by the ego, <= 5", "by the ego, <= 10",
        "survival, checkable", "survival, other", "ROC area", "accusations/min",
    )  # fmt: skip
    lines = tuple(
        (
            row.attack,
            str(row.num_malicious),
            row.defence,
            *map(_format_proportion, (*row.named, *row.named_checkable, *row.named_by_ego)),
            *map(_format_survival, (row.seen, row.blind)),
            "" if row.roc is None else f"{row.roc.area:.3f}",
            _format_accusations(row),
        )
        for row in rows
    )
    return StudyTable(title, headings, lines)


def _format_proportion(value: Proportion) -> str:
    return f"{value.successes} of {value.total} [{value.low:.2f}, {value.high:.2f}]" if value.total else ""


def _format_survival(value: Survival) -> str:
    return _format_proportion(value.surviving)


def _format_accusations(row: AttackRow) -> str:
    rate = row.accusations
    return f"{rate.events} in {rate.minutes:.1f} [< {rate.upper:.2g}]" if rate.minutes else ""


def make_panels(rows: Sequence[AttackRow]) -> list[CurvePanel]:
    """Return AP against the number of malicious agents, time to detection, and ROC, of the first attack's and all defences."""
    attacked = [row for row in rows if row.attack != NO_ATTACK]
    panels = []
    for method in dict.fromkeys(row.method for row in attacked):
        first = next(row.attack for row in attacked if row.method == method)
        panels.append(_make_count_panel(rows, method, first))
    defended = [row for row in attacked if row.defence != NO_DEFENCE and row.num_malicious == 1]
    if defended:
        method = defended[-1].method
        chosen = [row for row in defended if row.method == method][:8]
        panels.append(_make_time_panel(method, chosen))
        curves = tuple(_make_roc_curve(row) for row in chosen if row.roc is not None)
        panels.append(
            CurvePanel(f"ROC of senders in frames, {method}", "honest, fraction", "malicious, fraction", curves)
        )
    return panels


def _make_count_panel(rows: Sequence[AttackRow], method: str, attack: str) -> CurvePanel:
    """Return AP@0.5 against the number of malicious agents; 0 is nothing attacked with the same defence."""
    curves = []
    for defence in dict.fromkeys(row.defence for row in rows if row.method == method):
        chosen = [row for row in rows if (row.method, row.defence) == (method, defence)]
        clean = [row for row in chosen if row.attack == NO_ATTACK]
        under = clean if defence == ORACLE else [row for row in chosen if row.attack == attack]
        points = {row.num_malicious: row.ap[0] for row in under}
        if clean and defence != ORACLE:
            points[0] = clean[0].ap[0]
        x = sorted(points)
        curves.append(Curve(defence, tuple(points[k] for k in x), tuple(map(float, x))))
    alone = next((row for row in rows if row.method.startswith("no-fusion")), None)
    if alone is not None:
        curves.append(Curve("alone", (alone.ap[0],)))
    return CurvePanel(f"{method} under {attack}", "malicious agents", "AP@0.5", tuple(curves))


def _make_time_panel(method: str, rows: Sequence[AttackRow]) -> CurvePanel:
    frames = range(1, max(FIRST_FRAMES) + 1)
    curves = []
    for row in rows:
        if row.times:
            hits = [sum(at is not None and at <= k for at in row.times) / len(row.times) for k in frames]
            label = f"{row.attack}, {row.defence}"
            curves.append(Curve(label, tuple(map(exact_interval, hits)), tuple(map(float, frames))))
    return CurvePanel(f"Time to detection, {method}", "frames since the attack began", "named, fraction", tuple(curves))


def _make_roc_curve(row: AttackRow) -> Curve:
    assert row.roc is not None
    values: tuple[Interval, ...] = tuple(map(exact_interval, row.roc.true_positive))
    return Curve(f"{row.attack}, {row.defence}", values, row.roc.false_positive)
