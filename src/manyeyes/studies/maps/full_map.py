# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's Table 3: {local, semi-global} maps of agents x every way to fuse them, on the map of each town; and its Fig. 4.

Every agent looks once a scenario, at an instant of the seed, and what it says reaches the map as bytes. All rows of a town are
held against one truth, that in view of anybody's tile, for a short view is part of what a local map is; "in own view" holds each
against what its agents could see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.metrics import PAPER_KINDS
from manyeyes.evaluation.maps.pooled_ap import Block, Judged, MapClaim, blocks_of, claimed, mean_of, pooled_ap, squares
from manyeyes.evaluation.maps.registry import METHODS, OURS, RIVALS
from manyeyes.evaluation.maps.spatial_bootstrap import BLOCK_M
from manyeyes.evaluation.statistics.bootstrap import Drawn, Interval
from manyeyes.evaluation.study import recording_digest
from manyeyes.maps.store.executors import map_blocks
from manyeyes.studies.maps.fleet import executor_of
from manyeyes.studies.maps.recorded_fleet import CrowdMap, CrowdUnit, run_unit
from manyeyes.studies.maps.running import Model, cells_of, claims_sheet, models, publish, title_of
from manyeyes.studies.town_maps import grounds_of
from manyeyes.viz.map_figures import Panel
from manyeyes.viz.progress import bars
from manyeyes.viz.study_table import Sheet, number, value

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

LOCAL, SEMI_GLOBAL = "local", "semi-global"
SURVEYS = (SEMI_GLOBAL, LOCAL)
GOAL = 0.10
PICTURED_M = 150.0
PAPER = Sheet(
    "CrowdMap's Table 3: two crossroads of DAIR-V2X; no bar and no rival",
    ("method", "Map-06 AP ped", "AP div", "mAP", "Map-13 AP ped", "AP div", "mAP"),
    (
        ("MapTR + PolyMerge", "0.148", "0.085", "0.117", "0.618", "0.081", "0.350, printed 0.399"),
        ("MapTR + FDC", "0.202", "0.027", "0.114", "0.516", "0.018", "0.267, printed 0.264"),
        ("MapTR + HBM", "0.159", "0.148", "0.154", "0.575", "0.063", "0.319"),
        ("CrowdMap", "0.332", "0.188", "0.260", "0.818", "0.179", "0.499"),
    ),
)

Place = tuple[str, str]
"""A survey and a method."""


@dataclass(frozen=True)
class Row:
    """A survey and a method on one town, maptr; over 64 m squares with all seeds. seen: agents' observations a map."""

    town: str
    survey: str
    method: str
    ap: tuple[Interval, ...]
    mean: Interval
    exact: Interval
    in_own_view: Interval
    seen: float
    bytes_per_message: float


@dataclass(frozen=True, eq=False)
class Town:
    """All maps of one town, by survey and method, each once a seed, and the truth in view of anybody's tile."""

    name: str
    maps: dict[Place, tuple[CrowdMap, ...]]

    @cached_property
    def known(self) -> list[Block]:
        """Every square that holds anything."""
        return blocks_of([self.judged(place, own) for place in self.maps for own in (False, True)])

    def judged(self, place: Place, in_own_view: bool = False) -> list[Judged]:
        """A row's maps against the truth, seed by seed."""
        truths = self.maps[place] if in_own_view else self.maps[SEMI_GLOBAL, place[1]]
        of = squares(self.name, BLOCK_M)
        return [Judged(one.made, other.truth, of) for one, other in zip(self.maps[place], truths)]


def run(options: Options, console: Console) -> None:
    """The study."""
    model, *others = models(options)
    if others:
        raise ConfigError(f"The study 'whole' takes one model: name it with --weights; got {1 + len(others)}.")
    methods = options.methods or METHODS
    towns = _towns(options, console, model, methods)
    means = {town.name: {place: _mean(town, place, town.known) for place in town.maps} for town in towns}
    rows = [_row(town, place, means[town.name][place]) for town in towns for place in town.maps]
    claims = _claims(means, methods)
    sheets = [_sheet(town.name, rows) for town in towns] + [claims_sheet(claims, "squares of 64 m"), PAPER]
    payload: dict[str, object] = {"rows": rows, "claims": claims}
    publish(options, console, title_of(options, [model]), payload, sheets, _panels(towns, means), 3)


def _towns(options: Options, console: Console, model: Model, methods: Sequence[str]) -> list[Town]:
    recording = model.world.open()
    data, cells = recording_digest(recording), cells_of(options)
    grounds = grounds_of(recording, recording.scenarios[:: options.every], "elsewhere")
    units = [
        CrowdUnit(model.world, model.weights, ground, survey, seed, tuple(methods), cells, data)
        for ground in grounds
        for survey in SURVEYS
        for seed in range(options.seeds)
    ]
    with bars(console) as progress:
        task = progress.add_task("Maps of towns", total=len(units))
        with executor_of(options.workers).open() as runner:
            done = map_blocks(run_unit, units, runner, lambda at, total: progress.update(task, completed=at))
    made = {(u.ground.name, u.survey, u.seed): maps for u, maps in zip(units, done)}
    return [
        Town(
            ground.name,
            {
                (survey, method): tuple(made[ground.name, survey, seed][k] for seed in range(options.seeds))
                for survey in SURVEYS
                for k, method in enumerate(methods)
            },
        )
        for ground in grounds
    ]


def _mean(town: Town, place: Place, known: list[Block], way: str = "maptr", in_own_view: bool = False) -> Drawn:
    judged = town.judged(place, in_own_view)
    return mean_of([pooled_ap(judged, kind, way, known=known) for kind in PAPER_KINDS])


def _row(town: Town, place: Place, mean: Drawn) -> Row:
    known, maps = town.known, town.maps[place]
    return Row(
        town.name,
        *place,
        ap=tuple(pooled_ap(town.judged(place), kind, known=known).interval() for kind in PAPER_KINDS),
        mean=mean.interval(),
        exact=_mean(town, place, known, "exact").interval(),
        in_own_view=_mean(town, place, known, in_own_view=True).interval(),
        seen=sum(one.seen for one in maps) / len(maps),
        bytes_per_message=sum(one.bytes_per_message for one in maps) / len(maps),
    )


def _claims(means: dict[str, dict[Place, Drawn]], methods: Sequence[str]) -> list[MapClaim]:
    """The whole, semi-global and our fusion, less each local row with a rival's fusion, as the mean over towns."""
    if OURS not in methods:
        return []

    def over_towns(place: Place) -> Drawn:
        return mean_of([of[place] for of in means.values()])

    whole = over_towns((SEMI_GLOBAL, OURS))
    rivals = {method: over_towns((LOCAL, method)) for method in methods if method in RIVALS}
    out = [claimed(f"the whole - local + {method}", whole.less(rival), 0.0) for method, rival in rivals.items()]
    if rivals:
        best = max(rivals, key=lambda method: rivals[method].value)
        out.append(claimed(f"the whole - local + {best}, the best of them, goal", whole.less(rivals[best]), GOAL))
    out.append(claimed(f"the whole - local + {OURS}", whole.less(over_towns((LOCAL, OURS))), 0.0))
    return out


def _sheet(town: str, rows: Sequence[Row]) -> Sheet:
    lines = tuple(
        (
            row.survey,
            row.method,
            *map(value, row.ap),
            value(row.mean),
            value(row.exact),
            value(row.in_own_view),
            number(row.seen),
            number(row.bytes_per_message),
        )
        for row in rows
        if row.town == town
    )
    headings = (
        "maps",
        "fusion",
        "AP ped",
        "AP div",
        "mAP",
        "mAP exact",
        "in own view",
        "observations",
        "bytes/message",
    )
    return Sheet(f"The map of {town}", headings, lines)


def _panels(towns: Sequence[Town], means: dict[str, dict[Place, Drawn]]) -> list[Panel]:
    """For each town the truth, the best local row of a rival, and the whole, about the middle of what is true."""
    out = []
    for town in towns:
        locals_ = {place: d.value for place, d in means[town.name].items() if place[0] == LOCAL and place[1] != OURS}
        best = max(locals_, key=lambda place: locals_[place], default=(LOCAL, OURS))
        places = [place for place in (best, (SEMI_GLOBAL, OURS)) if place in town.maps]
        if not places:
            continue
        truth = town.maps[SEMI_GLOBAL, places[-1][1]][0].truth
        x, y = truth.points.mean(0).round().tolist() if len(truth) else (0.0, 0.0)
        area = (x - PICTURED_M, y - PICTURED_M, x + PICTURED_M, y + PICTURED_M)
        out.append(Panel(f"{town.name}: truth in view", truth, area=area))
        out += [
            Panel(f"{town.name}: {survey} + {method}", town.maps[survey, method][0].made, truth, area=area)
            for survey, method in places
        ]
    return out
