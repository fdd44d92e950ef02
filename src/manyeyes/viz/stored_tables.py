# SPDX-License-Identifier: Apache-2.0
"""Tables of stored results (JSON of commands, studies and benchmarks), for documents.

A result is tabulated only if it states where it comes from: command, commit, seeds, and split where it has a recording.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.training_seeds import (
    SeedRun,
    compare_with_baselines,
    compute_pooled_std,
    summarize_seeds,
)
from manyeyes.viz.stored_pose_tables import is_pose_lines, is_pose_rows, make_pose_lines, make_pose_rows
from manyeyes.viz.stored_study_tables import (
    format_stored_interval,
    make_main_tables,
    make_printed_tables,
    make_robustness_tables,
)
from manyeyes.viz.study_table import format_difference, format_interval as format_value
from manyeyes.viz.table import Lines, StoredTable, add_class_column

_IOUS = ("AP@0.5", "AP@0.7")


@dataclass(frozen=True)
class StoredResult:
    """A file of results. command, commit, seeds, split: where its numbers come from; split is empty without a recording."""

    path: Path
    result: Any
    command: str
    commit: str
    seeds: tuple[int, ...]
    split: str

    @property
    def origin(self) -> str:
        """Format where the numbers come from, for the line below a table."""
        seeds = "seed" if len(self.seeds) == 1 else "seeds"
        parts = (f"`{self.command}`", f"commit {self.commit}", f"{seeds} {', '.join(map(str, self.seeds))}")
        return ", ".join((*parts, *((f"split {self.split}",) if self.split else ()))) + "."


def load_result(path: Path) -> StoredResult:
    """Read a file of results.

    Raises:
        ConfigError: it cannot be read, or does not state where its numbers come from; the text names file and fields.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        origin, result = stored["provenance"], stored["result"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: no stored result with provenance ({error!r}); write it by its command.") from error
    fields = result if isinstance(result, dict) else {}
    config = origin.get("config")
    stated = config.get("command") if isinstance(config, dict) else None
    command = fields.get("command") or stated or origin.get("command")
    seeds = origin.get("seeds") or [origin.get("seed")]
    split = _find_split(origin, fields)
    missing = [
        name
        for name, value in (
            ("command", command),
            ("git_commit", origin.get("git_commit")),
            ("seed", None if None in seeds else seeds),
            ("split", split or _has_no_recording(fields)),
        )
        if not value
    ]
    if missing:
        raise ConfigError(
            f"{path}: its provenance lacks {', '.join(missing)}, so its numbers cannot be made again and are not "
            "written to a document; store the result again by its command, in a checkout."
        )
    commit, _, changes = str(origin["git_commit"]).partition("+")
    return StoredResult(
        path, result, command, f"{commit[:12]}{f' with {changes}' if changes else ''}", tuple(seeds), split
    )


def _find_split(origin: dict[str, Any], result: dict[str, Any]) -> str:
    """Return the split, or several, that a result is of; empty where it states none."""
    config = origin.get("config")
    options = config.get("options") if isinstance(config, dict) else None
    options = options if isinstance(options, dict) else {}
    if result.get("study") == "strata":
        return ", ".join(dict.fromkeys(row["stratum"] for row in result["rows"]))
    if "cases" in result:
        # Recordings are named by the command; each case is one of them.
        return ", ".join(dict.fromkeys(case["case"] for case in result["cases"]))
    # The live runtime plays a folder and a split.
    played = options.get("recording") or ("", "")
    return str(options.get("validation_split") or options.get("split") or result.get("split") or played[1])


def _is_speed(result: dict[str, Any]) -> bool:
    """Return whether a result is of the benchmark of speed."""
    return "settings" in result and "contender" in (result.get("rows") or [{}])[0]


def _has_no_recording(result: dict[str, Any]) -> bool:
    """Return whether a result is of a benchmark whose scenes are made by its seed."""
    return is_pose_lines(result) or is_pose_rows(result) or _is_speed(result) or _has_simulated_scenes(result)


_SIMULATED_STUDIES = ("adversarial", "malicious-agents", "map-incremental", "false-accusations", "signatures")


def _has_simulated_scenes(result: dict[str, Any]) -> bool:
    """Return whether a result is of the step, of the cost of maps, of the live runtime or of a study of drives or map fusion, which
    simulate what they need.
    """
    simulates = "summaries" in result or result.get("study") in _SIMULATED_STUDIES
    simulates |= "load_before" in result
    return simulates or "costs" in result or "present_stages_ms" in (result.get("rows") or [{}])[0]


def make_tables(stored: StoredResult) -> tuple[StoredTable, ...]:
    """Make the tables of one file, by what it holds.

    Raises:
        ConfigError: it is of none of the known commands.
    """
    result = stored.result
    for fits, make in _KINDS:
        if isinstance(result, dict) and fits(result):
            return tuple(make(result))
    raise ConfigError(
        f"{stored.path}: no result of evaluate, finetune, a study, unseen_scenes.py or speed.py; no table is known for it."
    )


def _format_bytes(number: float | None) -> str:
    return f"{number:,.0f}" if number else "-"


def _make_evaluation(result: dict[str, Any]) -> list[StoredTable]:
    lines: Lines = [("method", *_IOUS, "bytes/message")]
    for row in result["rows"]:
        ap = (format_stored_interval(row["ap50"]), format_stored_interval(row["ap70"]))
        lines.append((row["method"], *ap, _format_bytes(row["bytes_per_message"])))
    classes = [row.get("class_name", "vehicle") for row in result["rows"]]
    tables = [StoredTable("methods", "Methods", add_class_column(lines, classes))]
    if result.get("operating_rows"):
        tables.append(_make_operating_table(result))
    if result.get("differences"):
        differences: Lines = [("paired difference", "metric", "ΔAP [95 % CI]")]
        differences += [
            (d["description"], d["metric"], format_stored_interval(d["interval"], "+.3f"))
            for d in result["differences"]
        ]
        tables.append(StoredTable("differences", "Paired differences", differences))
    return tables


def _make_operating_table(result: dict[str, Any]) -> StoredTable:
    lines: Lines = [
        (
            "method", "threshold", "precision", "recall", "F", "false alarms/frame", "duplicates/object", "legacy AP@0.5",
            "legacy AP@0.7",
        )
    ]  # fmt: skip
    for row in result["operating_rows"]:
        point = row["point"]
        values = [
            point[name]
            for name in ("precision", "recall", "f_score", "false_alarms_per_frame", "duplicates_per_object")
        ]
        cells = (format_stored_interval(value) for value in (*values, *row["legacy_ap"]))
        lines.append((row["method"], f"{point['threshold']['score']:.3f} ({point['threshold']['source']})", *cells))
    classes = [row["class_name"] for row in result["operating_rows"]]
    threshold = result["protocol"]["score_threshold"]
    title = f"At one score threshold, IoU 0.5; legacy AP of detections with score above {threshold:g}"
    return StoredTable("operating-point", title, add_class_column(lines, classes))


def _make_strata(result: dict[str, Any]) -> list[StoredTable]:
    lines: Lines = [("stratum", "method", "scenarios", *_IOUS, "bytes/message")]
    for row in result["rows"]:
        ap = tuple(map(format_stored_interval, row["ap"]))
        lines.append(
            (row["stratum"], row["method"], str(row["num_scenarios"]), *ap, _format_bytes(row["bytes_per_message"]))
        )
    return [StoredTable("strata", "Strata", lines)]


def _make_sensors(result: dict[str, Any]) -> list[StoredTable]:
    tables = []
    for method in dict.fromkeys(row["method"] for row in result["rows"]):
        mine = [row for row in result["rows"] if row["method"] == method]
        cells = {(row["law"], _name_column(row)): row["ap"][0] for row in mine}
        laws, columns = (list(dict.fromkeys(names)) for names in zip(*cells))
        lines: Lines = [("intensity", *columns)]
        lines += [(law, *(format_stored_interval(cells.get((law, column))) for column in columns)) for law in laws]
        tables.append(StoredTable(f"sensors-{method}", f"AP@0.5 by sensor, {method}", lines))
    return tables


def _name_column(row: dict[str, Any]) -> str:
    tilt = f", tilt {row['tilt_deg']:g}°" if row["tilt_deg"] else ""
    return f"{row['recording']}, {row['sweeps']} sweep{'s' if row['sweeps'] > 1 else ''}{tilt}"


def _make_cases(result: dict[str, Any]) -> list[StoredTable]:
    lines: Lines = [
        ("recording", "frames", "vehicles", "matched at IoU 0.5", "false boxes above the limit", "under crowns")
    ]
    for case in result["cases"]:
        crowns = f"{case['matched_under_crowns']} of {case['under_crowns']}" if case["under_crowns"] else "-"
        numbers = (case["frames"], case["vehicles"], case["matched"], case["false_boxes"])
        lines.append((case["case"], *(f"{n:,}" for n in numbers), crowns))
    return [StoredTable("cases", "Real recordings and hard scenes, each agent alone", lines)]


def _make_finetune(result: dict[str, Any]) -> list[StoredTable]:
    lines: Lines = [("weights", "method", *_IOUS, "bytes/message")]
    for row in result["rows"]:
        ap = tuple(map(format_stored_interval, row["ap"]))
        lines.append((row["weights"], row["method"], *ap, _format_bytes(row["bytes_per_message"])))
    return [StoredTable("finetune", "Before and after fine-tuning", lines)]


def _make_speed(result: dict[str, Any]) -> list[StoredTable]:
    lines: Lines = [("sparse against dense PointPillars with attention fusion", "ratio")]
    names = {"sparse, unpruned": "unpruned", "sparse, pruned": "at the cells that `costr-small` keeps"}
    for row in result["rows"]:
        if row["ratio"] is not None:
            name = names.get(row["contender"], row["contender"])
            lines.append((f"widths {row['widths']}, {name}", f"{row['ratio']['together']:.1f}x"))
    return [StoredTable("speed", "Speed", lines)]


_KINDS: tuple[tuple[Callable[[dict[str, Any]], bool], Callable[[dict[str, Any]], list[StoredTable]]], ...] = (
    (lambda result: result.get("study") == "sensors", _make_sensors),
    (lambda result: result.get("study") == "strata", _make_strata),
    (is_pose_lines, make_pose_lines),
    (is_pose_rows, make_pose_rows),
    (lambda result: "cases" in result, _make_cases),
    (lambda result: "stats" in result and "rows" in result, _make_evaluation),
    (lambda result: "cpu_minutes" in result and "rows" in result, _make_finetune),
    (_is_speed, _make_speed),
    (lambda result: result.get("study") == "main-table", make_main_tables),
    (lambda result: result.get("study") == "robustness", make_robustness_tables),
    (lambda result: "study" in result and "tables" in result, make_printed_tables),
)


def make_seed_tables(
    runs: Sequence[tuple[str, StoredResult]], method: str, class_name: str = "vehicle"
) -> tuple[StoredTable, ...]:
    """Make the tables of methods that were trained from several seeds: means with spread, and differences of the first to the
    others.

    runs: name of a method, and results of 'manyeyes evaluate' of one of its trainings. method: the strategy whose numbers count.

    Raises:
        ConfigError: a file lacks the strategy, its resamples or the seed of the training.
    """
    names = list(dict.fromkeys(name for name, _ in runs))
    lines: Lines = [("method", "seeds", *(f"{iou}{text}" for iou in _IOUS for text in ("", " sd over seeds")))]
    differences: Lines = [("difference of means", "metric", "value [95 % CI]", "claimed")]
    cells: dict[str, list[str]] = {name: [] for name in names}
    seeds, pooled = dict[str, str](), list[str]()
    for column, iou in enumerate(_IOUS):
        summaries = summarize_seeds([_read_run(name, stored, method, class_name, column) for name, stored in runs])
        std = compute_pooled_std(summaries)
        pooled.append(f"{iou} {std:.3f}")
        for s in summaries:
            seeds[s.method] = ", ".join(map(str, s.seeds))
            cells[s.method] += [format_value(s.mean), "-" if math.isnan(s.seed_std) else f"{s.seed_std:.3f}"]
        for d in compare_with_baselines(summaries, names[0]):
            claim = "yes" if d.is_claimed else "not claimed"
            differences.append((f"{d.method} - {d.baseline}", iou, format_difference(d.interval), claim))
    lines += [(name, seeds[name], *cells[name]) for name in names]
    title = (
        f"Differences; claimed from twice the standard deviation over seeds, pooled over methods: {', '.join(pooled)}"
    )
    return StoredTable("seeds", "Mean over training seeds", lines), StoredTable("seed-differences", title, differences)


def _read_run(name: str, stored: StoredResult, method: str, class_name: str, column: int) -> SeedRun:
    result = stored.result
    stats = [s for s in result["stats"] if s["method"] == method and s["class_name"] == class_name]
    seed = result.get("training_seed")
    if not stats or seed is None or not stats[0].get("resamples"):
        wanted = f"the method {method} of class {class_name} with its resamples, and training_seed"
        raise ConfigError(f"{stored.path}: needs {wanted}; evaluate weights whose card has a seed, by this version.")
    resamples = np.array([math.nan if v is None else v for v in stats[0]["resamples"][column]])
    return SeedRun(
        name, int(seed), stats[0]["ap_summaries"][column]["ap"]["value"], resamples, tuple(result["scenarios"])
    )
