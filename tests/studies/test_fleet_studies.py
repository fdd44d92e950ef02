# SPDX-License-Identifier: Apache-2.0
"""Studies from made-up cells, whose means are worked by hand, and one real unit on a generated crossroads."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps import adversarial
from manyeyes.evaluation.maps.adversarial import make_attacks, measure_displacement
from manyeyes.evaluation.maps.association_oracle import fuse_with_true_association
from manyeyes.evaluation.maps.experiment import FleetTrial, replace_poses, run_trial
from manyeyes.evaluation.maps.malicious_agents import AgentErrors
from manyeyes.evaluation.maps.metrics import THRESHOLDS, KindAp, KindMetrics, LengthScore, MapMetrics, evaluate_map
from manyeyes.evaluation.maps.oracles import split_in_half
from manyeyes.evaluation.maps.registry import (
    TUNED_CHANGES,
    MethodSettings,
    apply_changes,
    check_method,
    fuse_observations,
    make_default_config,
    make_tuned_settings,
)
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import MapFusionConfig
from manyeyes.maps.registry import OURS, TWO_AGENTS, VARIANTS, list_map_fusions
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.simulator.fleet.simulate import HONEST, MALICIOUS
from manyeyes.studies.engine.cells import CellStore
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps import fleet_cells, malicious_agents as malicious_study
from manyeyes.studies.maps.adversarial import AdversarialJob, make_summary_table
from manyeyes.studies.maps.fleet_cells import FleetJob, FleetResult, make_cell
from manyeyes.studies.maps.fusion import (
    compare_with_best,
    compare_with_oracle,
    compute_paired_difference,
    find_best_baseline,
    group_name,
    make_trials,
    run,
)
from manyeyes.studies.maps.tuning import PLACES as TUNING_PLACES, SEARCH_SPACE, list_tuned_methods, sample_changes
from manyeyes.studies.options import (
    FleetPoseNoiseOptions,
    FusionOptions,
    MaliciousAgentsOptions,
    MapFusionStudyOptions,
)


def make_kind(kind: str, ap: float, f: float, dup: float) -> KindMetrics:
    scores = tuple(
        KindAp(protocol, distances, (ap,) * 3, ap, 1)
        for protocol in ("maptr", "streammapnet", "exact")
        for distances in THRESHOLDS.values()
    )
    lengths = tuple(LengthScore(d, 1.0, 1.0, f1) for d, f1 in ((0.3, 0.8), (0.5, f), (1.0, 0.95)))
    return KindMetrics(kind, 3, 3, scores, lengths, dup, 1.0, 0.1, 0.2, 0.3, 0.4, math.nan)


def make_result(
    method: str, count: int, seed: int, crossing: float, divider: float, f: float = 0.9, dup: float = 1.0
) -> FleetResult:
    metrics = MapMetrics((make_kind("crossing", crossing, f, dup), make_kind("divider", divider, f, dup)))
    return FleetResult("cross", 300.0, "local", count, seed, 0.4, method, 1.0, metrics)


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
METHODS_COMPARED = (OURS, "union", "polymerge")


def select(count: int) -> list[FleetResult]:
    return [r for r in RESULTS if r.num_observations == count]


def test_the_best_baseline_is_that_of_the_requested_metric() -> None:
    sixty = select(60)
    assert find_best_baseline(sixty, METHODS_COMPARED, "mean_ap", "exact", "narrow") == "union"
    assert find_best_baseline(sixty, METHODS_COMPARED, "divider", "exact", "narrow") == "polymerge"
    assert find_best_baseline(sixty, (OURS, "oracle-pose"), "mean_ap", "exact", "narrow") is None
    assert compute_paired_difference(sixty, OURS, "union", "mean_ap", "exact", "narrow").value == pytest.approx(
        (0.5 + 0.3) / 2
    )


def test_lateral_errors_are_divided_by_those_of_the_joint_oracle() -> None:
    """Twice the median and a quarter of the p95 in one cell; the other cell has no oracle."""
    kinds = tuple(replace(k, lateral_median_m=0.05, lateral_p95_m=0.8) for k in RESULTS[0].metrics.kinds)
    oracle = replace(RESULTS[0], method="oracle-joint", metrics=MapMetrics(kinds))
    ratios = {c.metric: c.interval.value for c in compare_with_oracle("60 observations", [*select(60), oracle])}
    assert ratios == pytest.approx({"lateral median": 0.1 / 0.05, "lateral p95": 0.2 / 0.8})


def test_ours_is_compared_with_the_best_baseline_of_each_metric() -> None:
    held = {c.metric: c for c in compare_with_best("60 observations", select(60), METHODS_COMPARED)}
    gain = held["mAP exact, narrow"]
    assert gain.description == "60 observations: manyeyes - union" and gain.interval.value == pytest.approx(0.4)
    dividers = held["AP divider"]
    assert dividers.interval.value == pytest.approx(0.7) and dividers.baseline_value == pytest.approx(0.3)
    held = {c.metric: c for c in compare_with_best("200 observations", select(200), METHODS_COMPARED)}
    assert held["F1@0.5 m divider"].interval.value == 0.98 and held["duplication divider"].interval.value == 1.02


def test_trials_cover_the_study() -> None:
    fusion = make_trials(FusionOptions(places=("cross",), observation_counts=(20, 60)), range(2))
    assert [(t.place, t.num_observations, t.seed) for t in fusion] == [
        ("cross", 20, 0), ("cross", 20, 1), ("cross", 60, 0), ("cross", 60, 1),
    ]  # fmt: skip
    default = make_trials(FusionOptions(), range(3))
    assert len(default) == 6 * 3 * 3
    assert {t.place for t in default}.isdisjoint(TUNING_PLACES)
    noise = make_trials(FleetPoseNoiseOptions(), range(3))
    assert sorted({t.fleet_config.pose_sigma_m for t in noise}) == [0.0, 0.4, 0.8, 1.2, 1.5]
    assert noise[-1].fleet_config.yaw_sigma_rad == pytest.approx(math.radians(1.5))
    table3 = make_trials(MapFusionStudyOptions(), range(3))
    assert {(t.size_m, t.view_label) for t in table3} == {
        (s, w) for s in (300.0, 250.0) for w in ("local", "semi-global")
    }


def test_places_of_another_shape_have_tables_of_their_own() -> None:
    def name(place: str) -> str:
        return group_name("fusion", replace(make_result("union", 20, 0, 0.5, 0.5), place=place))

    assert name("Town03") == "20 observations"
    assert name("roundabout") == name("merge") == "20 observations, other shapes"


def test_our_row_with_two_agents_is_no_baseline() -> None:
    results = [make_result(TWO_AGENTS, 20, 0, 0.9, 0.9), make_result("union", 20, 0, 0.5, 0.5)]
    assert find_best_baseline(results, (OURS, TWO_AGENTS, "union"), "divider", "exact", "narrow") == "union"
    assert find_best_baseline(results, (OURS, TWO_AGENTS), "divider", "exact", "narrow") is None


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
    store = CellStore(tmp_path)
    job = FleetJob(experiment.trial, ("union", "oracle-cuts"), MethodSettings(), store)
    monkeypatch.setattr(fleet_cells, "run_trial", lambda trial: experiment)
    made = job()
    assert len(list(tmp_path.iterdir())) == 2
    monkeypatch.setattr(fleet_cells, "run_trial", lambda trial: pytest.fail("made again"))
    assert str(job()) == str(made)
    cell = make_cell(job.trial, "union", job.settings)
    path = store.path(cell)
    path.write_bytes(path.read_bytes()[:-40])
    assert store.load(cell) is None
    config = apply_changes(make_default_config("union"), (("rules.min_score", 0.5),))
    other = MethodSettings((("union", config),))
    assert store.path(make_cell(job.trial, "union", other)) != path
    cuts = [store.path(make_cell(job.trial, "oracle-cuts", settings)) for settings in (other, job.settings)]
    assert cuts[0] == cuts[1]


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
    trials = make_attacks(("cross",), (0,), (1.0, 4.0))
    assert {(t.fleet_config.attack_mode, t.fleet_config.malicious_offset_m) for t in trials} == {
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

    monkeypatch.setattr(adversarial, "run_trial", carried_out)
    monkeypatch.setattr(adversarial, "fuse_observations", furthest)
    adversarial._fuse_without_attack.cache_clear()
    trials, store = make_attacks(("cross",), (0,), (1.0, 4.0)), CellStore(tmp_path)
    found = [AdversarialJob(trial, MethodSettings(), store)() for trial in trials]
    adversarial._fuse_without_attack.cache_clear()
    assert [
        (m.num_malicious, m.num_stations, m.num_displaced, m.num_lost, m.num_displaced_without_attack) for m in found
    ] == 2 * [
        (1, 2, 2, 0, 2),
        (1, 2, 2, 2, 2),
    ]
    assert found[0].max_m == pytest.approx(1.15) and math.isnan(found[1].max_m)
    assert len(fused_inputs) == 6, "honest observations are fused once, and the truth of all once"
    again = [AdversarialJob(trial, MethodSettings(), store)() for trial in trials]
    assert repr(again) == repr(found) and len(fused_inputs) == 6, "a study that was stopped goes on"


def test_displaced_stations_add_up_over_places_and_seeds_by_attack() -> None:
    def make(place: str, attack: str, displaced: int) -> adversarial.AdversarialResult:
        return adversarial.AdversarialResult(place, 0, attack, 2.0, 10, 2, 1000, displaced, 1, 30, 0.1, 0.2)

    results = [make("a", "independent", 5), make("b", "independent", 700), make("a", "colluding", 9)]
    assert make_summary_table(results).lines == (
        ("independent", "2", "2,000", "705", "60", "2", "700"),
        ("colluding", "2", "1,000", "9", "30", "1", "9"),
    )


def test_every_method_is_searched_over_its_own_fields_defaults_first() -> None:
    assert set(SEARCH_SPACE) == set(list_tuned_methods()) == set(list_map_fusions()) - {*VARIANTS}
    for method in list_tuned_methods():
        assert sample_changes(method, 0) == ()
        config = make_default_config(method)
        draws = [apply_changes(config, sample_changes(method, k)) for k in range(6)]
        assert draws[0] == config and len({repr(d) for d in draws}) > 3
        assert {name for name, _ in sample_changes(method, 1)} == set(SEARCH_SPACE[method]), "a choice names no field"
    changed = apply_changes(MapFusionConfig(), (("stations.evidence.min_publish_prob", 0.9),))
    assert changed.stations.evidence.min_publish_prob == 0.9 and changed.pose_solver == MapFusionConfig().pose_solver
    assert make_tuned_settings().config_of(OURS) == MapFusionConfig(), "a study publishes what the product publishes"
    assert make_tuned_settings().config_of("polymerge").min_fraction == 0.3 and make_tuned_settings().config_of(
        "union"
    ) == make_default_config("union")
    for method, changes in TUNED_CHANGES.items():
        assert all(value in SEARCH_SPACE[method][name] for name, value in changes), "tuning never drew this"


def test_a_study_writes_its_tables_and_goes_on(experiment, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(fleet_cells, "run_trial", lambda trial: replace(experiment, trial=trial))
    options = FusionOptions(
        places=("cross",), observation_counts=(12,), seeds=2, methods=(OURS, "union"), workers=1, out=tmp_path
    )
    run(options, StudyContext("fusion", options, Console(quiet=True)))
    held = json.loads((tmp_path / "fusion.json").read_text())["result"]
    assert [(r["method"], r["seed"]) for r in held["results"]] == [(OURS, 0), ("union", 0), (OURS, 1), ("union", 1)]
    assert [s["method"] for s in held["summaries"]] == [OURS, "union"]
    assert {c["description"] for c in held["comparisons"]} == {
        "12 observations: manyeyes - union", "12 observations: manyeyes",
    }  # fmt: skip
    assert "## 12 observations, 2 results" in (tmp_path / "fusion.md").read_text()
    monkeypatch.setattr(fleet_cells, "run_trial", lambda trial: pytest.fail("made again"))
    run(options, StudyContext("fusion", options, Console(quiet=True)))
    assert json.loads((tmp_path / "fusion.json").read_text())["result"] == held


def test_an_unknown_method_is_refused_before_the_first_trial(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(fleet_cells, "run_trial", lambda trial: pytest.fail("a trial ran"))
    options = FusionOptions(
        places=("cross",), observation_counts=(12,), seeds=1, methods=(OURS, "guess"), workers=1, out=tmp_path
    )
    with pytest.raises(ConfigError, match="guess"):
        run(options, StudyContext("fusion", options, Console(quiet=True)))


def test_detection_of_malicious_agents_is_tabulated_and_goes_on(monkeypatch, tmp_path) -> None:
    def measure(trial: FleetTrial, _settings: MethodSettings) -> AgentErrors:
        config = trial.fleet_config
        offset = config.malicious_offset_m[0]
        return AgentErrors(
            trial.place,
            trial.seed,
            config.attack_mode,
            config.malicious_fraction,
            offset,
            (0.5, 1.5),
            (offset,),
            (0, 8),
        )

    monkeypatch.setattr(malicious_study, "measure_agent_errors", measure)
    options = MaliciousAgentsOptions(
        places=("cross",), seeds=2, fractions=(0.1, 0.4), offsets_m=(1.0, 2.0), workers=1, out=tmp_path
    )
    context = StudyContext("malicious-agents", options, Console(quiet=True))
    malicious_study.run(options, context)
    rows = json.loads((tmp_path / "malicious-agents.json").read_text())["result"]["rows"]
    assert [(r["attack"], r["fraction"], r["offset_m"], r["roc"]["area"]) for r in rows] == [
        (attack, fraction, offset, 0.5 if offset == 1.0 else 1.0)
        for fraction in (0.1, 0.4) for attack in ("independent", "colluding") for offset in (1.0, 2.0)
    ]  # fmt: skip
    assert (tmp_path / "malicious-agents.png").stat().st_size > 10_000
    monkeypatch.setattr(malicious_study, "measure_agent_errors", lambda *_: pytest.fail("computed again"))
    malicious_study.run(options, context)
