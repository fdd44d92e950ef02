# SPDX-License-Identifier: Apache-2.0
"""Samples of tiles: clouds, poses, truth and ink say the same thing before and after every augmentation; keyed; split by town."""

import dataclasses
import math

import numpy as np
import pytest
import shapely
import torch

from manyeyes.datatypes import AgentFrame, BevGrid, ConfigError, PointCloud, Snapshot, Transform
from manyeyes.datatypes.camera import Camera, CameraImage
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, KINDS, MapElements
from manyeyes.evaluation.maps.curvature import measure_curved_length
from manyeyes.models.maps.bev import BevConfig
from manyeyes.models.maps.head import MapHeadConfig
from manyeyes.models.maps.map_model import MapModelConfig
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.training.maps.samples import (
    MapAugmentConfig,
    TileStream,
    mirror_frame,
    rasterise_elements,
)
from manyeyes.training.mirroring import resize_transform

CONFIG = MapModelConfig(
    BevConfig(BevGrid(-12.0, -12.0, -2.0, 12.0, 12.0, 4.0, pillar=0.5)),
    BevGrid(-20.0, -10.0, -1.0, 20.0, 10.0, 1.0, pillar=1.0),
    head=MapHeadConfig(channels=16, heads=4),
)
EXACT = MapAugmentConfig(1, 4, 0.0, 0.0, flip=False)
MAPS = {
    "Aton": MapElements.of([[[-50.0, 3.0], [50.0, 3.0]], [[2, -4], [6, -4], [6, 0], [2, 0]]], [DIVIDER, CROSSING]),
    "Bton": MapElements.of([[[1000.0, -50.0], [1000.0, 50.0]]], DIVIDER),
}


class Drives:
    """Agents on a line; the cloud of each is points on the painted line of its town, and one bright point of its own."""

    scenarios = ("aton_0", "aton_1", "bton_0")

    def length(self, scenario):
        return 2

    def eval_indices(self, scenario):
        return range(2)

    def agents(self, scenario):
        return (1, 2)

    def snapshot(self, scenario, index):
        rng = keyed_generator("drives", scenario, index)
        frames = []
        for agent in range(2):
            if scenario.startswith("aton"):
                pose = Transform.from_xyz_yaw(rng.uniform(-6, 6), 0, 1.0, rng.uniform(-3, 3))
                line = np.stack((np.linspace(-10, 10, 40), np.full(40, 3.0), np.full(40, 1.0)), 1)
            else:
                pose = Transform.from_xyz_yaw(1001, rng.uniform(-6, 6), 1.0, rng.uniform(-3, 3))
                line = np.stack((np.full(40, 1000.0), np.linspace(-10, 10, 40), np.full(40, 1.0)), 1)
            frames.append(AgentFrame.of(PointCloud.of(pose.inverse().apply(torch.from_numpy(line))), pose, agent))
        return Snapshot(scenario, index, tuple(frames))


def stream(augment=EXACT, seed=0, **fields):
    return TileStream(Drives(), MAPS, CONFIG, augment, seed, **fields)


AUGMENTS = {
    "none": EXACT,
    "turn": dataclasses.replace(EXACT, max_yaw_rad=0.5),
    "shift": dataclasses.replace(EXACT, max_shift_m=4.0),
    "bend": dataclasses.replace(EXACT, max_yaw_rad=0.5, bend_probability=1.0, max_curvature=0.03),
    "curved": dataclasses.replace(EXACT, curved_candidates=4),
    "all": MapAugmentConfig(1, 6, 0.5, 4.0, flip=True, bend_probability=0.5, curved_candidates=3),
}


@pytest.mark.parametrize("name", AUGMENTS)
def test_points_truth_and_line_mask_agree(name):
    for number in range(12):
        sample = stream(AUGMENTS[name]).draw(number)
        line = next(sample.truth.polyline(i) for i in range(len(sample.truth)) if sample.truth.kind[i] == DIVIDER)
        # Between vertices 2 m apart, a bent line is off by at most 15 mm.
        tolerance = 0.016 if AUGMENTS[name].bend_probability else 1e-4
        for k, frame in enumerate(sample.frames):
            # Every point of the cloud lies on the painted line, in the tile and in the ink of the look.
            there = sample.tile_from_agent[k].apply(frame.points.xyz.double())[:, :2].numpy()
            inside = np.hypot(*(there - line.mean(0)).T) < 8
            assert inside.any()
            distances = shapely.distance(shapely.points(there[inside]), shapely.LineString(line))
            np.testing.assert_allclose(distances, 0, atol=tolerance)
            near = frame.points.xyz[CONFIG.bev.grid.contains(frame.points.xyz[:, :2]), :2]
            # A cell's border may fall either way: some point within half a step is on an inked cell.
            yx = CONFIG.bev.token_grid.cells(near)
            ink = torch.nn.functional.max_pool2d(sample.line_mask[k, :1].float(), 3, 1, 1)[0]
            assert len(near) and bool((ink[yx[:, 0], yx[:, 1]] > 0).all())
            assert 0.005 < float(sample.line_mask[k, 0].float().mean()) < 0.1


def test_bent_tiles_are_curved_and_others_of_straight_streets_are_not():
    bent, straight = ([stream(AUGMENTS[n]).draw(k).truth for k in range(12)] for n in ("bend", "none"))
    assert not any(measure_curved_length(truth) for truth in straight)
    curved = [measure_curved_length(truth) for truth in bent]
    assert sum(length > 5 for length in curved) >= 6
    # Bent to both sides: the middle of a line lies left or right of its chord.
    sides = {np.sign(_middle_offset(truth.polyline(0))) for truth in bent if truth.kind[0] == DIVIDER}
    assert sides == {-1.0, 1.0}


def _middle_offset(line):
    chord, middle = line[-1] - line[0], line[len(line) // 2] - line[0]
    return chord[0] * middle[1] - chord[1] * middle[0]


def test_samples_are_keyed_and_have_several_frames():
    augment = MapAugmentConfig(1, 6, 0.5, 4.0)
    a, b = stream(augment).draw(5), stream(augment).draw(5)
    assert torch.equal(a.tile_from_agent.translation, b.tile_from_agent.translation) and torch.equal(
        a.line_mask, b.line_mask
    )
    assert not np.array_equal(a.truth.points, stream(augment, seed=1).draw(5).truth.points)
    counts = {len(stream(augment).draw(number).frames) for number in range(30)}
    assert counts == {1, 2, 3, 4, 5, 6}


class DrivesWithPoles(Drives):
    """The second agent of each scenario is a roadside unit, but in the last there is none."""

    def snapshot(self, scenario, index):
        first, second = super().snapshot(scenario, index).frames
        second = dataclasses.replace(second, is_infrastructure=scenario != "bton_0")
        return Snapshot(scenario, index, (first, second))


@pytest.mark.parametrize(("agents", "kinds"), [("all", {0, 1}), ("vehicles", {0}), ("roadside-units", {1})])
def test_frames_of_one_kind_of_agent(agents, kinds):
    augment = MapAugmentConfig(1, 6, agents=agents)
    drawn = [TileStream(DrivesWithPoles(), MAPS, CONFIG, augment, 0).draw(number) for number in range(20)]
    assert {int(frame.is_infrastructure) for sample in drawn for frame in sample.frames} == kinds
    assert len({len(sample.frames) for sample in drawn}) > 3


def test_a_recording_without_the_wanted_agents_is_refused():
    augment = MapAugmentConfig(agents="roadside-units")
    with pytest.raises(ConfigError, match="have no roadside-units"):
        TileStream(Drives(), MAPS, CONFIG, augment, 0).draw(0)


def test_pose_errors_move_frames_and_not_the_truth():
    noisy = dataclasses.replace(EXACT, min_frames=4, sigma_xy_m=0.5, sigma_yaw_rad=0.02)
    exact, moved = stream(dataclasses.replace(EXACT, min_frames=4)).draw(3), stream(noisy).draw(3)
    np.testing.assert_array_equal(exact.truth.points, moved.truth.points)
    away = (exact.tile_from_agent.translation - moved.tile_from_agent.translation).norm(dim=1)
    assert bool((away > 0).all()) and float(away.max()) < 3.0
    assert torch.equal(exact.line_mask, moved.line_mask)


def test_evaluation_town_is_refused_in_training():
    assert stream(held_out=("Cton",)).towns == ("Aton", "Bton")
    with pytest.raises(ConfigError, match="bton"):
        stream(held_out=("Bton",))


def test_line_mask_covers_lines_and_fills_crossings():
    grid = BevGrid(-4.0, -4.0, -1.0, 4.0, 4.0, 1.0, pillar=0.5, stride=2)
    square = [[-1.4, -1.4], [1.4, -1.4], [1.4, 1.4], [-1.4, 1.4]]
    elements = MapElements.of([[[-9.0, 0.1], [9.0, 0.1]], square], [DIVIDER, CROSSING])
    ink = rasterise_elements(elements, grid, ("crossing", "divider"))
    row = int(grid.cells(torch.tensor([[0.0, 0.1]]))[0, 0])
    assert ink[1].nonzero().tolist() == [[row, c] for c in range(8)]
    rows, columns = ink[0].nonzero().unbind(1)
    expected = grid.cells(torch.tensor([[-1.4, -1.4], [1.4, 1.4]]))
    assert int(rows.min()) == int(expected[0, 0]) and int(columns.max()) == int(expected[1, 1])
    assert int(ink[0].sum()) == (int(rows.max()) - int(rows.min()) + 1) ** 2
    assert [KINDS[CROSSING], KINDS[DIVIDER]] == ["crossing", "divider"]


def test_a_mirrored_camera_projects_the_mirrored_point_to_the_mirrored_column():
    frame = Drives().snapshot("aton_0", 0).frames[0]
    zero = torch.zeros((), dtype=torch.float64)
    ahead = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    turned = Transform.from_rpy(torch.tensor([1.0, 0.3, 1.5], dtype=torch.float64), zero + 0.02, zero + 0.1, zero + 0.6)
    pose = turned @ Transform(ahead, torch.zeros(3, dtype=torch.float64))
    camera = Camera(torch.tensor([[30.0, 0, 17], [0, 32, 12], [0, 0, 1]], dtype=torch.float64), pose, 40, 24)
    photo = CameraImage(camera, torch.randint(0, 256, (3, 24, 40), dtype=torch.uint8))
    flipped = mirror_frame(dataclasses.replace(frame, images=(photo,)))
    assert torch.equal(flipped.points.xyz[:, 1], -frame.points.xyz[:, 1])
    other = flipped.images[0]
    assert float(torch.det(other.camera.agent_from_camera.rotation)) == pytest.approx(1.0)
    points = torch.tensor([[9.0, 4.0, 0.0], [12.0, 8.0, 0.5]], dtype=torch.float64)
    there, depth = camera.project(points)
    mirror, same = other.camera.project(points * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    assert torch.allclose(depth, same) and torch.allclose(mirror[:, 1], there[:, 1])
    assert torch.allclose(mirror[:, 0], 40 - there[:, 0])
    u, v = there[0].long().tolist()
    assert torch.equal(other.rgb[:, v, 39 - u], photo.rgb[:, v, u])
    again = mirror_frame(flipped).images[0]
    assert torch.equal(again.rgb, photo.rgb) and torch.allclose(again.camera.intrinsic, camera.intrinsic)


def test_a_mirrored_turn_is_a_turn_the_other_way():
    back = resize_transform(Transform.from_xyz_yaw(1.0, 2.0, 3.0, 0.4), 1.0, flip=True)
    assert float(back.yaw) == pytest.approx(-0.4) and back.translation.tolist() == [1.0, -2.0, 3.0]
    assert math.isclose(float(torch.det(back.rotation)), 1.0)
