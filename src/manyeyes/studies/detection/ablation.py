# SPDX-License-Identifier: Apache-2.0
"""Variants of a training, clean, with delay and with pose noise: CoSTr, Table III.

The order is that of the command line; a branch is held against the one before it. What was trained, how long and from which
seed stands in the model card of each file and is shown beside. ``@BYTES`` behind a file: a message has so many bytes at most,
of those tokens that the trained mask takes (MI, Eq. 10-13); without it a message holds all tokens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.models import checkpoint
from manyeyes.studies.detection.perturbations import CLEAN, Perturbation
from manyeyes.studies.engine.conditions import Condition, ResultGrid
from manyeyes.studies.engine.replay_study import (
    OURS_TEMPORAL,
    PAPER_NOTE,
    parse_checkpoints,
    prepare_study,
    with_replay,
)
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import AblationOptions
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.study_table import StudyTable, format_difference, format_interval, format_log2, format_number
from manyeyes.viz.table import LOG2_BYTES

LEARNED_MASK = "intermediate-mi-temporal"
PERTURBATIONS = (CLEAN, Perturbation(delay_s=0.2), Perturbation(position_sigma_m=0.4))
PAPER_ROWS = (
    ("none", 0.875, 0.831, 0.762, 16.43),
    ("SE", 0.897, 0.842, 0.790, 16.94),
    ("SE, DAST", 0.919, 0.849, 0.883, 16.94),
    ("SE, DAST, DAST in FAST's place", 0.933, 0.878, 0.911, 16.94),
    ("SE, DAST, FAST", 0.946, 0.928, 0.926, 16.94),
    ("SE, DAST, FAST, MI", 0.941, 0.924, 0.925, 14.71),
)


@dataclass(frozen=True)
class AblationRow:
    """A branch. ap: at IoU 0.5 and 0.7 under each of UNDER; gain_over_previous: AP@0.5 over the branch before. card: of its
    weights.
    """

    variant: str
    ap: tuple[tuple[Interval, Interval], ...]
    gain_over_previous: tuple[Interval, ...]
    bytes_per_message: float
    card: dict[str, Any]


@dataclass(frozen=True)
class _AblationVariant:
    """A detector, and the most bytes of a message if the trained mask is to choose its tokens."""

    name: str
    weights: Path
    budget_bytes: int | None

    @property
    def method(self) -> str:
        return OURS_TEMPORAL if self.budget_bytes is None else LEARNED_MASK

    def apply_to(self, base: BenchmarkConfig) -> BenchmarkConfig:
        """Return the configuration of a benchmark of this branch."""
        config = replace(base, methods=(self.method,), weights=str(self.weights))
        return config if self.budget_bytes is None else with_replay(config, budget_bytes=self.budget_bytes)


def _parse_variant(name: str, weights: str, max_bytes: str) -> _AblationVariant:
    if max_bytes and not (max_bytes.isdigit() and int(max_bytes)):
        raise ConfigError(f"Variant {name!r}: behind @ stands a number of bytes, one or more; got {max_bytes!r}.")
    return _AblationVariant(name, Path(weights), int(max_bytes) if max_bytes else None)


def run(options: AblationOptions, context: StudyContext) -> None:
    """Run the ablation study and write its report."""
    variants = [
        _parse_variant(name, *words.partition("@")[::2])
        for name, words in parse_checkpoints(options.checkpoints, "ablation", "weights.safetensors[@BYTES]").items()
    ]
    study = prepare_study(options, context)
    conditions = [
        Condition(
            _condition_name(variant.name, perturbation),
            perturbation.apply_to(variant.apply_to(study.base), study.pose_noise),
        )
        for variant in variants
        for perturbation in PERTURBATIONS
    ]
    cards = [checkpoint.read_card(variant.weights) for variant in variants]
    result_rows = make_rows(study.run(conditions), variants, cards)
    tables = [_make_results_table(result_rows), _make_cards_table(result_rows), _make_paper_table()]
    payload: dict[str, object] = {"rows": result_rows, "paper": {"note": PAPER_NOTE, "rows": PAPER_ROWS}}
    notes = (PAPER_NOTE.replace('column "paper"', "last table"),)
    study.write_report(payload, tables, make_panels(result_rows), conditions, notes)


def _condition_name(variant: str, perturbation: Perturbation) -> str:
    return f"{variant}: {perturbation.name}"


def make_rows(
    results: ResultGrid, variants: Sequence[_AblationVariant], cards: Sequence[dict[str, Any]]
) -> tuple[AblationRow, ...]:
    """Return the table, in the order of the branches."""
    out, previous = [], []
    for variant, card in zip(variants, cards):
        keys = [(_condition_name(variant.name, perturbation), variant.method) for perturbation in PERTURBATIONS]
        out.append(
            AblationRow(
                variant.name,
                tuple(map(results.ap_pair, keys)),
                tuple(results.paired_difference(key, other, 0) for key, other in zip(keys, previous)),
                results.results[keys[0]].bytes_per_message,
                card,
            )
        )
        previous = keys
    return tuple(out)


def _make_results_table(result_rows: Sequence[AblationRow]) -> StudyTable:
    names = [perturbation.name for perturbation in PERTURBATIONS]
    headings = (
        "variant", *(f"AP@0.5 {n}" for n in names), *(f"AP@0.7 {n}" for n in names),
        *(f"gain over the previous {n}" for n in names), "bytes/message", LOG2_BYTES,
    )  # fmt: skip
    lines = tuple(
        (
            row.variant,
            *(format_interval(half) for half, _ in row.ap),
            *(format_interval(seven) for _, seven in row.ap),
            *(tuple(map(format_difference, row.gain_over_previous)) or ("",) * len(PERTURBATIONS)),
            format_number(row.bytes_per_message),
            format_log2(row.bytes_per_message),
        )
        for row in result_rows
    )
    return StudyTable("Variants", headings, lines)


def _make_cards_table(result_rows: Sequence[AblationRow]) -> StudyTable:
    lines = tuple(
        (row.variant, *(str(row.card.get(key, "")) for key in ("steps", "seed", "command"))) for row in result_rows
    )
    return StudyTable("How they were trained", ("variant", "steps", "seed", "command"), lines)


def _make_paper_table() -> StudyTable:
    lines = tuple((name, *(f"{v:.3f}" for v in ap), f"{ab:.2f}") for name, *ap, ab in PAPER_ROWS)
    headings = ("parts", *(perturbation.name for perturbation in PERTURBATIONS), LOG2_BYTES)
    return StudyTable("The paper's own table, AP@0.5: another data set, unknown protocol", headings, lines)


def make_panels(result_rows: Sequence[AblationRow]) -> list[CurvePanel]:
    """Return AP@0.5 and AP@0.7 of the branches, a line per perturbation."""
    x, ticks = tuple(map(float, range(len(result_rows)))), tuple(row.variant for row in result_rows)
    return [
        CurvePanel(
            f"AP@{iou}", "", f"AP@{iou}",
            tuple(Curve(u.name, tuple(row.ap[k][which] for row in result_rows), x) for k, u in enumerate(PERTURBATIONS)),
            ticks=ticks,
        )
        for which, iou in enumerate(("0.5", "0.7"))
    ]  # fmt: skip
