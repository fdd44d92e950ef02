# SPDX-License-Identifier: Apache-2.0
"""Every study from end to end on a small recording, with weights that were never trained: what is written, kept and refused."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast
from unittest.mock import Mock

import pytest
import torch
from PIL import Image

from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vRecording, Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.detection import benchmark
from manyeyes.evaluation.detection.accumulator import MetricAccumulator
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, load_detector, run_scenario
from manyeyes.evaluation.detection.compute_times import compute_time_s
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.studies.detection import robustness, sensors, shared_bandwidth
from manyeyes.studies.detection.perturbations import CLEAN, COMBINED_SEVERE, Perturbation, select_perturbations
from manyeyes.studies.engine import replay_study
from manyeyes.studies.engine.conditions import ResultGrid, ResultKey
from manyeyes.viz.curves import CurvePanel
from manyeyes.viz.stored_tables import StoredResult, make_tables
from manyeyes.viz.table import StoredTable

HALF = torch.tensor([2.3, 0.95, 0.8])


def crossing(scenario: str, index: int, agents: int) -> Snapshot:
    """Agents on a line see the ground, a parked car and one that drives at 10 m/s."""
    rng = torch.Generator().manual_seed(index)
    poses = [Transform.from_xyz_yaw(12.0 * k + (1.0 - k) * index, 0.5 * k, 0, 0.1 * k) for k in range(agents)]
    cars = [Transform.from_xyz_yaw(8, 5, 0, 0.4), Transform.from_xyz_yaw(4 + index, -5, 0, 0.0)]
    frames = []
    for k, pose in enumerate(poses):
        ground = (torch.rand(200, 3, generator=rng) - 0.5) * torch.tensor([50.0, 50.0, 0.02])
        parts = [ground]
        for car in cars:
            body = (torch.rand(100, 3, generator=rng) * 2 - 1) * HALF + torch.tensor([0.0, 0.0, 0.8])
            parts.append((pose.inverse() @ car).apply(body))
        xyz = torch.cat(parts)
        cloud = PointCloud.of(xyz, torch.full((len(xyz),), 0.5))
        frames.append(AgentFrame(5 + k, index * 100_000_000, cloud, pose, torch.zeros(3, 3)))
    center = torch.tensor([[8, 5, 0.8], [4 + index, -5, 0.8]], dtype=torch.float64)
    yaw, velocity = torch.tensor([0.4, 0.0]).double(), torch.tensor([[0.0, 0.0], [10.0, 0.0]]).double()
    boxes = Boxes.of(center, (2 * HALF).double().expand(2, 3), yaw, id=torch.tensor([90, 91]), velocity=velocity)
    seen = torch.ones(agents, 2, dtype=torch.bool)
    return Snapshot(scenario, index, tuple(frames), GroundTruth(boxes, seen, Transform.stack(poses)))


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("data")
    for name, agents in (("a", 2), ("b", 3)):
        writer = Opv2vWriter(root / "test" / name)
        for index in range(6):
            snapshot = crossing(name, index, agents)
            writer.write(snapshot, snapshot.truth.boxes.velocity.norm(dim=1))
        writer.close({"history_frames": 4})
    return root


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), path, {"steps": 7, "seed": 3, "command": "manyeyes train"})
    return path


@pytest.fixture
def panels(monkeypatch) -> list[CurvePanel]:
    """What is to be drawn, instead of drawing it."""
    last: list[CurvePanel] = []

    def keep(drawn: list[CurvePanel], path: Path) -> None:
        last[:] = drawn
        Image.new("RGB", (500, 10)).save(path)

    monkeypatch.setattr(replay_study, "save_curves", keep)
    return last


def evaluate(data: Path, weights: Path, out: Path, study: str, *words: object) -> dict:
    """The JSON that a study wrote."""
    common = ("--data", data, "--split", "test", "--weights", weights, "--workers", 1, "--out", out)
    assert cli.main([str(word) for word in ("study", study, *common, *words)]) == 0
    with Image.open(out / f"{study}.png") as picture:
        assert picture.width > 400
    assert (out / f"{study}.md").read_text().startswith(f"# {study}\n")
    return json.loads((out / f"{study}.json").read_text())


def list_tables(path: Path) -> tuple[StoredTable, ...]:
    """The tables of a document for a stored study."""
    return make_tables(StoredResult(path, json.loads(path.read_text())["result"], "", "", (0,), "test"))


@pytest.fixture
def small_set(monkeypatch) -> tuple:
    """Six of the disturbances."""
    assert len({d.name for d in robustness.ALL_PERTURBATIONS}) == len(robustness.ALL_PERTURBATIONS) == 21
    delay, position, lost = robustness.DELAYS[-1], robustness.POSITIONS[-1], robustness.LOSSES[-1]
    kept = (robustness.CLEAN, robustness.DELAYS[0], delay, position, lost, list(robustness.ORACLES)[3])
    monkeypatch.setattr(robustness, "ALL_PERTURBATIONS", kept)
    return kept


@pytest.mark.slow
def test_robustness_has_a_row_per_perturbation_and_method(data, weights, tmp_path, small_set, panels) -> None:
    held = evaluate(
        data, weights, tmp_path, "robustness", "--methods", "no-fusion", "late", "intermediate", "--frame-stride", 2
    )
    rows, origin = held["result"]["rows"], held["provenance"]
    assert {"command", "seed", "versions", "git_commit", "config"} <= set(origin)
    assert len(rows) == 1 + 2 * len(small_set)
    late = [r for r in rows if r["method"] == "late"]
    assert [r["oracle"] for r in late] == ["", "true poses", "", "", "", "no delay"]
    # A message that is d old when it comes is d old when it is used; frame 4 alone is evaluated.
    assert [late[k]["age_ms"] for k in (0, 1, 2, 3)] == pytest.approx([0, 100, 400, 0])
    assert [len(r["ap_by_speed"]) for r in late] == [3, 3, 3, 0, 0, 0]
    # One car stands, one drives at 10 m/s, none is slower: that class has no AP.
    assert [speed["value"] is None for speed in late[0]["ap_by_speed"]] == [False, True, False]
    assert late[0]["ap_drop"][0]["value"] == 0 and late[0]["bytes_per_message"] > 0
    assert [r["paper_ap"] for r in rows if r["method"] == "intermediate"][:3] == [0.946, 0.937, 0.909]
    comparisons = held["result"]["comparisons"]
    assert sum("intermediate - late" in c["description"] for c in comparisons) == 2 * len(small_set)
    assert [c["description"] for c in comparisons[-3:]] == [
        f"intermediate, {level} - clean" for level in ("0.4 s", "0.8 m", "30 % loss")
    ]
    table = next(t for t in list_tables(tmp_path / "robustness.json") if t.name == "robustness")
    assert (
        table.lines[0] == ("perturbation", "no-fusion", "late", "intermediate")
        and len(table.lines) == 1 + len(rows) // 2
    )
    assert all("margin" not in c and "verdict" not in c for c in comparisons), "targets are not the package's"
    assert [p.title for p in panels] == ["Delay", "Heading noise", "Position noise", "Packet loss", "Combined"]
    assert {c.label: c.x for c in panels[0].curves} == {
        "no-fusion": (),
        "late": (0, 0.1, 0.4),
        "intermediate": (0, 0.1, 0.4),
    }


@pytest.fixture(scope="module")
def main_table(data, weights, tmp_path_factory) -> Path:
    """The folder of a main table: both forms, a baseline inside and one bare, with and without pose correction."""
    folder = tmp_path_factory.mktemp("table")
    with torch.random.fork_rng():
        torch.manual_seed(1)
        for name in ("max", "max/bare"):
            bare = Detector(replace(COSTR_TINY, fusion=name, codebook=None))
            checkpoint.save(bare, folder / f"{name.replace('/', '-')}.safetensors", {})
    baselines = (f"F-Cooper={folder}/max-bare.safetensors", f"W2C={folder}/max.safetensors@intermediate-where2comm")
    methods = ("no-fusion", "late", "intermediate", "late-temporal", "no-fusion-temporal")
    words = ("--frame-stride", 2, "--perturbations", "clean", "0.8 m", "--channels", "its-g5-6", "--methods", *methods)
    common = ("--data", data, "--split", "test", "--weights", weights, "--workers", 1, "--out", folder)
    command = ("study", "main-table", *common, *words, "--checkpoints", *baselines)
    assert cli.main([str(word) for word in command]) == 0
    return folder


@pytest.mark.slow
def test_the_main_table_judges_both_forms_at_sweep_and_answer(main_table) -> None:
    held = json.loads((main_table / "main-table.json").read_text())
    rows = {
        (r["channel"], r["perturbation"]["position_sigma_m"], r["corrector"], r["method"]): r
        for r in held["result"]["rows"]
    }
    assert set(rows) == {
        *(("any channel", 0.0, "off", m) for m in ("no-fusion", "no-fusion-temporal")),
        *(
            ("its-g5-6", sigma, corrector, m)
            for sigma in (0.0, 0.8)
            for corrector in ("off", "voting")
            for m in ("late", "intermediate", "late-temporal", "F-Cooper", "W2C")
        ),
    }
    late, alone = rows["its-g5-6", 0.0, "off", "late"], rows["any channel", 0.0, "off", "no-fusion"]
    assert late["answer_ms"] == pytest.approx(100 + 1e3 * compute_time_s("late"))
    assert late["compute_ms"] == 1e3 * compute_time_s("late")
    assert alone["answer_ms"] == pytest.approx(1e3 * compute_time_s("no-fusion"))
    noise = [c["config"]["pose_noise"] for c in held["provenance"]["config"]["config"]["conditions"]]
    assert {n["claim"] for n in noise if n} == {"none"} and {n["in_time"] for n in noise if n} == {"autoregressive"}
    text = (main_table / "main-table.md").read_text()
    assert "claimed covariance: none" in text and "random walk of 0.02 m" in text and "AP@0.7 at answer" in text
    assert "duplicates/object" in text and "parameters of fusion" in text
    descriptions = {c["description"] for c in held["result"]["comparisons"]}
    assert "intermediate - F-Cooper, its-g5-6: 0.8 m, corrector voting" in descriptions
    assert "intermediate - no-fusion, its-g5-6: 0.8 m" in descriptions
    assert "intermediate, its-g5-6: 0.8 m, corrector voting - off" in descriptions
    assert "intermediate, its-g5-6: 0.8 m, corrector voting - clean" in descriptions
    assert "intermediate, its-g5-6: 0.8 m - clean" in descriptions
    assert not any("temporal" in d for d in descriptions), "ours has no form with memory here"


@pytest.mark.slow
def test_the_main_table_states_parameters_and_both_counts_of_bytes(main_table, weights) -> None:
    rows = {r["method"]: r for r in json.loads((main_table / "main-table.json").read_text())["result"]["rows"]}
    whole = sum(p.numel() for p in load_detector(str(weights)).parameters())
    fusion = sum(p.numel() for p in load_detector(str(weights)).fusion.parameters())
    assert rows["intermediate"]["parameters"] == {"fusion": fusion, "whole": whole}
    assert rows["F-Cooper"]["parameters"]["fusion"] == 0 == rows["late"]["parameters"]["fusion"]
    assert rows["late"]["parameters"]["whole"] < whole - fusion
    rules = {name: row["paper_rule"] for name, row in rows.items()}
    assert rules == {
        "no-fusion": "nothing", "no-fusion-temporal": "nothing", "late": "boxes", "late-temporal": "boxes",
        "intermediate": "cells and indices", "F-Cooper": "dense map", "W2C": "cells",
    }  # fmt: skip
    grid, channels = load_detector(str(weights)).token_grid, load_detector(str(weights)).encoder.out_channels
    assert rows["F-Cooper"]["paper_bytes"] == grid.shape[0] * grid.shape[1] * channels * 4
    assert rows["no-fusion"]["paper_bytes"] == rows["no-fusion"]["bytes_per_message"] == 0
    assert rows["intermediate"]["paper_bytes"] > rows["intermediate"]["bytes_per_message"] / 2 > 0


@pytest.mark.slow
def test_documents_tabulate_a_stored_main_table(main_table) -> None:
    tables = {table.name: table.lines for table in list_tables(main_table / "main-table.json")}
    assert {"ap50-its-g5-6-off", "ap70-its-g5-6-voting", "operating-point", "cost", "channel-its-g5-6"} <= set(tables)
    assert tables["ap50-its-g5-6-off"][0] == ("method", "clean", "0.8 m")
    assert [line[0] for line in tables["cost"][1:3]] == ["no-fusion", "no-fusion-temporal"]
    assert len(tables["ap50-its-g5-6-voting"]) == 1 + 2 + 5


@pytest.mark.slow
def test_random_rows_are_made_again_by_their_commands(main_table, capsys) -> None:
    path = main_table / "main-table.json"
    assert cli.main(["report", "check-cells", str(path), "--count", "1", "--seed", "3"]) == 0
    assert capsys.readouterr().out.count("equal") == 1
    held = json.loads(path.read_text())
    for row in held["result"]["rows"]:
        row["ap"][0]["value"] += 0.001
    (main_table / "changed.json").write_text(json.dumps(held))
    assert cli.main(["report", "check-cells", str(main_table / "changed.json"), "--count", "1"]) == 1
    output = capsys.readouterr()
    assert "ap[0].value" in output.out and "1 of 1 rows differ" in output.err


@pytest.mark.slow
def test_perturbations_are_selected_by_name(data, weights, tmp_path, panels) -> None:
    words = ("--methods", "late", "intermediate", "--frame-stride", 2, "--perturbations", "0.4 s")
    held = evaluate(data, weights, tmp_path, "robustness", *words)["result"]
    assert [r["perturbation"]["delay_s"] for r in held["rows"]] == [0, 0, 0.4, 0.4]
    assert "intermediate, 0.4 s - clean" in {c["description"] for c in held["comparisons"]}
    text = (tmp_path / "robustness.md").read_text()
    assert "## Delay" in text and "## Position noise" not in text
    with pytest.raises(ConfigError, match=r"No perturbation '4 s'; choose from clean, 0.1 s"):
        select_perturbations(["4 s"], robustness.ALL_PERTURBATIONS)


@pytest.mark.slow
def test_baseline_fusions_are_compared_with_ours_under_each_perturbation(
    data, weights, tmp_path, panels, capsys
) -> None:
    words = (
        "--methods",
        "intermediate",
        "--frame-stride",
        2,
        "--perturbations",
        "0.4 s",
        "--checkpoints",
        f"same={weights}",
    )
    held = evaluate(data, weights, tmp_path, "robustness", *words)["result"]
    assert [(r["method"], r["perturbation"]["delay_s"]) for r in held["rows"]] == [
        ("intermediate", 0), ("same", 0), ("intermediate", 0.4), ("same", 0.4),
    ]  # fmt: skip
    # A baseline of the same weights has the same AP and AP drop.
    for ours, same in (held["rows"][:2], held["rows"][2:]):
        assert ours["ap"] == same["ap"] and ours["ap_drop"] == same["ap_drop"]
    against = [c for c in held["comparisons"] if "intermediate - same" in c["description"]]
    assert len(against) == 4 and all(c["interval"]["value"] == 0 for c in against)
    common = ("study", "robustness", "--data", data, "--split", "test", "--weights", weights)
    assert cli.main([str(word) for word in (*common, "--out", tmp_path / "b", "--checkpoints", f"late={weights}")]) != 0
    assert "methods of the names late" in capsys.readouterr().err and not (tmp_path / "b").exists()


@pytest.mark.slow
def test_an_interrupted_study_resumes_and_a_finished_one_replays_nothing(
    data, weights, tmp_path, monkeypatch, small_set, panels
) -> None:
    monkeypatch.setattr(robustness, "ALL_PERTURBATIONS", small_set[:4])
    words = ("--methods", "no-fusion", "late", "--frame-stride", 2)
    first = evaluate(data, weights, tmp_path, "robustness", *words)["result"]
    cells = sorted((tmp_path / "cells").iterdir())
    assert len(cells) == 1 + 4
    cells[1].unlink()  # the first four are of the method late, each of another perturbation
    cells[3].write_bytes(cells[3].read_bytes()[:100])
    played: list[object] = []
    plain = benchmark.run_scenario
    monkeypatch.setattr(benchmark, "run_scenario", lambda *job: [played.extend(job[1]), plain(*job)][1])
    assert evaluate(data, weights, tmp_path, "robustness", *words)["result"] == first
    assert len(played) == 2 * 2
    assert sorted((tmp_path / "cells").iterdir()) == cells
    played.clear()
    assert evaluate(data, weights, tmp_path, "robustness", *words)["result"] == first
    assert played == []


@pytest.mark.slow
def test_budgets_are_respected_and_small_ones_send_less(data, weights, tmp_path) -> None:
    words = (
        "--methods",
        "no-fusion",
        "late",
        "--token-selection",
        "intermediate",
        "--token-encodings",
        "float16",
        "int8",
    )
    held = evaluate(data, weights, tmp_path, "bandwidth", *words, "--budgets", 1398, 4096, "--frame-stride", 2)[
        "result"
    ]
    rows = held["rows"]
    assert [(r["token_encoding"], r["budget_bytes"]) for r in rows] == [
        (p, b) for p in ("float16", "int8") for b in (1398, 4096, None)
    ]
    for row in rows:
        assert row["budget_bytes"] is None or 0 < row["max_message_bytes"] <= row["budget_bytes"]
        assert row["bytes_per_message"] <= row["max_message_bytes"] and row["compression_ratio"] > 1
    assert rows[0]["bytes_per_message"] <= rows[1]["bytes_per_message"] <= rows[2]["bytes_per_message"]
    assert {r["method"] for r in held["reference_rows"]} == {"no-fusion", "late"}


@pytest.mark.slow
def test_every_method_has_a_curve_over_budgets_of_its_own(data, weights, tmp_path, panels) -> None:
    words = ("--frame-stride", 2, "--methods", "no-fusion", "late", "intermediate", "early")
    rows = evaluate(data, weights, tmp_path, "byte-curves", *words, "--budgets", 1398, 400, "all")["result"]["rows"]
    assert [(r["method"], r["budget_bytes"]) for r in rows] == [
        ("no-fusion", None),
        *((m, b) for m in ("late", "intermediate", "early") for b in (400, 1398, None)),
    ]
    for row in rows[1:]:
        assert row["budget_bytes"] is None or row["max_message_bytes"] <= row["budget_bytes"]
    sizes = [r["bytes_per_message"] for r in rows]
    assert sizes[0] == 0 and all(sizes[k] <= sizes[k + 1] <= sizes[k + 2] for k in (1, 4, 7)) and sizes[7] < sizes[9]
    assert [(p.ylabel, p.in_bytes, [len(c.x) for c in p.curves]) for p in panels] == [
        ("AP@0.5", True, [0, 3, 3, 3]), ("AP@0.7", True, [0, 3, 3, 3]),
    ]  # fmt: skip
    assert rows[5]["command"].endswith("--budgets 1398 --rows intermediate")
    assert [t.name for t in list_tables(tmp_path / "byte-curves.json")] == ["ap-against-bytes-without-memory"]


@pytest.mark.slow
def test_numbers_of_agents_are_evaluated_on_scenarios_that_have_them(data, weights, tmp_path, panels) -> None:
    words = ("--methods", "no-fusion", "late", "--frame-stride", 2)
    rows = evaluate(data, weights, tmp_path, "num-agents", *words)["result"]["rows"]
    assert [(r["num_agents"], r["method"], r["num_scenarios"]) for r in rows] == [
        (1, "no-fusion", 2), (1, "late", 2), (2, "late", 2), (3, "late", 1),
    ]  # fmt: skip
    assert rows[1]["bytes_per_message"] == 0 < rows[2]["bytes_per_message"]
    assert rows[1]["gain_over_no_fusion"]["value"] == 0 and rows[2]["gain_over_one_fewer"]["num_scenarios"] == 2
    assert rows[3]["gain_over_no_fusion"]["num_scenarios"] == 1
    assert [(p.ylabel, c.label, c.x) for p in panels for c in p.curves] == [
        ("AP@0.5", "late", (1, 2, 3)), ("AP@0.5 over no fusion", "late", (1, 2, 3)),
    ]  # fmt: skip


@pytest.mark.slow
def test_numbers_of_agents_compare_methods_with_memory_with_no_fusion_with_memory(data, weights, tmp_path, panels):
    words = ("--methods", "no-fusion-temporal", "late-temporal", "--frame-stride", 2)
    rows = evaluate(data, weights, tmp_path, "num-agents", *words)["result"]["rows"]
    alone, *fused = rows
    assert [(r["num_agents"], r["method"]) for r in fused] == [(n, "late-temporal") for n in (1, 2, 3)]
    assert (alone["num_agents"], alone["gain_over_no_fusion"]) == (1, None)
    assert [r["gain_over_no_fusion"]["num_scenarios"] for r in fused] == [2, 2, 1]


@pytest.mark.slow
def test_ablation_shows_each_checkpoint_with_its_card(data, weights, tmp_path, panels) -> None:
    files = [Path(shutil.copy(weights, tmp_path / f"{name}.safetensors")) for name in ("first", "again")]
    words = ("--frame-stride", 2, "--checkpoints", *(f"{file.stem}={file}" for file in files))
    rows = evaluate(data, weights, tmp_path, "ablation", *words)["result"]["rows"]
    assert [r["variant"] for r in rows] == ["first", "again"] and rows[0]["card"]["steps"] == 7
    assert [d["value"] for d in rows[1]["gain_over_previous"]] == [0, 0, 0] and rows[0]["gain_over_previous"] == []
    page = (tmp_path / "ablation.md").read_text()
    # None of the rows has the weights of --weights.
    assert rows[0]["bytes_per_message"] > 0 and "| first" in page and "\n2 weights on " in page
    assert [p.ticks for p in panels] == 2 * [("first", "again")] and len(panels[0].curves) == 3


@pytest.mark.slow
def test_a_checkpoint_of_the_ablation_may_have_a_budget(data, weights, tmp_path, panels, capsys) -> None:
    words = ("--frame-stride", 2, "--checkpoints", f"all={weights}", f"masked={weights}@1398")
    rows = evaluate(data, weights, tmp_path, "ablation", *words)["result"]["rows"]
    assert 0 < rows[1]["bytes_per_message"] <= 1398 < rows[0]["bytes_per_message"]
    for wrong in ("0", "many", "-5"):
        words = ("ablation", "--data", data, "--split", "test", "--checkpoints", f"masked={weights}@{wrong}")
        assert cli.main([str(word) for word in ("study", *words)]) == 1
        assert "behind @ stands a number of bytes" in capsys.readouterr().err


@pytest.mark.slow
def test_with_shared_bandwidth_every_agent_is_ego_under_one_budget(data, weights, tmp_path, panels) -> None:
    words = ("--methods", "no-fusion", "--token-selection", "intermediate", "--budgets", 6000, "--frame-stride", 2)
    rows = evaluate(data, weights, tmp_path, "shared-bandwidth", *words)["result"]["rows"]
    bound, alone = rows
    assert (bound["budget_bytes"], alone["budget_bytes"], alone["method"]) == (6000, None, "no-fusion")
    assert 0 < bound["mean_snapshot_bytes"] <= bound["max_snapshot_bytes"] <= 6000
    assert bound["num_ego_frames"] == alone["num_ego_frames"] == 2 + 3
    assert {c.label: len(c.x) for c in panels[0].curves} == {"intermediate": 1, "no-fusion": 0}


class Pairs:
    """Results of which only the names are known; a difference is the pair of its two keys."""

    def __init__(self, *keys: ResultKey) -> None:
        self.results = {key: Mock(num_frames=1) for key in keys}

    def ap_pair(self, key: ResultKey) -> ResultKey:
        return key

    def paired_difference(self, key: ResultKey, other: ResultKey, _: int) -> tuple[ResultKey, ResultKey]:
        return key, other

    def compare(self, description: str, key: ResultKey, other: ResultKey) -> tuple[str, ResultKey, ResultKey]:
        return description, key, other


def test_with_shared_bandwidth_gains_are_over_no_fusion_of_the_same_form() -> None:
    alone = ("no-fusion", "no-fusion-temporal")
    grid = Pairs(("6000", "intermediate"), ("6000", "intermediate-temporal"), *(("no budget", name) for name in alone))
    rows = shared_bandwidth.make_rows(cast(ResultGrid, grid))
    assert [row.gain_over_no_fusion for row in rows] == [
        (("6000", "intermediate"), ("no budget", "no-fusion")),
        (("6000", "intermediate-temporal"), ("no budget", "no-fusion-temporal")),
        None,
        None,
    ]
    missing = shared_bandwidth.make_rows(cast(ResultGrid, Pairs(("1", "late-temporal"), ("no budget", "no-fusion"))))
    assert [row.gain_over_no_fusion for row in missing] == [None, None]


def test_sensors_compares_each_form_with_no_fusion_of_that_form() -> None:
    names = tuple(f"{name}{form}" for form in ("", "-temporal") for name in ("no-fusion", "intermediate"))
    rows = tuple(
        sensors.SensorsRow("r", law, 1, 0.0, name, Mock(), Mock(), 0.0)
        for law in ("material", "zero")
        for name in names
    )
    keys = [sensors._key_of(row) for row in rows]
    found = sensors.make_comparisons(cast(ResultGrid, Pairs(*keys)), rows)
    pairs = [(key, other) for _, key, other in cast("list[tuple[str, ResultKey, ResultKey]]", found)]
    assert pairs == [
        (keys[1], keys[0]), (keys[3], keys[2]), (keys[5], keys[4]), (keys[5], keys[1]), (keys[7], keys[6]), (keys[7], keys[3]),
    ]  # fmt: skip


@pytest.mark.slow
def test_the_qualitative_study_shows_the_frame_with_max_agents(data, weights, tmp_path) -> None:
    held = evaluate(data, weights, tmp_path, "qualitative")["result"]
    assert (held["scenario"], held["frame"]) == ("b", 5)
    assert [r["method"] for r in held["rows"]] == ["no-fusion", "late", "intermediate", "early"]
    assert all(r["num_true"] == 2 for r in held["rows"])


def scores(tallies: list[MetricAccumulator]) -> list[list[float]]:
    """What each method found."""
    return [[x for frame in tally.frames for x in frame.score.tolist()] for tally in tallies]


@pytest.mark.slow
def test_conditions_side_by_side_are_as_each_by_itself(data, weights) -> None:
    opener = partial(Opv2vRecording, data, "test")
    base = BenchmarkConfig(str(weights), ("late", "early"))
    configs = [disturbance.apply_to(base) for disturbance in (CLEAN, COMBINED_SEVERE, Perturbation(delay_s=0.1))]
    together = [scores(tallies) for tallies in run_scenario(opener, configs, "b")]
    apart = [scores(run_scenario(opener, [config], "b")[0]) for config in configs]
    assert together == apart and together[0] != together[1] != together[2]


def test_no_fusion_is_the_same_under_every_perturbation(data, weights) -> None:
    base = BenchmarkConfig(str(weights), ("no-fusion",))
    calm, rough = run_scenario(
        partial(Opv2vRecording, data, "test"), [CLEAN.apply_to(base), COMBINED_SEVERE.apply_to(base)], "b"
    )
    assert scores(calm) == scores(rough) and len(scores(calm)[0]) > 0


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("bandwidth", "--token-encodings", "moon"), ("moon", "float16")),
        (("bandwidth", "--token-selection", "moon"), ("moon", "intermediate")),
        (("ablation",), ("name=weights.safetensors",)),
        (("byte-curves", "--budgets", "0"), ("--budgets takes numbers of bytes",)),
        (("byte-curves", "--rows", "moon"), ("no row 'moon'", "intermediate-temporal")),
        (("main-table", "--checkpoints", "late=x"), ("methods of the names late",)),
        (("ablation", "--checkpoints", "a=x", "a=y"), ("each name once",)),
    ],
)
def test_invalid_arguments_are_one_line_before_any_work(data, weights, tmp_path, capsys, words, named) -> None:
    common = ("--data", data, "--split", "test", "--weights", weights, "--out", tmp_path / "out")
    assert cli.main([str(word) for word in ("study", *words, *common)]) == 1
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 1 and all(name in output[0] for name in named)
    assert not (tmp_path / "out").exists()
