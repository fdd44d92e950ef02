# SPDX-License-Identifier: Apache-2.0
"""Directions of vectors are those of the C library, whatever the processor."""

import math

import numpy as np

from manyeyes.simulator.scene.directions import direction


def test_directions_are_atan2_to_the_last_bit() -> None:
    y, x = np.random.default_rng(3).normal(size=(2, 20_000))
    assert direction(y, x).tolist() == [math.atan2(*pair) for pair in zip(y.tolist(), x.tolist())]


def test_directions_broadcast_and_keep_signs() -> None:
    out = direction([[0.0], [-0.0]], [1.0, -1.0])
    assert out.shape == (2, 2) and out.tolist() == [[0.0, math.pi], [-0.0, -math.pi]]
    assert math.copysign(1, out[1, 0]) == -1 and direction(1.0, 0.0).shape == ()
