# SPDX-License-Identifier: Apache-2.0
"""The error that looks of one drive share, against the mode of the whole model solved at once."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.maps.fusion.drive_bias import drive_error

P = np.diag([0.16, 0.16, 0.0001])
FAR = 1e6  # sigmas: the prior never lets go


def told(information, correction):
    """heard and urge of looks whom lines tell corrections (O, 3) with information (O, 3, 3)."""
    return np.array(information), np.einsum("oij,oj->oi", np.array(information), np.array(correction))


def whole_model(heard, urge, alike):
    """The slow twin: the mode of b and all e_i together, from sum (d - b - e)' L (d - b - e) + e' P_own^-1 e + b' P_all^-1 b."""
    count = len(heard)
    normal, right = np.zeros((3 * count + 3, 3 * count + 3)), np.zeros(3 * count + 3)
    normal[:3, :3] = np.linalg.inv(alike * P)
    for k in range(count):
        rows = slice(3 * k + 3, 3 * k + 6)
        normal[:3, :3] += heard[k]
        normal[:3, rows] += heard[k]
        normal[rows, :3] += heard[k]
        normal[rows, rows] += heard[k] + np.linalg.inv((1 - alike) * P)
        right[:3] += urge[k]
        right[rows] += urge[k]
    return np.linalg.solve(normal, right)[:3]


@pytest.mark.parametrize("alike", [0.2, 0.5, 0.8])
def test_it_is_the_mode_of_the_whole_model_also_where_lines_tell_one_direction_only(alike):
    rng = np.random.default_rng(1)
    roots = rng.normal(0.0, 2.0, (4, 3, 3))
    roots[1, 1:] = 0.0  # only one direction
    roots[2] = 0.0  # nothing
    heard, urge = told(roots.transpose(0, 2, 1) @ roots, rng.normal(0.0, 0.3, (4, 3)))
    found = drive_error(heard, urge, np.tile(P, (4, 1, 1)), np.zeros(4, np.int64), alike, FAR)
    assert found == pytest.approx(np.tile(whole_model(heard, urge, alike), (4, 1)), abs=1e-9)


def test_a_look_that_no_line_tells_anything_is_off_as_its_drive_is_and_other_drives_are_not():
    heard, urge = told([1e4 * np.eye(3)] * 3 + [np.zeros((3, 3))] * 2, [(0.6, 0.0, 0.01)] * 3 + [(0.0, 0.0, 0.0)] * 2)
    found = drive_error(heard, urge, np.tile(P, (5, 1, 1)), np.array([0, 0, 0, 0, 1]), 0.5, FAR)
    # Three looks told whole: 3 / (3 + 1) of their mean, since own and common error are of one size.
    assert found[:4, :2] == pytest.approx(np.tile((0.45, 0.0), (4, 1)), abs=1e-2)
    assert found[4] == pytest.approx(np.zeros(3))


def test_a_drive_that_is_far_off_is_believed_to_be():
    heard, urge = told([1e4 * np.eye(3)], [(3.0, 0.0, 0.0)])
    claim, drive = P[None], np.zeros(1, np.int64)
    assert drive_error(heard, urge, claim, drive, 0.5, FAR)[0, 0] == pytest.approx(1.5, abs=0.01)
    assert drive_error(heard, urge, claim, drive, 0.5, 3.0)[0, 0] > 2.8
    assert len(drive_error(heard[:0], urge[:0], claim[:0], drive[:0], 0.5, 3.0)) == 0
