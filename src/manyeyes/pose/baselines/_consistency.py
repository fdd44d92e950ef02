# SPDX-License-Identifier: Apache-2.0
"""Associations of two agents' boxes, and which of them one rigid motion in the plane can hold at once.

Two associations (i, i') and (j, j') are consistent where the edges i to j and i' to j' agree in length, in the difference of the
headings of their ends, and in the direction of the edge against the heading of its first end; headings count modulo pi. A length
alone also admits the mirror image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from manyeyes.datatypes import ConfigError
from manyeyes.pose.landmarks import Landmarks

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class ConsistencyConfig:
    """max_boxes: at most so many per agent, those of highest score. max_size_difference_m: of length and width of one object.
    max_length_difference_m: of two edges; min_length_m: of an edge. max_turn_rad: difference of headings and directions.
    """

    max_boxes: int = 50
    max_size_difference_m: tuple[float, float] = (1.4, 0.5)
    max_length_difference_m: float = 1.5
    min_length_m: float = 2.0
    max_turn_rad: float = 0.26

    def __post_init__(self) -> None:
        limits = (*self.max_size_difference_m, self.max_length_difference_m, self.min_length_m, self.max_turn_rad)
        if self.max_boxes < 1 or min(limits) <= 0:
            raise ConfigError("ConsistencyConfig needs max_boxes >= 1 and limits above 0.")


@dataclass(frozen=True)
class ConsistencyGraph:
    """pairs: (P, 2) rows of two landmark sets. length_difference: (P, P) sparse and symmetric, of consistent pairs (m), at least
    1e-9 so that a stored entry is an edge.
    """

    pairs: Ints
    length_difference: csr_matrix


def build_consistency_graph(a: Landmarks, b: Landmarks, config: ConsistencyConfig) -> ConsistencyGraph:
    """Return the graph of all associations of boxes of alike size and one instant."""
    apart = np.abs(a.size[:, None] - b.size[None])
    is_alike = (apart < config.max_size_difference_m).all(-1) & (a.instant[:, None] == b.instant[None])
    pairs = np.argwhere(is_alike)
    i, k = pairs.T
    edges_a, edges_b = _describe_edges(a), _describe_edges(b)
    rows, columns, differences = list[Ints](), list[Ints](), list[Floats]()
    for row in range(len(pairs)):
        # Later associations only; the matrix is made symmetric below.
        later = np.arange(row + 1, len(pairs))
        of_a, of_b = (table[:, x[row], x[later]] for table, x in ((edges_a, i), (edges_b, k)))
        difference = np.abs(of_a[0] - of_b[0])
        keep = (difference < config.max_length_difference_m) & (np.minimum(of_a[0], of_b[0]) > config.min_length_m)
        later, difference = later[keep], difference[keep]
        turns = _turn_modulo_pi(of_a[1:, keep] - of_b[1:, keep])
        keep = (turns < config.max_turn_rad).all(0)
        rows.append(np.full(int(keep.sum()), row))
        columns.append(later[keep])
        differences.append(np.maximum(difference[keep], 1e-9))
    if not rows:
        return ConsistencyGraph(pairs, csr_matrix((len(pairs), len(pairs))))
    upper = csr_matrix(
        (np.concatenate(differences), (np.concatenate(rows), np.concatenate(columns))), (len(pairs), len(pairs))
    )
    return ConsistencyGraph(pairs, csr_matrix(upper + upper.T))


def _describe_edges(x: Landmarks) -> Floats:
    """Return (4, N, N): length, difference of the headings, and direction against the heading of the first and the last end."""
    delta = x.xy[None] - x.xy[:, None]
    direction = np.arctan2(delta[..., 1], delta[..., 0])
    yaw = x.yaw
    return np.stack(
        (np.hypot(*delta.transpose(2, 0, 1)), yaw[None] - yaw[:, None], direction - yaw[:, None], direction - yaw)
    )


def _turn_modulo_pi(angle: Floats) -> Floats:
    """Return the size of angles modulo pi, at most pi / 2."""
    return np.abs(np.remainder(angle + np.pi / 2, np.pi) - np.pi / 2)
