# SPDX-License-Identifier: Apache-2.0
"""The map commands in sequence on a generated crossroads: every file is written, every error is one line."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pyarrow", reason="the 'map' extra is not installed")
pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.cli import main as cli
from manyeyes.maps.elements.observation_file import read_observations
from manyeyes.maps.fusion.fuse import MapFusionConfig
from manyeyes.maps.registry import OURS, TWO_AGENTS
from manyeyes.maps.store.store import MapStore
from manyeyes.studies.map_folder import read_vector_map


def run(*words: object) -> int:
    return cli.main([str(word) for word in words])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("map")
    assert run("map", "simulate", "cross", "--observations", 24, "--size", 150, "--seed", 3, "--out", path) == 0
    assert run("map", "fuse", path) == 0
    return path


@pytest.mark.slow
def test_simulate_and_fuse_leave_observations_truth_and_a_map(folder) -> None:
    assert {p.name for p in folder.iterdir()} == {"observations", "truth", "cut.json", "simulate.json", "map"}
    made, truth = read_vector_map(folder / "map"), read_vector_map(folder / "truth")
    assert len(truth) > 20 and len(made.select_published()) > 5 and made.frame == truth.frame
    held = json.loads((folder / "map" / "fuse.json").read_text())
    assert held["result"]["observations"] == 24 and held["result"]["hash"] == made.quantised_hash()
    assert held["provenance"]["config"]["settings"]["pose_solver"]["spacing_m"] == 1.0


def test_the_same_seed_is_the_same_map(folder, tmp_path) -> None:
    assert run("map", "simulate", "cross", "--observations", 24, "--size", 150, "--seed", 3, "--out", tmp_path) == 0
    assert run("map", "fuse", tmp_path, "--out", tmp_path / "again") == 0
    assert read_vector_map(tmp_path / "again").quantised_hash() == read_vector_map(folder / "map").quantised_hash()


@pytest.mark.slow
def test_evaluate_prints_and_writes_the_metrics(folder, capsys) -> None:
    assert run("map", "evaluate", folder / "map") == 0
    output = capsys.readouterr().out
    assert "divider" in output and "AP MapTR" in output
    held = json.loads((folder / "map" / "quality.json").read_text())["result"]
    assert 0.3 < held["mean_ap"]["exact"] <= 1.0
    assert run("map", "evaluate", folder / "truth", "--truth", folder / "truth") == 0
    perfect = json.loads((folder / "truth" / "quality.json").read_text())["result"]
    assert perfect["mean_ap"] == {"exact": 1.0, "maptr": 1.0, "streammapnet": 1.0}
    assert {score["ap"] for kind in perfect["kinds"] if kind["n_truth"] for score in kind["ap_scores"]} == {1.0}


@pytest.mark.slow
def test_a_baseline_map_is_written_and_diff_lists_the_differences(folder, capsys) -> None:
    assert run("map", "fuse", folder, "--method", "union") == 0
    page, numbers = folder / "change.html", folder / "change.json"
    assert run("map", "diff", folder / "map", folder / "union", "--out", numbers) == 0
    assert run("map", "diff", folder / "map", folder / "union", "--out", page) == 0
    assert "divider" in capsys.readouterr().out
    rows = json.loads(numbers.read_text())["result"]["kinds"]
    divider = next(r for r in rows if r["kind"] == "divider")
    assert divider["num_unchanged"] == 0 and divider["num_added"] > 0 and divider["added_length_m"] > 0
    assert "New map" in page.read_text()
    capsys.readouterr()
    assert run("map", "diff", folder / "map", folder / "map", "--out", numbers) == 0
    rows = json.loads(numbers.read_text())["result"]["kinds"]
    assert all(
        r["num_changed"] == r["num_added"] == r["num_removed"] == 0
        and r["added_length_m"] == r["removed_length_m"] == 0
        for r in rows
    )
    assert sum(r["num_unchanged"] for r in rows) == len(read_vector_map(folder / "map").select_published())


def test_view_draws_a_page_and_a_picture(folder) -> None:
    assert run("map", "view", folder / "map") == 0
    page = (folder / "map" / "map.html").read_text()
    assert "maplibregl" in page and '"observed":{"type":"FeatureCollection","features":[{' in page
    assert run("map", "view", folder / "map", "--out", folder / "map.png") == 0
    with Image.open(folder / "map.png") as picture:
        assert min(picture.size) > 500


def test_export_writes_a_file_that_others_read(folder, tmp_path) -> None:
    assert run("map", "export", folder / "map", tmp_path / "map.geojson") == 0
    held = json.loads((tmp_path / "map.geojson").read_text())
    assert len(held["features"]) == len(read_vector_map(folder / "map").select_published())
    assert run("map", "export", folder / "map", tmp_path / "all.geojson", "--include-unpublished") == 0
    assert len(json.loads((tmp_path / "all.geojson").read_text())["features"]) >= len(held["features"])


def test_a_map_of_one_agent_that_needs_two_states_why_nothing_is_published(folder, tmp_path, capsys) -> None:
    assert run("map", "simulate", "cross", "--observations", 1, "--size", 150, "--out", tmp_path) == 0
    assert run("map", "fuse", tmp_path, "--method", TWO_AGENTS, "--out", tmp_path / "map") == 0
    assert len(read_vector_map(tmp_path / "map")) > 0 and "No element is published" in capsys.readouterr().out
    assert run("map", "export", tmp_path / "map", tmp_path / "none.geojson") == 0
    assert "--trusted" in capsys.readouterr().out
    assert run("map", "export", tmp_path / "map", tmp_path / "all.geojson", "--include-unpublished") == 0
    assert run("map", "export", folder / "map", tmp_path / "map.geojson") == 0
    assert "No element is published" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_store_may_require_two_agents_also_after_a_retraction(tmp_path, capsys) -> None:
    drive, store = tmp_path / "drive", str(tmp_path / "store")
    assert run("map", "simulate", "cross", "--observations", 8, "--size", 150, "--out", drive) == 0
    counts = []
    for method in (OURS, TWO_AGENTS):
        assert run("map", "fuse", drive, "--store", store, "--executor", "inline", "--method", method) == 0
        counts.append(len(read_vector_map(store).select_published()))
    assert counts[0] > counts[1]
    agent = read_observations(drive / "observations").observations[0].agent
    words = ("--agent", agent, "--reason", "test", "--executor", "inline")
    assert run("map", "retract", store, *words) == 0
    kept = read_vector_map(store).select_published()
    assert len(kept) <= counts[1] and (kept.agents >= 2).all()
    # A release of other settings, as of an earlier version, has no method by that name.
    manifest = max(Path(store).glob("releases/*.json"))
    release = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**release, "settings": "MapFusionConfig(old=1)"}))
    rest = read_observations(drive / "observations").observations[-1].agent
    words = ("--agent", rest, "--reason", "test", "--executor", "inline")
    capsys.readouterr()
    assert run("map", "retract", store, *words) == 1
    assert "release 3 was made with other settings" in capsys.readouterr().err
    assert run("map", "retract", store, *words, "--no-fuse", "--method", "union") == 1
    assert "A store is fused by" in capsys.readouterr().err
    # Both were refused before anything was retracted.
    assert run("map", "retract", store, *words, "--method", OURS) == 0
    assert "retracted now, 0 before" in capsys.readouterr().out
    assert MapStore(store).manifest().settings == repr(MapFusionConfig())


@pytest.mark.slow
def test_a_store_takes_observations_and_other_commands_read_its_last_release(folder, tmp_path, capsys) -> None:
    store = tmp_path / "city"
    assert run("map", "fuse", folder, "--store", store, "--executor", "inline") == 0
    assert "release 1 after 24 new observations, 0 known, 0 rejected" in capsys.readouterr().out
    assert run("map", "fuse", folder, "--store", store, "--executor", "inline") == 0
    assert "release 2 after 0 new observations, 24 known" in capsys.readouterr().out
    assert read_vector_map(store).quantised_hash() == read_vector_map(folder / "map").quantised_hash()
    assert run("map", "diff", folder / "map", store) == 0
    assert run("map", "fuse", folder, "--store", store, "--method", "union") == 1
    assert (
        "A store is fused by manyeyes, manyeyes-two-agents, manyeyes-map-model; fuse without --store"
        in capsys.readouterr().err
    )


def test_import_reads_results_of_a_model(tmp_path, capsys) -> None:
    vectors = [[[0.0, 0.0], [10.0, 0.0]], [[0.0, 3.5], [10.0, 3.5]]]
    results = {"meta": {}, "results": {t: {"vectors": vectors, "scores": [0.9, 0.05], "labels": [1, 2]} for t in "abc"}}
    (tmp_path / "submission_vector.json").write_text(json.dumps(results))
    (tmp_path / "poses.csv").write_text(
        "token,agent,pass_id,time_ns,x,y,yaw\na,car,one,1000,5,5,0.1\nb,van,two,2000,5.2,5,0.1\n"
    )
    words = ("map", "import", tmp_path / "submission_vector.json", "--poses", tmp_path / "poses.csv")
    assert run(*words, "--origin", 49.0, 8.4, "--out", tmp_path / "in") == 0
    output = capsys.readouterr().out
    assert "2 observations of 2 elements" in output and "'c' has no pose" in output
    view = read_observations(tmp_path / "in" / "observations").observations[0].view
    assert (np.ptp(view[:, 0]), np.ptp(view[:, 1])) == (60.0, 30.0), "the models look farther ahead than to the sides"
    assert run("map", "fuse", tmp_path / "in") == 0
    assert run(*words, "--out", tmp_path / "in") == 1
    assert "--origin" in capsys.readouterr().err


def spoil_cut(folder: Path) -> Path:
    (folder / "cut.json").write_text('{"junctions": "POLYGON ((", "area": [0, 0, 1, 1]}')
    return folder / "map"


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("simulate", "moon"), ("moon", "Town03")),
        (("simulate", "cross", "--crowd", "shy"), ("shy", "colluding-malicious")),
        (("fuse", "{here}"), ("{here}", "Parquet")),
        (("fuse", "{here}", "--method", "guess"), ("guess", "chamfer-nms")),
        (("evaluate", "{here}"), ("{here}", "lines.parquet")),
        (("view", "{here}"), ("{here}", "lines.parquet")),
        (("view", "{here}", "--out", "x.jpg"), ("x.jpg", ".html")),
        (("diff", "{here}", "{here}", "--out", "x.txt"), ("x.txt", ".json")),
        (("export", "{here}", "{here}/x.dxf"), ("lines.parquet",)),
        (("import", "{here}/x.json"), ("--poses",)),
    ],
)
def test_missing_files_are_one_line_with_their_name(words, named, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("map", *(word.format(here=tmp_path) for word in words)) == 1
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 1 and output[0].startswith("manyeyes: ")
    assert all(name.format(here=tmp_path) in output[0] for name in named)


def test_a_damaged_cut_is_one_line(folder, capsys) -> None:
    before = (folder / "cut.json").read_text()
    assert run("map", "evaluate", spoil_cut(folder)) == 1
    (folder / "cut.json").write_text(before)
    output = capsys.readouterr().err.splitlines()
    assert output[-1].startswith("manyeyes: ") and "cut.json" in output[-1]
