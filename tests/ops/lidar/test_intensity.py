# SPDX-License-Identifier: Apache-2.0
"""Intensity laws: worked numbers, bounds, and the way back from a recorded cloud."""

import math

import pytest
import torch

from manyeyes.datatypes import ConfigError, PointCloud
from manyeyes.ops.lidar.intensity import (
    ATTENUATION_PER_M,
    INTENSITY_KINDS,
    INTENSITY_LAWS,
    MAX_BEAM_GAIN_CHANGE,
    IntensityLaw,
    change_intensity_law,
    compute_intensity,
)

REFLECTIVITY = torch.tensor([0.12, 0.4, 0.75, 0.0])
RANGE = torch.tensor([0.0, 25.0, 100.0, 10.0])
ELEVATION = torch.tensor([-0.2, -0.1, 0.0, 0.01])


def stored(law: IntensityLaw, key: tuple[int | str, ...] = ("test",)) -> torch.Tensor:
    return compute_intensity(law, REFLECTIVITY, RANGE, ELEVATION, key)


def test_the_table_has_every_kind_under_its_name():
    assert set(INTENSITY_LAWS) == set(INTENSITY_KINDS)
    assert all(law.kind == name for name, law in INTENSITY_LAWS.items())


@pytest.mark.parametrize("name", INTENSITY_LAWS)
def test_every_law_stays_within_zero_and_one_and_is_float32(name):
    bright = compute_intensity(INTENSITY_LAWS[name], 5 * REFLECTIVITY, RANGE, ELEVATION, ("test",))
    assert bright.dtype == torch.float32 and bright.shape == (4,)
    assert float(bright.min()) >= 0.0 and float(bright.max()) <= 1.0


def test_material_is_reflectivity_times_attenuation():
    expected = [0.12, 0.4 * math.exp(-0.1), 0.75 * math.exp(-0.4), 0.0]
    torch.testing.assert_close(stored(INTENSITY_LAWS["material"]), torch.tensor(expected))


def test_carla_depends_on_range_alone():
    expected = [1.0, math.exp(-0.1), math.exp(-0.4), math.exp(-0.04)]
    torch.testing.assert_close(stored(INTENSITY_LAWS["carla"]), torch.tensor(expected))


def test_constant_and_zero():
    assert stored(IntensityLaw("constant", floor=0.25)).tolist() == [0.25] * 4
    assert stored(INTENSITY_LAWS["zero"]).tolist() == [0.0] * 4


def test_low_gain_rounds_to_eight_bits():
    material = stored(INTENSITY_LAWS["material"])
    expected = [round(float(value) * 0.03 * 255) / 255 for value in material]
    torch.testing.assert_close(stored(INTENSITY_LAWS["low-gain-8bit"]), torch.tensor(expected))
    assert len(set(expected)) > 2, "the case has several levels"


def test_gain_gamma_is_a_curve_of_the_material():
    law = IntensityLaw("gain-gamma", gain=0.5, gamma=0.5, floor=0.1)
    torch.testing.assert_close(stored(law), 0.1 + 0.5 * stored(INTENSITY_LAWS["material"]).sqrt())


def test_beams_have_gains_of_their_own_that_stay():
    elevation = torch.tensor([-0.2, -0.2, -0.1, -0.1, 0.0])
    ones = torch.full((5,), 0.5)
    at = compute_intensity(INTENSITY_LAWS["per-beam-gain"], ones, torch.zeros(5), elevation, ("a",))
    assert at[0] == at[1] and at[2] == at[3] and len({*at.tolist()}) == 3
    assert float((at / 0.5 - 1).abs().max()) <= MAX_BEAM_GAIN_CHANGE
    again = compute_intensity(INTENSITY_LAWS["per-beam-gain"], ones, torch.zeros(5), elevation, ("a",))
    other = compute_intensity(INTENSITY_LAWS["per-beam-gain"], ones, torch.zeros(5), elevation, ("b",))
    assert torch.equal(at, again) and not torch.equal(at, other)


def test_shuffled_keeps_the_values_and_noise_does_not():
    reflectivity = torch.linspace(0.0, 1.0, 500)
    zero = torch.zeros(500)
    material = compute_intensity(INTENSITY_LAWS["material"], reflectivity, zero, zero)
    shuffled = compute_intensity(INTENSITY_LAWS["shuffled"], reflectivity, zero, zero, ("test",))
    noise = compute_intensity(INTENSITY_LAWS["noise"], reflectivity, zero, zero, ("test",))
    assert torch.equal(shuffled.sort().values, material.sort().values) and not torch.equal(shuffled, material)
    assert abs(float(noise.mean()) - 0.5) < 0.05 and not torch.equal(noise.sort().values, material.sort().values)


def test_a_recorded_cloud_is_changed_as_the_sensor_would_have_stored_it():
    height_m = 1.9
    direction = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0.0, -0.1], [0.0, 1.0, 0.02], [-1.0, -1.0, 0.0], [1, 1, 0]])
    )
    xyz = direction * RANGE[:, None] + torch.tensor([0.0, 0.0, height_m])
    recorded = PointCloud.of(xyz, REFLECTIVITY * torch.exp(-ATTENUATION_PER_M * RANGE))
    for name in ("carla", "constant", "low-gain-8bit", "gain-gamma"):
        law = INTENSITY_LAWS[name]
        changed = change_intensity_law(recorded, law, height_m)
        torch.testing.assert_close(changed.intensity, stored(law), atol=1e-5, rtol=1e-5)
        assert changed.xyz is recorded.xyz
    assert change_intensity_law(recorded, INTENSITY_LAWS["material"], height_m) is recorded


@pytest.mark.parametrize(
    "arguments", [{"kind": "lambert"}, {"gain": -1.0}, {"gamma": 0.0}, {"floor": 1.5}, {"floor": float("nan")}]
)
def test_impossible_laws_are_refused(arguments):
    with pytest.raises(ConfigError):
        IntensityLaw(**arguments)
