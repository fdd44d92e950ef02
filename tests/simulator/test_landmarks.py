# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.simulator.fleet.landmark_errors import BoxNoise
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene

EXACT = BoxNoise(1e-9, 1e-9, 0.0, 1e-9)


def moved(xy, pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return xy @ np.array([[c, s], [-s, c]]) + pose[:2]


def test_common_rows_are_one_object_and_no_other_pair_is():
    scene = make_landmark_scene(LandmarkSpec(5, 6, 7, EXACT), 0, 3)
    ego, other = (b[0].center[:, :2].numpy() for b in (scene.ego, scene.other))
    there = moved(other, scene.ego_from_other)
    apart = np.hypot(*(ego[:, None] - there[None]).transpose(2, 0, 1))
    assert (len(ego), len(other)) == (11, 12)
    assert set(zip(*np.nonzero(apart < 1e-6))) == set(map(tuple, scene.common_pairs)) and len(scene.common_pairs) == 5
    np.testing.assert_allclose(scene.common_xy, ego[scene.common_pairs[:, 0]], atol=1e-6)


def test_disjoint_scenes_have_no_common_objects():
    scene = make_landmark_scene(LandmarkSpec(4, 15, 15, EXACT, disjoint=True), 0, 0)
    there = moved(scene.other[0].center[:, :2].numpy(), scene.ego_from_other)
    apart = np.hypot(*(scene.ego[0].center[:, None, :2].numpy() - there[None]).transpose(2, 0, 1))
    assert apart.min() > 1e-3 and len(scene.common_pairs) == 0


def test_motion_carries_earlier_frames_to_now():
    scene = make_landmark_scene(LandmarkSpec(3, 4, 4, EXACT, num_instants=4), 1, 0)
    assert len(scene.ego) == len(scene.other) == 4
    np.testing.assert_allclose(scene.ego_from_then[0], 0, atol=1e-12)
    for n in range(4):
        ego = moved(scene.ego[n].center[:, :2].numpy(), scene.ego_from_then[n])
        there = moved(scene.other[n].center[:, :2].numpy(), scene.ego_from_other)
        apart = np.hypot(*(ego[:, None] - there[None]).transpose(2, 0, 1))
        assert (apart < 1e-6).sum() == 3


def test_a_scene_is_its_key():
    one, two, other = (make_landmark_scene(LandmarkSpec(), 5, k) for k in (1, 1, 2))
    assert (one.ego[0].center == two.ego[0].center).all() and (one.ego_from_other == two.ego_from_other).all()
    assert one.ego_from_other[0] != other.ego_from_other[0]


def test_dair_counts_have_half_of_frames_with_three_or_more():
    counts = [len(make_landmark_scene(LandmarkSpec(None, 1, 1), 0, k).common_pairs) for k in range(60)]
    assert 0.35 < np.mean(np.array(counts) >= 3) < 0.75 and max(counts) <= 12


def test_counts_below_zero_are_refused():
    with pytest.raises(ConfigError, match="at least 0"):
        LandmarkSpec(num_ego_only=-1)
