# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.presets import (
    SIMULATION_PRESETS,
    SimulationPreset,
    SplitPreset,
    make_jobs,
    simulation_preset,
    with_cameras,
)
from manyeyes.simulator.sensors.camera import camera_rig


def test_no_town_is_on_two_sides() -> None:
    for preset in SIMULATION_PRESETS.values():
        sides = [set(part.towns) for part in preset.splits]
        assert sum(map(len, sides)) == len(set().union(*sides))
    with pytest.raises(ConfigError, match="Town01 is in 'train' and in 'test'"):
        SimulationPreset((SplitPreset("train", ("Town01",), 1), SplitPreset("test", ("Town01",), 1)))


def test_the_benchmark_has_its_documented_scenes() -> None:
    jobs = make_jobs(simulation_preset("carla-towns-small"), 0)
    counts = {split: sum(job.split == split for job in jobs) for split in ("train", "validate", "test")}
    assert counts == {"train": 150, "validate": 22, "test": 84}
    towns = {job.split: set() for job in jobs}
    for job in jobs:
        towns[job.split].add(job.spec.town)
        assert job.spec.frames - job.spec.history_frames == 10
        assert (job.spec.history_frames, job.spec.lead_frames) == (6, 6)
        assert job.spec.vehicles + (job.spec.roadside_chance == 1.0) >= 2
    assert towns["validate"] == {"Town07"}
    assert towns["test"] == {"Town05", "Town10HD"}
    assert len({(job.split, job.spec.name) for job in jobs}) == len(jobs)


@pytest.mark.parametrize(("preset", "folder"), [("smoke-opv2v", "validate"), ("smoke-dair", "val")])
def test_scenes_of_val_are_keyed_by_the_name_of_their_folder(preset: str, folder: str) -> None:
    (job,) = [job for job in make_jobs(simulation_preset(preset), 7) if job.split == folder]
    random = keyed_generator(7, "preset", folder, 0)
    vehicles, seed = (
        random.integers(*(np.array(simulation_preset(preset).vehicles) + [0, 1])),
        random.integers(1, 2**30),
    )
    assert (job.spec.vehicles, job.spec.seed, job.spec.town) == (vehicles, seed, "generated-2")


def test_the_number_of_beams_names_the_sensors() -> None:
    (job,) = make_jobs(simulation_preset("demo"), 0)
    assert (job.spec.lidar, job.spec.roadside_lidar) == ("opv2v-16", "opv2v-roadside-16")
    (job, *_) = make_jobs(simulation_preset("carla-maps"), 0)
    assert (job.spec.lidar, job.spec.roadside_lidar) == ("opv2v", "opv2v-roadside")


def test_the_seed_decides() -> None:
    preset = simulation_preset("carla-towns-small")
    assert make_jobs(preset, 3) == make_jobs(preset, 3)
    assert make_jobs(preset, 3) != make_jobs(preset, 4)


def test_presets_with_cameras_have_the_same_scenes() -> None:
    preset = simulation_preset("smoke-opv2v")
    blind, seeing = make_jobs(preset, 3), make_jobs(with_cameras(preset), 3)
    assert [replace(job.spec, cameras="none", roadside_cameras="none") for job in seeing] == [j.spec for j in blind]
    assert {(job.spec.cameras, job.spec.roadside_cameras) for job in seeing} == {
        ("opv2v-small", "dair-infrastructure-small")
    }
    with pytest.raises(ConfigError, match="in OPV2V's layout only"):
        with_cameras(simulation_preset("smoke-dair"))


def test_scenes_for_maps_with_cameras_are_the_same_scenes() -> None:
    blind, seeing = (make_jobs(simulation_preset(name), 0) for name in ("carla-maps", "carla-maps-camera"))
    assert [replace(job.spec, cameras="none", roadside_cameras="none") for job in seeing] == [j.spec for j in blind]
    assert all(camera_rig(job.spec.cameras) and camera_rig(job.spec.roadside_cameras) for job in seeing)


def test_the_demo_runs_without_any_town(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(name: str, path: str | None) -> Path:
        raise ConfigError(f"no {name} in {path}")

    monkeypatch.setattr("manyeyes.simulator.presets.find_town", nowhere)
    (job,) = make_jobs(simulation_preset("demo"), 0, str(tmp_path))
    assert job.spec.town.startswith("generated-")
    assert job.towns is None  # generated roads are in no folder
    assert job.spec.vehicles == 3
    assert job.spec.roadside_chance == 1.0


def test_an_unknown_preset_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="No simulation preset 'town'; choose one of carla-towns-small"):
        simulation_preset("town")


def test_presets_of_published_tables_store_material_intensity_of_todays_sensors() -> None:
    names = ("carla-towns-small", "carla-towns-large", "carla-maps", "carla-maps-camera", "demo", "dair-crossing")
    for name in (*names, "smoke-opv2v", "smoke-dair"):
        specs = {(job.spec.intensity, job.spec.sensor_mix) for job in make_jobs(simulation_preset(name), 0)}
        assert specs == {("material", "none")}, name


@pytest.mark.parametrize("name", ["carla-sensors-small", "no-vehicles", "near-field"])
def test_training_scenes_of_mixed_sensors_store_material_intensity_which_other_laws_are_drawn_from(name: str) -> None:
    preset = simulation_preset(name)
    assert preset.intensity == "material" and any(part.split == "train" for part in preset.splits)


def test_mixed_sensors_train_on_the_towns_and_rates_stated() -> None:
    jobs = make_jobs(simulation_preset("carla-sensors-small"), 0)
    train = [job for job in jobs if job.split == "train"]
    assert 120 <= len(train) <= 150
    assert {job.spec.town for job in train} == {"Town01", "Town02", "Town03", "Town04", "Town06"}
    assert {job.spec.town for job in jobs if job.split == "validate"} == {"Town07"}
    assert {job.spec.town for job in jobs if job.split == "test"} == {"Town05", "Town10HD"}
    assert {(job.spec.sensor_mix, job.spec.intensity) for job in jobs} == {("all", "material")}
    assert {job.spec.rate_hz for job in train} == {10.0, 20.0}
    seeds = {job.spec.seed for job in make_jobs(simulation_preset("carla-towns-small"), 0)}
    assert not seeds & {job.spec.seed for job in jobs}


def test_the_sensor_matrix_has_the_same_scenes_with_other_beams() -> None:
    def scenes(name: str) -> list[tuple[str, str, int, float]]:
        jobs = [job for job in make_jobs(simulation_preset(name), 0) if job.split != "train"]
        return [(job.split, job.spec.name, job.spec.seed, job.spec.density) for job in jobs]

    first = scenes("carla-beams-16")
    assert {split for split, *_ in first} == {"validate", "test"}
    for name in ("carla-beams-32", "carla-beams-64", "carla-beams-128", "carla-unseen-sensor"):
        assert scenes(name) == first
    unseen = make_jobs(simulation_preset("carla-unseen-sensor"), 0)
    assert {job.spec.agent_lidar(agent).name for job in unseen for agent in (1, -1)} == {"unseen-sensor"}
    assert {job.spec.intensity for job in unseen} == {None}


# make_scenario tries this number of seeds from that of a specification.
ATTEMPTS = 40


def test_sealed_scenes_have_seeds_and_generated_towns_of_no_other_preset() -> None:
    """Only specifications are made here: no scene of the sealed split may be simulated before the final tables."""
    sealed = make_jobs(simulation_preset("sealed-2026b"), 0)
    assert {job.split for job in sealed} == {"town05", "town10hd", "generated", "generated-sensors"}
    own = {job.spec.seed + i for job in sealed for i in range(ATTEMPTS)}
    towns = {job.spec.town for job in sealed if job.spec.town.startswith("generated-")}
    assert min(int(town.removeprefix("generated-")) for town in towns) == 101
    for name in SIMULATION_PRESETS:
        if name != "sealed-2026b":
            others = make_jobs(simulation_preset(name), 0)
            assert not own & {job.spec.seed + i for job in others for i in range(ATTEMPTS)}, name
            assert not towns & {job.spec.town for job in others}, name
    strata = {split: {job.spec.town for job in sealed if job.split == split} for split in {job.split for job in sealed}}
    assert sum(map(len, strata.values())) == len(set().union(*strata.values()))
    assert {job.spec.sensor_mix for job in sealed if job.split == "generated-sensors"} == {"all"}
    assert {job.spec.lidar for job in sealed if job.spec.sensor_mix == "none"} == {"opv2v-16"}


def test_mixed_sensors_are_not_written_in_dairs_layout() -> None:
    preset = simulation_preset("smoke-dair")
    with pytest.raises(ConfigError, match="Mixed sensors are written in OPV2V's layout only"):
        replace(preset, splits=(replace(preset.splits[0], sensor_mix="all"),))
