# SPDX-License-Identifier: Apache-2.0
"""Coherent point drift: a known motion is found, with pycpd as a reference, and cases where the published method diverges."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from manyeyes.maps.baselines.cpd import CpdConfig, register

FAR = np.array([452_000.0, 4_403_000.0])


def bend(n: int = 30) -> np.ndarray:
    x = np.linspace(0, 25, n)
    return np.stack((x, 4 * np.sin(x / 6)), 1)


def moved(points: np.ndarray, angle: float, shift: tuple[float, float], scale: float = 1.0) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return scale * points @ np.array([[c, s], [-s, c]]) + shift


@pytest.mark.parametrize("origin", [np.zeros(2), FAR])
@pytest.mark.parametrize(("scaled", "scale"), [(False, 1.0), (True, 1.1)])
def test_a_known_motion_is_found(origin: np.ndarray, scaled: bool, scale: float) -> None:
    target = moved(bend(), 0.05, (0.6, -0.4), scale) + origin
    drift = register(target, bend() + origin, CpdConfig(estimate_scale=scaled, tolerance=1e-12, max_iterations=500))
    assert np.abs(drift.apply(bend() + origin) - target).max() < 1e-3
    assert drift.scale == pytest.approx(scale, abs=1e-4)


def test_pycpd_finds_the_same_similarity() -> None:
    pycpd = pytest.importorskip("pycpd", reason="pycpd, the oracle, is not installed")
    rng = np.random.default_rng(0)
    target = moved(bend(), 0.1, (0.5, 0.8), 1.05) + rng.normal(0, 0.05, (30, 2))
    for w in (0.0, 0.3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reference, (scale, _, _) = pycpd.RigidRegistration(
                X=target, Y=bend(), w=w, tolerance=1e-9, max_iterations=400
            ).register()
        drift = register(
            target, bend(), CpdConfig(estimate_scale=True, outlier_fraction=w, tolerance=1e-12, max_iterations=400)
        )
        assert drift.scale == pytest.approx(scale, abs=1e-3)
        assert np.abs(drift.apply(bend()) - reference).max() < 0.02


def test_as_published_it_slides_a_part_into_the_middle_of_the_whole_and_stretches_it() -> None:
    whole, part = bend(60), bend(60)[:20] + (0.0, 0.5)
    free = register(whole, part, CpdConfig(estimate_scale=True, tolerance=1e-9, max_iterations=300))
    held = register(
        whole, part, CpdConfig(outlier_fraction=0.3, initial_sigma_m=0.5, tolerance=1e-9, max_iterations=300)
    )
    assert free.scale > 1.5
    assert np.abs(held.apply(part) - bend(60)[:20]).max() < 0.6
    assert np.abs(free.apply(part) - bend(60)[:20]).max() > 3.0


def test_a_motion_beyond_the_clamp_is_refused() -> None:
    target = bend() + (5.0, 0.0)
    drift = register(target, bend(), CpdConfig(max_shift_m=2.0))
    assert np.array_equal(drift.apply(bend()), bend())
