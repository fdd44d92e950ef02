# SPDX-License-Identifier: Apache-2.0
"""nuScenes' result file: its schema by hand, a round trip, and its bound on boxes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from manyeyes.datasets.nuscenes_results import make_sample_token, read_results, write_results
from manyeyes.datatypes import LABELS, Boxes, RecordingError

# Of the detection task, as its rules state them.
DETECTION_NAMES = {
    "car", "truck", "bus", "trailer", "construction_vehicle", "pedestrian", "motorcycle", "bicycle", "traffic_cone", "barrier"
}  # fmt: skip
ATTRIBUTES = {
    "pedestrian.moving", "pedestrian.sitting_lying_down", "pedestrian.standing", "cycle.with_rider", "cycle.without_rider",
    "vehicle.moving", "vehicle.parked", "vehicle.stopped", "",
}  # fmt: skip
FIELDS = {
    "sample_token": str, "translation": 3, "size": 3, "rotation": 4, "velocity": 2, "detection_name": str,
    "detection_score": float, "attribute_name": str,
}  # fmt: skip


def boxes() -> Boxes:
    n = len(LABELS)
    center = torch.arange(3.0 * n, dtype=torch.float64).reshape(n, 3) - 7
    size = torch.tensor([[4.5, 1.9, 1.5]], dtype=torch.float64).repeat(n, 1) + torch.arange(n)[:, None] * 0.1
    velocity = torch.stack((torch.arange(n) * 0.3, -torch.arange(n) * 0.2), 1).double()
    yaw, score = torch.linspace(-3, 3, n).double(), torch.linspace(0.9, 0.1, n).double()
    return Boxes.of(center, size, yaw, score, torch.arange(n), velocity=velocity)


def test_the_file_has_the_schema_of_a_submission(tmp_path: Path) -> None:
    write_results(tmp_path / "a.json", {make_sample_token("town_1", 7): boxes(), "empty": Boxes.empty()})
    content = json.loads((tmp_path / "a.json").read_text())
    assert set(content) == {"meta", "results"} and set(content["results"]) == {"town_1_000007", "empty"}
    assert set(content["meta"]) == {"use_camera", "use_lidar", "use_radar", "use_map", "use_external"}
    assert all(isinstance(value, bool) for value in content["meta"].values()) and content["meta"]["use_lidar"]
    for one in content["results"]["town_1_000007"]:
        assert set(one) == set(FIELDS)
        for name, kind in FIELDS.items():
            if isinstance(kind, int):
                assert len(one[name]) == kind and all(isinstance(v, float) and math.isfinite(v) for v in one[name])
            else:
                assert isinstance(one[name], kind)
        assert one["sample_token"] == "town_1_000007"
        assert one["detection_name"] in DETECTION_NAMES and one["attribute_name"] in ATTRIBUTES
        assert math.hypot(*one["rotation"]) == pytest.approx(1.0) and min(one["size"]) > 0
    assert content["results"]["empty"] == []


def test_a_box_by_hand(tmp_path: Path) -> None:
    """4.5 m long, 1.9 wide, 1.5 high, turned by 90 degrees to the left, at 2 m/s along y."""
    bus = Boxes.of([[1.0, 2.0, 3.0]], [[4.5, 1.9, 1.5]], [math.pi / 2], [0.25], [3], velocity=[[0.0, 2.0]])
    write_results(tmp_path / "a.json", {"s": bus})
    (one,) = json.loads((tmp_path / "a.json").read_text())["results"]["s"]
    assert one["translation"] == [1, 2, 3] and one["size"] == pytest.approx([1.9, 4.5, 1.5])
    assert one["rotation"] == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
    assert one["velocity"] == [0, 2] and one["detection_score"] == 0.25
    assert one["detection_name"] == "bus" and one["attribute_name"] == "vehicle.moving"


def test_what_is_written_reads_back(tmp_path: Path) -> None:
    write_results(tmp_path / "a.json", {"s": boxes()})
    found, true = read_results(tmp_path / "a.json")["s"], boxes()
    for name in ("center", "size", "yaw", "score", "velocity"):
        assert torch.allclose(getattr(found, name), getattr(true, name), atol=1e-12)
    # nuScenes has no vans.
    assert [LABELS[i] for i in found.label] == ["car", "car", *LABELS[2:]]


def test_attributes_are_those_of_the_class_and_empty_where_nothing_moves(tmp_path: Path) -> None:
    write_results(tmp_path / "a.json", {"s": boxes()})
    found = {
        one["detection_name"]: one["attribute_name"]
        for one in json.loads((tmp_path / "a.json").read_text())["results"]["s"]
    }
    assert found == {
        "car": "", "truck": "vehicle.moving", "bus": "vehicle.moving", "pedestrian": "pedestrian.moving",
        "bicycle": "cycle.with_rider", "motorcycle": "cycle.with_rider",
    }  # fmt: skip


def test_of_more_than_500_boxes_the_best_are_written(tmp_path: Path) -> None:
    n = 620
    score = torch.rand(n, generator=torch.Generator().manual_seed(0)).double()
    many = Boxes.of(torch.rand(n, 3).double(), torch.ones(n, 3).double(), torch.zeros(n).double(), score)
    write_results(tmp_path / "a.json", {"s": many})
    found = read_results(tmp_path / "a.json")["s"]
    assert len(found) == 500 and torch.allclose(found.score, score.sort(descending=True).values[:500])


@pytest.mark.parametrize(
    "text", ["", "[]", '{"meta": {}}', '{"results": {"s": [{"translation": [1]}]}}', '{"results": 5}']
)
def test_another_file_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(RecordingError, match=r"a\.json: expected a result file"):
        read_results(tmp_path / "a.json")
