# SPDX-License-Identifier: Apache-2.0
"""AP against bytes a message, for each token selection and each token encoding: CoSTr, Fig. 3.

Bytes are those handed to the bus: headers, indices, scales, checksums and all, mean over messages. The budget of a message goes
down to one packet. "all" is every token that the trained pruning left; at float32 it is what the others are held against.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from manyeyes.comms.payloads import TOKEN_ENCODINGS
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import load_detector
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.significance import MarginTest, check_margin
from manyeyes.evaluation.study import Condition, ResultGrid
from manyeyes.studies.running import (
    NO_FUSION,
    OURS,
    make_margin_table,
    prepare_study,
    resolve_token_selection,
    run_study,
    with_replay,
    write_study_report,
)
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.study_table import StudyTable, format_difference, format_interval, format_log2, format_number

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

BUDGETS = (1398, 2796, 4096, 8192, 16384, 32768, 65536, 131072)
UNLIMITED, REFERENCE_ENCODING, CODEBOOK = "references", "float32", "codebook"
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


def run(options: Options, console: Console) -> None:
    """Run the bandwidth study and write its report."""
    context, methods = prepare_study(options, console), resolve_token_selection(options)
    encodings = _resolve_encodings(options)
    budgets = (*sorted(options.budgets or BUDGETS), None)
    others = tuple(m for m in context.base.methods if m not in methods)
    conditions = [
        Condition(
            _condition_name(b, p), with_replay(replace(context.base, methods=methods), token_encoding=p, budget_bytes=b)
        )
        for p in encodings
        for b in budgets
    ]
    if REFERENCE_ENCODING not in encodings:
        config = with_replay(
            replace(context.base, methods=methods), token_encoding=REFERENCE_ENCODING, budget_bytes=None
        )
        conditions.append(Condition(_condition_name(None, REFERENCE_ENCODING), config))
    if others:
        conditions.append(Condition(UNLIMITED, replace(context.base, methods=others)))
    results = run_study(context, conditions)
    result_rows = make_rows(results, encodings, budgets, methods)
    reference_rows = tuple(
        BandwidthRow(None, "", m, (results.bootstrap_ap((UNLIMITED, m), 0), results.bootstrap_ap((UNLIMITED, m), 1)), None,
            results.results[UNLIMITED, m].bytes_per_message, results.results[UNLIMITED, m].volume.max_message_bytes, None)
        for m in others
    )  # fmt: skip
    margin_tests = check_margins(results, result_rows, encodings, budgets, methods)
    tables = [
        _make_results_table(f"Tokens as {p}", [row for row in result_rows if row.token_encoding == p])
        for p in encodings
    ]
    tables += [_make_results_table("Beside", reference_rows)] if reference_rows else []
    tables += [make_margin_table(margin_tests)] if margin_tests else []
    payload: dict[str, object] = {"rows": result_rows, "reference_rows": reference_rows, "margin_tests": margin_tests}
    write_study_report(context, payload, tables, make_panels(result_rows, reference_rows), conditions)


def _resolve_encodings(options: Options) -> tuple[str, ...]:
    """Those asked for, or all that the weights can write: codes need a codebook."""
    for name in options.token_encodings:
        if name not in TOKEN_ENCODINGS:
            raise ConfigError(f"Tokens are not written as {name!r}; known: {', '.join(TOKEN_ENCODINGS)}.")
    has_codes = load_detector(options.replay_options.weights).codebook is not None
    return options.token_encodings or tuple(name for name in TOKEN_ENCODINGS if name != CODEBOOK or has_codes)


def _condition_name(budget: int | None, encoding: str) -> str:
    return f"{'all' if budget is None else budget} {encoding}"


def make_rows(
    results: ResultGrid, encodings: Sequence[str], budgets: Sequence[int | None], methods: Sequence[str]
) -> tuple[BandwidthRow, ...]:
    """The table: precisions, budgets, selectors."""
    out = []
    for encoding in encodings:
        for budget in budgets:
            for method in methods:
                key, reference_key = (
                    (_condition_name(budget, encoding), method),
                    (_condition_name(None, REFERENCE_ENCODING), method),
                )
                result, reference = results.results[key], results.results[reference_key]
                bytes_per_message = result.bytes_per_message
                out.append(
                    BandwidthRow(
                        budget,
                        encoding,
                        method,
                        (results.bootstrap_ap(key, 0), results.bootstrap_ap(key, 1)),
                        (
                            results.paired_difference(reference_key, key, 0),
                            results.paired_difference(reference_key, key, 1),
                        ),
                        bytes_per_message,
                        result.volume.max_message_bytes,
                        reference.bytes_per_message / bytes_per_message if bytes_per_message else None,
                    )
                )
    return tuple(out)


def check_margins(
    results: ResultGrid,
    result_rows: Sequence[BandwidthRow],
    encodings: Sequence[str],
    budgets: Sequence[int | None],
    methods: Sequence[str],
) -> tuple[MarginTest, ...]:
    """Test our token selection: a small AP drop at few bytes, and not below a baseline at equal budgets."""
    if OURS not in methods:
        return ()
    out: list[MarginTest] = []
    reference_key = (_condition_name(None, REFERENCE_ENCODING), OURS)
    compressed = [
        r
        for r in result_rows
        if r.method == OURS
        and r.token_encoding == REFERENCE_ENCODING
        and r.compression_ratio
        and r.compression_ratio >= MIN_COMPRESSION_RATIO
    ]
    if compressed:
        largest_row = max(compressed, key=lambda row: row.bytes_per_message)
        description = f"{largest_row.compression_ratio:.1f} times fewer bytes - all, {REFERENCE_ENCODING}"
        out.append(
            check_margin(
                description,
                results,
                (_condition_name(largest_row.budget_bytes, REFERENCE_ENCODING), OURS),
                reference_key,
                0,
                -0.005,
            )
        )
    compact_encodings = [p for p in encodings if p not in ("float32", "float16")]
    if THREE_PACKETS_BYTES in budgets:
        for p in compact_encodings:
            out.append(
                check_margin(
                    f"{THREE_PACKETS_BYTES} B as {p} - all, {REFERENCE_ENCODING}",
                    results,
                    (_condition_name(THREE_PACKETS_BYTES, p), OURS),
                    reference_key,
                    0,
                    -0.01,
                )
            )
    for encoding in encodings:
        for budget in (b for b in budgets if b is not None):
            for baseline in (s for s in methods if s != OURS):
                name = _condition_name(budget, encoding)
                out.append(
                    check_margin(f"{OURS} - {baseline}, {name}", results, (name, OURS), (name, baseline), 0, 0.0)
                )
    return tuple(out)


def _make_results_table(title: str, result_rows: Sequence[BandwidthRow]) -> StudyTable:
    headings = (
        "budget B", "selector", "AP@0.5", "AP@0.7", "lost @0.5", "lost @0.7", "bytes/message", "AB log2", "largest B", "fewer",
    )  # fmt: skip
    lines = tuple(
        (
            "" if not row.token_encoding else "all" if row.budget_bytes is None else f"{row.budget_bytes:,}",
            row.method,
            *map(format_interval, row.ap),
            *(map(format_difference, row.ap_drop) if row.ap_drop else ("", "")),
            format_number(row.bytes_per_message),
            format_log2(row.bytes_per_message),
            format_number(row.max_message_bytes),
            "" if row.compression_ratio is None else f"{row.compression_ratio:.1f} x",
        )
        for row in result_rows
    )
    return StudyTable(title, headings, lines)


def make_panels(result_rows: Sequence[BandwidthRow], reference_rows: Sequence[BandwidthRow]) -> list[CurvePanel]:
    """AP@0.5 against the mean bytes of a message, a panel a precision."""
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
            message_bytes = (row.bytes_per_message,) if row.bytes_per_message and row.method != NO_FUSION else ()
            curves.append(Curve(row.method, (row.ap[0],), message_bytes))
        out.append(CurvePanel(f"Tokens as {encoding}", "bytes a message, mean", "AP@0.5", tuple(curves), in_bytes=True))
    return out
