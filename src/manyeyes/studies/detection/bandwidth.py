# SPDX-License-Identifier: Apache-2.0
"""AP against bytes a message, for each token selection and each token encoding: CoSTr, Fig. 3.

Bytes are those handed to the bus: headers, indices, scales, checksums and all, mean over messages. The budget of a message goes
down to one packet. "all" is every token that the trained pruning left; at float32 it is what the others are held against.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.token_codec import default_token_encoding
from manyeyes.comms.payloads import TOKEN_ENCODINGS
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import load_detector
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.studies.engine.conditions import Condition, ResultGrid, ResultKey
from manyeyes.studies.engine.replay_study import (
    ALONE,
    OURS_TEMPORAL,
    prepare_study,
    resolve_token_selection,
    with_replay,
)
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import BandwidthOptions
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.study_table import (
    StudyTable,
    format_difference,
    format_interval,
    format_log2,
    format_number,
    make_comparison_table,
)
from manyeyes.viz.table import LOG2_BYTES

BUDGETS = (1398, 2796, 4096, 8192, 16384, 32768, 65536, 131072)
UNLIMITED, REFERENCE_ENCODING, CODEBOOK, CLUSTERS = "references", "float32", "codebook", "clusters"
THREE_PACKETS_BYTES, MIN_COMPRESSION_RATIO = 4096, 4.7


@dataclass(frozen=True)
class BandwidthRow:
    """Tokens chosen and written in one way within a budget, None: all. ap_drop: AP less than with all tokens at float32.

    bytes_per_message: mean; max_message_bytes: of one message. compression_ratio: how many times fewer bytes than all tokens at
    float32.
    """

    budget_bytes: int | None
    token_encoding: str
    method: str
    ap: tuple[Interval, Interval]
    ap_drop: tuple[Interval, Interval] | None
    bytes_per_message: float
    max_message_bytes: int
    compression_ratio: float | None


def run(options: BandwidthOptions, context: StudyContext) -> None:
    """Run the bandwidth study and write its report."""
    study, methods = prepare_study(options, context), resolve_token_selection(options.token_selection)
    encodings = _resolve_encodings(options)
    budgets = (*sorted(options.budgets or BUDGETS), None)
    others = tuple(m for m in study.base.methods if m not in methods)
    base = replace(study.base, methods=methods)
    cases = [(b, p) for p in encodings for b in budgets]
    if REFERENCE_ENCODING not in encodings:
        cases.append((None, REFERENCE_ENCODING))
    conditions = [
        Condition(_condition_name(b, p), with_replay(base, token_encoding=p, budget_bytes=b)) for b, p in cases
    ]
    if others:
        conditions.append(Condition(UNLIMITED, replace(study.base, methods=others)))
    results = study.run(conditions)
    result_rows = make_rows(results, encodings, budgets, methods)
    reference_rows = tuple(_make_row(results, (UNLIMITED, m), None, "", None) for m in others)
    comparisons = make_comparisons(results, result_rows, encodings, budgets, methods)
    tables = [
        _make_results_table(f"Tokens as {p}", [row for row in result_rows if row.token_encoding == p])
        for p in encodings
    ]
    tables += [_make_results_table("Other methods", reference_rows)] if reference_rows else []
    tables += [make_comparison_table(comparisons)] if comparisons else []
    payload: dict[str, object] = {"rows": result_rows, "reference_rows": reference_rows, "comparisons": comparisons}
    study.write_report(payload, tables, make_panels(result_rows, reference_rows), conditions)


def _resolve_encodings(options: BandwidthOptions) -> tuple[str, ...]:
    """Return those asked for, or all that the weights can write: codes need a codebook, clusters a fusion that makes them."""
    for name in options.token_encodings:
        if name not in TOKEN_ENCODINGS:
            raise ConfigError(f"Tokens are not written as {name!r}; known: {', '.join(TOKEN_ENCODINGS)}.")
    usual = default_token_encoding(load_detector(options.replay_options.weights))
    of_weights = (CODEBOOK, CLUSTERS)
    return options.token_encodings or tuple(n for n in TOKEN_ENCODINGS if n not in of_weights or n == usual)


def _condition_name(budget: int | None, encoding: str) -> str:
    return f"{'all' if budget is None else budget} {encoding}"


def make_rows(
    results: ResultGrid, encodings: Sequence[str], budgets: Sequence[int | None], methods: Sequence[str]
) -> tuple[BandwidthRow, ...]:
    """Make the table: encodings, budgets, methods of token selection."""
    return tuple(
        _make_row(results, (_condition_name(b, p), m), b, p, (_condition_name(None, REFERENCE_ENCODING), m))
        for p in encodings
        for b in budgets
        for m in methods
    )


def _make_row(
    results: ResultGrid, key: ResultKey, budget: int | None, encoding: str, reference: ResultKey | None
) -> BandwidthRow:
    result = results.results[key]
    size = result.bytes_per_message
    drop = None if reference is None else results.difference_pair(reference, key)
    ratio = results.results[reference].bytes_per_message / size if reference is not None and size else None
    max_bytes = result.volume.max_message_bytes
    return BandwidthRow(budget, encoding, key[1], results.ap_pair(key), drop, size, max_bytes, ratio)


def make_comparisons(
    results: ResultGrid,
    result_rows: Sequence[BandwidthRow],
    encodings: Sequence[str],
    budgets: Sequence[int | None],
    methods: Sequence[str],
) -> tuple[Comparison, ...]:
    """Compare our token selection: with all tokens at float32, and with the baselines at equal budgets."""
    if OURS_TEMPORAL not in methods:
        return ()
    reference = (_condition_name(None, REFERENCE_ENCODING), OURS_TEMPORAL)
    compressed = [
        r
        for r in result_rows
        if (r.method, r.token_encoding) == (OURS_TEMPORAL, REFERENCE_ENCODING)
        and (r.compression_ratio or 0.0) >= MIN_COMPRESSION_RATIO
    ]
    cases = []
    if compressed:
        row = max(compressed, key=lambda row: row.bytes_per_message)
        cases.append((row.budget_bytes, REFERENCE_ENCODING, f"{row.compression_ratio:.1f} times fewer bytes"))
    if THREE_PACKETS_BYTES in budgets:
        compact = [p for p in encodings if p not in ("float32", "float16")]
        cases += [(THREE_PACKETS_BYTES, p, f"{THREE_PACKETS_BYTES} B as {p}") for p in compact]
    out = [
        results.compare(f"{what} - all, {REFERENCE_ENCODING}", (_condition_name(b, p), OURS_TEMPORAL), reference)
        for b, p, what in cases
    ]
    for name in (_condition_name(b, p) for p in encodings for b in budgets if b is not None):
        for baseline in (m for m in methods if m != OURS_TEMPORAL):
            out.append(
                results.compare(f"{OURS_TEMPORAL} - {baseline}, {name}", (name, OURS_TEMPORAL), (name, baseline))
            )
    return tuple(out)


def _make_results_table(title: str, result_rows: Sequence[BandwidthRow]) -> StudyTable:
    headings = (
        "budget [bytes]", "token selection", "AP@0.5", "AP@0.7", "ΔAP@0.5 vs. all", "ΔAP@0.7 vs. all", "bytes/message", LOG2_BYTES,
        "max bytes", "compression",
    )  # fmt: skip
    lines = tuple(
        (
            "" if not row.token_encoding else "all" if row.budget_bytes is None else f"{row.budget_bytes:,}",
            row.method,
            *map(format_interval, row.ap),
            *((format_difference(-drop) for drop in row.ap_drop) if row.ap_drop else ("", "")),
            format_number(row.bytes_per_message),
            format_log2(row.bytes_per_message),
            format_number(row.max_message_bytes),
            "" if row.compression_ratio is None else f"{row.compression_ratio:.1f} x",
        )
        for row in result_rows
    )
    return StudyTable(title, headings, lines)


def make_panels(result_rows: Sequence[BandwidthRow], reference_rows: Sequence[BandwidthRow]) -> list[CurvePanel]:
    """Return AP@0.5 against the mean bytes of a message, one panel for each encoding."""
    out = []
    for encoding in dict.fromkeys(row.token_encoding for row in result_rows):
        curves = []
        for method in dict.fromkeys(row.method for row in result_rows):
            method_rows = [
                r for r in result_rows if (r.token_encoding, r.method) == (encoding, method) and r.bytes_per_message
            ]
            if method_rows:
                curves.append(
                    Curve(method, tuple(r.ap[0] for r in method_rows), tuple(r.bytes_per_message for r in method_rows))
                )
        for row in reference_rows:
            message_bytes = (row.bytes_per_message,) if row.bytes_per_message and row.method not in ALONE else ()
            curves.append(Curve(row.method, (row.ap[0],), message_bytes))
        out.append(
            CurvePanel(f"Tokens as {encoding}", "bytes per message, mean", "AP@0.5", tuple(curves), in_bytes=True)
        )
    return out
