# SPDX-License-Identifier: Apache-2.0
"""Studies of map fusion: methods side by side over places, counts of observations and seeds, held against bars.

A cell is a place and a seed; intervals are percentile bootstraps over cells (Efron and Tibshirani, 1993), 95 %, and a difference
of two methods is paired over the same cells. The best rival at a count is the one with the greatest mean there. A bar is judged
by the whole interval, as everywhere: where it straddles the bar, the table says "not resolved".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.experiment import Trial
from manyeyes.evaluation.maps.map_cells import Cell, Unit, run_unit
from manyeyes.evaluation.maps.oracles import ORACLES
from manyeyes.evaluation.maps.registry import OURS, RIVALS, Settings
from manyeyes.evaluation.statistics.bootstrap import Interval, mean_interval, resolved
from manyeyes.evaluation.statistics.bootstrap import Verdict as Word
from manyeyes.maps.store.executors import Executor, map_blocks
from manyeyes.simulator.fleet.config import CROWDS

TEST_PLACES = ("Town03", "Town05", "av2-miami", "av2-pittsburgh")
TUNING_PLACES = ("Town01", "Town02", "Town07")
COUNTS, SEEDS = (20, 60, 200), (0, 1, 2)
NOISE_M = (0.0, 0.4, 0.8, 1.2, 1.5)
NOISE_COUNT = 100
TABLE3 = (("Town05", 300.0), ("Town03", 250.0))
TABLE3_COUNT = 60


@dataclass(frozen=True)
class StudyConfig:
    """Which trials and methods. counts and noise are used by the studies that have them."""

    name: str
    places: tuple[str, ...] = TEST_PLACES
    counts: tuple[int, ...] = COUNTS
    seeds: tuple[int, ...] = SEEDS
    noise_m: tuple[float, ...] = NOISE_M
    methods: tuple[str, ...] = (OURS, *RIVALS)
    settings: Settings = field(default_factory=Settings)


def trials(config: StudyConfig) -> list[Trial]:
    """The trials of a study, places together: a place is read once a process."""
    local = CROWDS["local"]
    if config.name == "fusion":
        return [Trial(p, n, s, crowd=local) for p in config.places for n in config.counts for s in config.seeds]
    if config.name == "noise":
        made = [Trial(p, NOISE_COUNT, s, crowd=local) for p in config.places for s in config.seeds]
        return [trial.noisy(sigma) for trial in made for sigma in config.noise_m]
    if config.name == "table3":
        windows = ("local", "semi-global")
        return [
            Trial(p, TABLE3_COUNT, s, size, window, CROWDS[window])
            for p, size in TABLE3
            for window in windows
            for s in config.seeds
        ]
    raise ConfigError(f"No study is called {config.name!r}; known: fusion, noise, table3, malicious, tuning.")


def run_study(
    config: StudyConfig, folder: Path, executor: Executor, progress: Callable[[int, int], None] | None = None
) -> tuple[Cell, ...]:
    """All cells of a study, in its own order whatever the executor; those kept in the folder are not made again."""
    units = [Unit(trial, config.methods, config.settings, folder) for trial in trials(config)]
    with executor.open() as runner:
        done = map_blocks(run_unit, units, runner, progress)
    return tuple(cell for cells in done for cell in cells)


@dataclass(frozen=True)
class Line:
    """A method's means over cells, with the interval of its mAP (exact, narrow)."""

    group: str
    method: str
    cells: int
    crossing: float
    divider: float
    mean: Interval
    maptr: float
    streammapnet: float
    f: float
    duplication: float
    fragmentation: float
    lateral_m: float
    end_error_m: float
    seconds: float


@dataclass(frozen=True)
class Verdict:
    """A bar of the study, what was measured against it, and the word on it: reached, missed or not resolved."""

    group: str
    what: str
    rival: str
    value: float
    low: float
    high: float
    bar: float
    word: Word


def group_of(config: StudyConfig, cell: Cell) -> str:
    """Which table a cell belongs to."""
    if config.name == "noise":
        return f"{cell.pose_sigma_m:g} m"
    if config.name == "table3":
        return f"{cell.size_m:g} m {cell.place}, {cell.window}"
    return f"{cell.count} observations"


def lines(config: StudyConfig, cells: Sequence[Cell]) -> tuple[Line, ...]:
    """The table: a group after the other, methods in the order of the study."""
    out = []
    for group in dict.fromkeys(group_of(config, cell) for cell in cells):
        for method in config.methods:
            own = [c for c in cells if group_of(config, c) == group and c.method == method]
            if own:
                out.append(_line(group, method, own))
    return tuple(out)


def _line(group: str, method: str, cells: Sequence[Cell]) -> Line:
    dividers = [c.kind("divider") for c in cells]
    return Line(
        group=group,
        method=method,
        cells=len(cells),
        crossing=_mean([c.ap_of("crossing") for c in cells]),
        divider=_mean([c.ap_of("divider") for c in cells]),
        mean=mean_interval([c.ap_of() for c in cells]),
        maptr=_mean([c.ap_of(way="maptr") for c in cells]),
        streammapnet=_mean([c.ap_of(way="streammapnet", thresholds="wide") for c in cells]),
        f=_mean([d.f[1] for d in dividers]),
        duplication=_mean([d.duplication for d in dividers]),
        fragmentation=_mean([d.fragmentation for d in dividers]),
        lateral_m=_mean([d.lateral_median_m for d in dividers]),
        end_error_m=_mean([d.end_error_m for d in dividers]),
        seconds=_mean([c.seconds for c in cells]),
    )


def verdicts(config: StudyConfig, cells: Sequence[Cell]) -> tuple[Verdict, ...]:
    """The bars of the fusion study, at each count; nothing for other studies."""
    if config.name != "fusion" or OURS not in config.methods:
        return ()
    out = []
    for group in dict.fromkeys(group_of(config, cell) for cell in cells):
        own = [c for c in cells if group_of(config, c) == group]
        for way, thresholds in (("exact", "narrow"), ("maptr", "narrow"), ("streammapnet", "wide")):
            out += _against_best(group, own, config.methods, way, thresholds)
        if group.startswith("60 "):
            out += _dividers(group, own, config.methods)
        if group.startswith("200 "):
            ours = [c.kind("divider") for c in own if c.method == OURS]
            f, duplication = mean_interval([k.f[1] for k in ours]), mean_interval([k.duplication for k in ours])
            out.append(
                Verdict(group, "F@0.5 m of dividers", "", f.value, f.low, f.high, 0.97, resolved(0.97, f.low, f.high))
            )
            low, high = duplication.low, duplication.high
            # Within both sides: the worse of two words.
            words = resolved(0.95, low, high), resolved(-1.05, -high, -low)
            word: Word = "reached" if words == ("reached",) * 2 else "missed" if "missed" in words else "not resolved"
            what = "duplication of dividers, 0.95 to 1.05"
            out.append(Verdict(group, what, "", duplication.value, low, high, 1.0, word))
    return tuple(out)


def _against_best(
    group: str, cells: Sequence[Cell], methods: Sequence[str], way: str, thresholds: str
) -> list[Verdict]:
    rival = best_rival(cells, methods, "mean", way, thresholds)
    if rival is None:
        return []
    gain = difference(cells, OURS, rival, "mean", way, thresholds)
    what = f"mAP ({way}, {thresholds}) above the best rival"
    return [Verdict(group, what, rival, gain.value, gain.low, gain.high, 0.10, resolved(0.10, gain.low, gain.high))]


def _dividers(group: str, cells: Sequence[Cell], methods: Sequence[str]) -> list[Verdict]:
    """AP of dividers: twice the best rival's, or half of its remaining error."""
    rival = best_rival(cells, methods, "divider", "exact", "narrow")
    if rival is None:
        return []
    theirs = _mean([c.ap_of("divider") for c in cells if c.method == rival])
    bar = min(2 * theirs, theirs + 0.5 * (1 - theirs))
    ours = mean_interval([c.ap_of("divider") for c in cells if c.method == OURS])
    what = f"AP of dividers; {rival} has {theirs:.3f}"
    return [Verdict(group, what, rival, ours.value, ours.low, ours.high, bar, resolved(bar, ours.low, ours.high))]


def best_rival(cells: Sequence[Cell], methods: Sequence[str], what: str, way: str, thresholds: str) -> str | None:
    """The rival with the greatest mean AP; of equal ones the first. Oracles are no rivals."""
    rivals = [m for m in methods if m != OURS and m not in ORACLES]
    means = [_mean([c.ap_of(what, way, thresholds) for c in cells if c.method == m]) for m in rivals]
    known = [(-mean, k) for k, mean in enumerate(means) if not math.isnan(mean)]
    return rivals[min(known)[1]] if known else None


def difference(cells: Sequence[Cell], a: str, b: str, what: str, way: str, thresholds: str) -> Interval:
    """AP of one method less that of another, paired over the cells that both have."""

    def of(method: str) -> dict[tuple[object, ...], float]:
        return {
            (c.place, c.size_m, c.window, c.count, c.seed, c.pose_sigma_m): c.ap_of(what, way, thresholds)
            for c in cells
            if c.method == method
        }

    one, other = of(a), of(b)
    gains = [one[key] - other[key] for key in sorted(one.keys() & other.keys())]
    return mean_interval([g for g in gains if not math.isnan(g)])


def _mean(values: Sequence[float]) -> float:
    """The mean of those that are numbers; NaN where none is."""
    known = [v for v in values if not math.isnan(v)]
    return float(np.mean(known)) if known else math.nan


def smaller(config: StudyConfig, places: Sequence[str] | None, counts: Sequence[int] | None, seeds: int) -> StudyConfig:
    """A study over fewer places, counts or seeds."""
    return replace(
        config,
        places=tuple(places or config.places),
        counts=tuple(counts or config.counts),
        seeds=tuple(range(seeds)),
    )
