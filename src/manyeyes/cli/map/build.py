# SPDX-License-Identifier: Apache-2.0
"""Build a map of a recording: agents predict map elements from sensor data, send them as bytes, and a map server fuses them.

Maps of scenarios that are named after a town (town05_0066, generated-1_0) are evaluated against its true map; others are built too.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from manyeyes._bounds import LengthM, OutputFolder, PositiveInt, Seed
from manyeyes.datatypes import ConfigError
from manyeyes.studies.replay_options import FileChecks

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.models.maps.map_model import MapModel
    from manyeyes.studies.map_pipeline import MapBuildStats


@dataclass(frozen=True)
class Options:
    """The recording, the map model and the output folder."""

    recording: tyro.conf.Positional[Path]
    """A data set, a folder of scenarios, or one scenario: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader."""
    split: str | None = None
    """Which split of a data set, such as test: a folder inside it; with DAIR-V2X one of its split file."""
    scenarios: PositiveInt | None = None
    """At most so many scenarios, the first ones; all by default."""
    source: Literal["model", "truth"] = "model"
    """What draws: a map model; or, as an oracle for all that follows, the true map with the errors of a simulated crowd."""
    weights: str | None = None
    """Of the map model: a shipped name or a .safetensors file of 'manyeyes train --preset map-small-lidar'."""
    map_mode: Literal["local", "semi-global"] = "local"
    """local: 30 x 30 m ahead of a vehicle, 50 x 30 m ahead of a roadside unit, each from its own frame. semi-global: 120 x 60 m
    around each agent, with the features of the others."""
    frame_stride: PositiveInt = 5
    """Use every n-th frame."""
    channel: str = "ideal"
    """The channel between agents: ideal, its-g5-6 (6 Mb/s), its-g5-27mbps, lte-v2x, nr-sidelink, cellular."""
    pose_sigma: LengthM = 0.0
    """Standard deviation of errors added to prior positions, metres; headings err in proportion, 1 degree a metre."""
    map: Path | None = None
    """The true map of a recording that no town is named after, in its world: an intersection of V2X-Seq (.json), a map of Argoverse
    2 (log_map_archive_*.json), or Lanelet2's .osm; without it such a map is made, not evaluated."""
    seed: Seed = 0
    """Of errors and losses."""
    out: OutputFolder = Path("out/map-build")
    """Folder for the maps, one a town: observations, truth, map, page, picture; and build.json."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """Build a map of a recording for each town."""
    from rich.console import Console

    from manyeyes.comms.channel import channel_preset
    from manyeyes.datasets.registry import open_recording
    from manyeyes.studies import provenance
    from manyeyes.studies.map_pipeline import MapBuildConfig, build_map, count_snapshots, write_built_map
    from manyeyes.studies.recordings import check_files
    from manyeyes.studies.town_maps import group_by_town
    from manyeyes.viz.progress import make_progress_bars
    from manyeyes.viz.table import missing_footer

    console = Console()
    channel_preset(options.channel)
    map_model = _load_map_model(options)
    config = MapBuildConfig(
        map_model, options.map_mode, options.frame_stride, options.channel, options.pose_sigma, options.seed
    )
    sensors = () if map_model is None else map_model.config.bev.sensors
    recording = open_recording(options.recording, options.split, images="camera" in sensors)
    mapped = recording.scenarios[: options.scenarios]
    left_out = recording.unreadable_scenarios if options.scenarios is None else frozenset[str]()
    missing = check_files(recording, options.checks, console, {*mapped, *left_out})
    name = options.recording.resolve().name
    town_maps = group_by_town(recording, mapped, name, options.map)
    if options.map is not None and all(town_map.map_file is None for town_map in town_maps):
        raise ConfigError(
            f"--map {options.map}: every scenario is named after a town, whose own map is known; leave it out."
        )
    all_stats = []
    for town_map in town_maps:
        with make_progress_bars(console) as progress:
            task = progress.add_task(town_map.name, total=count_snapshots(recording, town_map, options.frame_stride))
            built = build_map(recording, town_map, config, partial(progress.advance, task))
            built = replace(built, stats=replace(built.stats, missing=missing))
        write_built_map(built, options.out / town_map.name, f"A map of {town_map.name} from sensors")
        _print_summary(console, built.stats, options.out / town_map.name)
        for rejected in built.map_server.rejected:
            sender = f"agent {rejected.agent} at {rejected.time_ns} ns"
            console.print(f"rejected: {sender}: {rejected.reason}", highlight=False, markup=False, soft_wrap=True)
        all_stats.append(built.stats)
    provenance_config = {
        "options": options,
        "model": None
        if map_model is None
        else {"fingerprint": map_model.fingerprint.hex(), "config": map_model.config},
    }
    provenance.write_json(options.out / "build.json", all_stats, provenance_config, options.seed)
    if missing.count:
        console.print(missing_footer(missing.count, "build.json"), highlight=False, soft_wrap=True)
    console.print(f"All numbers are in {options.out / 'build.json'}", highlight=False, soft_wrap=True)


def _load_map_model(options: Options) -> MapModel | None:
    """Return the map model; None where the truth draws."""
    from manyeyes.models import pretrained

    if options.source == "truth":
        if options.weights is not None:
            raise ConfigError("--source truth draws without a model; leave --weights out.")
        return None
    if options.weights is None and pretrained.DEFAULT_MAP_MODEL not in pretrained.list_map_models():
        raise ConfigError(
            "No map model ships with this version: give --weights FILE of 'manyeyes train --preset map-small-lidar', or "
            "--source truth to see what follows from a model with the errors of a simulated crowd."
        )
    return pretrained.load_map_model(options.weights or pretrained.DEFAULT_MAP_MODEL)


def _print_summary(console: Console, stats: MapBuildStats, out: Path) -> None:
    from manyeyes.viz.map_table import make_kinds_table

    s = stats
    if s.scores is not None:
        console.print(make_kinds_table(s.scores, f"{s.name}: the map against the truth in view"))
        if s.union_scores is not None:
            console.print(make_kinds_table(s.union_scores, f"{s.name}: all observations together, unfused"))
    else:
        console.print(f"{s.name}: no true map is known by this name, so the map is not evaluated.", highlight=False)
    console.print(
        f"{s.num_messages} messages of {s.bytes_per_message:,.0f} bytes, {s.num_lost} lost, {s.num_rejected} put "
        f"aside: {s.num_published} "
        f"published elements of {s.num_elements}; open {out / 'map.html'}",
        highlight=False,
        soft_wrap=True,
    )
