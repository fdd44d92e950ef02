# SPDX-License-Identifier: Apache-2.0
"""The studies of the map model: tables, claims, pictures and files, on drawings that are known; and whole maps by an oracle."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("pyarrow", reason="the 'map' extra is not installed")
pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.cli import main as cli
from manyeyes.datasets.missing import NONE_MISSING
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps.tile_metrics import TileRow, TileTable
from manyeyes.evaluation.maps.tile_prediction import (
    CLEAN,
    CLEAN_CORRECTED,
    CORRECTED,
    NOISY,
    ROADSIDE,
    SINGLE_VEHICLE,
    VEHICLE,
    ScenarioPredictions,
    TilePrediction,
)
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.models import checkpoint, pretrained
from manyeyes.models.maps.bev import BevConfig
from manyeyes.models.maps.head import MapHeadConfig
from manyeyes.models.maps.map_model import MapModel, MapModelConfig
from manyeyes.models.maps.presets import FORMAT
from manyeyes.studies.map_pipeline import MapBuildConfig
from manyeyes.studies.maps import (
    full_map as whole,
    local,
    map_pose_noise as pose,
    model_study,
    recorded_fleet as crowd,
    semi_global,
)
from manyeyes.studies.town_maps import TownMap

CONFIG = MapModelConfig(
    BevConfig(
        BevGrid(-8.0, -8.0, -2.0, 8.0, 8.0, 4.0, pillar=0.5), channels=16, raster_channels=8, raster_blocks=(1, 1)
    ),
    BevGrid(-10.0, -5.0, -1.0, 10.0, 5.0, 1.0, pillar=1.0),
    token_channels=8,
    neck_blocks=(1, 1),
    head=MapHeadConfig(num_queries=4, num_points=5, channels=16, feedforward_channels=32, layers=1, heads=4),
)
RING = [[10.0, -4.0], [14.0, -4.0], [14.0, 4.0], [10.0, 4.0]]
STREETS = MapElements.of(
    [*([[0.0, 6.0 * k], [28.0, 6.0 * k]] for k in range(-2, 2)), RING, [[0.0, 14.0], [28.0, 14.0]]],
    [DIVIDER] * 4 + [CROSSING, BOUNDARY],
)
NOTHING = Boxes.of(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))


@dataclass(frozen=True)
class Crossroads:
    """In each scenario four agents drive in towards the middle of the place 'cross', each on its own arm."""

    scenarios: tuple[str, ...] = ("cross_0", "cross_1", "cross_2")

    def length(self, scenario: str) -> int:
        return 8

    def eval_indices(self, scenario: str) -> range:
        return range(2, 8)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (1, 2, 3, 4)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        away = 75.0 - 20.0 * self.scenarios.index(scenario) - 3.0 * index
        turns = [k * np.pi / 2 for k in range(4)]
        poses = [Transform.from_xyz_yaw(-away * np.cos(t), -away * np.sin(t), 0.0, t) for t in turns]
        cloud = PointCloud.of(torch.ones(4, 3))
        frames = [AgentFrame.of(cloud, at, 1 + k, index * 10**8) for k, at in enumerate(poses)]
        truth = GroundTruth(NOTHING, torch.zeros(4, 0, dtype=torch.bool), Transform.stack(poses))
        return Snapshot(scenario, index, tuple(frames), truth)


def save(path, sensors=("lidar",), towns=()):
    torch.manual_seed(0)
    config = replace(CONFIG, bev=replace(CONFIG.bev, sensors=sensors))
    checkpoint.save(MapModel(config), path, {"towns": list(towns)}, format=FORMAT)
    return path


@pytest.fixture
def weights(tmp_path, monkeypatch):
    monkeypatch.setattr(model_study, "open_sensor_recording", lambda data, split, sensors: Crossroads())
    monkeypatch.setattr(model_study, "load_true_maps", lambda recording: {"cross": STREETS})
    monkeypatch.setattr(model_study, "open_recording", lambda *words, **options: Crossroads())
    monkeypatch.setattr(model_study, "check_files", lambda recording, checks, console: NONE_MISSING)
    return save(tmp_path / "random.safetensors")


def study(name, weights, out, *words, seeds=2):
    common = (
        "--data",
        out,
        "--weights",
        weights,
        "--workers",
        1,
        "--seeds",
        seeds,
        "--out",
        out,
        *words,
    )
    assert cli.main([str(word) for word in ("study", name, *common)]) == 0
    with Image.open(out / f"{name}.png") as picture:
        assert picture.width > 400
    assert f"![{name}]({name}.png)" in (out / f"{name}.md").read_text()
    return json.loads((out / f"{name}.json").read_text())["result"], (out / f"{name}.md").read_text()


@dataclass(frozen=True)
class FixedPredictor:
    """A study's drawing: by row, how many of the elements of STREETS come out, from the first."""

    parts: tuple[tuple[str, int], ...]
    frame_counts: tuple[int, ...] = (1, 2, 5, 10)
    sigma_m: float = 0.5
    deg_per_m: float = 2.0

    @property
    def cache_key(self) -> str:
        return repr(self)

    def __call__(self, map_model, source, scenario, seed):
        return [TilePrediction(row, STREETS.take(np.arange(n)), STREETS, (1000,) * n) for row, n in self.parts]


def make_predictor(parts):
    return FixedPredictor(tuple(parts.items()))


def get_differences(result):
    return {comparison["description"]: comparison["interval"]["value"] for comparison in result["comparisons"]}


def test_more_frames_against_one(weights, tmp_path, monkeypatch):
    monkeypatch.setattr(semi_global, "SemiGlobalPredictor", lambda: make_predictor({"1": 1, "2": 2, "5": 5, "10": 6}))
    result, text = study("semi-global", weights, tmp_path)
    rows = {row["name"]: row for row in result["rows"]["LiDAR"]}
    # One of four dividers and no crossing: (0 + .25) / 2; with five elements all of both.
    assert [rows[name]["mean_ap"][0]["value"] for name in ("1", "2", "5", "10")] == pytest.approx(
        [0.125, 0.25, 1.0, 1.0]
    )
    assert rows["1"]["ap"][0][2]["value"] == 0.0 and rows["10"]["ap"][0][2]["value"] == 1.0, "the boundary"
    assert (
        rows["2"]["bytes_per_tile"] == 2000 and rows["2"]["num_tiles"] == 6 and len(rows["2"]["mean_ap_by_seed"]) == 2
    )
    assert get_differences(result)["LiDAR: 10 frames - one vehicle"] == pytest.approx(0.875)
    (straight,) = result["curvature_rows"]["LiDAR"]
    assert straight["name"] == "straight" and straight["mean_ap"][0]["value"] == 1.0, "no street is curved"
    assert text.count("not run") == 4, "cameras, and both, in each table"


def table(parts):
    """What a study would judge, of three scenarios."""
    return TileTable(
        [
            ScenarioPredictions(name, 0, tuple(make_predictor(parts)(None, None, name, 0)))
            for name in Crossroads.scenarios
        ]
    )


def test_each_larger_number_of_frames_is_compared_with_one():
    held = semi_global.make_comparisons("LiDAR", table({"1": 3, "5": 2, "10": 4}), ("1", "5", "10"))
    assert [c.description for c in held] == ["LiDAR: 5 frames - one vehicle", "LiDAR: 10 frames - one vehicle"]
    # Three, two and four of four dividers, and no crossing.
    assert [c.interval.value for c in held] == pytest.approx([-0.125, 0.125]) and held[0].metric == "mAP"


def test_local_maps_have_a_row_for_each_kind_of_agent(weights, tmp_path, monkeypatch):
    monkeypatch.setattr(local, "LocalPredictor", lambda rows=(): make_predictor({VEHICLE: 6, ROADSIDE: 2}))
    result, text = study("local", weights, tmp_path)
    assert [(r["name"], r["mean_ap"][0]["value"]) for r in result["rows"]["LiDAR"]] == [
        (VEHICLE, 1.0),
        (ROADSIDE, 0.25),
    ]
    assert "CrowdMap's Table 1" in text


def test_roadside_units_may_have_weights_of_their_own(weights, tmp_path, monkeypatch, capsys):
    opened, parts = [], {VEHICLE: 6, ROADSIDE: 2}
    load = model_study.pretrained.load_map_model
    monkeypatch.setattr(
        model_study.pretrained, "load_map_model", lambda name: opened.append(Path(name).stem) or load(name)
    )
    monkeypatch.setattr(local, "LocalPredictor", lambda rows: make_predictor({row: parts[row] for row in rows}))
    own = save(tmp_path / "roadside.safetensors", towns=("town01",))
    result, _ = study("local", weights, tmp_path, "--roadside-weights", own)
    assert [(r["name"], r["mean_ap"][0]["value"], r["num_tiles"]) for r in result["rows"]["LiDAR"]] == [
        (VEHICLE, 1.0, 6),
        (ROADSIDE, 0.25, 6),
    ]
    assert {"random", "roadside"} <= set(opened)
    # Models of other sensors than the vehicles' are no row of the same table.
    camera = save(tmp_path / "camera.safetensors", ("camera",))
    words = (
        "study",
        "local",
        "--data",
        tmp_path,
        "--weights",
        weights,
        "--roadside-weights",
        camera,
        "--out",
        tmp_path,
    )
    assert cli.main([*map(str, words), "--workers", "1"]) == 1
    assert "the same sensors" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_the_corrector_is_held_against_half_of_the_loss(weights, tmp_path, monkeypatch):
    rows = {SINGLE_VEHICLE: 1, CLEAN: 5, NOISY: 2, CORRECTED: 5, CLEAN_CORRECTED: 5}
    monkeypatch.setattr(pose, "PoseNoisePredictor", lambda pose_correction: make_predictor(rows))
    result, text = study("map-pose-noise", weights, tmp_path)
    half = "LiDAR: corrected - (clean + noisy) / 2"
    assert get_differences(result)[half] == pytest.approx(0.375)
    assert get_differences(result)["LiDAR: corrected without noise - clean"] == 0.0
    assert "0.5 m and 1 degrees (sigma)" in text
    # Clean 1, noisy .25: half of it won back is .625; four lines have all dividers and no crossing, .5.
    less = {c.description: c for c in pose.make_comparisons("LiDAR", table(rows | {CORRECTED: 4}))}[half]
    assert less.interval.value == less.interval.high == pytest.approx(-0.125)


@pytest.mark.slow
def test_full_maps_by_map_mode_and_method_against_one_truth(weights, tmp_path, monkeypatch):
    """The oracle predicts elements; their bytes are fused and evaluated."""
    town_map = TownMap("cross", Crossroads.scenarios, "cross", (0.0, 0.0))
    monkeypatch.setattr(whole, "group_by_town", lambda *_: [town_map])
    made = []
    monkeypatch.setattr(
        crowd,
        "MapBuildConfig",
        lambda map_model, map_mode, frame_stride: made.append(map_mode) or MapBuildConfig(None, map_mode, frame_stride),
    )
    result, text = study("full-map", weights, tmp_path, "--methods", "manyeyes", "union", "chamfer-nms", seeds=1)
    rows = {(row["map_mode"], row["method"]): row for row in result["rows"]}
    assert list(rows)[:2] == [("semi-global", "manyeyes"), ("semi-global", "union")] and len(rows) == 6
    ours, late = rows["semi-global", "manyeyes"], rows["local", "union"]
    assert (
        ours["observations_per_map"] == late["observations_per_map"] == 12
        and ours["bytes_per_message"] > late["bytes_per_message"] > 80
    )
    assert ours["mean_ap"]["value"] == pytest.approx(ours["own_view_mean_ap"]["value"])
    assert late["mean_ap"]["value"] < late["own_view_mean_ap"]["value"], (
        "a local map is held against what tiles see, too"
    )
    assert ours["mean_ap"]["value"] > late["mean_ap"]["value"] + 0.1 and ours["mean_ap"]["num_scenarios"] > 5
    names = {f"semi-global + manyeyes - local + {method}" for method in ("union", "chamfer-nms", "manyeyes")}
    differences = get_differences(result)
    assert names <= set(differences) and "The map of cross" in text
    best = [value for name, value in differences.items() if name.endswith("the best baseline")]
    assert best == [min(value for name, value in differences.items() if "union" in name or "nms" in name)]
    assert made == ["semi-global", "local"]
    study("full-map", weights, tmp_path, "--methods", "manyeyes", "union", seeds=1)
    assert len(made) == 2, "what was seen is kept"


def test_missing_or_repeated_options_are_one_line(weights, tmp_path, capsys, monkeypatch):
    def refused(*words):
        assert cli.main([str(word) for word in ("study", *words)]) == 1
        return capsys.readouterr().err

    monkeypatch.setattr(pretrained, "list_map_models", lambda: ())
    assert "--preset map-small-lidar" in refused("local", "--data", tmp_path)
    again = save(tmp_path / "again.safetensors")
    assert "One model a set of sensors" in refused("local", "--data", tmp_path, "--weights", weights, again)
    both = save(tmp_path / "both.safetensors", ("lidar", "camera"))
    assert "takes one model" in refused("full-map", "--data", tmp_path, "--weights", weights, both)
    trained = save(tmp_path / "taught.safetensors", towns=("Cross",))
    assert "Split by place" in refused("map-pose-noise", "--data", tmp_path, "--weights", trained)


def test_a_table_has_the_rows_of_each_set_of_sensors_in_order_and_names_the_missing_ones() -> None:
    def make_row(name: str) -> TileRow:
        shown = Interval(0.5, 0.4, 0.6, 0.95, 3)
        return TileRow(name, 3, ((shown,) * 3,) * 2, (shown,) * 2, (0.5,), 2.0, 100.0, 200.0)

    table = model_study.make_rows_table("t", {"both": [make_row("c")], "LiDAR": [make_row("a"), make_row("b")]})
    assert [line[:2] for line in table.lines] == [
        ("LiDAR", "a"),
        ("LiDAR", "b"),
        ("camera", model_study.NOT_RUN),
        ("both", "c"),
    ]
    assert {len(line) for line in table.lines} == {len(model_study.HEADINGS)}
