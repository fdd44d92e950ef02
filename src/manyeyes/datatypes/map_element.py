# SPDX-License-Identifier: Apache-2.0
"""Elements of a map as columns: many polylines and rings in a few immutable arrays, so that a million cost no objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from manyeyes.datatypes.errors import ShapeError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

KINDS = ("divider", "boundary", "crossing", "stop_line")
DIVIDER, BOUNDARY, CROSSING, STOP_LINE = range(len(KINDS))
STYLES = ("solid", "dashed", "double", "none")
SOLID, DASHED, DOUBLE, NO_STYLE = range(len(STYLES))

DEFAULT_SIGMA_M = 0.12


def freeze(values: ArrayLike, dtype: type[np.generic]) -> NDArray:
    """Return a contiguous, read-only array of that type; the caller's own array stays writeable."""
    array = np.ascontiguousarray(values, dtype=dtype).view()
    array.flags.writeable = False
    return array


def check_offsets(name: str, offsets: Ints, total: int) -> None:
    """Raise ShapeError unless offsets (N+1,) starts at 0, never falls and ends at total."""
    if (
        offsets.ndim != 1
        or len(offsets) == 0
        or offsets[0] != 0
        or offsets[-1] != total
        or (offsets[1:] < offsets[:-1]).any()
    ):
        raise ShapeError(
            f"{name}.offsets needs offsets (N+1,) that start at 0, never fall and end at {total}; "
            f"got shape {offsets.shape} from {offsets[:1].tolist()} to {offsets[-1:].tolist()}."
        )


def take_rows(offsets: Ints, rows: Ints) -> tuple[Ints, Ints]:
    """Return the offsets of the chosen rows of a table, and the (P',) places of their entries, row by row."""
    counts = offsets[rows + 1] - offsets[rows]
    chosen = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    return chosen, np.arange(chosen[-1]) + np.repeat(offsets[rows] - chosen[:-1], counts)


@dataclass(frozen=True, eq=False)
class Polygons:
    """R open rings in one frame, ring i being ``points[offsets[i]:offsets[i + 1]]``; points: (Q, 2) metres, offsets: (R+1,)."""

    points: Floats
    offsets: Ints

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", freeze(np.reshape(self.points, (-1, 2)), np.float64))
        object.__setattr__(self, "offsets", freeze(self.offsets, np.int64))
        check_offsets("Polygons", self.offsets, len(self.points))

    @classmethod
    def of(cls, rings: Sequence[ArrayLike] = ()) -> Polygons:
        """Return rings (K, 2) as columns."""
        arrays = [np.reshape(np.asarray(ring, np.float64), (-1, 2)) for ring in rings]
        offsets = np.concatenate(([0], np.cumsum([len(a) for a in arrays], dtype=np.int64)))
        return cls(np.concatenate(arrays) if arrays else np.zeros((0, 2)), offsets)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def ring(self, i: int) -> Floats:
        """Return (K, 2) ring i."""
        return self.points[self.offsets[i] : self.offsets[i + 1]]


@dataclass(frozen=True, eq=False)
class MapElements:
    """N polylines and rings in one frame, as columns.

    kind: (N,) int64, index into KINDS. offsets: (N+1,) int64, element i being ``points[offsets[i]:offsets[i + 1]]``.
    points: (P, 2) float64 metres; a crossing is an open ring (its closing edge is implied), all others are polylines.
    score: (N,) in [0, 1]. sigma: (P,) metres, one standard deviation across the line. style: (N, S) probabilities over
    STYLES. The arrays are read-only. Coordinates are planar: x forward or east, y left or north.
    """

    kind: Ints
    offsets: Ints
    points: Floats
    score: Floats
    sigma: Floats
    style: Floats

    def __post_init__(self) -> None:
        for name, dtype in _DTYPES.items():
            object.__setattr__(self, name, freeze(getattr(self, name), dtype))
        n, p = len(self.kind), len(self.points)
        expected = {"kind": (n,), "points": (p, 2), "score": (n,), "sigma": (p,), "style": (n, len(STYLES))}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(f"MapElements.{name} needs shape {shape}; got {getattr(self, name).shape}.")
        check_offsets("MapElements", self.offsets, p)
        if len(self.offsets) != n + 1:
            raise ShapeError(f"MapElements.offsets needs shape {(n + 1,)}; got {self.offsets.shape}.")
        if n and (self.kind.min() < 0 or self.kind.max() >= len(KINDS)):
            raise ShapeError(
                f"MapElements.kind needs 0 to {len(KINDS) - 1} ({', '.join(KINDS)}); got {self.kind.max()}."
            )

    @classmethod
    def of(
        cls,
        polylines: Sequence[ArrayLike],
        kind: ArrayLike,
        score: ArrayLike = 1.0,
        sigma: ArrayLike = DEFAULT_SIGMA_M,
        style: ArrayLike = NO_STYLE,
    ) -> MapElements:
        """Return elements from lines (K, 2); kind, score and style are one for all or (N,) (style: (N, S) too), sigma one or
        (P,).
        """
        arrays = [np.reshape(np.asarray(line, np.float64), (-1, 2)) for line in polylines]
        n = len(arrays)
        offsets = np.concatenate(([0], np.cumsum([len(a) for a in arrays], dtype=np.int64)))
        styles = np.asarray(style)
        return cls(
            np.broadcast_to(np.asarray(kind, np.int64), (n,)),
            offsets,
            np.concatenate(arrays) if arrays else np.zeros((0, 2)),
            np.broadcast_to(np.asarray(score, np.float64), (n,)),
            np.broadcast_to(np.asarray(sigma, np.float64), (int(offsets[-1]),)),
            styles if styles.ndim == 2 else np.eye(len(STYLES))[np.broadcast_to(styles, (n,))],
        )

    @classmethod
    def empty(cls) -> MapElements:
        """Return an instance without elements."""
        return cls.of([], DIVIDER)

    @classmethod
    def cat(cls, many: Sequence[MapElements]) -> MapElements:
        """Return several sets of one frame as one, in order."""
        if not many:
            return cls.empty()
        starts = np.cumsum([0, *(len(m.points) for m in many)])
        columns = {
            f.name: np.concatenate([getattr(m, f.name) for m in many]) for f in fields(cls) if f.name != "offsets"
        }
        offsets = np.concatenate([m.offsets[:-1] + start for m, start in zip(many, starts)] + [starts[-1:]])
        return cls(offsets=offsets, **columns)

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def counts(self) -> Ints:
        """(N,) points of each element."""
        return self.offsets[1:] - self.offsets[:-1]

    @property
    def closed(self) -> NDArray[np.bool_]:
        """(N,) whether the last point joins the first."""
        return self.kind == CROSSING

    @property
    def element_of_point(self) -> Ints:
        """(P,) the element of each point."""
        return np.repeat(np.arange(len(self)), self.counts)

    def polyline(self, i: int) -> Floats:
        """Return (K, 2) the points of element i, a ring without its first point repeated."""
        return self.points[self.offsets[i] : self.offsets[i + 1]]

    def take(self, rows: ArrayLike) -> MapElements:
        """Return the chosen elements, by index in the order given or by a mask (N,)."""
        index = np.asarray(rows)
        index = np.flatnonzero(index) if index.dtype == np.bool_ else index.astype(np.int64)
        offsets, places = take_rows(self.offsets, index)
        return MapElements(
            self.kind[index], offsets, self.points[places], self.score[index], self.sigma[places], self.style[index]
        )

    def with_points(self, points: ArrayLike) -> MapElements:
        """Return the same elements with each point moved: (P, 2)."""
        return MapElements(self.kind, self.offsets, np.asarray(points), self.score, self.sigma, self.style)

    def transform(self, x: float, y: float, yaw: float) -> MapElements:
        """Return the same elements in the frame where this one's origin stands at x, y (m) turned by yaw (rad)."""
        c, s = np.cos(yaw), np.sin(yaw)
        px, py = self.points[:, 0], self.points[:, 1]
        return self.with_points(np.stack((c * px - s * py + x, s * px + c * py + y), 1))

    def segments(self) -> tuple[Ints, Ints, Ints]:
        """Return (S,) places in points where segments start and end, and their elements; rings have their closing segment too."""
        element_of_point = self.element_of_point
        start = np.arange(len(self.points))
        last = start + 1 == self.offsets[1:][element_of_point]
        end = np.where(last, self.offsets[:-1][element_of_point], start + 1)
        keep = ~last | (self.closed & (self.counts > 2))[element_of_point]
        return start[keep], end[keep], element_of_point[keep]

    def lengths(self) -> Floats:
        """Return (N,) metres along each element, the closing edge of a ring included."""
        start, end, element_of_segment = self.segments()
        step = np.hypot(*(self.points[end] - self.points[start]).T)
        return np.bincount(element_of_segment, step, len(self)).astype(np.float64)

    def bounds(self) -> Floats:
        """Return (N, 4) minimum x and y, maximum x and y; an element without points: inf, inf, -inf, -inf."""
        box = np.tile((np.inf, np.inf, -np.inf, -np.inf), (len(self), 1))
        some = self.counts > 0
        starts = self.offsets[:-1][some]
        if len(starts):
            box[some, :2] = np.minimum.reduceat(self.points, starts, axis=0)
            box[some, 2:] = np.maximum.reduceat(self.points, starts, axis=0)
        return box


_DTYPES: dict[str, type[np.generic]] = {
    "kind": np.int64,
    "offsets": np.int64,
    "points": np.float64,
    "score": np.float64,
    "sigma": np.float64,
    "style": np.float64,
}
