# SPDX-License-Identifier: Apache-2.0
"""Bars of misbehaviour detection on results written by hand."""

import json

from benchmarks.attack_bars import Measured, Options, main, measure_accusations, measure_attacks

from manyeyes.viz.stored_tables import load_result, make_tables


def interval(value: float, low: float, high: float) -> list[dict]:
    return [{"value": value, "low": low, "high": high}]


def row(attack: str, defence: str = "ray-evidence", **changes: object) -> dict:
    none = {"successes": 0, "total": 0, "low": 0.0, "high": 1.0}
    survival = {"surviving": none, "marked": none, "trusted": none}
    base = {
        "attack": attack, "method": "late", "num_malicious": 1, "defence": defence, "num_scenarios": 20,
        "vs_clean": interval(-0.001, -0.002, 0.0), "vs_oracle": interval(-0.004, -0.008, 0.0), "vs_alone": interval(0.1, 0.05, 0.2),
        "named": [none, none], "named_checkable": [none, none], "named_by_ego": [none, none], "seen": survival, "blind": survival,
    }  # fmt: skip
    return {**base, **changes}


def test_undefended_rows_and_the_oracle_have_no_bar() -> None:
    assert list(measure_attacks([row("ghost-1-seen", "none"), row("none", "oracle")])) == []


def test_differences_are_compared_by_their_whole_interval() -> None:
    bars = {
        m.name: m.verdict for m in measure_attacks([row("none"), row("copy", vs_oracle=interval(-0.03, -0.04, -0.02))])
    }
    assert bars == {
        "late, none x1, ray-evidence: clean cost, AP@0.5": "met",
        "late, copy x1, ray-evidence: defended - oracle, AP@0.5": "not met",
        "late, copy x1, ray-evidence: defended - alone, AP@0.5": "met",
    }


def test_named_senders_and_marked_claims() -> None:
    found = {"successes": 9, "total": 20, "low": 0.23, "high": 0.68}
    every = {"successes": 5, "total": 5, "low": 0.48, "high": 1.0}
    survival = {"surviving": every, "marked": every, "trusted": {**every, "successes": 4}}
    rows = [row("ghost-1-seen", named=[found, found], blind=survival)]
    assert [(m.bar, m.verdict) for m in measure_attacks(rows)] == [
        ("1", "met"), ("1", "met"), ("2", "not met"), ("4", "met"), ("4", "not met"),
    ]  # fmt: skip


def test_false_accusations_state_the_missing_minutes() -> None:
    rate = {"events": 0, "minutes": 30.0, "low": 0.0, "high": 0.12, "upper": 0.1}
    few, enough = measure_accusations(
        [
            {"variant": "clean", "defence": "ray-evidence", "accusations": rate},
            {"variant": "rain", "defence": "ray-evidence", "accusations": {**rate, "minutes": 300.0, "upper": 0.00999}},
        ]
    )
    assert few.verdict == "inconclusive" and few.n.endswith("300 are asked")
    assert enough.verdict == "met" and "300 are asked" not in enough.n


def test_a_missing_value_is_inconclusive() -> None:
    assert Measured("1", "a", float("nan"), 0.0, 1.0, "0", minimum=0.0).verdict == "inconclusive"


def test_two_scenarios_decide_no_difference() -> None:
    assert {m.verdict for m in measure_attacks([row("copy", num_scenarios=2)])} == {"inconclusive"}


def test_the_bars_are_stored_as_a_table_for_documents(tmp_path, capsys) -> None:
    attacks = {
        "provenance": {"config": {"options": {"split": "val"}}},
        "result": {"study": "attacks", "rows": [row("none"), row("copy", vs_oracle=interval(-0.03, -0.04, -0.02))]},
    }
    (tmp_path / "attacks.json").write_text(json.dumps(attacks))
    assert main(Options((tmp_path / "attacks.json",), tmp_path / "bars.json")) == 1
    stored = load_result(tmp_path / "bars.json")
    (table,) = make_tables(stored)
    assert stored.split == "val" and len(table.lines) == 4
    assert table.lines[2][1:3] == ("late, copy x1, ray-evidence: defended - oracle, AP@0.5", "-0.03 [-0.04, -0.02]")
    assert capsys.readouterr().out.count("not met") == 1
