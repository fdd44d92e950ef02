# SPDX-License-Identifier: Apache-2.0
"""FeaKM's ablation, its Table 3: with and without a confidence map, with one scale of fusion and with several.

What a row is stands in evaluation/pose/feakm_ablation.py. A branch is a detector and a net taught on its views, with ``@8``
behind it for the paper's eight pairs; its rows are kept under --out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, load_detector, resolve_protocol
from manyeyes.evaluation.pose.feakm_ablation import SIGMAS, FeakmVariant, FeakmVariantRow, run_ablation
from manyeyes.evaluation.statistics.bootstrap import exact_interval
from manyeyes.models.checkpoint import fingerprint
from manyeyes.pose.feakm import FeakmCorrector
from manyeyes.pose.registry import load_corrector
from manyeyes.studies.engine.cells import Cell, hash_recording
from manyeyes.studies.engine.replay_study import ReplayStudy, open_study, parse_checkpoints
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import FeakmOptions
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.progress import make_progress_bars
from manyeyes.viz.study_table import StudyTable, format_number

Report = Callable[[str, int], None]
COMPUTED_BY = ("manyeyes.evaluation.pose.feakm_ablation", "manyeyes.evaluation.detection.benchmark")
PAPER_NOTE = "The last table is FeaKM's own: DAIR-V2X, AP@0.5, CoAlign's protocol; it is for reference only."
PAPER_ROWS = (
    ("neither", 0.741, 0.704, 0.682, 0.678),
    ("several scales", 0.780, 0.716, 0.682, 0.666),
    ("confidence map", 0.778, 0.716, 0.674, 0.660),
    ("both", 0.768, 0.716, 0.690, 0.678),
)


def run(options: FeakmOptions, context: StudyContext) -> None:
    """Run the ablation of FeaKM and write its report."""
    named = parse_checkpoints(options.checkpoints, "feakm", "detector.safetensors,net.safetensors[@8]")
    variants = [(_parse_variant(name, files), files.partition("@")[2]) for name, files in named.items()]
    study = open_study(options, context, BenchmarkConfig(options.weights, protocol=options.protocol))
    result_rows = make_rows(study, variants)
    payload: dict[str, object] = {"rows": result_rows, "paper": {"note": PAPER_NOTE, "rows": PAPER_ROWS}}
    tables = [
        *(_make_ap_table(result_rows, k) for k in range(len(IOU_THRESHOLDS))),
        _make_found_table(result_rows),
        _make_paper_table(),
    ]
    study.write_report(payload, tables, make_panels(result_rows), notes=(PAPER_NOTE,))


def _parse_variant(name: str, files: str) -> FeakmVariant:
    detector, _, net = files.partition(",")
    if not net.partition("@")[0].endswith(".safetensors"):
        raise ConfigError(f"Variant {name!r} needs two files, detector.safetensors,net.safetensors[@8]; got {files!r}.")
    net_corrector = load_corrector(net)
    assert isinstance(net_corrector, FeakmCorrector)
    return FeakmVariant(name, load_detector(detector), net_corrector)


def make_rows(study: ReplayStudy, variants: Sequence[tuple[FeakmVariant, str]]) -> list[FeakmVariantRow]:
    """Return rows of every variant and its minimum number of pairs, as it was written; stored ones are not computed again."""
    recording, seed = study.base.filter_recording(study.opener()), study.context.seed
    protocol = resolve_protocol(study.base)
    protocol = protocol.with_classes(protocol.classes[:1])
    data_key = hash_recording(recording), SIGMAS, seed, protocol
    out = list[FeakmVariantRow]()
    with make_progress_bars(study.context.console) as progress:
        task = progress.add_task("Evaluating", total=len(variants) * len(recording.scenarios))
        for n, (variant, pairs) in enumerate(variants):
            scenarios_done = {s: n * len(recording.scenarios) + k for k, s in enumerate(recording.scenarios)}

            def report(scenario: str, index: int, done: dict[str, int] = scenarios_done) -> None:
                progress.update(task, completed=done[scenario])

            fingerprints = variant.detector.fingerprint, fingerprint(variant.corrector.net), pairs
            cell = Cell[tuple[FeakmVariantRow, ...]](
                "feakm", tuple[FeakmVariantRow, ...], (fingerprints, data_key), COMPUTED_BY
            )

            def compute(variant: FeakmVariant = variant, report: Report = report) -> tuple[FeakmVariantRow, ...]:
                return run_ablation(recording, [variant], SIGMAS, protocol=protocol, seed=seed, report=report)

            rows = study.context.store.load_or_compute(cell, compute)
            out += [replace(row, variant=variant.name) for row in rows]
    return out


def _format_lines(
    result_rows: Sequence[FeakmVariantRow], column: str, digits: int, iou: int = 0
) -> tuple[tuple[str, ...], ...]:
    def format_cell(row: FeakmVariantRow) -> str:
        return format_number(row.ap[iou] if column == "ap" else row.found_fraction, digits)

    names = dict.fromkeys(row.variant for row in result_rows)
    return tuple((name, *(format_cell(row) for row in result_rows if row.variant == name)) for name in names)


def _make_headings() -> tuple[str, ...]:
    return ("variant", *(f"{s:g} m, {s:g}°" for s in SIGMAS))


def _make_ap_table(result_rows: Sequence[FeakmVariantRow], iou: int) -> StudyTable:
    return StudyTable(f"AP@{IOU_THRESHOLDS[iou]:g}", _make_headings(), _format_lines(result_rows, "ap", 3, iou))


def _make_found_table(result_rows: Sequence[FeakmVariantRow]) -> StudyTable:
    return StudyTable(
        "Fraction of collaborators whose pose was found", _make_headings(), _format_lines(result_rows, "found", 2)
    )


def _make_paper_table() -> StudyTable:
    lines = tuple((name, *(f"{v:.3f}" for v in ap)) for name, *ap in PAPER_ROWS)
    return StudyTable("FeaKM's Table 3, AP@0.5: another data set", _make_headings(), lines)


def make_panels(result_rows: Sequence[FeakmVariantRow]) -> list[CurvePanel]:
    """Return AP against sigma, a line for each variant."""
    names = dict.fromkeys(row.variant for row in result_rows)
    return [
        CurvePanel(
            "FeaKM's parts", "sigma, metres and degrees", f"AP@{threshold:g}",
            tuple(Curve(n, tuple(exact_interval(r.ap[k]) for r in result_rows if r.variant == n), SIGMAS) for n in names),
        )
        for k, threshold in enumerate(IOU_THRESHOLDS)
    ]  # fmt: skip
