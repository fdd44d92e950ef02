# SPDX-License-Identifier: Apache-2.0
"""A map that takes in one observation at a time: against the fold, and at what cost."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.vector_map import PUBLISHED, VectorMap
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.incremental import IncrementalConfig, IncrementalMap, compute_map_fscore
from manyeyes.maps.registry import make_two_agents_config

VIEW = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
SIDES = ((BOUNDARY, -5.25), (DIVIDER, -1.75), (DIVIDER, 1.75), (BOUNDARY, 5.25))
RING = np.array([[20.0, -5.0], [24.0, -5.0], [24.0, 5.0], [20.0, 5.0]])


def make_observation(x, number, error=0.0, crossing=True, low=0.0, high=120.0):
    """A road along x from low to high, seen from (x, 0), without noise of points; the prior pose has a lateral error."""
    along = np.arange(max(low, x - 30.0), min(high, x + 30.0) + 0.1, 2.0)
    lines = [np.stack((along - x, np.full(len(along), y)), 1) for _, y in SIDES]
    kinds = [kind for kind, _ in SIDES]
    if crossing and abs(x - 22.0) < 27.0:
        lines.append(RING - (x, 0.0))
        kinds.append(CROSSING)
    return Observation(
        agent=f"agent{number}",
        pass_id=f"pass{number}",
        time_ns=1_700_000_000_000_000_000 + number * 3_600_000_000_000,
        pose=np.array([x, error, 0.0]),
        covariance=np.diag([0.16, 0.16, 1e-4]),
        view=VIEW,
        elements=MapElements.of(lines, kinds, 0.9),
    )


def make_observations(count=8, sigma=0.3):
    rng = np.random.default_rng(4)
    return [make_observation(30.0 + 5.0 * k, k, rng.normal(0.0, sigma)) for k in range(count)]


def test_the_incremental_map_equals_the_batch_map():
    observations = make_observations()
    fold = fuse(observations)
    live = IncrementalMap(fuse(observations[:4]))
    done = [live.update(o) for o in observations[4:]]
    fused = live.build_map()
    assert compute_map_fscore(fused, fold) > 0.95
    assert sorted(fused.select_published().elements.kind) == sorted(fold.select_published().elements.kind)
    assert done[0].num_confirmed > 100 and done[0].num_created > 0
    last = {o.id for o in observations}
    assert {row.tobytes().hex() for row in fused.observations} == last


def test_a_map_is_built_from_an_empty_one():
    live = IncrementalMap(VectorMap.empty())
    for o in make_observations(3, 0.0):
        live.update(o)
    fused = live.build_map().select_published()
    assert len(fused) == 5 and compute_map_fscore(fused, fuse(make_observations(3, 0.0))) > 0.95


def test_one_observation_of_a_trusted_unit_is_published_at_once():
    config = IncrementalConfig(fusion=make_two_agents_config())
    for trusted, published in ((True, 5), (False, 0)):
        live = IncrementalMap(VectorMap.empty(), config=config)
        live.update(replace(make_observations(1)[0], trusted=trusted))
        assert len(live.build_map().select_published()) == published


@pytest.mark.parametrize(("score", "published"), [(0.9, 5), (0.6, 1), (0.45, 0)])
def test_one_observation_publishes_what_its_scores_make_probable(score, published):
    """The calibrated probability reaches 0.7 at log-odds of 1.24 for lines in one view and 0.47 for the crossing."""
    first = make_observations(1)[0]
    first = replace(first, elements=replace(first.elements, score=np.full(len(first.elements), score)))
    live = IncrementalMap(VectorMap.empty())
    live.update(first)
    assert len(live.build_map().select_published()) == len(fuse([first]).select_published()) == published


def test_an_observation_counts_once():
    observations = make_observations(5)
    live = IncrementalMap(fuse(observations))
    before = live.build_map().quantised_hash()
    again = live.update(observations[2])
    assert (again.num_confirmed, again.num_missed, again.num_created) == (0, 0, 0)
    assert live.build_map().quantised_hash() == before


def test_a_pose_is_corrected_against_the_map():
    live = IncrementalMap(fuse([replace(make_observation(30.0, k), trusted=True) for k in range(3)]))
    for error in (0.6, -0.9, 3.0):
        assert abs(live.update(make_observation(32.0, 10 + round(error * 10), error)).pose[1]) < 0.1


def test_removed_elements_retire_and_new_ones_are_published():
    live = IncrementalMap(fuse([make_observation(30.0, k, high=40.0) for k in range(6)]))
    for k in range(9):
        live.update(make_observation(30.0, 10 + k, crossing=False))
    fused = live.build_map().select_published()
    assert CROSSING not in fused.elements.kind.tolist()
    assert abs(fused.elements.lengths() - 60.0).max() < 2.0


def test_drift_of_a_map_from_itself_and_from_another_street():
    one = fuse(make_observations(4))
    away = VectorMap.of(one.elements.transform(0.0, 30.0, 0.0))
    assert compute_map_fscore(one, one) == 1.0 and compute_map_fscore(one, away) == 0.0


@pytest.mark.parametrize("elements", [400, 8000])
def test_cost_does_not_grow_with_the_map(elements):
    base = [make_observation(30.0, k) for k in range(2)]
    one = fuse(base).elements.take(np.arange(4))
    copies = [one.transform(0.0, 60.0 * k, 0.0) for k in range(elements // 4)]
    city = VectorMap.of(MapElements.cat(copies))
    assert (city.state == PUBLISHED).all()
    small, large = IncrementalMap(VectorMap.of(one)), IncrementalMap(city)
    spent = {id(small): [], id(large): []}
    for k in range(12):
        for live in (small, large):
            begin = time.perf_counter()
            live.update(make_observation(30.0, 50 + k))
            spent[id(live)].append(time.perf_counter() - begin)
    assert min(spent[id(large)]) < 5.0 * min(spent[id(small)])
