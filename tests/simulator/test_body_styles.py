# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.simulator.scene.body_styles import make_market_shape, make_styled_shape
from manyeyes.simulator.scene.vehicle_market import CLASSIC_MARKET, WORLD_MARKET
from manyeyes.simulator.scene.vehicle_shapes import TYRE, make_vehicle_shape


@pytest.mark.parametrize("style", WORLD_MARKET.styles, ids=lambda style: style.name)
def test_bodies_fill_their_box_and_no_more(style) -> None:
    for id, size in enumerate((style.low, style.high, style.low)):
        body = make_styled_shape(style.name, size, 1, id)
        low, high = (body.center - body.half).min(0), (body.center + body.half).max(0)
        assert (low >= np.array([-0.5, -0.5, 0.0]) * size - 1e-9).all()
        assert (high <= np.array([0.5, 0.5, 1.0]) * size + 1e-9).all()
        np.testing.assert_allclose((high - low)[[0, 2]], np.array(size)[[0, 2]], rtol=0.03)
        np.testing.assert_allclose((high - low)[1], size[1], rtol=0.05)
        assert (body.half > 0).all()
        assert 1 <= (body.part == TYRE).sum() <= 3
        assert ((body.reflectivity > 0) & (body.reflectivity <= 0.95)).all()


def test_the_classic_market_has_the_classic_bodies() -> None:
    one, two = (
        make_market_shape(CLASSIC_MARKET, "van", (5.5, 2.0, 2.2), 4, 9),
        make_vehicle_shape("van", (5.5, 2.0, 2.2), 4, 9),
    )
    np.testing.assert_array_equal(one.center, two.center)
    np.testing.assert_array_equal(one.reflectivity, two.reflectivity)


def test_an_unknown_style_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="No body of style 'tram'; choose one of kei"):
        make_styled_shape("tram", (4, 2, 1), 0, 0)
