# SPDX-License-Identifier: Apache-2.0
"""FeaKM's ablation, its Table 3: with and without a confidence map, with one scale of fusion and with several.

What a row is stands in evaluation/pose/feakm_ablation.py. A branch is a detector and a net taught on its views, with ``@8``
behind it for the paper's eight pairs; its rows are kept under --out.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from manyeyes._io import atomic_write
from manyeyes._source import source_digest
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS
from manyeyes.evaluation.detection.benchmark import load_detector, resolve_protocol
from manyeyes.evaluation.pose.feakm_ablation import SIGMAS, FeakmVariant, FeakmVariantRow, run_ablation
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.study import COMPUTED_BY, hash_recording
from manyeyes.models.checkpoint import fingerprint
from manyeyes.pose.feakm import FeakmCorrector
from manyeyes.pose.registry import load_corrector
from manyeyes.studies.detection.ablation import parse_checkpoints
from manyeyes.studies.running import StudyContext, prepare_study, write_study_report
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.progress import make_progress_bars
from manyeyes.viz.study_table import StudyTable, format_number

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

PAPER_NOTE = "The last table is FeaKM's own: DAIR-V2X, AP@0.5, CoAlign's protocol; it is for reference only."
PAPER_ROWS = (
    ("neither", 0.741, 0.704, 0.682, 0.678),
    ("several scales", 0.780, 0.716, 0.682, 0.666),
    ("confidence map", 0.778, 0.716, 0.674, 0.660),
    ("both", 0.768, 0.716, 0.690, 0.678),
)


def run(options: Options, console: Console) -> None:
    """Run the ablation of FeaKM and write its report."""
    named = parse_checkpoints(options.checkpoints, "feakm", "detector.safetensors,net.safetensors[@8]")
    variants = [(_parse_variant(name, files), files.partition("@")[2]) for name, files in named.items()]
    context = prepare_study(options, console)
    result_rows = make_rows(context, variants)
    payload: dict[str, object] = {"rows": result_rows, "paper": {"note": PAPER_NOTE, "rows": PAPER_ROWS}}
    tables = [
        *(_make_ap_table(result_rows, k) for k in range(len(IOU_THRESHOLDS))),
        _make_found_table(result_rows),
        _make_paper_table(),
    ]
    write_study_report(context, payload, tables, make_panels(result_rows), [], (PAPER_NOTE,))


def _parse_variant(name: str, files: str) -> FeakmVariant:
    detector, _, net = files.partition(",")
    if not net.partition("@")[0].endswith(".safetensors"):
        raise ConfigError(f"Branch {name!r} needs two files, detector.safetensors,net.safetensors[@8]; got {files!r}.")
    net_corrector = load_corrector(net)
    assert isinstance(net_corrector, FeakmCorrector)
    return FeakmVariant(name, load_detector(detector), net_corrector)


def make_rows(context: StudyContext, variants: Sequence[tuple[FeakmVariant, str]]) -> list[FeakmVariantRow]:
    """Rows of every branch and its least number of pairs, as it was written; those that are kept are not made again."""
    recording, seed = context.base.filter_recording(context.opener()), context.options.seed
    code = source_digest(COMPUTED_BY, "manyeyes.evaluation.pose.feakm_ablation")
    protocol, data_key = resolve_protocol(context.base), (hash_recording(recording), code, SIGMAS, seed)
    out = list[FeakmVariantRow]()
    with make_progress_bars(context.console) as progress:
        task = progress.add_task("Judging", total=len(variants) * len(recording.scenarios))
        for n, (variant, pairs) in enumerate(variants):
            scenarios_done = {s: n * len(recording.scenarios) + k for k, s in enumerate(recording.scenarios)}
            fingerprints = variant.detector.fingerprint, fingerprint(variant.corrector.net), pairs
            key = hashlib.blake2b(repr((fingerprints, data_key)).encode(), digest_size=8).hexdigest()
            path = context.results_folder / f"feakm-{key}.json"
            if not path.is_file():

                def report(scenario: str, index: int, done: dict[str, int] = scenarios_done) -> None:
                    progress.update(task, completed=done[scenario])

                new_rows = run_ablation(recording, [variant], SIGMAS, protocol=protocol, seed=seed, report=report)
                atomic_write(path, json.dumps([asdict(row) for row in new_rows]).encode())
            stored = json.loads(path.read_text(encoding="utf-8"))
            out += [FeakmVariantRow(**(row | {"variant": variant.name, "ap": tuple(row["ap"])})) for row in stored]
    return out


def _format_lines(
    result_rows: Sequence[FeakmVariantRow], column: str, digits: int, iou: int = 0
) -> tuple[tuple[str, ...], ...]:
    def format_cell(row: FeakmVariantRow) -> str:
        return format_number(row.ap[iou] if column == "ap" else row.found_fraction, digits)

    names = dict.fromkeys(row.variant for row in result_rows)
    return tuple((name, *(format_cell(row) for row in result_rows if row.variant == name)) for name in names)


def _make_headings() -> tuple[str, ...]:
    return ("branch", *(f"{s:g} m, {s:g}°" for s in SIGMAS))


def _make_ap_table(result_rows: Sequence[FeakmVariantRow], iou: int) -> StudyTable:
    return StudyTable(f"AP@{IOU_THRESHOLDS[iou]:g}", _make_headings(), _format_lines(result_rows, "ap", 3, iou))


def _make_found_table(result_rows: Sequence[FeakmVariantRow]) -> StudyTable:
    return StudyTable(
        "Share of collaborators whose pose was found", _make_headings(), _format_lines(result_rows, "answered", 2)
    )


def _make_paper_table() -> StudyTable:
    lines = tuple((name, *(f"{v:.3f}" for v in ap)) for name, *ap in PAPER_ROWS)
    return StudyTable("FeaKM's Table 3, AP@0.5: another data set", _make_headings(), lines)


def make_panels(result_rows: Sequence[FeakmVariantRow]) -> list[CurvePanel]:
    """AP against sigma, a line a branch."""
    names = dict.fromkeys(row.variant for row in result_rows)
    return [
        CurvePanel(
            "FeaKM's parts", "sigma, metres and degrees", f"AP@{threshold:g}",
            tuple(Curve(n, tuple(_make_interval(r.ap[k]) for r in result_rows if r.variant == n), SIGMAS) for n in names),
        )
        for k, threshold in enumerate(IOU_THRESHOLDS)
    ]  # fmt: skip


def _make_interval(value: float) -> Interval:
    return Interval(value, value, value, 0.95, 1)
