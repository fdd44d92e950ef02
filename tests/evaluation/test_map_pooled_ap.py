# SPDX-License-Identifier: Apache-2.0
"""Many maps evaluated as one list: the numbers are those of ``metrics``, intervals are over blocks, differences are paired."""

import math

import numpy as np
import pytest

from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps.metrics import evaluate_map
from manyeyes.evaluation.maps.pooled_ap import (
    MapPair,
    assign_to_scenario,
    assign_to_squares,
    average_samples,
    bootstrap_pooled_ap,
    bootstrap_pooled_mean_ap,
    collect_blocks,
)
from manyeyes.evaluation.maps.tiles import place_side_by_side
from manyeyes.evaluation.statistics.bootstrap import draw_resamples

RING = np.array([[0.0, 5.0], [4.0, 5.0], [4.0, 8.0], [0.0, 8.0]])


def rough(seed: int) -> tuple[MapElements, MapElements]:
    """Seven true lines and a crossing; the map errs by some decimetres, misses two lines and invents one."""
    draw = np.random.default_rng(seed)
    lines = [np.array([[0.0, 12.0 * k], [25.0, 12.0 * k + 1]]) for k in range(-6, 1)]
    truth = MapElements.of([*lines, RING], [DIVIDER] * 7 + [CROSSING])
    drawn = [line + draw.normal(0, 0.5, 2) for line in lines[:5]] + [
        lines[6] + [0.0, 5.0],
        RING + draw.normal(0, 0.4, 2),
    ]
    return MapElements.of(drawn, [DIVIDER] * 6 + [CROSSING], draw.uniform(0, 1, 7).round(1)), truth


@pytest.mark.parametrize("way", ["maptr", "exact"])
def test_the_value_is_that_of_all_maps_side_by_side(way) -> None:
    pairs = [rough(seed) for seed in range(4)]
    evaluated = [MapPair(mine, truth, assign_to_scenario(str(k))) for k, (mine, truth) in enumerate(pairs)]
    whole = evaluate_map(place_side_by_side([p[0] for p in pairs]), place_side_by_side([p[1] for p in pairs]))
    for kind in ("divider", "crossing"):
        assert bootstrap_pooled_ap(evaluated, kind, way, num_resamples=5).value == pytest.approx(
            whole.get_ap(kind, way), abs=1e-12
        )
    assert (
        0
        < bootstrap_pooled_mean_ap(evaluated, way, num_resamples=5).value
        == pytest.approx(whole.mean_ap(way), abs=1e-12)
    )
    assert 0.1 < whole.get_ap("divider", way) < 0.9


def test_a_draw_is_the_ap_of_the_maps_that_it_holds_as_often_as_it_holds_them() -> None:
    evaluated = [MapPair(*rough(seed), assign_to_scenario(f"{seed}")) for seed in range(3)]
    drawn, weights = bootstrap_pooled_ap(evaluated, "divider", num_resamples=8, seed=3), draw_resamples(3, 8, 3)
    for value, weight in zip(drawn.samples, weights):
        held = [evaluated[k] for k in range(3) for _ in range(weight[k])]
        again = [MapPair(one.predicted, one.truth, assign_to_scenario(f"{k}")) for k, one in enumerate(held)]
        # Copies tie in score with their originals, and a copy may stand before or behind: hence not exactly equal.
        assert value == pytest.approx(bootstrap_pooled_ap(again, "divider", num_resamples=0).value, abs=0.02)


def test_seeds_of_one_scenario_are_drawn_together() -> None:
    """Scenario a is drawn right at both seeds, b wrong at both: with two blocks a draw has AP 0, .5 or 1; with four more."""
    truth = MapElements.of([[[0.0, 0.0], [20.0, 0.0]]], DIVIDER)
    wrong = truth.with_points(truth.points + [0.0, 9.0])
    evaluated = [
        MapPair(drawn, truth, assign_to_scenario(name))
        for name, drawn in (("a", truth), ("b", wrong))
        for _ in range(2)
    ]
    got = bootstrap_pooled_ap(evaluated, "divider", num_resamples=200)
    # Equal scores: a's and b's are ranked by place, b's nine metres above come last.
    assert set(np.unique(got.samples)) == {0.0, 0.5, 1.0} and got.names == ("a/0/0", "b/0/0")


def test_a_hit_is_never_without_its_truth() -> None:
    """The drawn line's middle lies in the next square: it counts where the truth is."""
    truth = MapElements.of([[[50.0, 5.0], [77.0, 5.0]], [[150.0, 5.0], [170.0, 5.0]]], DIVIDER)
    drawn = MapElements.of([[[51.0, 5.0], [78.0, 5.0]]], DIVIDER)
    evaluated = [MapPair(drawn, truth, assign_to_squares("town", 64.0))]
    got = bootstrap_pooled_ap(evaluated, "divider", "exact", num_resamples=300)
    assert collect_blocks([evaluated]) == [("town", 0, 0), ("town", 1, 0), ("town", 2, 0)]
    assert np.nanmax(got.samples) == 1.0 and np.isnan(got.samples).any(), "a draw without truth has no number"


def test_differences_are_paired_and_equal_maps_do_not_differ() -> None:
    evaluated = [MapPair(*rough(seed), assign_to_scenario(f"{seed}")) for seed in range(6)]
    worse = [MapPair(one.predicted.take(np.arange(4)), one.truth, one.assign_blocks) for one in evaluated]
    known = collect_blocks([evaluated, worse])
    all_of_it, less = (
        bootstrap_pooled_mean_ap(side, all_blocks=known, num_resamples=300) for side in (evaluated, worse)
    )
    nothing = all_of_it.paired_difference(all_of_it)
    assert (nothing.value, nothing.low, nothing.high) == (0.0, 0.0, 0.0)
    gain = all_of_it.paired_difference(less)
    assert gain.low > 0 and gain.high - gain.low < all_of_it.interval().high - less.interval().low


def test_a_mean_is_over_kinds_with_ground_truth() -> None:
    evaluated = [MapPair(*rough(0), assign_to_scenario("a")), MapPair(*rough(1), assign_to_scenario("b"))]
    both = average_samples(
        [
            bootstrap_pooled_ap(evaluated, "divider", num_resamples=5),
            bootstrap_pooled_ap(evaluated, "stop_line", num_resamples=5),
        ]
    )
    assert (
        both.value == bootstrap_pooled_ap(evaluated, "divider", num_resamples=5).value
        and not np.isnan(both.samples).any()
    )
    assert math.isnan(average_samples([bootstrap_pooled_ap(evaluated, "stop_line", num_resamples=5)]).value)
    nothing = MapPair(MapElements.empty(), evaluated[0].truth, assign_to_scenario("a"))
    assert bootstrap_pooled_ap([nothing], "divider", num_resamples=5).value == 0.0
