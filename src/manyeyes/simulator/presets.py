# SPDX-License-Identifier: Apache-2.0
"""Named sets of scenarios: which towns train, validate and test, and how many scenes of what kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.opv2v.scan import SPLIT_FOLDERS
from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.dair import record_dair
from manyeyes.simulator.record import Job, RecordingProgress, record
from manyeyes.simulator.scene.environment import environment_spec
from manyeyes.simulator.scene.scenario import ScenarioSpec
from manyeyes.simulator.scene.towns import GENERATED, TOWN_SPLIT, assert_disjoint_split, find_town


@dataclass(frozen=True)
class SplitPreset:
    """Scenes of one split: count of them, in turn over the towns.

    lidar_beams: number of LiDAR beams of all agents of a scene, in turn over the scenes; None for the preset's own sensors.
    lidars: names in the table of LiDARs of the vehicles' sensors, in turn over the scenes, in place of the preset's.
    sensor_mix: as in ScenarioSpec; it replaces all these sensors.
    """

    split: str
    towns: tuple[str, ...]
    count: int
    lidar_beams: tuple[int | None, ...] = (None,)
    lidars: tuple[str, ...] = ()
    sensor_mix: str = "none"


@dataclass(frozen=True)
class SimulationPreset:
    """Contents of a recording.

    vehicles: minimum and maximum number of connected vehicles of a scene. roadside_chance: probability of a roadside unit,
    which is always present with a single vehicle, unless the environment has no other vehicles. lead_frames: frames before
    those of a scene (ScenarioSpec), so that the sender of a message 0.4 s old had half a second of history. density, clutter:
    of traffic and of roadside objects (ScenarioSpec), uniform between these for each scene. fallback_town: generated roads
    where a town is not found; None makes that an error. layout: of the files; dair has one vehicle and the unit, and evaluates
    every pair. cameras, roadside_cameras: as in ScenarioSpec. rates_hz: in turn over the scenes. intensity: a law for all
    sensors, None for each sensor's own. scene_key: part of the random key of every scene; presets of one key have the same
    scenes with other sensors. environment: name of a world in ENVIRONMENTS.
    """

    splits: tuple[SplitPreset, ...]
    frames: int = 16
    history_frames: int = 6
    lead_frames: int = 0
    rates_hz: tuple[float, ...] = (10.0,)
    vehicles: tuple[int, int] = (1, 4)
    roadside_chance: float = 0.7
    lidar: str = "opv2v"
    roadside_lidar: str = "opv2v-roadside"
    min_vehicles: int = 16
    density: tuple[float, float] = (3.5, 7.0)
    clutter: tuple[float, float] = (0.4, 1.0)
    fallback_town: str | None = None
    layout: Literal["opv2v", "dair"] = "opv2v"
    cameras: str = "none"
    roadside_cameras: str = "none"
    intensity: str | None = None
    scene_key: str = ""
    environment: str = "classic"

    def __post_init__(self) -> None:
        if self.layout == "dair" and {self.cameras, self.roadside_cameras} != {"none"}:
            raise ConfigError("Pictures are written in OPV2V's layout only; choose a preset of it, or no cameras.")
        if self.layout == "dair" and any(part.sensor_mix != "none" for part in self.splits):
            raise ConfigError(
                "Mixed sensors are written in OPV2V's layout only; choose a preset of it, or no sensor_mix."
            )
        assert_disjoint_split({part.split: part.towns for part in self.splits})


def _towns(train: int, val: int, test: int) -> tuple[SplitPreset, ...]:
    return (
        SplitPreset("train", TOWN_SPLIT["train"], train, (16, 16, 32, 16, None, 16, 16, 32)),
        SplitPreset("val", TOWN_SPLIT["val"], val, (16,)),
        SplitPreset("test", TOWN_SPLIT["test"], test, (16,)),
    )


def _crowded(splits: tuple[SplitPreset, ...]) -> SimulationPreset:
    """Streets where one agent sees little: much traffic, much that stands in between, and three to five agents mostly.

    Intensity is that of the material, which training draws other laws from, and which published tables are measured on.
    """
    return SimulationPreset(
        splits,
        lead_frames=6,
        vehicles=(2, 4),
        roadside_chance=0.8,
        density=(6.0, 10.0),
        clutter=(1.0, 1.8),
        intensity="material",
    )


# For detectors of any sensor: each agent has a sensor, a mounting and a tilt of its own.
_SENSORS = replace(
    _crowded(
        (
            SplitPreset("train", TOWN_SPLIT["train"], 130, sensor_mix="all"),
            SplitPreset("val", TOWN_SPLIT["val"], 16, sensor_mix="all"),
            SplitPreset("test", TOWN_SPLIT["test"], 28, sensor_mix="all"),
        )
    ),
    lead_frames=0,
    rates_hz=(10.0, 10.0, 20.0),
    scene_key="sensors",
    environment="urban-2026",
)


def _one_sensor(mix: str, val: int = 8, test: int = 16) -> SimulationPreset:
    """Scenes for evaluation, the same in every such preset, with one sensor for all vehicles and one for all poles."""
    return replace(
        _crowded(
            (
                SplitPreset("val", TOWN_SPLIT["val"], val, sensor_mix=mix),
                SplitPreset("test", TOWN_SPLIT["test"], test, sensor_mix=mix),
            )
        ),
        frames=10,
        lead_frames=0,
        scene_key="sensor-matrix",
    )


# To be simulated once, for final tables (docs/reference/protocol.md). Strata are splits: they are reported apart.
_SEALED = replace(
    _crowded(
        (
            SplitPreset("town05", ("Town05",), 40, (16,)),
            SplitPreset("town10hd", ("Town10HD",), 40, (16,)),
            SplitPreset("generated", tuple(f"{GENERATED}{seed}" for seed in range(101, 121)), 40, (16,)),
            SplitPreset(
                "generated-sensors", tuple(f"{GENERATED}{seed}" for seed in range(121, 141)), 40, sensor_mix="all"
            ),
        )
    ),
    scene_key="sealed-2026b",
)


# For maps: many places rather than many instants, a second apart; mostly OPV2V's own 64 beams, since paint lies between fewer.
_STREETS = SimulationPreset(
    (
        SplitPreset("train", TOWN_SPLIT["train"], 240, (None, None, 32, None, None, 16)),
        SplitPreset("val", TOWN_SPLIT["val"], 24),
        SplitPreset("test", TOWN_SPLIT["test"], 84),
    ),
    frames=4,
    history_frames=0,
    rates_hz=(1.0,),
    vehicles=(3, 5),
    roadside_chance=0.8,
    density=(3.5, 8.0),
    intensity="material",
)

_SMOKE_SPLITS = (
    SplitPreset("train", ("generated-1",), 2),
    SplitPreset("val", ("generated-2",), 1),
    SplitPreset("test", ("generated-3",), 1),
)

# Generated roads: it needs no file.
_CROSSING = SimulationPreset(
    (
        SplitPreset("train", ("generated-1", "generated-4", "generated-6", "generated-7"), 24),
        SplitPreset("val", ("generated-2", "generated-8"), 8),
        SplitPreset("test", ("generated-3", "generated-9"), 8),
    ),
    frames=10,
    history_frames=0,
    vehicles=(1, 1),
    roadside_chance=1.0,
    lidar="dair-vehicle",
    roadside_lidar="dair-infrastructure",
    min_vehicles=8,
    layout="dair",
    intensity="material",
)

# One sensor that looks up by 2 degrees, one of 32 beams, and one that looks up by 15 degrees.
_THREE_LIDARS = ("opv2v-16", "v2xset", "argoverse2")


def _hard_cases(train: int, val: int, test: int, more_val: tuple[str, ...] = ()) -> tuple[SplitPreset, ...]:
    return (
        SplitPreset("train", TOWN_SPLIT["train"], train, sensor_mix="all"),
        SplitPreset("val", (*TOWN_SPLIT["val"], *more_val), val, lidars=_THREE_LIDARS),
        SplitPreset("test", TOWN_SPLIT["test"], test, lidars=_THREE_LIDARS),
    )


# A single agent that is the only vehicle of its scene: every box that is detected is false.
_NO_VEHICLES = SimulationPreset(
    _hard_cases(30, 12, 48, (f"{GENERATED}21",)),
    frames=9,
    history_frames=4,
    vehicles=(1, 1),
    roadside_chance=0.0,
    clutter=(0.6, 1.6),
    intensity="material",
    environment="urban-2026-no-vehicles",
)

# Streets full of traffic and of parked vehicles, so that many of them are close to an agent.
_NEAR_FIELD = SimulationPreset(
    _hard_cases(20, 6, 24),
    frames=9,
    history_frames=4,
    vehicles=(3, 4),
    roadside_chance=0.0,
    density=(7.0, 10.0),
    intensity="material",
    environment="urban-2026",
)

SIMULATION_PRESETS: dict[str, SimulationPreset] = {
    "carla-towns-small": _crowded(_towns(150, 22, 84)),
    "carla-towns-large": _crowded(_towns(600, 60, 200)),
    "carla-maps": _STREETS,
    # The same scenes, to the last point of their clouds, with pictures of what lies on the road.
    "carla-maps-camera": replace(_STREETS, cameras="opv2v-road", roadside_cameras="dair-infrastructure-road"),
    "smoke-opv2v": SimulationPreset(_SMOKE_SPLITS, frames=3, history_frames=1, min_vehicles=4, intensity="material"),
    "demo": SimulationPreset(
        (SplitPreset("test", ("Town10HD",), 1, (16,)),),
        frames=56,
        vehicles=(3, 3),
        roadside_chance=1.0,
        fallback_town="generated-5",
        intensity="material",
    ),
    "dair-crossing": _CROSSING,
    # The vehicle's sensor as DAIR-V2X has it: denser at the horizon, and tilted.
    "dair-crossing-tilted": replace(_CROSSING, lidar="dair-pandar40p"),
    "no-vehicles": _NO_VEHICLES,
    "near-field": _NEAR_FIELD,
    "smoke-dair": replace(_CROSSING, splits=_SMOKE_SPLITS, frames=3, min_vehicles=4),
    "carla-sensors-small": _SENSORS,
    "carla-beams-16": _one_sensor("beams-16"),
    "carla-beams-32": _one_sensor("beams-32"),
    "carla-beams-64": _one_sensor("beams-64"),
    "carla-beams-128": _one_sensor("beams-128"),
    # With its own intensity; a few scenes to fine-tune on.
    "carla-unseen-sensor": replace(
        _one_sensor("unseen"),
        splits=(
            SplitPreset("train", TOWN_SPLIT["train"], 20, sensor_mix="unseen"),
            *_one_sensor("unseen").splits,
        ),
        intensity=None,
    ),
    "sealed-2026b": _SEALED,
}


def simulation_preset(name: str) -> SimulationPreset:
    """Return a preset by its name in SIMULATION_PRESETS."""
    if name not in SIMULATION_PRESETS:
        raise ConfigError(f"No simulation preset '{name}'; choose one of {', '.join(SIMULATION_PRESETS)}.")
    return SIMULATION_PRESETS[name]


def with_cameras(preset: SimulationPreset) -> SimulationPreset:
    """Return the same scenes with four cameras per vehicle and one per roadside unit, on a quarter of their pixels or less."""
    return replace(preset, cameras="opv2v-small", roadside_cameras="dair-infrastructure-small")


def _town_or_fallback(name: str, towns: str | None, fallback_town: str | None) -> str:
    """Return the town, or its stand-in where its roads are not found."""
    if fallback_town is None:
        return name
    try:
        find_town(name, towns)
    except ConfigError:
        return fallback_town
    return name


def _lidar_of(name: str, beams: int | None) -> str:
    """Name the sensor of the table with this number of beams."""
    return name if beams is None else f"{name}-{beams}"


def make_jobs(preset: SimulationPreset, seed: int, towns: str | None = None) -> list[Job]:
    """Return the scenarios of a preset; each depends on seed, split and its number alone."""
    jobs, is_alone = [], not environment_spec(preset.environment).other_vehicles
    key = (preset.scene_key,) if preset.scene_key else ()
    for part in preset.splits:
        # The folder's name is part of the random key: another name would change every scene.
        folder = SPLIT_FOLDERS.get(part.split, part.split) if preset.layout == "opv2v" else part.split
        for index in range(part.count):
            random = keyed_generator(seed, "preset", folder, index, *key)
            town = _town_or_fallback(part.towns[index % len(part.towns)], towns, preset.fallback_town)
            beams = part.lidar_beams[index % len(part.lidar_beams)]
            vehicles = int(random.integers(preset.vehicles[0], preset.vehicles[1] + 1))
            spec = ScenarioSpec(
                town=town,
                seed=int(random.integers(1, 2**30)),
                name=f"{town.lower()}_{index:04d}",
                vehicles=vehicles,
                frames=preset.frames,
                history_frames=preset.history_frames,
                lead_frames=preset.lead_frames,
                rate_hz=preset.rates_hz[index % len(preset.rates_hz)],
                roadside_chance=1.0 if vehicles == 1 and not is_alone else preset.roadside_chance,
                lidar=part.lidars[index % len(part.lidars)] if part.lidars else _lidar_of(preset.lidar, beams),
                roadside_lidar=_lidar_of(preset.roadside_lidar, beams),
                density=round(float(random.uniform(*preset.density)), 3),
                min_vehicles=preset.min_vehicles,
                clutter=round(float(random.uniform(*preset.clutter)), 3),
                cameras=preset.cameras,
                roadside_cameras=preset.roadside_cameras,
                intensity=preset.intensity,
                sensor_mix=part.sensor_mix,
                environment=preset.environment,
            )
            jobs.append(Job(folder, spec, None if town.startswith(GENERATED) else towns))
    return sorted(jobs, key=lambda job: (job.split != "train", job.split != "validate", job.spec.town, job.spec.name))


@dataclass(frozen=True)
class RecordedContent:
    """What of a preset is recorded. splits: by name, beside what the folder holds already; none: all. cameras: pictures too."""

    splits: tuple[str, ...] = ()
    cameras: bool = False


EVERYTHING = RecordedContent()
"""All splits, without pictures."""


def _find_split_folders(name: str, preset: SimulationPreset, splits: Sequence[str]) -> frozenset[str]:
    """Return the folders of splits of a preset."""
    known = [part.split for part in preset.splits]
    if unknown := [split for split in splits if split not in known]:
        raise ConfigError(f"The preset '{name}' has no split '{unknown[0]}'; choose from {', '.join(known)}.")
    if preset.layout != "opv2v":
        raise ConfigError(
            f"The preset '{name}' is in DAIR-V2X's layout, which numbers the frames of all splits together; simulate all splits."
        )
    return frozenset(SPLIT_FOLDERS.get(split, split) for split in splits)


def simulate(
    preset: str,
    out: Path | str,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[RecordingProgress], None] | None = None,
    towns: Path | str | None = None,
    content: RecordedContent = EVERYTHING,
    on_repair: Callable[[FileProblem], None] | None = None,
) -> Path:
    """Simulate a preset's recording into a folder; returns the path of its manifest.

    towns: the first place to search for roads. on_repair: as in :func:`~manyeyes.simulator.record.record`.

    Raises:
        ConfigError: the preset or a split is unknown, or the layout is DAIR-V2X's, which numbers the frames of all splits together.
    """
    place = None if towns is None else str(towns)
    wanted = with_cameras(simulation_preset(preset)) if content.cameras else simulation_preset(preset)
    jobs = make_jobs(wanted, seed, place)
    if content.splits:
        folders = _find_split_folders(preset, wanted, content.splits)
        jobs = [job for job in jobs if job.split in folders or (Path(out) / job.split / job.spec.name).is_dir()]
    write = record_dair if wanted.layout == "dair" else record
    return write(jobs, out, workers, progress, {"preset": preset, "seed": seed}, on_repair)
