# SPDX-License-Identifier: Apache-2.0
"""The studies of prior poses on a small recording: AP before and after correction, and the poses themselves."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from PIL import Image
from tests.studies.engine.test_conditions import make_result

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.detection.protocols import PROTOCOLS
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig
from manyeyes.models.pose.feakm import FORMAT, FeakmConfig, FeakmNet
from manyeyes.models.pose.matcher import MatcherConfig
from manyeyes.studies.detection.perturbations import Perturbation
from manyeyes.studies.engine.conditions import ResultGrid
from manyeyes.studies.pose import feakm, pose_estimation as pose_accuracy, pose_noise_ap as pose

PLACES = torch.tensor(
    [
        (8, 5, 0.4),
        (20, -6, 1.5),
        (-9, 4, 0.1),
        (14, 8, -0.3),
        (14, 16, 2.2),
        (2, -14, 0.9),
        (12, -18, -1.0),
        (-4, 15, 0.2),
    ]
).double()
POSES = {5: Transform.from_xyz_yaw(0, 0, 0, 0.1), -1: Transform.from_xyz_yaw(15, 4, 0, 3.0)}


def cars() -> Boxes:
    n = len(PLACES)
    center = torch.cat((PLACES[:, :2], torch.full((n, 1), 0.8).double()), 1)
    size = torch.tensor([[4.5, 1.9, 1.6]]).double().repeat(n, 1)
    return Boxes.of(center, size, PLACES[:, 2].clone(), id=torch.arange(n) + 100)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    for name in ("a", "b"):
        writer = Opv2vWriter(root / "data" / "test" / name)
        for index in range(3):
            ground = torch.rand(150, 3, generator=torch.Generator().manual_seed(index)) * torch.tensor(
                [30.0, 30.0, 0.02]
            )
            cloud = PointCloud.of(ground - torch.tensor([15.0, 15.0, 0.0]), torch.full((150,), 0.5))
            frames = tuple(
                AgentFrame(i, index * 100_000_000, cloud, p, torch.zeros(3, 3), is_infrastructure=i < 0)
                for i, p in POSES.items()
            )
            truth = GroundTruth(
                cars(), torch.ones(2, len(PLACES), dtype=torch.bool), Transform.stack(list(POSES.values()))
            )
            writer.write(Snapshot(name, index, frames, truth))
        writer.close({"history_frames": 1})
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), root / "untrained.safetensors", {})
    return root


def evaluate(data, out, study, *words):
    common = ["--data", data / "data", "--split", "test", "--weights", data / "untrained.safetensors"]
    common += ["--workers", 1] if study == "pose-noise-ap" else []
    assert cli.main([str(w) for w in ("study", study, *common, "--out", out, *words)]) == 0
    with Image.open(out / f"{study}.png") as picture:
        assert picture.width > 400
    return json.loads((out / f"{study}.json").read_text())["result"]


@pytest.mark.slow
def test_every_corrector_with_every_fusion_under_the_requested_levels(data, tmp_path) -> None:
    words = ("--methods", "no-fusion", "intermediate", "--frame-stride", 2, "--perturbations", "2°, 2 m", "0.8 m")
    held = evaluate(data, tmp_path, "pose-noise-ap", *words)
    assert [(r["corrector"], r["method"]) for r in held["rows"][::3]] == [
        ("identity", "intermediate"),
        ("voting", "intermediate"),
    ]
    assert held["frames"] == {"0 to 3": 0, "4 to 7": 0, "8 and more": 2}
    assert all(len(r["ap_by_common_objects"]) == 3 and r["gain_over_no_fusion"] for r in held["rows"])
    descriptions = [c["description"] for c in held["comparisons"]]
    assert descriptions[:3] == [
        "voting, clean: corrected - true poses",
        "voting, 0.8 m: corrected - true poses",
        "voting, 2°, 2 m, 8 and more in common: corrected - true poses",
    ]
    assert descriptions[3].startswith("voting, worst level (") and descriptions[3].endswith(
        "8 and more in common: corrected - no fusion"
    )
    assert {c["metric"] for c in held["comparisons"]} == {"AP@0.5"} and len(descriptions) == 4
    assert {name: len(at5) for name, at5, _ in held["paper"]["rows"]}["FeaKM, 4 pairs"] == 11


def test_the_default_corrector_is_compared_with_each_other_one_by_common_objects() -> None:
    """Voting finds one vehicle more than mash where two objects are common, and three more where nine are."""
    levels = (pose.CLEAN, Perturbation(position_sigma_m=0.8), pose.LEVELS[4], pose.LEVELS[-1])
    found = {"identity": (2, 2), "voting": (2, 4), "mash": (1, 1)}
    results = {
        (pose.condition_name(name, level), "intermediate"): make_result("intermediate", hits)
        for name, hits in found.items()
        for level in levels
    }
    grid, common = ResultGrid(results, PROTOCOLS["global-sort"]), {("s0", 0): 2, ("s1", 0): 9}
    comparisons = pose.make_comparisons(grid, tuple(found), common)
    gains = {c.description: c.interval.value for c in comparisons if c.description.startswith("voting - mash, ")}
    buckets = "0 to 3 in common", "8 and more in common"
    assert list(gains) == [
        f"voting - mash, {name}"
        for level in ("clean", "2°, 2 m")
        for name in (level, *(f"{level}, {bucket}" for bucket in buckets))
    ] + ["voting - mash, 0.8 m"]
    assert gains["voting - mash, 2°, 2 m, 0 to 3 in common"] == pytest.approx(1 / 4)
    assert gains["voting - mash, 2°, 2 m, 8 and more in common"] == pytest.approx(3 / 4)
    assert not any("voting - identity" in c.description for c in comparisons)


def test_the_levels_are_feakms_columns() -> None:
    assert len(pose.LEVELS) == 11 and all(len(ap) == 11 for _, *aps in pose.PAPER_AP for ap in aps)
    assert pose.LEVELS[1] == Perturbation(heading_sigma_deg=0.2) and pose.LEVELS[-1].name == "2°, 2 m"
    assert [c.x for p in pose.make_panels(()) for c in p.curves] == []


def test_baseline_fusions_are_rows_with_uncorrected_priors(data, tmp_path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        baseline = Detector(replace(COSTR_TINY, fusion="v2x-vit"))
        checkpoint.save(baseline, data / "baseline.safetensors", {})
    words = ("--methods", "intermediate", "--frame-stride", 2, "--correctors", "identity", "--perturbations", "2°, 2 m")
    held = evaluate(
        data, tmp_path, "pose-noise-ap", *words, "--checkpoints", f"V2X-ViT={data / 'baseline.safetensors'}"
    )
    assert [(r["corrector"], r["method"]) for r in held["rows"]] == 2 * [("identity", "intermediate")] + 2 * [
        ("identity", "V2X-ViT")
    ]
    assert held["rows"][2]["ap_drop"][0]["value"] == 0.0
    assert (
        "| identity" in (tmp_path / "pose-noise-ap.md").read_text()
        and "V2X-ViT" in (tmp_path / "pose-noise-ap.md").read_text()
    )


def write_net(data, name: str, detector: str = "", max_keypoints: int = 64) -> str:
    """An untrained net of FeaKM, for the untrained detector."""
    torch.manual_seed(0)
    channels = COSTR_TINY.encoder.channels[2]
    config = FeakmConfig(
        BoxKeypointConfig(channels, 32, 8, min_score=0.0, max_keypoints=max_keypoints),
        MatcherConfig(32, 8, 1, 1),
        detector,
    )
    checkpoint.save(FeakmNet(config), data / name, {}, format=FORMAT)
    return str(data / name)


@pytest.mark.slow
def test_the_ablation_of_feakm_has_a_row_per_variant_and_level_and_stores_it(data, tmp_path, monkeypatch) -> None:
    one, two = write_net(data, "one.safetensors"), write_net(data, "two.safetensors", max_keypoints=3)
    detector = data / "untrained.safetensors"
    words = ("--frame-stride", 2, "--checkpoints", f"map={detector},{one}", f"three points={detector},{two}@8")
    held = evaluate(data, tmp_path, "feakm", *words)
    assert [(r["variant"], r["sigma"]) for r in held["rows"]] == [
        (name, sigma) for name in ("map", "three points") for sigma in (0.0, 0.4, 0.8, 1.2)
    ]
    assert all(len(r["ap"]) == 2 and r["num_frames"] == r["num_collaborators"] == 2 for r in held["rows"])
    assert held["rows"][4]["found_fraction"] == 0.0 and held["paper"]["rows"][3][1] == 0.768
    monkeypatch.setattr(feakm, "run_ablation", None)
    assert evaluate(data, tmp_path, "feakm", *words)["rows"] == held["rows"]


def test_feakm_corrects_before_fusion_by_the_file_of_its_weights(data, tmp_path) -> None:
    net = write_net(data, "few.safetensors", max_keypoints=5)
    options = ("--frame-stride", 2, "--perturbations", "clean", "--correctors", "identity", net, f"{net}@8")
    words = ("--methods", "intermediate", *options)
    held = evaluate(data, tmp_path, "pose-noise-ap", *words)
    plain, four, eight = (r["bytes_per_message"] for r in held["rows"])
    # Five objects with a descriptor each; a section's own bytes and a packet more may come with them.
    assert 5 * 45 <= four - plain <= 5 * 49 + 100 and four == eight
    with torch.random.fork_rng():
        wrong = write_net(data, "wrong.safetensors", detector="ab" * 8)
    common = ("--data", data / "data", "--split", "test", "--weights", data / "untrained.safetensors", "--workers", 1)
    assert cli.main([str(w) for w in ("evaluate", *common, "--out", tmp_path, "--pose-correction", wrong)]) == 1


@pytest.mark.slow
def test_poses_are_evaluated_by_error_and_common_objects_and_stored(data, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(pose_accuracy, "SIGMAS", (0.0, 0.8))
    monkeypatch.setattr(pose_accuracy, "NOISE_FAMILIES", (("offset", 0.5), ("none", 0.0)))
    calls = []

    def process(self, frame):
        calls.append(frame.agent_id)
        return SimpleNamespace(boxes=cars().transform(POSES[frame.agent_id].inverse()).to(torch.float32))

    monkeypatch.setattr(PerceptionCache, "process", process)
    held = evaluate(data, tmp_path, "pose-estimation", "--correctors", "identity", "voting", "coalign")
    rows = {(r["trial"]["corrector"], r["trial"]["noise"]["kind"], r["trial"]["noise"]["sigma_m"]): r
            for r in held["rows"] if r["common_range"] is None}  # fmt: skip
    assert len(rows) == 3 * 2 + 2 * 2 and calls
    assert rows["voting", "gaussian", 0.8]["score"]["success_rate"] == [1.0, 1.0, 1.0]
    assert (
        rows["voting", "gaussian", 0.8]["score"]["mean_displacement_m"]
        < rows["identity", "gaussian", 0.8]["score"]["mean_displacement_m"]
    )
    assert (
        rows["voting", "none", 0.0]["score"]["coverage"] == 1.0
        and rows["identity", "none", 0.0]["score"]["coverage"] == 0.0
    )
    # Off by 2.5 m where 0.5 m is stated, eight objects in common: each is contradicted, none of the honest is.
    assert rows["voting", "offset", 0.5]["score"]["conflict_rate"] == 1.0
    assert rows["voting", "gaussian", 0.8]["score"]["conflict_rate"] == 0.0
    conflict = list(map(list, rows["voting", "offset", 0.5]["confusion"]))[2]
    assert conflict == [0, 0, 4, 0, 0]
    assert {r["common_range"][0] for r in held["rows"] if r["common_range"]} == {8}
    assert all(100 < r["bytes_per_message"] < 400 and len(r["risk_by_coverage"]) == 20 for r in held["rows"])
    # Every scene holds the same vehicles at the same places: at the same place the pose is right, at "another" one it is not.
    nulls = {(r["corrector"], r["kind"]): r for r in held["nulls"]}
    assert set(nulls) == {(c, k) for c in ("identity", "voting", "coalign") for k in ("other place", "same place")}
    other, same = nulls["voting", "other place"], nulls["voting", "same place"]
    assert other["num_null"] == same["num_null"] == 4 == other["num_true"]
    assert other["answered"] == other["wrong"] == same["answered"] == 1.0 and same["wrong"] == 0.0
    assert other["risk_by_coverage"] == [0.5] * 20 and same["risk_by_coverage"] == [0.0] * 20
    assert nulls["identity", "same place"]["answered"] == 0.0 and nulls["identity", "same place"]["coverage"] == 0.0
    calls.clear()
    again = evaluate(data, tmp_path, "pose-estimation", "--correctors", "identity", "voting", "coalign")
    assert not calls and again["rows"] == held["rows"] and str(again["nulls"]) == str(held["nulls"])
    assert not math.isnan(rows["voting", "gaussian", 0.8]["score"]["mean_displacement_m"])


def test_every_number_of_common_objects_is_in_one_range() -> None:
    for count in (*range(30), 10**6):
        assert sum(low <= count <= high for low, high in pose.COMMON_OBJECT_RANGES) == 1, count
