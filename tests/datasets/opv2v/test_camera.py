# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

pytest.importorskip("PIL", reason="pictures need the view extra")

from manyeyes.datasets.formats.image_io import read_image, write_png
from manyeyes.datasets.opv2v import Opv2vRecording, Opv2vWriter
from manyeyes.datasets.opv2v.camera import read_cameras
from manyeyes.datatypes import AgentFrame, Camera, CameraImage, PointCloud, RecordingError, Snapshot, Transform

# world_from_camera of a level camera that looks along the agent's x: right is -y, down is -z.
AHEAD = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)


def angle(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


def camera(yaw: float, pitch: float, place: tuple[float, float, float]) -> Camera:
    turn = Transform.from_rpy(torch.tensor(place, dtype=torch.float64), angle(0.0), angle(pitch), angle(yaw))
    intrinsic = torch.tensor([[33.5, 0, 8], [0, 33.5, 6], [0, 0, 1]], dtype=torch.float64)
    return Camera(intrinsic, Transform(turn.rotation @ AHEAD, turn.translation), 16, 12)


def snapshot() -> Snapshot:
    random = np.random.default_rng(0)
    cameras = camera(0.0, 0.0, (2.5, 0, 1)), camera(-1.7, 0.1, (0.0, -0.3, 1.8))
    images = tuple(
        CameraImage(c, torch.from_numpy(random.integers(0, 256, (3, 12, 16)).astype(np.uint8))) for c in cameras
    )
    pose = Transform.from_rpy(torch.tensor([210.0, -34, 5], dtype=torch.float64), angle(0.01), angle(-0.03), angle(2.2))
    cloud = PointCloud.of(torch.tensor([[5.0, 1, 0], [9, -2, 1]]))
    frame = AgentFrame(3, 0, cloud, pose, torch.zeros(3, 3, dtype=torch.float64), images=images)
    pole = replace(frame, agent_id=-1, is_infrastructure=True, images=images[:1], sensor_height_m=5.0)
    return Snapshot("one", 0, (frame, pole))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    writer = Opv2vWriter(tmp_path / "one")
    writer.write(snapshot())
    later = replace(snapshot(), frames=tuple(replace(f, timestamp_ns=100_000_000) for f in snapshot().frames))
    writer.write(later)
    writer.close({})
    return tmp_path


def test_images_and_cameras_round_trip(root: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    kept = tmp_path_factory.mktemp("kept")
    for _ in range(2):  # the second time from the cache
        recording = Opv2vRecording(root, images=True, cache_folder=kept)
        read = recording.snapshot("one", 0)
        assert [len(frame.images) for frame in read.frames] == [2, 1]
        for frame, true in zip(read.frames, snapshot().frames):
            for one, two in zip(frame.images, true.images):
                assert torch.equal(one.rgb, two.rgb)
                torch.testing.assert_close(one.camera.intrinsic, two.camera.intrinsic)
                place, wanted = one.camera.agent_from_camera, two.camera.agent_from_camera
                torch.testing.assert_close(place.matrix(), wanted.matrix(), atol=1e-9, rtol=0)
    assert recording.missing_summary == ()


def test_images_are_read_only_on_demand(root: Path) -> None:
    assert all(frame.images == () for frame in Opv2vRecording(root, use_cache=False).snapshot("one", 0).frames)


def test_the_extrinsic_takes_lidar_points_to_the_camera_in_unreals_axes(root: Path) -> None:
    content = yaml.safe_load((root / "one" / "3" / "000000.yaml").read_text())
    frame = snapshot().frames[0]
    for number, image in enumerate(frame.images):
        entry = content[f"camera{number}"]
        assert np.array(entry["extrinsic"]).shape == (4, 4)
        agent = torch.tensor([[7.0, 2.0, 0.5]], dtype=torch.float64)
        lidar = agent - torch.tensor([0, 0, frame.sensor_height_m], dtype=torch.float64)
        left_handed = [*(lidar[0] * torch.tensor([1.0, -1, 1])).tolist(), 1.0]
        ahead, right, up, _ = np.array(entry["extrinsic"]) @ left_handed
        x, y, z = image.camera.agent_from_camera.inverse().apply(agent)[0].tolist()
        assert (right, -up, ahead) == pytest.approx((x, y, z), abs=1e-6)


def test_a_yaml_as_opv2v_writes_it(tmp_path: Path) -> None:
    # The agent stands at the origin, heading along CARLA's x; camera 1 is 0.3 m to its right and looks 100 degrees to the right.
    text = {
        "camera1": {"cords": [0.0, 0.3, 1.8, 0.0, 100.0, 0.0], "extrinsic": np.eye(4).tolist(), "intrinsic": np.eye(3).tolist()},
        "lidar_pose": [0.0, 0.0, 1.9, 0.0, 0.0, 0.0], "true_ego_pos": [0.0] * 6, "vehicles": {},
    }  # fmt: skip
    folder = tmp_path / "one" / "7"
    folder.mkdir(parents=True)
    (folder / "000000.yaml").write_text(yaml.safe_dump(text))
    Opv2vWriter(tmp_path / "other").write(snapshot())
    (folder / "000000.pcd").write_bytes((tmp_path / "other" / "3" / "000000.pcd").read_bytes())
    write_png(folder / "000000_camera1.png", torch.zeros(3, 4, 6, dtype=torch.uint8))
    (frame,) = Opv2vRecording(tmp_path / "one", images=True, use_cache=False).snapshot("one", 0).frames
    (image,) = frame.images
    assert (image.camera.width, image.camera.height) == (6, 4)
    place = image.camera.agent_from_camera
    assert place.translation.tolist() == pytest.approx([0.0, -0.3, 1.8])
    ahead = place.rotation[:, 2]
    assert ahead.tolist() == pytest.approx([np.cos(np.deg2rad(100)), -np.sin(np.deg2rad(100)), 0], abs=1e-12)
    assert place.rotation[:, 1].tolist() == pytest.approx([0, 0, -1], abs=1e-12)


def test_a_missing_image_is_a_problem_and_a_damaged_one_an_error(root: Path) -> None:
    folder = root / "one" / "3"
    (folder / "000002_camera1.png").unlink()
    recording = Opv2vRecording(root, images=True, use_cache=False)
    (problem,) = recording.missing_summary
    assert "1 of 2 frames lack the picture of camera 1, the first is 000002" in problem
    assert [len(f.images) for f in recording.snapshot("one", 1).frames] == [1, 1]
    assert Opv2vRecording(root, use_cache=False).missing_summary == ()
    (folder / "000000_camera0.png").write_bytes(b"no picture")
    with pytest.raises(RecordingError, match=r"000000_camera0\.png: expected a picture"):
        recording.snapshot("one", 0)


def test_a_camera_without_its_numbers_is_named(tmp_path: Path) -> None:
    path = tmp_path / "000000.yaml"
    path.write_text("camera0: {cords: [1, 2, 3], intrinsic: [[1, 0, 0]]}\n")
    with pytest.raises(RecordingError, match=r"six numbers at 'camera0\.cords'"):
        read_cameras(path)
    path.write_text("RSU: false\n")
    assert read_cameras(path) == ()


def test_an_image_round_trips(tmp_path: Path) -> None:
    rgb = torch.arange(3 * 5 * 7, dtype=torch.uint8).reshape(3, 5, 7)
    write_png(tmp_path / "a.png", rgb)
    assert torch.equal(read_image(tmp_path / "a.png"), rgb)
