# SPDX-License-Identifier: Apache-2.0
"""Tokens of other agents and instants in the ego's frame, and the cells that tokens propose, in compiled loops.

For inference on the CPU: a few thousand tokens are little work for each of the sixty tensor operations of ``transform_tokens`` and
``token_merge``, which hold the references.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import F32x1, F32x2, F64x1, F64x2, I64x1, njit, set_row


class ProposalColumns(NamedTuple):
    """First columns of the quantities of a proposal that a motion changes; speed_unit: m/s of one unit of velocity."""

    heat: int
    offset: int
    z: int
    axis: int
    direction: int
    velocity: int
    speed_unit: float


class GridCells(NamedTuple):
    """A grid's range, metres, its pillar and stride, and its rows and columns."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float
    pillar: float
    stride: int
    rows: int
    columns: int


class MovedTokens(NamedTuple):
    """What tokens become: features (N, C), places (N, 2), pose contexts (N, 5), proposals (N, P), and their rows (N,) before."""

    features: F32x2
    xy: F32x2
    pose_context: F32x2
    proposal: F32x2
    row: I64x1


@njit(cache=True, nogil=True)
def move_tokens(
    tokens: F32x2,
    xy: F32x2,
    sizes: I64x1,
    links: F64x2,
    max_speed_mps: float,
    columns: ProposalColumns,
    grid: GridCells,
    out: MovedTokens,
) -> int:  # pragma: no cover
    """Move the tokens of parts of these sizes to their egos' frames, without those out of range; returns how many are left.

    links: (parts, 20), see ``transform_tokens._describe_links``. max_speed_mps: faster tokens are not propagated.
    """
    at, end = 0, 0
    for part in range(sizes.shape[0]):
        start, end, link = end, end + sizes[part], links[part]
        for i in range(start, end):
            kept = True
            if link[0] > 0:
                _copy_token(tokens[i], xy[i], out, at)
            else:
                kept = _move_token(tokens[i], xy[i], link, np.float32(max_speed_mps), columns, grid, out, at)
            if kept:
                out.row[at] = i
                at += 1
    return at


@njit(cache=True, nogil=True)
def _copy_token(token: F32x1, xy: F32x1, out: MovedTokens, at: int) -> None:  # pragma: no cover
    """Write one of the ego's own current tokens to row at."""
    channels = out.features.shape[1]
    set_row(out.features[at], token)
    set_row(out.proposal[at], token[channels:])
    set_row(out.xy[at], xy)
    out.pose_context[at] = np.float32(0)


@njit(cache=True, nogil=True)
def _move_token(
    token: F32x1,
    xy: F32x1,
    link: F64x1,
    max_speed_mps: np.float32,
    columns: ProposalColumns,
    grid: GridCells,
    out: MovedTokens,
    at: int,
) -> bool:  # pragma: no cover
    """Write one token to row at; return whether it is in range."""
    channels, quarter = out.features.shape[1], out.features.shape[1] // 4
    stated, unit = token[channels:], np.float32(columns.speed_unit)
    x, y, age = xy[0], xy[1], np.float32(link[2])
    vx, vy = stated[columns.velocity] * unit, stated[columns.velocity + 1] * unit
    if np.sqrt(vx * vx + vy * vy) <= max_speed_mps:
        x, y = x + vx * age, y + vy * age
    px, py = np.float64(x), np.float64(y)
    place = out.xy[at]
    place[0], place[1] = link[8] * px + link[9] * py + link[17], link[11] * px + link[12] * py + link[18]
    if not (place[0] >= np.float32(grid.x_min) and place[0] < np.float32(grid.x_max)):
        return False
    if not (place[1] >= np.float32(grid.y_min) and place[1] < np.float32(grid.y_max)):
        return False
    height = np.float32(link[14] * px + link[15] * py + link[19])
    context, spread = out.pose_context[at], link[4] * np.sqrt(px * px + py * py)
    context[0], context[1], context[2] = height, link[5], link[7]
    context[3], context[4] = np.sqrt(link[3] * link[3] + spread * spread), link[2] / 0.1
    s, c, feature, moved = np.float32(link[5]), np.float32(link[6]), out.features[at], out.proposal[at]
    # Unsigned places: a signed one might count from the end, and the test for it keeps the loops from vectors.
    two, one = np.uintp(2), np.uintp(1)
    for k in range(np.uintp(quarter)):
        a, b = token[two * k], token[two * k + one]
        feature[two * k], feature[two * k + one] = a * c - b * s, a * s + b * c
    for k in range(np.uintp(2 * quarter), np.uintp(channels)):
        feature[k] = token[k]
    for k in range(np.uintp(stated.shape[0])):
        moved[k] = stated[k]
    moved[columns.z] += height
    for k in (columns.offset, columns.direction, columns.velocity):
        moved[k], moved[k + 1] = stated[k] * c - stated[k + 1] * s, stated[k] * s + stated[k + 1] * c
    k, cc, cs = columns.axis, c * c - s * s, np.float32(2) * c * s
    moved[k], moved[k + 1] = stated[k] * cc - stated[k + 1] * cs, stated[k] * cs + stated[k + 1] * cc
    return True


@njit(cache=True, nogil=True)
def assign(
    xy: F32x2,
    proposal: F32x2,
    ego: I64x1,
    columns: ProposalColumns,
    votes: tuple[float, float],
    grid: GridCells,
    key: I64x1,
    cell_offset: F32x2,
) -> None:  # pragma: no cover
    """Fill key (N,) and cell_offset (N, 2) of ``token_merge.assign_cells``.

    votes: minimum logit and maximum offset, in cells, with which a token moves to its proposed centre.
    """
    cell = np.float32(grid.stride * grid.pillar)
    low_x, low_y = np.float32(grid.x_min), np.float32(grid.y_min)
    high_x, high_y = np.float32(grid.x_max), np.float32(grid.y_max)
    for i in range(xy.shape[0]):
        stated = proposal[i]
        dx, dy = stated[columns.offset], stated[columns.offset + 1]
        x, y = xy[i, 0], xy[i, 1]
        if stated[columns.heat] > votes[0] and max(abs(dx), abs(dy)) <= votes[1]:
            gx, gy = x + dx * cell, y + dy * cell
            if gx >= low_x and gx < high_x and gy >= low_y and gy < high_y:
                x, y = gx, gy
        column = np.floor(((np.float64(x) - grid.x_min) / grid.pillar - 0.5) / grid.stride + 0.5)
        row = np.floor(((np.float64(y) - grid.y_min) / grid.pillar - 0.5) / grid.stride + 0.5)
        column, row = min(max(column, 0.0), grid.columns - 1.0), min(max(row, 0.0), grid.rows - 1.0)
        key[i] = (ego[i] * grid.rows + np.int64(row)) * grid.columns + np.int64(column)
        middle_x = np.float32(grid.x_min + (column * grid.stride + 0.5) * grid.pillar)
        middle_y = np.float32(grid.y_min + (row * grid.stride + 0.5) * grid.pillar)
        cell_offset[i, 0], cell_offset[i, 1] = (xy[i, 0] - middle_x) / cell, (xy[i, 1] - middle_y) / cell
