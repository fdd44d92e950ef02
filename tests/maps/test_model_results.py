# SPDX-License-Identifier: Apache-2.0
import dataclasses
import json
import math

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.formats.model_results import (
    RESULT_OPTIONS,
    ModelResultsError,
    read_model_results,
    read_nuscenes_poses,
    read_pose_csv,
)

FRAME = MapFrame(49.0, 8.4)
RING = [[4.0, -3.0], [7.0, -3.0], [7.0, 3.0], [4.0, 3.0], [4.0, -3.0]]


def vector(points, name, score):
    return {"pts": points, "pts_num": len(points), "cls_name": name, "type": 0, "confidence_level": score}


def write(path, value):
    path.write_text(json.dumps(value))
    return path


@pytest.fixture
def poses(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text(
        "token,agent,pass_id,time_ns,x,y,yaw,sigma_x,sigma_y,sigma_yaw\n"
        "a,car,p1,1000,10,20,1.5707963267948966,0.5,0.5,0.01\n"
        "b,car,p1,2000,11,20,0,,,\n"
    )
    return read_pose_csv(path, FRAME)


def test_maptr_in_the_lidars_axes_is_turned_forward(tmp_path, poses):
    # x right, y forward: a line 5 m ahead that runs from left to right.
    vectors = [
        vector([[-3, 5], [3, 5]], "divider", 0.9),
        vector(RING, "ped_crossing", 0.4),
        vector([[0, 0], [0, 9]], "centerline", 0.8),
    ]
    path = write(tmp_path / "r.json", {"meta": {}, "results": [{"sample_token": "a", "vectors": vectors}]})
    reading = read_model_results(path, poses, RESULT_OPTIONS["maptr-nuscenes"])
    (observation,) = reading.observations
    elements = observation.elements
    assert reading.frame == FRAME and not reading.rejected
    assert elements.kind.tolist() == [DIVIDER, CROSSING]
    assert reading.left_out == {"class 'centerline'": 1}
    np.testing.assert_allclose(elements.polyline(0), [[5, 3], [5, -3]])
    assert elements.counts.tolist() == [2, 4]
    np.testing.assert_allclose(elements.score, [0.9, 0.4])
    # The vehicle looks along y of the map from (10, 20).
    np.testing.assert_allclose(observation.elements_in_map().polyline(0), [[7, 25], [13, 25]], atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(observation.covariance)), [0.5, 0.5, 0.01])
    assert (observation.agent, observation.pass_id, observation.time_ns) == ("car", "p1", 1000)


def test_streammapnet_counts_its_classes(tmp_path, poses):
    sample = {"vectors": [RING, [[0, 1], [9, 1]], [[0, 5], [9, 5]]], "scores": [0.5, 0.6, 0.1], "labels": [0, 1, 2]}
    path = write(tmp_path / "s.json", {"meta": {}, "results": {"b": sample, "a": sample}})
    reading = read_model_results(path, poses, RESULT_OPTIONS["streammapnet-100x50"])
    first, second = reading.observations
    assert (first.time_ns, second.time_ns) == (2000, 1000)
    assert first.elements.kind.tolist() == [CROSSING, DIVIDER, BOUNDARY]
    np.testing.assert_allclose(np.ptp(first.view, axis=0), [100, 50])
    np.testing.assert_allclose(np.diag(first.covariance), [0.49, 0.49, math.radians(0.8) ** 2])
    strict = dataclasses.replace(RESULT_OPTIONS["streammapnet"], min_score=0.4)
    assert read_model_results(path, poses, strict).observations[0].elements.kind.tolist() == [CROSSING, DIVIDER]


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ({"sample_token": "zz", "vectors": []}, "no pose"),
        ({"sample_token": "b", "vectors": [vector([[0, 0], [1, "x"]], "divider", 0.5)]}, "finite"),
        ({"sample_token": "b", "vectors": [vector([[0, 0], [1, float("nan")]], "divider", 0.5)]}, "finite"),
        ({"sample_token": "b", "vectors": [vector([[0, 0], [1, 1]], "divider", 1.5)]}, "score"),
        ({"sample_token": "b", "vectors": [vector([[0, 0], [4, 4], [4, 0], [0, 4]], "ped_crossing", 0.5)]}, "cross"),
        ({"sample_token": "b", "vectors": {"x": 1}}, "layout"),
        (["b"], "no pose"),
    ],
)
def test_invalid_samples_are_rejected_and_the_rest_is_read(tmp_path, poses, bad, reason):
    good = {"sample_token": "a", "vectors": [vector([[0, 0], [9, 0]], "divider", 0.5)]}
    path = write(tmp_path / "r.json", {"results": [bad, good]})
    reading = read_model_results(path, poses, RESULT_OPTIONS["maptr-av2"])
    assert [o.time_ns for o in reading.observations] == [1000]
    assert [(q.row, q.count) for q in reading.rejected] == [(0, 1)] and reason in reading.rejected[0].reason
    columns = {"results": {"b": {"vectors": [RING], "scores": [], "labels": [0]}}}
    aside = read_model_results(write(path, columns), poses, RESULT_OPTIONS["streammapnet"]).rejected
    assert "layout" in aside[0].reason


def test_a_sample_that_is_there_twice_counts_once_and_huge_numbers_are_rejected(tmp_path, poses):
    vectors = [vector([[0, 0], [10**400, 0]], "divider", 0.9)]
    samples = [
        {"sample_token": "a", "vectors": []},
        {"sample_token": "a", "vectors": []},
        {"sample_token": "b", "vectors": vectors},
    ]
    loaded = read_model_results(write(tmp_path / "r.json", {"results": samples}), poses, RESULT_OPTIONS["maptr-av2"])
    assert len(loaded.observations) == 1
    assert [r.row for r in loaded.rejected] == [1, 2]
    assert "is there twice" in loaded.rejected[0].reason and "finite numbers" in loaded.rejected[1].reason


def test_sample_without_elements_is_empty_observation(tmp_path, poses):
    path = write(tmp_path / "r.json", {"results": [{"sample_token": "a", "vectors": []}]})
    assert len(read_model_results(path, poses, RESULT_OPTIONS["maptr-av2"]).observations[0].elements) == 0


@pytest.mark.parametrize(
    "text",
    ["{", "[]", '{"results": 3}', "[" * 100_000, '{"results": {"a": 1, "a": 2}}', '{"results": [], "results": []}'],
)
def test_a_file_of_another_kind_is_refused(tmp_path, poses, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(ModelResultsError, match=r"x\.json"):
        read_model_results(tmp_path / "x.json", poses, RESULT_OPTIONS["streammapnet"])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("token,agent\na,b\n", "pass_id"),
        ("token,agent,pass_id,time_ns,x,y,yaw\na,b,c,1,2,north,0\n", "line 2"),
        ("token,agent,pass_id,time_ns,x,y,yaw,sigma_x\na,b,c,1,2,3,0,-1\n", "above 0"),
        ("token,agent,pass_id,time_ns,x,y,yaw\na,b,c,1,inf,3,0\n", "finite"),
        ("token,agent,pass_id,time_ns,x,y,yaw\na,b,c,1,2,3,0\na,b,c,2,2,3,0\n", "line 3: token 'a' is in line 2 too"),
    ],
)
def test_a_table_of_poses_that_cannot_be_read_is_named(tmp_path, text, reason):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(ModelResultsError, match=reason):
        read_pose_csv(tmp_path / "p.csv", FRAME)


def quaternion(yaw):
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


@pytest.fixture
def nuscenes(tmp_path):
    tables = {
        "log": [
            {"token": "l1", "location": "boston-seaport", "vehicle": "n008"},
            {"token": "l2", "location": "singapore-onenorth", "vehicle": "n015"},
        ],
        "scene": [
            {"token": "c1", "log_token": "l1", "name": "scene-1"},
            {"token": "c2", "log_token": "l2", "name": "scene-2"},
        ],
        "sample": [{"token": "s1", "scene_token": "c1"}, {"token": "s2", "scene_token": "c2"}],
        "ego_pose": [{"token": "e", "translation": [100.0, 200.0, 0.0], "rotation": quaternion(math.pi / 2)}],
        # nuScenes' roof LiDAR: 0.9 m ahead of the rear axle, its x to the right.
        "calibrated_sensor": [{"token": "k", "translation": [0.9, 0.0, 1.8], "rotation": quaternion(-math.pi / 2)}],
        "sample_data": [
            {
                "sample_token": sample,
                "ego_pose_token": "e",
                "calibrated_sensor_token": "k",
                "timestamp": 5,
                "is_key_frame": key,
                "filename": f"samples/{sensor}/x",
            }
            for sample, key, sensor in (
                ("s1", True, "LIDAR_TOP"),
                ("s1", True, "CAM_FRONT"),
                ("s1", False, "LIDAR_TOP"),
                ("s2", True, "LIDAR_TOP"),
            )
        ],
    }
    for name, rows in tables.items():
        write(tmp_path / f"{name}.json", rows)
    return tmp_path


def test_nuscenes_poses_are_of_the_frame_that_the_results_are_in(nuscenes, tmp_path):
    vehicle = read_nuscenes_poses(nuscenes, "boston-seaport")
    assert vehicle.tokens == ("s1",) and vehicle.frame.latitude == pytest.approx(42.3368, abs=1e-4)
    assert (vehicle.poses[0].agent, vehicle.poses[0].pass_id, vehicle.poses[0].time_ns) == ("n008", "scene-1", 5000)
    np.testing.assert_allclose(vehicle.poses[0].pose, (100, 200, math.pi / 2))
    lidar = read_nuscenes_poses(nuscenes, "boston-seaport", axes="lidar")
    np.testing.assert_allclose(lidar.poses[0].pose, (100, 200.9, math.pi / 2), atol=1e-12)
    # 5 m ahead of the LiDAR, which looks along y of the map.
    ahead = {"results": [{"sample_token": "s1", "vectors": [vector([[0, 5], [0, 9]], "divider", 0.5)]}]}
    path = write(tmp_path / "r.json", ahead)
    (observation,) = read_model_results(path, lidar, RESULT_OPTIONS["maptr-nuscenes"]).observations
    np.testing.assert_allclose(observation.elements_in_map().points, [[100, 205.9], [100, 209.9]], atol=1e-9)


@pytest.mark.parametrize("rotation", ["north", [1, 0, 0], [1, 0, 0, "x"], [10**400, 0, 0, 10**400]])
def test_a_nuscenes_pose_without_numbers_is_named(nuscenes, rotation):
    rows = json.loads((nuscenes / "ego_pose.json").read_text())
    for row in rows:
        row["rotation"] = rotation
    write(nuscenes / "ego_pose.json", rows)
    with pytest.raises(ModelResultsError, match="a pose and a time in numbers"):
        read_nuscenes_poses(nuscenes, "boston-seaport")


def test_nuscenes_tables_that_do_not_fit_are_named(nuscenes):
    with pytest.raises(ModelResultsError, match="boston-seaport"):
        read_nuscenes_poses(nuscenes, "atlantis")
    with pytest.raises(ModelResultsError, match="no LiDAR key frame"):
        read_nuscenes_poses(nuscenes, "singapore-queenstown")
    write(nuscenes / "ego_pose.json", [{"token": "other", "translation": [0, 0, 0], "rotation": [1, 0, 0, 0]}])
    with pytest.raises(ModelResultsError, match="'e'"):
        read_nuscenes_poses(nuscenes, "boston-seaport")
    write(nuscenes / "ego_pose.json", [{"token": "e"}])
    with pytest.raises(ModelResultsError, match="translation"):
        read_nuscenes_poses(nuscenes, "boston-seaport")
