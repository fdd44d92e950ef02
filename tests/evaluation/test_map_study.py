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
from manyeyes.evaluation.maps import adversarial as map_malice, map_cells
from manyeyes.evaluation.maps.adversarial import make_adversarial_jobs, measure_displacement, run_adversarial_jobs
from manyeyes.evaluation.maps.experiment import FleetTrial, replace_poses, run_trial
from manyeyes.evaluation.maps.hyperparameter_search import SEARCH_SPACE, sample_changes
from manyeyes.evaluation.maps.map_cells import (
    ApRow,
    KindRow,
    MapStudyJob,
    MapStudyResult,
    map_result_path,
    read_map_result,
    run_study_job,
)
from manyeyes.evaluation.maps.oracles import fuse_with_true_association, split_in_half
from manyeyes.evaluation.maps.registry import (
    TUNED_CHANGES,
    MethodSettings,
    apply_changes,
    check_method,
    fuse_observations,
    make_default_config,
    make_tuned_settings,
)
from manyeyes.evaluation.maps.study import (
    MapStudyConfig,
    check_margins,
    compute_paired_difference,
    find_best_baseline,
    make_trials,
    restrict_study,
    summarize_methods,
)
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import MapFusionConfig
from manyeyes.maps.registry import OURS, list_map_fusions
from manyeyes.maps.store.executors import InlineExecutor
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.simulator.fleet.simulate import HONEST, MALICIOUS


def make_result(
    method: str, count: int, seed: int, crossing: float, divider: float, f: float = 0.9, dup: float = 1.0
) -> MapStudyResult:
    ap = tuple(
        ApRow(way, thresholds, crossing, divider, math.nan, math.nan, (crossing + divider) / 2)
        for way in ("maptr", "streammapnet", "exact")
        for thresholds in ("narrow", "wide")
    )
    kind = KindRow("divider", 3, 3, (0.8, f, 0.95), (1, 1, 1), (1, 1, 1), dup, 1.0, 0.1, 0.2, 0.3, 0.4, math.nan)
    return MapStudyResult("cross", 300.0, "local", count, seed, 0.4, method, 1.0, ap, (kind,))


RESULTS = [
    make_result(OURS, 60, 0, 1.0, 0.8),
    make_result(OURS, 60, 1, 0.8, 0.6),
    make_result("union", 60, 0, 0.6, 0.2),
    make_result("union", 60, 1, 0.8, 0.0),
    make_result("polymerge", 60, 0, 0.2, 0.4),
    make_result("polymerge", 60, 1, 0.2, 0.2),
    make_result(OURS, 200, 0, 1.0, 1.0, f=0.98, dup=1.02),
    make_result("union", 200, 0, 1.0, 0.0),
]
CONFIG = MapStudyConfig("fusion", methods=(OURS, "union", "polymerge"))


def test_a_summary_is_a_mean_over_results() -> None:
    table = {(line.group, line.method): line for line in summarize_methods(CONFIG, RESULTS)}
    ours = table["60 observations", OURS]
    assert (ours.num_results, ours.crossing, ours.divider) == (2, pytest.approx(0.9), pytest.approx(0.7))
    assert ours.mean_ap.value == pytest.approx(0.8) and ours.mean_ap.low == pytest.approx(0.7)
    assert ("200 observations", "polymerge") not in table


def test_the_best_baseline_is_that_of_the_requested_metric() -> None:
    sixty = [c for c in RESULTS if c.num_observations == 60]
    assert find_best_baseline(sixty, CONFIG.methods, "mean_ap", "exact", "narrow") == "union"
    assert find_best_baseline(sixty, CONFIG.methods, "divider", "exact", "narrow") == "polymerge"
    assert find_best_baseline(sixty, (OURS, "oracle-pose"), "mean_ap", "exact", "narrow") is None
    assert compute_paired_difference(sixty, OURS, "union", "mean_ap", "exact", "narrow").value == pytest.approx(
        (0.5 + 0.3) / 2
    )


def test_margins_are_compared_with_measurements() -> None:
    held = {(v.group, v.description.split(";")[0]): v for v in check_margins(CONFIG, RESULTS)}
    gain = held["60 observations", "mAP (exact, narrow) above the best baseline"]
    assert gain.baseline == "union" and gain.value == pytest.approx(0.4) and gain.verdict == "met"
    dividers = held["60 observations", "AP of dividers"]
    assert (
        dividers.margin == pytest.approx(0.6) and dividers.value == pytest.approx(0.7) and dividers.verdict != "not met"
    )
    assert held["200 observations", "F@0.5 m of dividers"].verdict == "met"
    assert held["200 observations", "duplication of dividers, 0.95 to 1.05"].verdict == "met"
    worse = [replace(c, kind_rows=(replace(c.kind_rows[0], duplication=1.2),)) for c in RESULTS]
    held = {v.description: v for v in check_margins(CONFIG, worse)}
    assert held["duplication of dividers, 0.95 to 1.05"].verdict == "not met"


def test_a_margin_inside_the_interval_is_not_resolved() -> None:
    two = [make_result(OURS, 200, 0, 1.0, 1.0, f=0.99, dup=1.0), make_result(OURS, 200, 1, 1.0, 1.0, f=0.95, dup=1.08)]
    held = {v.description: v.verdict for v in check_margins(CONFIG, two)}
    assert held["duplication of dividers, 0.95 to 1.05"] == held["F@0.5 m of dividers"] == "inconclusive"


def test_trials_cover_the_study() -> None:
    fusion = make_trials(restrict_study(MapStudyConfig("fusion"), ("cross",), (20, 60), 2))
    assert [(t.place, t.num_observations, t.seed) for t in fusion] == [
        ("cross", 20, 0), ("cross", 20, 1), ("cross", 60, 0), ("cross", 60, 1),
    ]  # fmt: skip
    assert len(make_trials(MapStudyConfig("fusion"))) == 4 * 3 * 3
    noise = make_trials(MapStudyConfig("fleet-pose-noise"))
    assert sorted({t.fleet_config.pose_sigma_m for t in noise}) == [0.0, 0.4, 0.8, 1.2, 1.5]
    assert noise[-1].fleet_config.yaw_sigma_rad == pytest.approx(math.radians(1.5))
    table3 = make_trials(MapStudyConfig("crowdmap-table3"))
    assert {(t.size_m, t.view_label) for t in table3} == {
        (s, w) for s in (300.0, 250.0) for w in ("local", "semi-global")
    }
    with pytest.raises(ConfigError, match="known: fusion"):
        make_trials(MapStudyConfig("moon"))


def test_an_unknown_method_lists_the_known_and_oracles_are_no_methods() -> None:
    with pytest.raises(ConfigError, match="union"):
        check_method("guess")
    check_method("oracle-pose")
    with pytest.raises(ConfigError, match="needs more than observations"):
        fuse_observations("oracle-pose", [], MethodSettings())


@pytest.fixture(scope="module")
def experiment():
    return run_trial(FleetTrial("cross", 12, 5, 120.0, fleet_config=CROWDS["local"]))


def test_a_stored_result_is_read_back_and_not_repeated(experiment, tmp_path, monkeypatch) -> None:
    unit = MapStudyJob(experiment.trial, ("union", "oracle-cuts"), MethodSettings(), tmp_path)
    monkeypatch.setattr(map_cells, "run_trial", lambda trial: experiment)
    made = run_study_job(unit)
    assert len(list(tmp_path.iterdir())) == 2
    monkeypatch.setattr(map_cells, "run_trial", lambda trial: pytest.fail("made again"))
    assert str(run_study_job(unit)) == str(made)
    path = map_result_path(unit, "union")
    path.write_text(path.read_text()[:-40])
    assert read_map_result(path) is None
    other = replace(
        unit,
        settings=MethodSettings((("union", apply_changes(make_default_config("union"), (("rules.min_score", 0.5),))),)),
    )
    assert map_result_path(other, "union") != path and map_result_path(other, "oracle-cuts") == map_result_path(
        unit, "oracle-cuts"
    )


def test_the_cut_keeps_the_ground_truth_and_removes_dividers_in_junctions(experiment) -> None:
    again = experiment.cut_policy(experiment.truth)
    assert len(again) == len(experiment.truth) and again.lengths().sum() == pytest.approx(
        experiment.truth.lengths().sum()
    )
    through = MapElements.of([[(-55.0, 2.0), (55.0, 2.0)]], DIVIDER)
    cut = experiment.cut_policy(through)
    assert len(cut) == 2 and cut.lengths().sum() < 110 - 15


def test_oracles_use_their_extra_knowledge(experiment) -> None:
    half = split_in_half(experiment.truth)
    open_lines = int((experiment.truth.kind != CROSSING).sum())
    assert len(half) == len(experiment.truth) + open_lines
    assert half.lengths().sum() == pytest.approx(experiment.truth.lengths().sum())
    true = replace_poses(experiment.observations, experiment.fleet.true_poses)
    assert np.allclose([o.pose for o in true], experiment.fleet.true_poses)
    assert all((o.covariance.diagonal() < 1e-3).all() for o in true)
    from manyeyes.evaluation.maps.metrics import evaluate_map

    known = evaluate_map(experiment.cut_policy(fuse_with_true_association(experiment)), experiment.truth)
    union = evaluate_map(
        experiment.cut_policy(fuse_observations("union", experiment.observations, MethodSettings()).elements),
        experiment.truth,
    )
    assert known.mean_ap() > union.mean_ap() and known.get_kind("divider").lateral_median_m < 0.6


def test_displaced_lines_are_measured_and_missing_lines_are_lost() -> None:
    def seen_by(elements: MapElements, agents: int) -> VectorMap:
        return VectorMap.of(elements, agents=agents)

    two = MapElements.of([[(0, 0), (10, 0)], [(0, 20), (10, 20)]], DIVIDER)
    moved = MapElements.of([[(0, 0.3), (10, 0.3)]], DIVIDER)
    assert measure_displacement(seen_by(two, 5), seen_by(moved, 5)).tolist() == pytest.approx(
        [0.3, 0.3, np.inf, np.inf]
    )
    assert len(measure_displacement(seen_by(two, 4), seen_by(moved, 5))) == 0
    units = make_adversarial_jobs(("cross",), (0,), MethodSettings(), Path(), (1.0, 4.0))
    assert {(u.trial.fleet_config.attack_mode, u.trial.fleet_config.malicious_offset_m) for u in units} == {
        (m, (o, o)) for m in ("independent", "colluding") for o in (1.0, 4.0)
    }


def test_displacement_by_attack_is_compared_with_displacement_without_attack(monkeypatch, tmp_path) -> None:
    fused_inputs = []

    def carried_out(trial: FleetTrial) -> SimpleNamespace:
        seen = (
            0.0,
            0.0,
            0.15 + trial.fleet_config.malicious_offset_m[0],
        )  # the lateral position of the line in each observation
        crowd = SimpleNamespace(roles=(HONEST, HONEST, MALICIOUS))
        return SimpleNamespace(observations=seen, fleet=crowd, place=SimpleNamespace(frame=None))

    def furthest(_method, seen, *_) -> VectorMap:
        fused_inputs.append(seen)
        return VectorMap.of(MapElements.of([[(0, max(seen)), (10, max(seen))]], DIVIDER), agents=5)

    monkeypatch.setattr(map_malice, "run_trial", carried_out)
    monkeypatch.setattr(map_malice, "fuse_observations", furthest)
    map_malice._fuse_without_attack.cache_clear()
    units = make_adversarial_jobs(("cross",), (0,), MethodSettings(), tmp_path, (1.0, 4.0))
    found = run_adversarial_jobs(units, InlineExecutor())
    map_malice._fuse_without_attack.cache_clear()
    assert [
        (m.num_malicious, m.num_stations, m.num_displaced, m.num_lost, m.num_displaced_without_attack) for m in found
    ] == 2 * [
        (1, 2, 2, 0, 2),
        (1, 2, 2, 2, 2),
    ]
    assert found[0].max_m == pytest.approx(1.15) and math.isnan(found[1].max_m)
    assert len(fused_inputs) == 6, "honest observations are fused once, and the truth of all once"
    again = run_adversarial_jobs(units, InlineExecutor())
    assert repr(again) == repr(found) and len(fused_inputs) == 6, "a study that was stopped goes on"


def test_every_method_is_searched_over_its_own_fields_defaults_first() -> None:
    assert set(SEARCH_SPACE) == set(list_map_fusions())
    for method in list_map_fusions():
        assert sample_changes(method, 0) == ()
        config = make_default_config(method)
        draws = [apply_changes(config, sample_changes(method, k)) for k in range(6)]
        assert draws[0] == config and len({repr(d) for d in draws}) > 3
        assert {name for name, _ in sample_changes(method, 1)} == set(SEARCH_SPACE[method]), "a choice names no field"
    changed = apply_changes(MapFusionConfig(), (("stations.evidence.publish_log_odds", 9.0),))
    assert changed.stations.evidence.publish_log_odds == 9.0 and changed.pose_solver == MapFusionConfig().pose_solver
    assert make_tuned_settings().config_of(OURS).stations.evidence.min_publish_agents == 1
    assert make_tuned_settings().config_of("polymerge").min_fraction == 0.3 and make_tuned_settings().config_of(
        "union"
    ) == make_default_config("union")
    for method, changes in TUNED_CHANGES.items():
        assert all(value in SEARCH_SPACE[method][name] for name, value in changes), "tuning never drew this"


def test_an_executor_changes_nothing_in_the_order_of_cells(experiment, tmp_path, monkeypatch) -> None:
    from manyeyes.evaluation.maps import study as map_study

    monkeypatch.setattr(map_cells, "run_trial", lambda trial: replace(experiment, trial=trial))
    config = restrict_study(MapStudyConfig("fusion", methods=("union",)), ("cross",), (12,), 2)
    cells = map_study.run_map_study(config, tmp_path, InlineExecutor())
    assert [(c.method, c.seed) for c in cells] == [("union", 0), ("union", 1)]
