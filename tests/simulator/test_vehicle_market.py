# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.datatypes import VEHICLE_LABELS, ConfigError
from manyeyes.simulator.scene.vehicle_market import (
    CLASSIC_MARKET,
    WORLD_MARKET,
    BodyStyle,
    VehicleMarket,
    draw_vehicles,
)


def test_lengths_reach_from_kei_cars_to_articulated_buses() -> None:
    kind, size = draw_vehicles(np.random.default_rng(0), 4000, WORLD_MARKET)
    assert size[:, 0].min() < 3.45
    assert size[:, 0].max() > 17.5
    assert 0.7 < (kind == 0).mean() < 0.85
    assert set(kind.tolist()) == set(range(len(VEHICLE_LABELS)))
    for k, s in zip(kind[:200], size[:200]):
        style = WORLD_MARKET.style_of(VEHICLE_LABELS[k], tuple(s), 0, 1)
        assert style in {s.name for s in WORLD_MARKET.styles if s.label == VEHICLE_LABELS[k]}


def test_marked_spaces_hold_no_more_than_they_are_long() -> None:
    for market in (CLASSIC_MARKET, WORLD_MARKET):
        kind, size = draw_vehicles(np.random.default_rng(0), 500, market, "parked", 5.2)
        assert size[:, 0].max() <= 5.2
        assert (kind != VEHICLE_LABELS.index("truck")).all()


def test_the_style_belongs_to_the_vehicle() -> None:
    size = (4.45, 1.8, 1.5)
    styles = [WORLD_MARKET.style_of("car", size, 3, id) for id in range(60)]
    assert styles == [WORLD_MARKET.style_of("car", size, 3, id) for id in range(60)]
    assert {"sedan", "estate"} <= set(styles)
    with pytest.raises(ConfigError, match="No style of market 'world' for a car"):
        WORLD_MARKET.style_of("car", (30.0, 2.0, 1.5), 0, 0)


def test_fractions_add_up_and_labels_are_known() -> None:
    with pytest.raises(ConfigError, match="add up to 1"):
        VehicleMarket("half", (BodyStyle("car", "car", 0.5, 1.0, (3, 1, 1), (4, 2, 2)),))
    with pytest.raises(ConfigError, match="label in"):
        BodyStyle("tram", "tram", 1.0, 1.0, (3, 1, 1), (4, 2, 2))
