# SPDX-License-Identifier: Apache-2.0
"""Studies from made-up cells, whose means are worked by hand, and one real unit on a generated crossroads."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps import adversarial as map_malice
from manyeyes.evaluation.maps import map_cells
from manyeyes.evaluation.maps.adversarial import displacement, malice_units, run_malice
from manyeyes.evaluation.maps.experiment import Trial, at_poses, carry_out
from manyeyes.evaluation.maps.hyperparameter_search import CHOICES, drawn
from manyeyes.evaluation.maps.map_cells import ApRow, Cell, KindRow, Unit, cell_path, read_cell, run_unit
from manyeyes.evaluation.maps.oracles import associated, halves
from manyeyes.evaluation.maps.registry import (
    METHODS,
    OURS,
    TUNED,
    Settings,
    check_method,
    configured,
    defaults,
    map_of,
    tuned,
)
from manyeyes.evaluation.maps.study import StudyConfig, best_rival, difference, lines, smaller, trials, verdicts
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import FuseConfig
from manyeyes.maps.store.executors import Inline
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.simulator.fleet.simulate import HONEST, MALICIOUS


def cell(method: str, count: int, seed: int, crossing: float, divider: float, f: float = 0.9, dup: float = 1.0) -> Cell:
    ap = tuple(
        ApRow(way, thresholds, crossing, divider, math.nan, math.nan, (crossing + divider) / 2)
        for way in ("maptr", "streammapnet", "exact")
        for thresholds in ("narrow", "wide")
    )
    kind = KindRow("divider", 3, 3, (0.8, f, 0.95), (1, 1, 1), (1, 1, 1), dup, 1.0, 0.1, 0.2, 0.3, 0.4, math.nan)
    return Cell("cross", 300.0, "local", count, seed, 0.4, method, 1.0, ap, (kind,))


CELLS = [
    cell(OURS, 60, 0, 1.0, 0.8),
    cell(OURS, 60, 1, 0.8, 0.6),
    cell("union", 60, 0, 0.6, 0.2),
    cell("union", 60, 1, 0.8, 0.0),
    cell("polymerge", 60, 0, 0.2, 0.4),
    cell("polymerge", 60, 1, 0.2, 0.2),
    cell(OURS, 200, 0, 1.0, 1.0, f=0.98, dup=1.02),
    cell("union", 200, 0, 1.0, 0.0),
]
CONFIG = StudyConfig("fusion", methods=(OURS, "union", "polymerge"))


def test_a_line_is_a_mean_over_cells() -> None:
    table = {(line.group, line.method): line for line in lines(CONFIG, CELLS)}
    ours = table["60 observations", OURS]
    assert (ours.cells, ours.crossing, ours.divider) == (2, pytest.approx(0.9), pytest.approx(0.7))
    assert ours.mean.value == pytest.approx(0.8) and ours.mean.low == pytest.approx(0.7)
    assert ("200 observations", "polymerge") not in table


def test_the_best_rival_is_that_of_the_number_asked_for() -> None:
    sixty = [c for c in CELLS if c.count == 60]
    assert best_rival(sixty, CONFIG.methods, "mean", "exact", "narrow") == "union"
    assert best_rival(sixty, CONFIG.methods, "divider", "exact", "narrow") == "polymerge"
    assert best_rival(sixty, (OURS, "oracle-pose"), "mean", "exact", "narrow") is None
    assert difference(sixty, OURS, "union", "mean", "exact", "narrow").value == pytest.approx((0.5 + 0.3) / 2)


def test_bars_are_held_against_what_was_measured() -> None:
    held = {(v.group, v.what.split(";")[0]): v for v in verdicts(CONFIG, CELLS)}
    gain = held["60 observations", "mAP (exact, narrow) above the best rival"]
    assert gain.rival == "union" and gain.value == pytest.approx(0.4) and gain.word == "reached"
    dividers = held["60 observations", "AP of dividers"]
    assert dividers.bar == pytest.approx(0.6) and dividers.value == pytest.approx(0.7) and dividers.word != "missed"
    assert held["200 observations", "F@0.5 m of dividers"].word == "reached"
    assert held["200 observations", "duplication of dividers, 0.95 to 1.05"].word == "reached"
    worse = [replace(c, kinds=(replace(c.kinds[0], duplication=1.2),)) for c in CELLS]
    held = {v.what: v for v in verdicts(CONFIG, worse)}
    assert held["duplication of dividers, 0.95 to 1.05"].word == "missed"


def test_a_bar_that_the_interval_straddles_is_not_resolved() -> None:
    two = [cell(OURS, 200, 0, 1.0, 1.0, f=0.99, dup=1.0), cell(OURS, 200, 1, 1.0, 1.0, f=0.95, dup=1.08)]
    held = {v.what: v.word for v in verdicts(CONFIG, two)}
    assert held["duplication of dividers, 0.95 to 1.05"] == held["F@0.5 m of dividers"] == "not resolved"


def test_trials_cover_what_the_study_says() -> None:
    fusion = trials(smaller(StudyConfig("fusion"), ("cross",), (20, 60), 2))
    assert [(t.place, t.count, t.seed) for t in fusion] == [
        ("cross", 20, 0), ("cross", 20, 1), ("cross", 60, 0), ("cross", 60, 1),
    ]  # fmt: skip
    assert len(trials(StudyConfig("fusion"))) == 4 * 3 * 3
    noise = trials(StudyConfig("noise"))
    assert sorted({t.crowd.pose_sigma for t in noise}) == [0.0, 0.4, 0.8, 1.2, 1.5]
    assert noise[-1].crowd.yaw_sigma == pytest.approx(math.radians(1.5))
    table3 = trials(StudyConfig("table3"))
    assert {(t.size_m, t.window) for t in table3} == {(s, w) for s in (300.0, 250.0) for w in ("local", "semi-global")}
    with pytest.raises(ConfigError, match="known: fusion"):
        trials(StudyConfig("moon"))


def test_an_unknown_method_lists_the_known_and_oracles_are_no_methods() -> None:
    with pytest.raises(ConfigError, match="union"):
        check_method("guess")
    check_method("oracle-pose")
    with pytest.raises(ConfigError, match="told more than observations"):
        map_of("oracle-pose", [], Settings())


@pytest.fixture(scope="module")
def scene():
    return carry_out(Trial("cross", 12, 5, 120.0, crowd=CROWDS["local"]))


def test_a_kept_cell_is_read_back_and_not_made_again(scene, tmp_path, monkeypatch) -> None:
    unit = Unit(scene.trial, ("union", "oracle-cuts"), Settings(), tmp_path)
    monkeypatch.setattr(map_cells, "carry_out", lambda trial: scene)
    made = run_unit(unit)
    assert len(list(tmp_path.iterdir())) == 2
    monkeypatch.setattr(map_cells, "carry_out", lambda trial: pytest.fail("made again"))
    assert str(run_unit(unit)) == str(made)
    path = cell_path(unit, "union")
    path.write_text(path.read_text()[:-40])
    assert read_cell(path) is None
    other = replace(
        unit, settings=Settings(chosen=(("union", configured(defaults("union"), (("rules.min_score", 0.5),))),))
    )
    assert cell_path(other, "union") != path and cell_path(other, "oracle-cuts") == cell_path(unit, "oracle-cuts")


def test_the_cut_leaves_the_truth_as_it_is_and_knows_no_divider_in_a_junction(scene) -> None:
    again = scene.cut(scene.truth)
    assert len(again) == len(scene.truth) and again.lengths().sum() == pytest.approx(scene.truth.lengths().sum())
    through = MapElements.of([[(-55.0, 2.0), (55.0, 2.0)]], DIVIDER)
    cut = scene.cut(through)
    assert len(cut) == 2 and cut.lengths().sum() < 110 - 15


def test_oracles_know_what_they_are_told(scene) -> None:
    half = halves(scene.truth)
    open_lines = int((scene.truth.kind != CROSSING).sum())
    assert len(half) == len(scene.truth) + open_lines
    assert half.lengths().sum() == pytest.approx(scene.truth.lengths().sum())
    true = at_poses(scene.observations, scene.crowd.true_poses)
    assert np.allclose([o.pose for o in true], scene.crowd.true_poses)
    assert all((o.covariance.diagonal() < 1e-3).all() for o in true)
    from manyeyes.evaluation.maps.metrics import judge

    known = judge(scene.cut(associated(scene)), scene.truth)
    union = judge(scene.cut(map_of("union", scene.observations, Settings()).elements), scene.truth)
    assert known.mean_ap() > union.mean_ap() and known.of("divider").lateral_median_m < 0.6


def test_a_line_that_moved_is_measured_and_one_that_is_gone_is_lost() -> None:
    def seen_by(elements: MapElements, agents: int) -> VectorMap:
        return VectorMap.of(elements, agents=agents)

    two = MapElements.of([[(0, 0), (10, 0)], [(0, 20), (10, 20)]], DIVIDER)
    moved = MapElements.of([[(0, 0.3), (10, 0.3)]], DIVIDER)
    assert displacement(seen_by(two, 5), seen_by(moved, 5)).tolist() == pytest.approx([0.3, 0.3, np.inf, np.inf])
    assert len(displacement(seen_by(two, 4), seen_by(moved, 5))) == 0
    units = malice_units(("cross",), (0,), Settings(), Path(), (1.0, 4.0))
    assert {(u.trial.crowd.malicious, u.trial.crowd.malicious_offset) for u in units} == {
        (m, (o, o)) for m in ("independent", "colluding") for o in (1.0, 4.0)
    }


def test_what_liars_move_stands_beside_what_they_would_move_by_telling_the_truth(monkeypatch, tmp_path) -> None:
    asked = []

    def carried_out(trial: Trial) -> SimpleNamespace:
        seen = (0.0, 0.0, 0.15 + trial.crowd.malicious_offset[0])  # where each says that the line lies
        crowd = SimpleNamespace(roles=(HONEST, HONEST, MALICIOUS))
        return SimpleNamespace(observations=seen, crowd=crowd, place=SimpleNamespace(frame=None))

    def furthest(_method, seen, *_) -> VectorMap:
        asked.append(seen)
        return VectorMap.of(MapElements.of([[(0, max(seen)), (10, max(seen))]], DIVIDER), agents=5)

    monkeypatch.setattr(map_malice, "carry_out", carried_out)
    monkeypatch.setattr(map_malice, "map_of", furthest)
    map_malice._without_lies.cache_clear()
    units = malice_units(("cross",), (0,), Settings(), tmp_path, (1.0, 4.0))
    found = run_malice(units, Inline())
    map_malice._without_lies.cache_clear()
    assert [(m.malicious, m.stations, m.moved, m.lost, m.by_truth) for m in found] == 2 * [
        (1, 2, 2, 0, 2),
        (1, 2, 2, 2, 2),
    ]
    assert found[0].largest_m == pytest.approx(1.15) and math.isnan(found[1].largest_m)
    assert len(asked) == 6, "what the honest say is fused once, and the truth of all once"
    again = run_malice(units, Inline())
    assert repr(again) == repr(found) and len(asked) == 6, "a study that was stopped goes on"


def test_every_method_is_tuned_over_fields_that_it_has_with_defaults_first() -> None:
    assert set(CHOICES) == set(METHODS)
    for method in METHODS:
        assert drawn(method, 0) == ()
        config = defaults(method)
        draws = [configured(config, drawn(method, k)) for k in range(6)]
        assert draws[0] == config and len({repr(d) for d in draws}) > 3
        assert {name for name, _ in drawn(method, 1)} == set(CHOICES[method]), "a choice names no field"
    changed = configured(FuseConfig(), (("stations.evidence.publish", 9.0),))
    assert changed.stations.evidence.publish == 9.0 and changed.align == FuseConfig().align
    assert tuned().ours.stations.evidence.publish_agents == 1
    assert tuned().of("polymerge").share == 0.3 and tuned().of("union") is None
    for method, changes in TUNED.items():
        assert all(value in CHOICES[method][name] for name, value in changes), "tuning never drew this"


def test_an_executor_changes_nothing_in_the_order_of_cells(scene, tmp_path, monkeypatch) -> None:
    from manyeyes.evaluation.maps import study as map_study

    monkeypatch.setattr(map_cells, "carry_out", lambda trial: replace(scene, trial=trial))
    config = smaller(StudyConfig("fusion", methods=("union",)), ("cross",), (12,), 2)
    cells = map_study.run_study(config, tmp_path, Inline())
    assert [(c.method, c.seed) for c in cells] == [("union", 0), ("union", 1)]
