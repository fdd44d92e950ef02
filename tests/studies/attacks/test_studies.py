# SPDX-License-Identifier: Apache-2.0
"""The studies attacks and false-accusations from end to end, on small scenes, with weights that were never trained."""

import json
from dataclasses import replace

import pytest
from tests.studies.attacks.scene import make_snapshot, write_recording, write_weights

from manyeyes.cli import main as cli
from manyeyes.studies.attacks import false_accusations
from manyeyes.studies.attacks.conditions import NO_ATTACK, NO_DEFENCE, ORACLE, AttackCondition, list_pairs
from manyeyes.studies.attacks.false_accusations import HonestDrive, _Player, make_specs
from manyeyes.studies.engine.cells import CellStore
from manyeyes.studies.options import FalseAccusationsOptions


@pytest.mark.slow
def test_the_study_attacks_writes_rows_and_goes_on_where_it_stopped(tmp_path, monkeypatch) -> None:
    data, weights = write_recording(tmp_path / "data"), write_weights(tmp_path / "weights.safetensors")
    words = [
        "study", "attacks", "--data", data, "--split", "test", "--weights", weights, "--workers", 1,
        "--methods", "late", "--attacks", "ghost-1-ahead", "shift-pose-2m", "--defences", "--counts", 1, "--out", tmp_path / "out",
    ]  # fmt: skip
    assert cli.main([str(word) for word in words]) == 0
    held = json.loads((tmp_path / "out" / "attacks.json").read_text())["result"]
    rows = {(r["attack"], r["defence"], r["method"]): r for r in held["rows"]}
    assert set(rows) == {
        (NO_ATTACK, NO_DEFENCE, "no-fusion"),
        (NO_ATTACK, NO_DEFENCE, "late"),
        (NO_ATTACK, ORACLE, "late"),
        ("ghost-1-ahead", NO_DEFENCE, "late"),
        ("shift-pose-2m", NO_DEFENCE, "late"),
    }
    ghost = rows["ghost-1-ahead", NO_DEFENCE, "late"]
    assert ghost["num_scenarios"] == 2 and ghost["named"][0] == {
        "successes": 0,
        "total": 2,
        "low": 0.0,
        "high": ghost["named"][0]["high"],
    }
    assert (
        ghost["vs_clean"][0]["value"] <= 0
        and ghost["seen"]["surviving"]["total"] + ghost["blind"]["surviving"]["total"] > 0
    )
    assert (tmp_path / "out" / "attacks.png").stat().st_size > 0
    assert "AP under attack" in (tmp_path / "out" / "attacks.md").read_text()
    cells = sorted((tmp_path / "out").rglob("*.cell"))
    monkeypatch.setattr(
        "manyeyes.studies.attacks.conditions.ScenarioPlayer.open", lambda job: pytest.fail("played again")
    )
    assert cli.main([str(word) for word in words]) == 0
    assert sorted((tmp_path / "out").rglob("*.cell")) == cells and len(cells) == 2 * len(rows)


def test_every_attack_has_its_baselines() -> None:
    pairs = list_pairs(
        ("ghost-1-seen", "collude-3", "pgd-10-lower"), ("late", "intermediate"), ("ray-evidence",), (1, 2)
    )
    conditions = {(c.attack, c.num_malicious, c.defence, m) for c, m in pairs}
    assert len(conditions) == len(pairs)
    for attack, size, _, method in conditions:
        if attack != NO_ATTACK:
            assert {(NO_ATTACK, size, d, method) for d in (NO_DEFENCE, "ray-evidence", ORACLE)} <= conditions
            assert (NO_ATTACK, size, NO_DEFENCE, "no-fusion") in conditions
    # Features are in tokens alone; the first attack has further numbers of malicious agents, the others their own.
    assert ("pgd-10-lower", 1, NO_DEFENCE, "late") not in conditions
    assert {size for attack, size, *_ in conditions if attack == "ghost-1-seen"} == {1, 2}
    assert {size for attack, size, *_ in conditions if attack == "collude-3"} == {2}


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--attacks", "none-such"), "known: ghost-1-seen"),
        (("--attacks", "false-sight"), "add --sight"),
        (("--defences", "oracle"), "is always a row"),
        (("--defences", "none-such"), "known:"),
        (("--misbehaviour", "none"), "leave out --misbehaviour"),
        (("--methods", "no-fusion"), "adds it by itself"),
    ],
)
def test_wrong_names_are_refused_before_any_work(tmp_path, capsys, words, text) -> None:
    common = ("study", "attacks", "--data", str(tmp_path), "--out", str(tmp_path / "out"))
    assert cli.main([*common, *words]) != 0
    assert text in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_the_study_false_accusations_counts_sender_minutes(tmp_path, monkeypatch) -> None:
    pytest.importorskip("libsumo")
    weights = write_weights(tmp_path / "weights.safetensors")
    words = [
        "study", "false-accusations", "--weights", weights, "--towns", "generated-2", "--drives", 1, "--seconds", 0.5,
        "--defences", "none", "--variants", "clean", "rain", "--out", tmp_path / "out",
    ]  # fmt: skip
    assert cli.main([str(word) for word in words]) == 0
    rows = json.loads((tmp_path / "out" / "false-accusations.json").read_text())["result"]["rows"]
    assert [(r["variant"], r["defence"], r["num_drives"]) for r in rows] == [("clean", "none", 1), ("rain", "none", 1)]
    for row in rows:
        rate = row["accusations"]
        assert rate["events"] == 0 and 0 < rate["minutes"] <= 20 * 0.5 / 60 and rate["upper"] > 1
    monkeypatch.setattr(false_accusations.HonestDrive, "_play", lambda self, pairs: pytest.fail("played again"))
    assert cli.main([str(word) for word in words]) == 0


@pytest.mark.parametrize("sight", [False, True])
def test_agents_of_honest_drives_send_sights_on_request(tmp_path, sight) -> None:
    weights = write_weights(tmp_path / "weights.safetensors")
    player = _Player.make("none", FalseAccusationsOptions(weights=str(weights), sight=sight), {})
    _, steps = (list(player.replay.step(make_snapshot("a", index))) for index in range(2))
    received = [one.message for step in steps for one in step.perception.received]
    assert len(received) == 4 * 3 and all((message.sight is not None) is sight for message in received)


def test_drives_with_and_without_sights_are_stored_apart(tmp_path) -> None:
    options, store = (
        FalseAccusationsOptions(weights=str(write_weights(tmp_path / "weights.safetensors"))),
        CellStore(tmp_path),
    )
    (spec, *_) = make_specs(options)
    drives = (HonestDrive(spec, "clean", replace(options, sight=sight), store) for sight in (True, False))
    assert len({store.path(drive.make_cell("ray-evidence")) for drive in drives}) == 2


def test_drives_differ_and_their_length_is_the_stated_one() -> None:
    specs = make_specs(FalseAccusationsOptions(drives=3, seconds=60.0, towns=("Town07", "Town01")))
    assert len({spec.seed for spec in specs}) == 3 and {spec.frames for spec in specs} == {600}
    assert [spec.town for spec in specs] == ["Town07", "Town01", "Town07"]


def test_names_of_conditions_are_unique() -> None:
    conditions = [AttackCondition(a, k, d) for a in (NO_ATTACK, "copy") for k in (1, 2) for d in (NO_DEFENCE, ORACLE)]
    assert len({condition.name for condition in conditions}) == len(conditions)
