# SPDX-License-Identifier: Apache-2.0
"""The coarse search against a slow twin that spreads every point into the raster, and on shifted crossroads."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion.coarse_search import CoarseSearchConfig, search_coarse
from manyeyes.maps.fusion.observation_arrays import to_observation_arrays

P = np.diag([4.0, 4.0, 1e-4])
VIEW = np.array([[-30.0, -30.0], [30.0, -30.0], [30.0, 30.0], [-30.0, 30.0]])
CONFIG = CoarseSearchConfig()


def observe(agent, at, error=(0.0, 0.0), yaw=0.0, turned=0.0):
    """A crossroads with one bent line, observed without noise from ``at``, with a prior pose that is wrong by error and turned."""
    along = np.arange(-25.0, 25.5, 1.0)
    lines = [np.stack((along, np.full(len(along), y)), 1) for y in (-3.4, 0.0, 3.4)]
    lines += [np.stack((np.full(len(along), x), along), 1) for x in (-5.1, 1.7)]
    lines += [np.stack((along, 12.0 + 0.02 * along**2), 1)]
    c, s = np.cos(yaw), np.sin(yaw)
    local = [(line - at) @ np.array([[c, -s], [s, c]]) for line in lines]
    kinds = [BOUNDARY, DIVIDER, BOUNDARY, DIVIDER, DIVIDER, BOUNDARY]
    pose = np.array([at[0] + error[0], at[1] + error[1], yaw + turned])
    return Observation(agent, f"{agent}-1", 1_700_000_000_000_000_000, pose, P, VIEW, MapElements.of(local, kinds, 0.9))


def search(observations, config=CONFIG):
    """Poses (O, 3) after the search and the arrays."""
    arrays = to_observation_arrays(observations, 1.0)
    return search_coarse(arrays, np.ones(len(arrays.xy), bool), np.arange(len(arrays)), config), arrays


def score_slowly(arrays, o, config):
    """The mean of s / (s + 1) under the points of observation o for each shift, from the definition."""
    first, cell, reach = arrays.observation_offsets, config.cell_m, config.max_shift_m
    mine = slice(first[o], first[o + 1])
    xy, tangent, kind = arrays.xy[mine], arrays.tangent[mine], arrays.kind_of_point[mine]
    world, world_tangent = arrays.to_world(np.asarray(arrays.pose))
    owner = arrays.observation_of_point
    others = np.flatnonzero(arrays.agent[owner] != arrays.agent[o])
    x, y, yaw = np.asarray(arrays.pose)[o]
    c, s = np.cos(yaw), np.sin(yaw)
    back = np.array([[c, -s], [s, c]])
    at, turned = (world[others] - (x, y)) @ back, world_tangent[others] @ back
    low = xy.min(0) - reach - 2.0
    shape = ((xy.max(0) + reach + 2.0 - low) / cell).astype(int) + 1
    raster = np.zeros((24, *shape))
    for q, place, (u, v) in zip(others, at, turned, strict=True):
        i, j = np.floor((place - low) / cell).astype(int)
        if not (2 <= i < shape[0] - 2 and 2 <= j < shape[1] - 2):
            continue
        sector = (np.arctan2(v, u) / np.pi % 1.0) * 6.0
        here = int(sector) % 6
        beside = (here + (1 if sector - np.floor(sector) > 0.5 else 5)) % 6
        for layer in (here, beside):
            for di in range(-2, 3):
                for dj in range(-2, 3):
                    spread = 0.8 * np.exp(-0.5 * (di * di + dj * dj))
                    raster[6 * arrays.kind_of_point[q] + layer, i + di, j + dj] += spread
    radius, chosen = round(reach / cell), range(0, len(xy), config.point_stride)
    score = np.zeros((2 * radius + 1, 2 * radius + 1))
    for p in chosen:
        i, j = np.floor((xy[p] - low) / cell).astype(int)
        layer = 6 * kind[p] + int((np.arctan2(tangent[p, 1], tangent[p, 0]) / np.pi % 1.0) * 6.0) % 6
        under = raster[layer, i - radius : i + radius + 1, j - radius : j + radius + 1]
        score += under / (under + 1.0)
    return score / len(chosen)


def best_slowly(arrays, o, config):
    """The shift of the best score, as the search defines it."""
    score = score_slowly(arrays, o, config)
    radius = len(score) // 2
    i, j = np.mgrid[-radius : radius + 1, -radius : radius + 1] * config.cell_m
    value = score - config.cost_per_m * np.hypot(i, j)
    best = np.unravel_index(value.argmax(), value.shape)
    shift = np.array([i[best], j[best]])
    gains = value[best] > score[radius, radius] + config.min_score_gain and np.hypot(*shift) > config.min_shift_m
    return shift if gains else np.zeros(2)


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.5])
def test_the_shift_is_the_best_of_the_definition(yaw):
    errors = [(0.0, 0.0), (0.1, -0.1), (2.6, 1.4), (-1.9, 3.2)]
    observations = [observe(f"a{k}", (0.3 * k, -0.4 * k), error, yaw * (k == 2)) for k, error in enumerate(errors)]
    found, arrays = search(observations)
    start = np.asarray(arrays.pose)
    for o in range(len(arrays)):
        c, s = np.cos(start[o, 2]), np.sin(start[o, 2])
        local = (found[o, :2] - start[o, :2]) @ np.array([[c, -s], [s, c]])
        np.testing.assert_allclose(local, best_slowly(arrays, o, CONFIG), atol=1e-9)
    moved = np.hypot(*(found - start)[:, :2].T)
    assert (moved > 1.2).sum() == 2  # both wrong poses, and none of the right ones


def test_a_wrong_position_is_found_within_a_cell_and_a_wrong_heading_among_those_tried():
    near = [observe(f"b{k}", (0.2 * k, 0.1 * k)) for k in range(3)]
    found, arrays = search([*near, observe("c", (0.0, 0.0), (-2.1, 3.3))])
    row = int(np.flatnonzero(arrays.agent == arrays.agents.index("c"))[0])
    assert np.abs(found[row, :2]).max() < 0.5
    # A heading that is wrong by five degrees: the pose is turned back, about the middle of its points.
    turns = (0.0, float(np.radians(-5.0)), float(np.radians(5.0)))
    tilted = observe("c", (0.0, 0.0), (2.0, -1.5), turned=float(np.radians(5.0)))
    found, arrays = search([*near, tilted], CoarseSearchConfig(yaw_steps_rad=turns))
    row = int(np.flatnonzero(arrays.agent == arrays.agents.index("c"))[0])
    assert abs(found[row, 2]) < 1e-9
    assert np.abs(found[row, :2]).max() < 0.5
