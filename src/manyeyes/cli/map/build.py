# SPDX-License-Identifier: Apache-2.0
"""Makes a map of a recording: agents draw what their sensors see, send it as bytes, and a cartographer fuses what it hears.

Scenarios that are named after a town (town05_0066, generated-1_0) are judged against its true map; of others a map is made as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from manyeyes.datatypes import ConfigError
from manyeyes.studies.replay_options import FileChecks

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.models.maps.map_model import Mapper
    from manyeyes.studies.map_pipeline import Numbers


@dataclass(frozen=True)
class Options:
    """What is mapped, by whom, and where it goes."""

    recording: tyro.conf.Positional[Path]
    """A dataset, a folder of scenarios, or one scenario, in OPV2V's layout; or a root in DAIR-V2X's."""
    split: str | None = None
    """Which split of a dataset: a folder inside it, such as test; with DAIR-V2X one of its split file."""
    scenarios: int | None = None
    """At most so many scenarios, the first ones; all by default."""
    source: Literal["model", "truth"] = "model"
    """What draws: a map model; or, as an oracle for all that follows, the true map with the errors of a simulated crowd."""
    weights: str | None = None
    """Of the map model: a shipped name or a .safetensors file of 'manyeyes train --preset map-small'."""
    survey: Literal["local", "semi-global"] = "local"
    """local: what lies ahead, 30 x 30 m of a vehicle, 50 x 30 m of a roadside unit, each by its own look. semi-global: 120 x 60 m
    about each agent, together with the looks of the others."""
    every: int = 5
    """Agents look at every n-th frame."""
    channel: str = "ideal"
    """The air between all: ideal, its-g5, its-g5-27, lte-v2x, nr-sidelink, cellular."""
    pose_sigma: float = 0.0
    """Standard deviation of errors added to claimed positions, metres; headings err in proportion, 1 degree a metre."""
    map: Path | None = None
    """The true map of a recording that no town is named after, in its world: an intersection of V2X-Seq (.json), a map of Argoverse
    2 (log_map_archive_*.json), or Lanelet2's .osm; without it such a map is made, not judged."""
    seed: int = 0
    """Of errors and losses."""
    out: Path = Path("out/map-build")
    """Folder for the maps, one a town: observations, truth, map, page, picture; and build.json."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """The verb."""
    from rich.console import Console

    from manyeyes.comms.channel import channel_preset
    from manyeyes.studies import provenance
    from manyeyes.studies.map_pipeline import Building, build_map, instants, write_built
    from manyeyes.studies.recordings import check_files, open_recording
    from manyeyes.studies.town_maps import grounds_of
    from manyeyes.viz.progress import bars
    from manyeyes.viz.table import missing_footer

    console = Console()
    channel_preset(options.channel)
    mapper = _mapper(options)
    building = Building(mapper, options.survey, options.every, options.channel, options.pose_sigma, options.seed)
    sensors = () if mapper is None else mapper.config.bev.sensors
    recording = open_recording(options.recording, options.split, images="camera" in sensors)
    mapped = recording.scenarios[: options.scenarios]
    left_out = recording.left_out if options.scenarios is None else frozenset[str]()
    missing = check_files(recording, options.checks, console, {*mapped, *left_out})
    name = options.recording.resolve().name
    grounds = grounds_of(recording, mapped, name, options.map)
    if options.map is not None and all(ground.map is None for ground in grounds):
        raise ConfigError(
            f"--map {options.map}: every scenario is named after a town, whose own map is known; leave it out."
        )
    all_numbers = []
    for ground in grounds:
        with bars(console) as progress:
            task = progress.add_task(ground.name, total=instants(recording, ground, options.every))
            built = build_map(recording, ground, building, partial(progress.advance, task))
            built = replace(built, numbers=replace(built.numbers, missing=missing))
        write_built(built, options.out / ground.name, f"A map of {ground.name} from sensors")
        _say(console, built.numbers, options.out / ground.name)
        for refused in built.cartographer.refused:
            where = f"agent {refused.agent} at {refused.time_ns} ns"
            console.print(f"put aside: {where}: {refused.reason}", highlight=False, markup=False, soft_wrap=True)
        all_numbers.append(built.numbers)
    config = {
        "options": options,
        "model": None if mapper is None else {"fingerprint": mapper.fingerprint.hex(), "config": mapper.config},
    }
    provenance.write_json(options.out / "build.json", all_numbers, config, options.seed)
    if missing.count:
        console.print(missing_footer(missing.count, "build.json"), highlight=False, soft_wrap=True)
    console.print(f"All numbers are in {options.out / 'build.json'}", highlight=False, soft_wrap=True)


def _mapper(options: Options) -> Mapper | None:
    """The map model; None where the truth draws."""
    from manyeyes.models import pretrained

    if options.source == "truth":
        if options.weights is not None:
            raise ConfigError("--source truth draws without a model; leave --weights out.")
        return None
    if options.weights is None and pretrained.MAPPER not in pretrained.mappers():
        raise ConfigError(
            "No map model ships with this version: give --weights FILE of 'manyeyes train --preset map-small', or "
            "--source truth to see what follows from a model with the errors of a simulated crowd."
        )
    return pretrained.load_mapper(options.weights or pretrained.MAPPER)


def _say(console: Console, numbers: Numbers, out: Path) -> None:
    from manyeyes.viz.map_table import kinds_terminal

    n = numbers
    if n.quality is not None:
        console.print(kinds_terminal(n.quality.ap, n.quality.kinds, f"{n.name}: the map against the truth in view"))
    else:
        console.print(f"{n.name}: no true map is known by this name, so the map is not judged.", highlight=False)
    console.print(
        f"{n.messages} messages of {n.bytes_per_message:,.0f} bytes, {n.lost} lost, {n.refused} put aside: {n.published} "
        f"published elements of {n.elements}; open {out / 'map.html'}",
        highlight=False,
        soft_wrap=True,
    )
