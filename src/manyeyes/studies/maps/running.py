# SPDX-License-Identifier: Apache-2.0
"""What studies of the map model have in common: whose weights, which recording, tables by sensors, claims, pictures, files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from manyeyes._io import atomic_write_text
from manyeyes.datasets.base import Recording
from manyeyes.datasets.dair_index import dair_root
from manyeyes.datasets.missing import MissingFiles
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.pooled_ap import MapClaim
from manyeyes.evaluation.maps.tile_cells import Draw, TileCell, World, run_tiles
from manyeyes.evaluation.maps.tile_metrics import KINDS, WAYS, TileRow, TileTable
from manyeyes.evaluation.maps.tiles import assert_split
from manyeyes.models import pretrained
from manyeyes.studies import provenance
from manyeyes.studies.map_recordings import has_pictures, open_looks, true_maps
from manyeyes.studies.maps.fleet import executor_of
from manyeyes.studies.recordings import cells_folder, check_files, open_recording
from manyeyes.viz.map_figures import Panel, save_figure
from manyeyes.viz.progress import bars
from manyeyes.viz.study_table import Sheet, change, markdown, number, terminal, value
from manyeyes.viz.table import NOT_RUN, missing_footer

if TYPE_CHECKING:
    from manyeyes.studies.maps.options import Options

SENSORS = {("lidar",): "LiDAR", ("camera",): "camera", ("lidar", "camera"): "both"}
"""The rows of a table, whether there are weights for them or not."""
HEADINGS = ("sensors", "row", "AP ped", "AP div", "mAP", "exact", "AP edge", "looks", "B/look", "B/tile")
"""AP and mAP in the way maptr, over crossings and dividers; exact: mAP in that way; edge: boundaries; B: bytes."""


@dataclass(frozen=True)
class OpenLooks:
    """Opens the recording with what these sensors took, in this process or another."""

    data: Path
    split: str
    sensors: tuple[str, ...]

    def __call__(self) -> Recording:
        """The recording."""
        return open_looks(self.data, self.split, self.sensors)


@dataclass(frozen=True)
class Model:
    """Weights by name, the sensors that they are for, and where they are judged."""

    weights: str
    sensors: str
    world: World


def missing_files(options: Options, console: Console) -> MissingFiles:
    """The files that the recording of a study lacks; an error unless they are allowed."""
    assert options.data is not None
    return check_files(open_recording(options.data, options.split), options.checks, console)


def cells_of(options: Options) -> Path:
    """The folder for the kept results of this study."""
    return cells_folder(options.out, missing_files(options, Console(quiet=True)))


def models(options: Options) -> tuple[Model, ...]:
    """The models that are judged: those given, or those that ship; refused where one was taught by a town that would judge it."""
    assert options.data is not None
    names = options.weights or _shipped_for(options)
    if not names:
        raise ConfigError(
            "No map model ships with this version: give --weights FILE of 'manyeyes train --preset map-small'."
        )
    found = []
    for name in names:
        sensors = pretrained.load_mapper(name).config.bev.sensors
        world = World(OpenLooks(options.data, options.split, sensors), true_maps)
        assert_split(
            pretrained.mapper_towns(name), [scenario.rpartition("_")[0] for scenario in world.open().scenarios]
        )
        found.append(Model(str(name), SENSORS[tuple(sorted(sensors, reverse=True))], world))
    if len({model.sensors for model in found}) < len(found):
        raise ConfigError(f"One model a set of sensors; got {', '.join(m.sensors for m in found)}.")
    return tuple(found)


def _shipped_for(options: Options) -> tuple[str, ...]:
    """The shipped models whose sensors the recording has."""
    assert options.data is not None
    if not pretrained.mappers():
        return ()
    seeing = dair_root(options.data) is None and has_pictures(open_recording(options.data, options.split, images=True))
    return tuple(
        name
        for name in pretrained.mappers()
        if seeing or "camera" not in pretrained.load_mapper(name).config.bev.sensors
    )


def tables(options: Options, console: Console, found: Sequence[Model], draw: Draw) -> dict[str, TileTable]:
    """What each model draws, by its sensors."""
    return {model.sensors: TileTable(_drawn(options, console, model, draw)) for model in found}


def _drawn(options: Options, console: Console, model: Model, draw: Draw) -> tuple[TileCell, ...]:
    with bars(console) as progress:
        task = progress.add_task(f"Tiles, {model.sensors}", total=None)
        return run_tiles(
            model.world,
            model.weights,
            draw,
            range(options.seeds),
            cells_of(options),
            executor_of(options.workers),
            lambda done, total: progress.update(task, completed=done, total=total),
            options.every,
        )


def rows_sheet(title: str, rows: Mapping[str, Sequence[TileRow]]) -> Sheet:
    """A line for each row of each set of sensors; sets without weights read "not run"."""
    lines: list[tuple[str, ...]] = []
    for sensors in SENSORS.values():
        lines += [(sensors, row.row, *_cells(row)) for row in rows.get(sensors, ())]
        if sensors not in rows:
            lines.append((sensors, NOT_RUN, *[""] * (len(HEADINGS) - 2)))
    return Sheet(title, HEADINGS, tuple(lines))


def _cells(row: TileRow) -> tuple[str, ...]:
    ap = dict(zip(KINDS, row.ap[WAYS.index("maptr")]))
    means = [value(row.mean[WAYS.index(way)]) for way in WAYS]
    sizes = (number(row.looks, 1), number(row.bytes_per_look), number(row.bytes_per_tile))
    return (value(ap["crossing"]), value(ap["divider"]), *means, value(ap["boundary"]), *sizes)


def claims_sheet(claims: Sequence[MapClaim], over: str) -> Sheet:
    """The claims as a table; over: what is drawn with replacement."""
    lines = tuple((c.what, change(c.difference), f"{c.bar:+.3f}", c.verdict) for c in claims)
    return Sheet(
        f"Claims, mAP paired over {over}", ("claim", "difference, 95 % interval", "at least", "verdict"), lines
    )


def shown(cells: Sequence[TileCell], weigh: Callable[[TileCell], int], count: int = 3) -> list[TileCell]:
    """So many cells of the first seed for a picture, evenly spaced in the order of what they weigh, not chosen for their looks."""
    first = sorted((c for c in cells if c.seed == cells[0].seed), key=lambda c: (weigh(c), c.scenario))
    places = np.unique(np.linspace(0, len(first) - 1, count + 2)[1:-1].round().astype(int))
    return [first[place] for place in places.tolist()]


def tile_panels(cell: TileCell, rows: Mapping[str, str], area: tuple[float, float, float, float]) -> list[Panel]:
    """The truth of a cell's tile, and the drawings of some rows on it; rows: their titles by name."""
    held = {one.row: one for one in cell.drawings}
    truth = held[next(iter(rows))].truth
    sure = {name: held[name].drawn.take(held[name].drawn.score >= 0.3) for name in rows}
    return [
        Panel(f"{cell.scenario}: truth", truth, area=area),
        *(Panel(f"{cell.scenario}: {title}", sure[name], truth, area=area) for name, title in rows.items()),
    ]


def publish(
    options: Options,
    console: Console,
    title: str,
    payload: dict[str, object],
    sheets: Sequence[Sheet],
    panels: Sequence[Panel],
    columns: int,
    notes: Sequence[str] = (),
) -> None:
    """Tables in the terminal; STUDY.json, STUDY.md and STUDY.png in the folder --out."""
    name = str(options.study)
    missing = missing_files(options, Console(quiet=True))
    footer = missing_footer(missing.count, f"{name}.json")
    notes = (*notes, footer) if footer else notes
    console.print(f"{title}\n", highlight=False, soft_wrap=True)
    for sheet in sheets:
        console.print(terminal(sheet))
        console.print()
    if footer:
        console.print(footer, highlight=False, soft_wrap=True)
    provenance.write_json(
        options.out / f"{name}.json", {"title": title, "missing": missing, **payload}, {"options": options}, 0
    )
    save_figure(panels, options.out / f"{name}.png", columns)
    picture = f"![{name}]({name}.png)\n"
    text = "\n".join([f"# {name}\n\n{title}\n", *map(markdown, sheets), *(f"{note}\n" for note in notes), picture])
    atomic_write_text(options.out / f"{name}.md", text)
    console.print(
        f"Intervals, numbers and picture are in {options.out / name}.md, .json and .png",
        highlight=False,
        soft_wrap=True,
    )


def title_of(options: Options, found: Sequence[Model]) -> str:
    """Weights, data, and how much of it."""
    assert options.data is not None
    scenarios = found[0].world.open().scenarios[:: options.every]
    names = ", ".join(Path(model.weights).stem for model in found)
    return f"{names} on {options.data.name}/{options.split}: {len(scenarios)} scenarios, {options.seeds} seeds"
