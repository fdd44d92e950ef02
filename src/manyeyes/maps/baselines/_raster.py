# SPDX-License-Identifier: Apache-2.0
"""Pictures of maps for heatmap_buffer: drawn lines and rings, thinned masks, components, and the longest walks in a skeleton."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, Boolx2, F64x1, F64x2, I64x1, I64x2, njit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


@njit(cache=True)
def draw_lines(
    heat: F64x2, points: F64x2, offsets: I64x1, score: F64x1, origin: F64x1, cell: float, radius: float
) -> None:  # pragma: no cover - compiled
    """Add each line's score once to every cell of heat (H, W) whose middle lies within radius of it; origin: corner of cell 0,
    0.
    """
    stamp = np.full(heat.shape, -1, np.int32)
    for k in range(len(offsets) - 1):
        for p in range(offsets[k], offsets[k + 1] - 1):
            ax, ay = points[p]
            dx, dy = points[p + 1, 0] - ax, points[p + 1, 1] - ay
            squared = dx * dx + dy * dy
            i0 = max(int((min(ax, ax + dx) - radius - origin[0]) / cell), 0)
            i1 = min(int((max(ax, ax + dx) + radius - origin[0]) / cell) + 1, heat.shape[0])
            j0 = max(int((min(ay, ay + dy) - radius - origin[1]) / cell), 0)
            j1 = min(int((max(ay, ay + dy) + radius - origin[1]) / cell) + 1, heat.shape[1])
            for i in range(i0, i1):
                x = origin[0] + (i + 0.5) * cell - ax
                for j in range(j0, j1):
                    if stamp[i, j] == k:
                        continue
                    y = origin[1] + (j + 0.5) * cell - ay
                    t = 0.0 if squared == 0.0 else min(max((x * dx + y * dy) / squared, 0.0), 1.0)
                    if (x - t * dx) ** 2 + (y - t * dy) ** 2 <= radius * radius:
                        heat[i, j] += score[k]
                        stamp[i, j] = k


@njit(cache=True)
def draw_rings(
    heat: F64x2, points: F64x2, offsets: I64x1, score: F64x1, origin: F64x1, cell: float
) -> None:  # pragma: no cover - compiled
    """Add each open ring's score to every cell of heat (H, W) whose middle lies inside it."""
    for k in range(len(offsets) - 1):
        a, b = offsets[k], offsets[k + 1]
        if b - a < 3:
            continue
        x0, x1 = points[a:b, 0].min(), points[a:b, 0].max()
        y0, y1 = points[a:b, 1].min(), points[a:b, 1].max()
        for i in range(max(int((x0 - origin[0]) / cell), 0), min(int((x1 - origin[0]) / cell) + 1, heat.shape[0])):
            x = origin[0] + (i + 0.5) * cell
            for j in range(max(int((y0 - origin[1]) / cell), 0), min(int((y1 - origin[1]) / cell) + 1, heat.shape[1])):
                y = origin[1] + (j + 0.5) * cell
                inside = False
                before = b - 1
                for p in range(a, b):
                    ux, uy, vx, vy = points[before, 0], points[before, 1], points[p, 0], points[p, 1]
                    if (uy > y) != (vy > y) and x < (vx - ux) * (y - uy) / (vy - uy) + ux:
                        inside = not inside
                    before = p
                if inside:
                    heat[i, j] += score[k]


@njit(cache=True)
def _get_neighbours(mask: Boolx2, i: int, j: int) -> Boolx1:  # pragma: no cover - compiled
    """Return the eight neighbours of a cell from above on, clockwise; beyond the border is nothing."""
    out = np.zeros(8, np.bool_)
    for k in range(8):
        u = i + (-1, -1, 0, 1, 1, 1, 0, -1)[k]
        v = j + (0, 1, 1, 1, 0, -1, -1, -1)[k]
        out[k] = 0 <= u < mask.shape[0] and 0 <= v < mask.shape[1] and mask[u, v]
    return out


@njit(cache=True)
def skeletonize(mask: Boolx2) -> Boolx2:  # pragma: no cover - compiled
    """Return the skeleton of a mask (H, W) by Zhang and Suen (Communications of the ACM 27(3), 1984)."""
    out = mask.copy()
    cells = np.argwhere(mask)
    changed = True
    while changed:
        changed = False
        for half in range(2):
            gone = np.zeros(len(cells), np.bool_)
            for k in range(len(cells)):
                n = _get_neighbours(out, cells[k, 0], cells[k, 1])
                count, rises = 0, 0
                for a in range(8):
                    count += n[a]
                    rises += (not n[a]) and n[(a + 1) % 8]
                if count < 2 or count > 6 or rises != 1:
                    continue
                if half == 0:
                    gone[k] = not (n[0] and n[2] and n[4]) and not (n[2] and n[4] and n[6])
                else:
                    gone[k] = not (n[0] and n[2] and n[6]) and not (n[0] and n[4] and n[6])
            for k in range(len(cells)):
                if gone[k]:
                    out[cells[k, 0], cells[k, 1]] = False
            if gone.any():
                changed = True
                cells = cells[~gone]
    return out


@njit(cache=True)
def _flood(
    mask: Boolx2, label: I64x2, number: int, start: int, queue: I64x1, predecessor: I64x2
) -> int:  # pragma: no cover - compiled
    """Walk from start (flat place) over cells of the mask, label them, note where each came from; how many were reached."""
    height, width = mask.shape
    queue[0] = start
    label[start // width, start % width] = number
    predecessor[start // width, start % width] = -1
    done, held = 0, 1
    while done < held:
        i, j = queue[done] // width, queue[done] % width
        for k in range(8):
            # The four straight steps first: a walk over corners only where it must.
            u = i + (-1, 0, 1, 0, -1, 1, 1, -1)[k]
            v = j + (0, 1, 0, -1, 1, 1, -1, -1)[k]
            if 0 <= u < height and 0 <= v < width and mask[u, v] and label[u, v] != number:
                label[u, v] = number
                predecessor[u, v] = queue[done]
                queue[held] = u * width + v
                held += 1
        done += 1
    return held


@njit(cache=True)
def label_components(mask: Boolx2) -> I64x2:  # pragma: no cover - compiled
    """Return (H, W) the number of each cell's component from 0 on, in the order of rows; -1 outside."""
    label = np.full(mask.shape, -1, np.int64)
    predecessor = np.empty(mask.shape, np.int64)
    cells = np.argwhere(mask)
    queue = np.empty(len(cells) + 1, np.int64)
    number = 0
    for k in range(len(cells)):
        if label[cells[k, 0], cells[k, 1]] < 0:
            _flood(mask, label, number, cells[k, 0] * mask.shape[1] + cells[k, 1], queue, predecessor)
            number += 1
    return label


@njit(cache=True)
def find_longest_walks(
    skeleton: Boolx2, min_cells: int, clear_cells: int, find_all: bool
) -> tuple[I64x2, I64x1]:  # pragma: no cover - compiled
    """Return cells (K, 2) and offsets of the longest walks of at least so many cells; find_all: what a component has besides
    its longest.

    A walk found clears the cells within clear steps of it, so that spurs along it are no walks.
    """
    mask = skeleton.copy()
    height, width = skeleton.shape
    label = np.full(skeleton.shape, -1, np.int64)
    predecessor = np.empty(skeleton.shape, np.int64)
    todo = np.argwhere(mask)
    queue = np.empty(len(todo) + 1, np.int64)
    cells, offsets = np.empty((len(todo), 2), np.int64), np.zeros(len(todo) + 1, np.int64)
    number, held, walks = 0, 0, 0
    for k in range(len(todo)):
        while mask[todo[k, 0], todo[k, 1]]:
            reached = _flood(mask, label, number, todo[k, 0] * width + todo[k, 1], queue, predecessor)
            reached = _flood(mask, label, number + 1, queue[reached - 1], queue, predecessor)
            number += 2
            place, start = queue[reached - 1], held
            while place >= 0:
                cells[held, 0], cells[held, 1] = place // width, place % width
                place = predecessor[place // width, place % width]
                held += 1
            found = held - start
            if not find_all or found < min_cells:
                # Nothing longer is left in this component.
                for q in range(reached):
                    mask[queue[q] // width, queue[q] % width] = False
            for c in range(start, held):
                for u in range(max(cells[c, 0] - clear_cells, 0), min(cells[c, 0] + clear_cells + 1, height)):
                    for v in range(max(cells[c, 1] - clear_cells, 0), min(cells[c, 1] + clear_cells + 1, width)):
                        mask[u, v] = False
            if found < min_cells:
                held = start
            else:
                walks += 1
                offsets[walks] = held
    return cells[:held], offsets[: walks + 1]
