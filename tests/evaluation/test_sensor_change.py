# SPDX-License-Identifier: Apache-2.0
"""Changed sensors: clouds alone change, by the same draws every time; a detector without its earlier sweep."""

import math

import pytest
import torch

from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.detection.sensor_change import SensorChange
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.detector.protocols import has_tokens
from manyeyes.models.detector.single_sweep import with_single_sweep


def snapshot(index: int = 0) -> Snapshot:
    rng = torch.Generator().manual_seed(3)
    frames = tuple(
        AgentFrame.of(
            PointCloud.of((torch.rand(50, 3, generator=rng) - 0.5) * 40, torch.rand(50, generator=rng)),
            Transform.from_xyz_yaw(agent, 0),
            agent_id=agent,
            timestamp_ns=index * 100_000_000,
            sensor_height_m=1.8,
        )
        for agent in (1, 2)
    )
    poses = Transform.stack([frame.world_from_agent for frame in frames])
    truth = GroundTruth(Boxes.empty(torch.float64), torch.zeros(2, 0, dtype=torch.bool), poses)
    return Snapshot("a", index, frames, truth)


def test_nothing_changes_without_a_change():
    given = snapshot()
    assert SensorChange().apply(given) is given and SensorChange(sweeps=1).apply(given) is given


@pytest.mark.parametrize("law", ["zero", "shuffled", "per-beam-gain", "carla"])
def test_a_law_changes_intensity_alone_and_equally_each_time(law):
    given = snapshot()
    one, two = (SensorChange(law).apply(given) for _ in range(2))
    for before, after, again in zip(given.frames, one.frames, two.frames):
        assert torch.equal(before.points.xyz, after.points.xyz)
        assert not torch.equal(before.points.intensity, after.points.intensity)
        assert torch.equal(after.points.intensity, again.points.intensity)
    assert one.truth is given.truth


def test_a_tilt_keeps_ranges_from_the_sensor_and_turns_by_its_angle():
    given = snapshot()
    tilted = SensorChange(tilt_deg=3.0).apply(given)
    later = SensorChange(tilt_deg=3.0).apply(snapshot(1))
    origin = torch.tensor([0.0, 0.0, 1.8])
    axes = []
    for before, after, following in zip(given.frames, tilted.frames, later.frames):
        a, b = before.points.xyz - origin, after.points.xyz - origin
        assert torch.allclose(a.norm(dim=1), b.norm(dim=1), atol=1e-4)
        rotation = torch.linalg.lstsq(a.double(), b.double()).solution.T
        assert math.degrees(math.acos(float(rotation[2, 2]))) == pytest.approx(3.0, abs=1e-3)
        assert torch.allclose(after.points.xyz, following.points.xyz)
        axes.append(rotation)
    assert not torch.allclose(axes[0], axes[1])


def test_unknown_laws_and_impossible_tilts_are_refused():
    with pytest.raises(ConfigError, match="No intensity law 'paint'"):
        SensorChange("paint")
    with pytest.raises(ConfigError, match="tilt_deg needs a number from 0 to 45; got 90"):
        SensorChange(tilt_deg=90.0)


def test_a_detector_of_single_sweeps_ignores_the_sweep_before():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        detector = Detector(COSTR_TINY).eval().requires_grad_(False)
    cloud, previous = (frame.points for frame in snapshot().frames)
    single = with_single_sweep(detector)
    assert has_tokens(single) and single.fingerprint == detector.fingerprint and single.grid == detector.grid
    alone = detector.extract_tokens(cloud, None)[0].features
    assert torch.equal(single.extract_tokens(cloud, previous)[0].features, alone)
    assert not torch.equal(detector.extract_tokens(cloud, previous)[0].features, alone)

    class Boxer:
        def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
            assert previous is None
            return Boxes.empty()

    boxer = with_single_sweep(Boxer())
    assert not has_tokens(boxer) and len(boxer.detect(cloud, previous)) == 0
