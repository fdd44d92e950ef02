# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.simulator.scene.scenario import ScenarioSpec
from manyeyes.simulator.sensors.sensor_mix import SENSOR_MIXES, sensor_mix


def test_each_agent_keeps_its_sensor_and_agents_differ() -> None:
    mix = sensor_mix("all")
    one = [mix.draw(False, 10.0, (5, "scene", agent)) for agent in range(30)]
    assert one == [mix.draw(False, 10.0, (5, "scene", agent)) for agent in range(30)]
    assert len({spec.name for spec in one}) > 8
    assert len({spec.height_m for spec in one}) > 25


def test_mountings_lie_in_their_bounds_and_fill_them() -> None:
    mix = sensor_mix("all")
    vehicles = [mix.draw(False, 10.0, (0, agent)) for agent in range(400)]
    poles = [mix.draw(True, 10.0, (1, agent)) for agent in range(400)]
    for specs, low, high in ((vehicles, 1.5, 2.5), (poles, 4.0, 7.0)):
        heights = [spec.height_m for spec in specs]
        assert low <= min(heights) < low + 0.1 < high - 0.1 < max(heights) <= high
    tilts = [round(math.degrees(spec.roll_rad), 6) for spec in vehicles + poles]
    assert -1.5 <= min(tilts) < -1.4 < 1.4 < max(tilts) <= 1.5
    assert max(spec.range_sigma_m for spec in vehicles) <= 0.05
    rainy = [spec.spurious_fraction > 0 for spec in vehicles]
    assert 0.05 < sum(rainy) / len(rainy) < 0.15
    beams = [spec.num_beams for spec in vehicles]
    assert {16, 32, 40, 64, 128} == set(beams)
    assert {spec.name for spec in poles} == set(mix.roadside_lidars)


def test_the_unseen_sensor_is_in_no_mix_for_training() -> None:
    names = {
        n for key, mix in SENSOR_MIXES.items() if key != "unseen" for n in (*mix.vehicle_lidars, *mix.roadside_lidars)
    }
    assert "unseen-sensor" not in names
    assert sensor_mix("unseen").draw(False, 10.0, (0,)).name == "unseen-sensor"


def test_a_mix_of_one_sensor_is_level_and_as_in_the_table() -> None:
    spec = sensor_mix("beams-32").draw(True, 10.0, (0,))
    assert (spec.name, spec.height_m, spec.roll_rad, spec.pitch_rad, spec.range_sigma_m) == (
        "opv2v-roadside-32", 5.0, 0.0, 0.0, 0.02,
    )  # fmt: skip


def test_a_scenario_overrides_the_law_of_its_sensors() -> None:
    own = ScenarioSpec("generated-1", 7, "one", sensor_mix="all")
    assert own.agent_lidar(3).name != "" and own.agent_lidar(-1).height_m >= 4.0
    assert replace(own, sensor_mix="none").agent_lidar(3).intensity.kind == "carla"
    assert replace(own, intensity="material").agent_lidar(3).intensity.kind == "material"
    assert replace(own, rate_hz=20.0).agent_lidar(3).rate_hz == 20.0


def test_misuse_is_named() -> None:
    with pytest.raises(ConfigError, match="No sensor mix 'any'; choose one of all, beams-16"):
        sensor_mix("any")
    with pytest.raises(ConfigError, match="No intensity law 'bright'; choose one of material"):
        ScenarioSpec("generated-1", 7, "one", intensity="bright")
