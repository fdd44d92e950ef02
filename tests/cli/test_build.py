# SPDX-License-Identifier: Apache-2.0
"""From a recording to a map: on a synthetic crossroads, and by the command."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow", reason="the 'map' extra is not installed")
pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.cli import main as cli
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.datatypes.map_element import KINDS
from manyeyes.maps.elements.observation_file import read_observations
from manyeyes.models import checkpoint, pretrained
from manyeyes.models.maps.map_model import MapModel
from manyeyes.models.maps.presets import FORMAT, MAP_TINY
from manyeyes.studies.map_folder import MapFolder, read_vector_map
from manyeyes.studies.map_pipeline import MapBuildConfig, build_map, count_snapshots, write_built_map
from manyeyes.studies.town_maps import TownMap, find_named_town, group_by_town

NOTHING = Boxes.of(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))


@dataclass(frozen=True)
class Crossroads:
    """Four agents drive in towards the middle of the place 'cross', whose zero is the world's, each on its own arm."""

    scenarios: tuple[str, ...] = ("cross_0",)
    frames: int = 20

    def length(self, scenario: str) -> int:
        return self.frames

    def eval_indices(self, scenario: str) -> range:
        return range(self.frames)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (1, 2, 3, 4)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        poses = []
        for k in range(4):
            away, heading = 60.0 - 3.0 * index, k * np.pi / 2
            poses.append(Transform.from_xyz_yaw(-away * np.cos(heading), -away * np.sin(heading), 0.0, heading))
        cloud = PointCloud.of(torch.randn(400, 3) * torch.tensor([8.0, 8.0, 0.2]))
        frames = [AgentFrame.of(cloud, pose, 1 + k, index * 10**8) for k, pose in enumerate(poses)]
        truth = GroundTruth(NOTHING, torch.zeros(4, 0, dtype=torch.bool), Transform.stack(poses))
        return Snapshot(scenario, index, tuple(frames), truth)


CROSS = TownMap("cross", ("cross_0",), "cross", (0.0, 0.0))
NOWHERE = TownMap("nowhere", ("cross_0",), None, (10.0, 20.0))


@pytest.fixture(scope="module")
def built():
    return build_map(Crossroads(), CROSS, MapBuildConfig(None, frame_stride=4))


def test_the_fused_map_is_better_than_the_union_of_observations(built) -> None:
    n = built.stats
    assert (n.num_messages, n.num_observations, n.num_lost, n.num_rejected) == (20, 20, 0, 0)
    assert 200 < n.bytes_per_message < 2000 and n.bytes_per_frame == 0
    assert (
        n.scores is not None
        and n.union_scores is not None
        and sum(k.n_truth for k in n.scores.kinds) == len(built.truth)
    )
    assert n.scores.mean_ap("maptr") > 0.5 and n.scores.mean_ap("maptr") > n.union_scores.mean_ap("maptr") + 0.1
    assert 0 < n.num_published <= n.num_elements < n.num_observed_elements and 0.6 < n.incremental_fscore <= 1.0
    assert {o.agent for o in built.map_server.observations} == {f"cross_0/{k}" for k in (1, 2, 3, 4)}


@pytest.mark.slow
def test_the_folder_is_read_by_the_other_commands(built, tmp_path) -> None:
    write_built_map(built, tmp_path, "A crossroads")
    assert {p.name for p in tmp_path.iterdir()} == {"observations", "truth", "cut.json", "map", "map.html", "map.png"}
    assert read_vector_map(tmp_path / "map").quantised_hash() == built.fused.quantised_hash()
    assert len(read_observations(tmp_path / "observations").observations) == 20
    assert MapFolder(tmp_path).read_cut_policy() is not None and "A crossroads" in (tmp_path / "map.html").read_text()
    assert cli.main(["map", "evaluate", str(tmp_path / "map")]) == 0
    held = json.loads((tmp_path / "map" / "quality.json").read_text())["result"]["mean_ap"]
    assert held["maptr"] == pytest.approx(built.stats.scores.mean_ap("maptr"), abs=0.02)


@pytest.mark.slow
def test_the_same_recording_is_the_same_map_and_pose_noise_moves_priors_only(built) -> None:
    again = build_map(Crossroads(), CROSS, MapBuildConfig(None, frame_stride=4))
    assert again.fused.quantised_hash() == built.fused.quantised_hash()
    noisy = build_map(Crossroads(), CROSS, MapBuildConfig(None, frame_stride=4, pose_sigma_m=0.4))
    for one, two in zip(noisy.map_server.observations, built.map_server.observations):
        np.testing.assert_array_equal(one.elements.points, two.elements.points)
        assert 0 < np.hypot(*(one.pose - two.pose)[:2]) < 2.0 and one.covariance[0, 0] == pytest.approx(0.1625, rel=0.1)


def test_lost_packets_are_counted() -> None:
    calls = []
    lossy = build_map(
        Crossroads(), CROSS, MapBuildConfig(None, frame_stride=4, channel="its-g5", seed=3), lambda: calls.append(1)
    )
    assert len(calls) == count_snapshots(Crossroads(), CROSS, 4) == 5
    assert lossy.stats.num_lost == lossy.stats.num_messages - lossy.stats.num_observations


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    checkpoint.save(
        MapModel(replace(MAP_TINY, head=replace(MAP_TINY.head, score_threshold=0.0))),
        path,
        {"towns": []},
        format=FORMAT,
    )
    return path


@pytest.mark.slow
def test_a_model_predicts_where_no_truth_is_known(weights, tmp_path) -> None:
    map_model = pretrained.load_map_model(weights)
    made = build_map(Crossroads(frames=9), NOWHERE, MapBuildConfig(map_model, "semi-global", frame_stride=8))
    stats = made.stats
    assert stats.scores is None and stats.union_scores is None and made.truth is None
    assert stats.num_messages == 8 and stats.bytes_per_frame > 1000
    assert made.map_server.observations[0].model == map_model.fingerprint.hex()
    np.testing.assert_allclose(made.map_server.observations[0].pose, [-70.0, -20.0, 0.0], atol=1e-5)
    write_built_map(made, tmp_path, "Nowhere")
    assert not (tmp_path / "truth").exists() and (tmp_path / "map.png").exists()


def test_the_oracle_needs_a_true_map() -> None:
    with pytest.raises(ConfigError, match="nowhere"):
        build_map(Crossroads(), NOWHERE, MapBuildConfig(None))
    with pytest.raises(ConfigError, match="frame_stride"):
        MapBuildConfig(None, frame_stride=0)


def test_scenarios_are_grouped_by_the_town_that_they_are_named_after() -> None:
    names = {"town05_0066": "Town05", "town10hd_3": "Town10HD", "generated-3_0": "generated-3"}
    assert {name: find_named_town(name) for name in names} == names
    assert find_named_town("2021_08_16_22_26_54") is None and find_named_town("generated-x_0") is None
    drive = Crossroads(("town05_0001", "town05_0002", "elsewhere_1"))
    one, two = group_by_town(drive, drive.scenarios, "mine")
    assert (one.name, one.town, one.scenarios) == ("town05", "Town05", ("town05_0001", "town05_0002"))
    assert (
        (two.name, two.town, two.start_xy) == ("mine", None, (-60.0, 0.0))
        and two.place is None
        and two.cut_policy is None
    )


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--source", "truth", "--weights", "x.safetensors"), "leave --weights out"),
        (("--weights", "nowhere"), "known are map-small-camera"),
        (("--weights", "nowhere.safetensors"), "no such file"),
        (("--source", "truth", "--channel", "moon"), "its-g5"),
        (("--source", "truth"), "scenario"),
    ],
)
def test_invalid_arguments_are_one_line(words, named, tmp_path, capsys) -> None:
    assert cli.main(["map", "build", str(tmp_path), *words, "--out", str(tmp_path / "out")]) == 1
    (output,) = capsys.readouterr().err.splitlines()
    assert output.startswith("manyeyes: ") and named in output


def test_without_shipped_weights_the_way_out_is_named(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(pretrained, "list_map_models", lambda: ())
    assert cli.main(["map", "build", str(tmp_path)]) == 1
    assert "--source truth" in capsys.readouterr().err


def test_pictures_are_read_of_opv2v_only(tmp_path) -> None:
    (tmp_path / "vehicle-side").mkdir()
    (tmp_path / "infrastructure-side").mkdir()
    with pytest.raises(ConfigError, match="pictures"):
        open_recording(tmp_path, images=True)


@pytest.mark.slow
def test_the_command_on_a_simulated_recording(tmp_path, capsys) -> None:
    pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    from manyeyes.simulator.presets import simulate

    simulate("smoke-opv2v", tmp_path / "tiny")
    words = ["map", "build", str(tmp_path / "tiny"), "--split", "test", "--source", "truth", "--frame-stride", "2"]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "against the truth in view" in printed and "all observations together, unfused" in printed
    held = json.loads((tmp_path / "out" / "build.json").read_text())
    (numbers,) = held["result"]
    assert numbers["name"] == "generated-3" and numbers["num_observations"] == numbers["num_messages"] > 2
    assert held["provenance"]["config"]["options"]["source"] == "truth"
    assert Path(tmp_path / "out" / "generated-3" / "map.html").is_file()
    assert cli.main([*words, "--map", str(tmp_path / "other.json"), "--out", str(tmp_path / "two")]) == 1
    assert "named after a town" in capsys.readouterr().err and not (tmp_path / "two").exists()


def test_a_real_maps_file_is_the_truth_where_no_town_is_named(tmp_path):
    lanes = {
        name: {
            "lane_type": "CITY_DRIVING",
            "left_boundary": ["(0, 0)", "(60, 0)"][::way],
            "right_boundary": edge[::way],
        }
        for name, way, edge in (("a", 1, ["(0, -3.5)", "(60, -3.5)"]), ("b", -1, ["(0, 3.5)", "(60, 3.5)"]))
    }
    path = tmp_path / "yizhuang06.json"
    path.write_text(json.dumps({"LANE": lanes}))
    ground = TownMap("road", ("x",), None, (0.0, 0.0), path)
    assert ground.place is not None and ground.origin_xy == (30.0, 0.0)
    truth = ground.place.truth
    assert sorted(KINDS[kind] for kind in truth.kind) == ["boundary", "boundary", "divider"]
    # A town's own map stands, whatever file is given for elsewhere.
    assert TownMap("cross", ("cross_0",), "cross", (0.0, 0.0), path).origin_xy != (30.0, 0.0)
