# SPDX-License-Identifier: Apache-2.0
"""Cells of a map study: one method on one trial, judged, kept as one JSON file that a study that was stopped finds again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manyeyes._io import atomic_write
from manyeyes._source import source_digest
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.evaluation.maps.experiment import Scene, Trial, carry_out
from manyeyes.evaluation.maps.metrics import THRESHOLDS, MapQuality, judge
from manyeyes.evaluation.maps.registry import RIVALS, Settings, make_map


@dataclass(frozen=True)
class ApRow:
    """AP of one way at one set of thresholds; NaN for a kind without truth. mean: crossing and divider, as in the paper."""

    way: str
    thresholds: str
    crossing: float
    divider: float
    boundary: float
    stop_line: float
    mean: float


@dataclass(frozen=True)
class KindRow:
    """The other numbers of one kind; f at .3, .5 and 1 m."""

    kind: str
    n_predicted: int
    n_truth: int
    f: tuple[float, ...]
    precision: tuple[float, ...]
    recall: tuple[float, ...]
    duplication: float
    fragmentation: float
    lateral_median_m: float
    lateral_p95_m: float
    order_m: float
    end_error_m: float
    branch_f1: float


@dataclass(frozen=True)
class Cell:
    """A method's numbers on a trial. seconds: of the method alone."""

    place: str
    size_m: float
    window: str
    count: int
    seed: int
    pose_sigma_m: float
    method: str
    seconds: float
    ap: tuple[ApRow, ...]
    kinds: tuple[KindRow, ...]

    def ap_of(self, what: str = "mean", way: str = "exact", thresholds: str = "narrow") -> float:
        """One AP: what is a kind, or mean."""
        return next(getattr(row, what) for row in self.ap if (row.way, row.thresholds) == (way, thresholds))

    def kind(self, name: str) -> KindRow:
        """The other numbers of a kind."""
        return next(row for row in self.kinds if row.kind == name)


@dataclass(frozen=True)
class Unit:
    """One trial and all methods on it: what one process does at a time. folder: where cells are kept."""

    trial: Trial
    methods: tuple[str, ...]
    settings: Settings
    folder: Path


def cell_path(unit: Unit, method: str) -> Path:
    """The file of a cell; its name holds a digest of the trial, the method's configuration and the code that they run."""
    said = repr((unit.trial, method, unit.settings.of(method), code_digest(method)))
    digest = hashlib.blake2b(said.encode(), digest_size=6).hexdigest()
    trial = unit.trial
    return unit.folder / f"{trial.place}-{trial.window}-{trial.count:04d}-{trial.seed}-{method}-{digest}.json"


def code_digest(method: str) -> str:
    """A hash of the code that a cell of a method follows from."""
    return source_digest(
        "manyeyes.evaluation.maps.map_cells", *((f"manyeyes.maps.baselines.{method}",) if method in RIVALS else ())
    )


def run_unit(unit: Unit) -> list[Cell]:
    """The cells of a unit: found, or made and kept."""
    cells: dict[str, Cell] = {}
    scene: Scene | None = None
    for method in unit.methods:
        path = cell_path(unit, method)
        found = read_cell(path)
        if found is None:
            scene = scene or carry_out(unit.trial)
            found = run_cell(scene, method, unit.settings)
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic_write(path, (json.dumps(plain(found), indent=1) + "\n").encode())
        cells[method] = found
    return list(cells.values())


def run_cell(scene: Scene, method: str, settings: Settings) -> Cell:
    """One method on a scene, judged."""
    start = time.perf_counter()
    elements = make_map(method, scene, settings)
    seconds = time.perf_counter() - start
    quality = judge(scene.cut(elements), scene.truth)
    trial = scene.trial
    return Cell(
        place=trial.place,
        size_m=trial.size_m,
        window=trial.window,
        count=trial.count,
        seed=trial.seed,
        pose_sigma_m=trial.crowd.pose_sigma,
        method=method,
        seconds=seconds,
        ap=tuple(ap_rows(quality)),
        kinds=tuple(kind_rows(quality)),
    )


def ap_rows(quality: MapQuality) -> Iterable[ApRow]:
    """Every AP of a judged map."""
    for way in dict.fromkeys(p.way for p in quality.kinds[0].precision):
        for thresholds in THRESHOLDS:
            kinds = {kind: quality.ap(kind, way, thresholds) for kind in KINDS}
            yield ApRow(way, thresholds, mean=quality.mean_ap(way, thresholds), **kinds)


def kind_rows(quality: MapQuality) -> Iterable[KindRow]:
    """The numbers of every kind of a judged map."""
    for k in quality.kinds:
        yield KindRow(
            kind=k.kind,
            n_predicted=k.n_predicted,
            n_truth=k.n_truth,
            f=tuple(s.f for s in k.length),
            precision=tuple(s.precision for s in k.length),
            recall=tuple(s.recall for s in k.length),
            duplication=k.duplication,
            fragmentation=k.fragmentation,
            lateral_median_m=k.lateral_median_m,
            lateral_p95_m=k.lateral_p95_m,
            order_m=k.order_m,
            end_error_m=k.end_error_m,
            branch_f1=k.branch_f1,
        )


def read_cell(path: Path) -> Cell | None:
    """A kept cell; None where there is none, or one of another form."""
    try:
        held = json.loads(path.read_text(encoding="utf-8"), parse_constant=float)
        ap = tuple(ApRow(**numbers(row)) for row in held.pop("ap"))
        kinds = tuple(KindRow(**numbers(row)) for row in held.pop("kinds"))
        return Cell(ap=ap, kinds=kinds, **held)
    except (OSError, ValueError, TypeError, KeyError):
        return None


def judge_maps(elements: MapElements, truth: MapElements) -> tuple[tuple[ApRow, ...], tuple[KindRow, ...]]:
    """The numbers of a map that is no cell: somebody's own, against somebody's own truth."""
    quality = judge(elements, truth)
    return tuple(ap_rows(quality)), tuple(kind_rows(quality))


def plain(value: object) -> object:
    """A cell as JSON holds it; NaN is null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def numbers(row: dict[str, Any]) -> dict[str, Any]:
    """A row as it was: null is NaN, lists are tuples."""

    def back(value: Any) -> Any:
        if value is None:
            return math.nan
        return tuple(back(v) for v in value) if isinstance(value, list) else value

    return {name: back(value) for name, value in row.items()}
