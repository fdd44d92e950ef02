# SPDX-License-Identifier: Apache-2.0
"""Sensors of samples: keyed, one law an agent in all of its sweeps, and geometry that still agrees."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import AgentFrame, BevGrid, ConfigError, PointCloud, Transform
from manyeyes.training.detector.samples import AugmentConfig, make_sample
from manyeyes.training.detector.sensor_augmentation import (
    MIXED_INTENSITY_KINDS,
    SensorAugmentation,
    SensorAugmentConfig,
    SweepTiming,
    add_blooming,
    add_spurious_returns,
    distort,
    draw_intensity_law,
)

GRID = BevGrid(-51.2, -51.2, -3.0, 51.2, 51.2, 5.0)


def still(**changes) -> SensorAugmentConfig:
    """Draws nothing but what is named."""
    none = {"single_sweep_prob": 0.0, "spurious_prob": 0.0, "max_tilt_rad": 0.0, "max_height_error_m": 0.0}
    return SensorAugmentConfig(**(none | changes))


def augment(sensors: SensorAugmentConfig) -> AugmentConfig:
    return AugmentConfig(0.0, 0.0, False, 0.0, 0.0, 99, sensors)


def sample(recording, sensors: SensorAugmentConfig, number: int = 0):
    snapshots = [recording.snapshot("toy_0", 0), recording.snapshot("toy_0", 1)]
    return make_sample(snapshots, 0, GRID, augment(sensors), ("test", number))


def test_without_draws_a_sample_is_that_of_the_recording(toy):
    drawn = sample(toy(), still(intensity_kinds=("material",)))
    plain = make_sample(
        [toy().snapshot("toy_0", 0), toy().snapshot("toy_0", 1)], 0, GRID, AugmentConfig.none(), ("test", 0)
    )
    for one, other in zip(drawn.views, plain.views, strict=True):
        assert torch.equal(one.cloud.xyz, other.cloud.xyz) and torch.equal(one.cloud.intensity, other.cloud.intensity)


def test_a_sample_is_a_function_of_its_key(toy):
    config = SensorAugmentConfig()
    one, again, other = (sample(toy(), config, number) for number in (1, 1, 2))
    assert all(torch.equal(a.cloud.intensity, b.cloud.intensity) for a, b in zip(one.views, again.views))
    assert any(not torch.equal(a.cloud.xyz, b.cloud.xyz) for a, b in zip(one.views, other.views))


def test_both_sweeps_of_an_agent_have_one_law(toy):
    for number in range(8):
        some = sample(toy(), still(intensity_kinds=("zero", "constant")), number)
        for view in some.views:
            assert len(view.previous_cloud)
            assert view.cloud.intensity.unique().tolist() == view.previous_cloud.intensity.unique().tolist()


def test_laws_are_shared_by_all_agents_or_not(toy):
    kinds = ("zero", "constant")
    levels = [
        {
            float(view.cloud.intensity[0])
            for view in sample(toy(), still(intensity_kinds=kinds, shared_law_prob=p), n).views
        }
        for p in (1.0, 0.0)
        for n in range(8)
    ]
    assert all(len(found) == 1 for found in levels[:8]) and any(len(found) > 1 for found in levels[8:])


def test_single_sweeps_have_no_previous_cloud(toy):
    assert all(not len(view.previous_cloud) for view in sample(toy(), still(single_sweep_prob=1.0)).views)


def test_boxes_hold_their_points_after_a_tilt(toy):
    for number in range(4):
        some = sample(toy(), still(max_tilt_rad=0.004, max_height_error_m=0.06), number)
        for view in some.views:
            points = view.cloud.xyz.to(view.visible_boxes.center.dtype)
            assert (view.visible_boxes.contains(points, 0.02).sum(1) == 60).all()


def test_the_mixture_draws_every_kind_within_its_bounds():
    rng = np.random.default_rng(0)
    laws = [draw_intensity_law(MIXED_INTENSITY_KINDS, rng) for _ in range(600)]
    assert {law.kind for law in laws} == set(MIXED_INTENSITY_KINDS)
    assert "shuffled" not in MIXED_INTENSITY_KINDS, "it is held out for evaluation"
    curves = [law for law in laws if law.kind == "gain-gamma"]
    assert min(law.gamma for law in curves) < 0.8 and max(law.gamma for law in curves) > 1.2


def test_spurious_returns_lie_on_the_rays_of_the_others():
    rng = np.random.default_rng(1)
    xyz = torch.from_numpy(rng.uniform(-40, 40, (2000, 3)).astype(np.float32))
    points = PointCloud.of(xyz, torch.full((2000,), 0.5))
    wet = add_spurious_returns(points, 0.1, 1.9, np.random.default_rng(2))
    origin = torch.tensor([0.0, 0.0, 1.9])
    ray, wet_ray = xyz - origin, wet.xyz - origin
    torch.testing.assert_close(torch.cosine_similarity(ray, wet_ray), torch.ones(2000), atol=1e-5, rtol=0)
    moved = wet_ray.norm(dim=1) < 0.99 * ray.norm(dim=1)
    assert 120 < int(moved.sum()) < 280 and torch.equal(wet.xyz[~moved], xyz[~moved])


def wall(count: int = 4000) -> PointCloud:
    """Returns around the sensor at 2 to 60 m, every second one of them of a bright target."""
    rng = np.random.default_rng(3)
    azimuth, distance = rng.uniform(-math.pi, math.pi, count), rng.uniform(2, 60, count)
    xyz = np.stack((distance * np.cos(azimuth), distance * np.sin(azimuth), np.full(count, 1.0)), 1).astype(np.float32)
    reach = np.linalg.norm(xyz - (0, 0, 1.9), axis=1)
    reflectivity = np.where(np.arange(count) % 2, 0.8, 0.3)
    return PointCloud.of(xyz, (reflectivity * np.exp(-0.004 * reach)).astype(np.float32))


def test_bright_targets_bloom_at_their_range_and_less_far_away():
    points, origin = wall(), torch.tensor([0.0, 0.0, 1.9])
    found = add_blooming(points, 0.02, 40.0, 1.9, np.random.default_rng(0))
    count = len(points)
    assert torch.equal(found.xyz[:count], points.xyz) and torch.equal(found.intensity[:count], points.intensity)
    ray = points.xyz - origin
    source = ((torch.arange(count) % 2 == 1) & (ray.norm(dim=1) < 40)).nonzero()[:, 0]
    assert len(found) - count == len(source) > 500
    copies, reach = found.xyz[count:] - origin, ray[source].norm(dim=1)
    torch.testing.assert_close(copies.norm(dim=1), reach, atol=1e-3, rtol=0)
    assert torch.equal(found.intensity[count:], points.intensity[source])
    angle = torch.acos(torch.cosine_similarity(copies.double(), ray[source].double()).clamp(max=1))
    assert bool((angle <= 0.0201 * (1 - reach / 40) + 1e-4).all())
    near, far = reach < 10, reach > 30
    assert 0.006 < float(angle[near].mean()) < 0.01 and float(angle[far].mean()) < 0.003


def test_what_was_measured_earlier_lies_ahead_of_a_driving_sensor():
    """Counter-clockwise from behind (-pi): what is to the right was measured 3/4 of a sweep before its end, the left 1/4."""
    around = PointCloud.of([[0.0, -10.0, 1.0], [10.0, 0.0, 1.0], [0.0, 10.0, 1.0], [-10.0, 0.01, 1.0]])
    timing = SweepTiming(-math.pi, 1, 0.1)
    shift = (distort(around, timing, 20.0).xyz - around.xyz)[:, 0]
    assert shift.tolist() == pytest.approx([1.5, 1.0, 0.5, 0.0], abs=1e-2)
    clockwise = (distort(around[:3], replace(timing, direction=-1), 20.0).xyz - around.xyz[:3])[:, 0]
    assert clockwise.tolist() == pytest.approx([0.5, 1.0, 1.5], abs=1e-2)
    assert torch.equal(distort(around, timing, 0.0).xyz, around.xyz)
    moved = distort(wall(), timing, 20.0)
    assert torch.equal(moved.xyz[:, 1:], wall().xyz[:, 1:]) and torch.equal(moved.intensity, wall().intensity)


def test_blooming_and_distortion_are_keyed_off_by_default_and_change_no_other_draw():
    frame = AgentFrame.of(wall(), Transform.identity(), 3, 5, speed_mps=15.0)
    off, on = SensorAugmentConfig(), SensorAugmentConfig(blooming_prob=1.0, distortion_prob=1.0)
    first, again, later = (SensorAugmentation(on, (3, 4), ("test", n)) for n in (0, 0, 1))
    assert torch.equal(first.points(frame).xyz, again.points(frame).xyz)
    assert first.sensor(3).distortion != later.sensor(3).distortion != first.sensor(4).distortion
    plain = SensorAugmentation(off, (3, 4), ("test", 0))
    for agent in (3, 4):
        drawn = first.sensor(agent)
        assert drawn.blooming_rad > 0 and drawn.distortion is not None
        kept = replace(drawn, blooming_rad=0.0, distortion=None, frame_from_measured=None)  # pyright: ignore
        assert kept == replace(plain.sensor(agent), frame_from_measured=None)  # pyright: ignore
    assert len(plain.points(frame)) == len(frame.points) < len(first.points(frame))
    tilts = [a.sensor(3).frame_from_measured.matrix() for a in (first, plain)]
    assert torch.equal(*tilts)


def test_a_sample_with_all_artefacts_is_a_function_of_its_key(toy):
    config = still(blooming_prob=1.0, distortion_prob=1.0, intensity_kinds=("material",))
    one, again = (sample(toy(), config, 1) for _ in range(2))
    assert all(torch.equal(a.cloud.xyz, b.cloud.xyz) for a, b in zip(one.views, again.views, strict=True))


def test_permutations_differ_between_sweeps_and_gains_of_beams_do_not():
    xyz = torch.randn(200, 3, generator=torch.Generator().manual_seed(0)) * 20
    frames = [
        AgentFrame.of(
            PointCloud.of(xyz, torch.rand(200, generator=torch.Generator().manual_seed(1))), Transform.identity(), 3, t
        )
        for t in (0, 1)
    ]
    for kind, same in (("shuffled", False), ("per-beam-gain", True)):
        sensors = SensorAugmentation(still(intensity_kinds=(kind,)), (3,), ("test",))
        first, second = (sensors.points(frame).intensity for frame in frames)
        assert torch.equal(first, second) is same


def test_unknown_kinds_are_refused():
    with pytest.raises(ConfigError, match="lambert"):
        SensorAugmentConfig(intensity_kinds=("lambert",))  # pyright: ignore
    with pytest.raises(ConfigError, match="none"):
        SensorAugmentConfig(intensity_kinds=())
