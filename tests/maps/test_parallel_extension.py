# SPDX-License-Identifier: Apache-2.0
"""Stations inferred beside a neighbour, on two rows of stations 1 m apart, small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER
from manyeyes.maps.fusion.parallel_extension import extend_parallel
from manyeyes.maps.fusion.polyline_linking import link_stations


def row(a, b, y, radius=None):
    """Stations at x = a..b at a height, or at those arcs of a circle with y metres less radius."""
    x = np.arange(a, b + 0.5)
    if radius is None:
        return np.stack((x, np.full(len(x), float(y))), 1)
    return np.stack(((radius - y) * np.sin(x / radius), radius - (radius - y) * np.cos(x / radius)), 1)


def extend_rows(parts, coverage=2.0, kinds=None):
    """What is inferred for rows of stations, with the row that each inferred station continues."""
    xy = np.concatenate(parts)
    step = [np.gradient(part, axis=0) for part in parts]
    tangent = np.concatenate([s / np.hypot(*s.T)[:, None] for s in step])
    kinds = kinds or [DIVIDER] * len(parts)
    kind = np.repeat(kinds, [len(part) for part in parts]).astype(np.int64)
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    often, never = np.full(len(xy), coverage), np.zeros(len(xy), bool)
    chains = link_stations(xy, tangent, kind, np.ones(len(xy)), never, often)
    places, turned, source = extend_parallel(xy, kind, often, chains)
    assert np.abs(np.hypot(*turned.T) - 1.0).max(initial=0.0) < 1e-9
    return places, owner[source]


def test_a_hole_is_filled_beside_a_bend():
    guide, before, after = row(0.0, 100.0, 0.0, 80.0), row(0.0, 30.0, 3.5, 80.0), row(60.0, 100.0, 3.5, 80.0)
    places, source = extend_rows([guide, before, after])
    assert len(places) == pytest.approx(29, abs=2) and set(source.tolist()) <= {1, 2}
    assert np.abs(np.hypot(places[:, 0], places[:, 1] - 80.0) - 76.5).max() < 0.1
    # One end that leads to the other is enough.
    assert len(set(source.tolist())) == 1


def test_the_extension_reaches_the_continuation():
    places, _ = extend_rows([row(0.0, 100.0, 0.0), row(0.0, 30.0, 3.5), row(60.0, 100.0, 4.1)])
    order = np.argsort(places[:, 0])
    assert (np.diff(places[order, 1]) > 0).all()
    assert places[:, 1].min() == pytest.approx(3.5, abs=0.05) and places[:, 1].max() == pytest.approx(4.1, abs=0.05)


@pytest.mark.parametrize(("coverage", "found"), [(0.0, 0), (2.0, 1), (9.0, 0)])
def test_extension_requires_low_coverage(coverage, found):
    places, _ = extend_rows([row(0.0, 100.0, 0.0), row(0.0, 30.0, 3.5), row(60.0, 100.0, 3.5)], coverage)
    assert bool(len(places)) == bool(found)


def test_an_end_without_continuation_is_extended_to_the_limit():
    places, source = extend_rows([row(0.0, 150.0, 0.0), row(0.0, 30.0, 3.5)])
    assert set(source.tolist()) == {1}
    assert places[:, 0].max() == pytest.approx(70.0, abs=1.0)  # 40 m
    edge, _ = extend_rows([row(0.0, 100.0, 0.0), row(0.0, 30.0, 3.5)], kinds=[DIVIDER, BOUNDARY])
    assert not len(edge)


@pytest.mark.parametrize("guide", [row(0.0, 30.0, 0.0), row(0.0, 100.0, -4.0), row(28.0, 100.0, 0.0) * [1.0, 1.0]])
def test_nothing_is_inferred_without_a_guide(guide):
    """One that ends as well; one that is too far; one that was not beside the line before."""
    places, source = extend_rows([guide, row(0.0, 30.0, 3.5)])
    assert 1 not in source.tolist() and not len(places[source == 1])


def test_no_stations():
    nothing = np.zeros((0, 2))
    places, turned, source = extend_parallel(
        nothing, np.zeros(0, np.int64), np.zeros(0), (np.zeros(1, np.int64), np.zeros(0, np.int64))
    )
    assert len(places) == len(turned) == len(source) == 0
