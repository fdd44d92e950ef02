# SPDX-License-Identifier: Apache-2.0
"""What one agent saw of the map, once: elements in its own frame, its prior pose, what it could see; and its file form.

The file form is documented in docs/reference/map-observations.md: Parquet, one row an observation.
"""

from __future__ import annotations

import hashlib
import math
import struct
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x2, I64x1, njit
from manyeyes.datatypes import ManyeyesError
from manyeyes.datatypes.map_element import CROSSING, MapElements, Polygons, freeze
from manyeyes.maps.elements.observation_limits import LIMITS

Floats = NDArray[np.float64]

FORMAT_VERSION = 1
# Characters of a wrong value that an error text repeats.
_MAX_SHOWN = 120
_REMEDY = "Mend it where it is made."


class ObservationError(ManyeyesError, ValueError):
    """An observation that cannot be trusted; the text names the field, what was expected and what came."""


@dataclass(frozen=True)
class MapFrame:
    """The local metric frame of a map: transverse Mercator on WGS 84 about an origin, scale 1, x east, y north, metres.

    latitude, longitude: degrees, EPSG:4326, of the point that is x = y = 0.
    """

    latitude: float = 0.0
    longitude: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.latitude) <= 90.0 and abs(self.longitude) <= 180.0):
            raise ObservationError(
                f"MapFrame needs latitude in [-90, 90] and longitude in [-180, 180] degrees; got {self.latitude}, {self.longitude}."
            )

    @property
    def proj(self) -> str:
        """The frame as a PROJ string."""
        return (
            f"+proj=tmerc +lat_0={self.latitude!r} +lon_0={self.longitude!r} +k=1 +x_0=0 +y_0=0 "
            "+datum=WGS84 +units=m +no_defs +type=crs"
        )


@dataclass(frozen=True, eq=False)
class ObservationContent:
    """Hold the fields of an observation as they are stored, unchecked, and name them by their content."""

    agent: str
    pass_id: str
    time_ns: int
    pose: Floats
    covariance: Floats
    view: Floats
    elements: MapElements
    model: str = ""
    trusted: bool = False
    occluders: Polygons = field(default_factory=Polygons.of)

    def __post_init__(self) -> None:
        for name in ("pose", "covariance", "view"):
            object.__setattr__(self, name, freeze(getattr(self, name), np.float64))

    @cached_property
    def id(self) -> str:
        """BLAKE2b-128 of the canonical bytes, in hexadecimal: equal content, equal id, on any machine."""
        return hashlib.blake2b(self.canonical_bytes(), digest_size=16).hexdigest()

    def canonical_bytes(self) -> bytes:
        """Return every field in the order of the class, numbers little-endian, lengths before contents, no negative zero."""
        e = self.elements
        out = [b"manyeyes.observation", struct.pack("<I", FORMAT_VERSION)]
        for text in (self.agent, self.pass_id, self.model):
            raw = text.encode()
            out.append(struct.pack("<I", len(raw)) + raw)
        out.append(struct.pack("<q?", self.time_ns, self.trusted))
        for array in (
            self.pose,
            self.covariance,
            self.view,
            self.occluders.points,
            e.points,
            e.score,
            e.sigma,
            e.style,
        ):
            out.append(struct.pack("<I", array.size) + (array + 0.0).astype("<f8", copy=False).tobytes())
        for array in (self.occluders.offsets, e.kind, e.offsets):
            out.append(struct.pack("<I", array.size) + array.astype("<i8", copy=False).tobytes())
        return b"".join(out)


@dataclass(frozen=True, eq=False)
class Observation(ObservationContent):
    """One agent's map elements, once; every field is checked, and lies within ``observation_limits.LIMITS``.

    agent: a pseudonym. pass_id: one drive of that agent. time_ns: nanoseconds since 1970, UTC.
    pose: (3,) x, y (m), yaw (rad) of the agent in the map's frame, the prior. covariance: (3, 3) of that pose, m and rad.
    view: (K, 2) metres, the polygon that the agent could see, an open ring in the agent's frame; occluders: what hid parts
    of it, same frame. elements: in the agent's frame. model: what made them. trusted: a surveyed pole, whose one word counts.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self)

    @classmethod
    def of_checked(cls, content: ObservationContent) -> Observation:
        """Return the observation of a content whose id is that of an observation; nothing is checked again."""
        made = object.__new__(cls)
        vars(made).update(vars(content))
        return made

    def elements_in_map(self, pose: Floats | None = None) -> MapElements:
        """Return the elements in the map's frame, at the prior pose or at another (3,)."""
        x, y, yaw = (float(v) for v in (self.pose if pose is None else pose))
        return self.elements.transform(x, y, yaw)


def _check(o: Observation) -> None:
    """Raise ObservationError for the first field that cannot be used."""
    _require(bool(o.agent), "agent", "a non-empty pseudonym", "none")
    for name in ("agent", "pass_id", "model"):
        _require_count(name, "characters", len(getattr(o, name)), LIMITS.max_text_length)
    _require(
        isinstance(o.time_ns, int) and 0 <= o.time_ns < 2**63, "time_ns", "whole nanoseconds since 1970", o.time_ns
    )
    for name, shape in (("pose", (3,)), ("covariance", (3, 3))):
        value = getattr(o, name)
        _require(value.shape == shape, name, f"shape {shape}", value.shape)
        _require_finite(name, value)
    remedy = "State it in metres of the map's frame, or choose an origin nearby."
    _require_max_abs("pose", o.pose[:2], LIMITS.max_position_m, "m from the origin along x and y", remedy)
    _require_max_abs("pose", o.pose[2:], LIMITS.max_yaw_rad, "rad of yaw")
    variance, min_variance = np.diag(o.covariance), LIMITS.min_pose_std**2
    _require_between(
        "covariance", variance[:2], min_variance, LIMITS.max_position_std_m**2, "variances of x and y (m²)"
    )
    _require_between("covariance", variance[2:], min_variance, LIMITS.max_yaw_std_rad**2, "a variance of yaw (rad²)")
    _require(_is_covariance(o.covariance), "covariance", "a symmetric, positive definite matrix", o.covariance)
    _require(
        o.view.ndim == 2 and o.view.shape[1] == 2 and len(o.view) >= 3, "view", "a ring (K, 2), K >= 3", o.view.shape
    )
    _check_rings("view", o.view, np.array([len(o.view)]))
    _require(is_simple_ring(o.view), "view", "a ring that does not cross itself", "one that does")
    _require_count("occluders", "rings", len(o.occluders), LIMITS.max_occluders)
    if len(o.occluders):
        _check_rings("occluders", o.occluders.points, np.diff(o.occluders.offsets))
    if len(o.elements):
        _check_elements(o.elements)


def _check_rings(name: str, points: Floats, counts: NDArray[np.int64]) -> None:
    """Raise ObservationError unless each ring has a usable number of points, all within reach."""
    min_points = int(counts.min())
    _require(min_points >= 3, name, "rings of 3 points or more", min_points)
    _require_count(name, "points a ring", int(counts.max()), LIMITS.max_ring_points)
    _require_reach(name, points)


def _check_elements(e: MapElements) -> None:
    """Raise ObservationError for the first column of the elements that cannot be used."""
    _require_count("elements", "elements", len(e), LIMITS.max_elements)
    _require_count("points", "points of all elements", len(e.points), LIMITS.max_points)
    _require_reach("points", e.points)
    _require_between("score", e.score, 0.0, 1.0)
    _require_between("sigma", e.sigma, 0.0, LIMITS.max_sigma_m)
    _require_between("style", e.style, 0.0, 1.0)
    _require(bool((np.abs(e.style.sum(1) - 1.0) < 1e-6).all()), "style", "probabilities that sum to 1", "others")
    counts, lengths, closed = e.counts, e.lengths(), e.closed
    _require_all(counts >= 2 + closed, counts, "2 points a line and 3 a crossing, or more")
    _require_all(
        ~closed | (counts <= LIMITS.max_ring_points), counts, f"at most {LIMITS.max_ring_points} points a ring"
    )
    longest = LIMITS.max_crossing_perimeter_m
    _require_all(~closed | (lengths <= longest), lengths, f"at most {longest:g} m around a crossing")
    dense, per_m = LIMITS.max_points_at_once, LIMITS.max_points_per_m
    _require_all(
        counts <= dense + per_m * lengths, counts, f"at most {dense} points an element and {per_m:g} more a metre"
    )
    total = float(lengths.sum())
    _require(total <= LIMITS.max_length_m, "points", f"at most {LIMITS.max_length_m:g} m of elements", f"{total:g} m")
    bad = int(_first_crossed_ring(e.kind, e.offsets, e.points, CROSSING))
    _require(bad < 0, "points", "crossings whose ring does not cross itself", f"element {bad}, whose ring does")


def _require(holds: bool, name: str, expected: str, actual: object, remedy: str = _REMEDY) -> None:
    if not holds:
        raise ObservationError(f"Observation.{name}: expected {expected}; got {shorten(actual)}. {remedy}")


def _require_finite(name: str, values: Floats) -> None:
    if not np.isfinite(values).all():
        _require(False, name, "finite numbers", "NaN or infinity")


def _require_max_abs(name: str, values: Floats, max_abs: float, what: str, remedy: str = _REMEDY) -> None:
    """Require that no value exceeds ``max_abs`` on either side of zero."""
    far = np.abs(values) > max_abs
    if far.any():
        _require(False, name, f"at most {max_abs:g} {what}", f"{values[far].flat[0]:g}", remedy)


def _require_reach(name: str, points: Floats) -> None:
    """Require finite points (P, 2) within the reach of an agent."""
    _require_finite(name, points)
    _require_max_abs(name, points, LIMITS.max_reach_m, "m from the agent along x and y")


def _require_between(name: str, values: Floats, low: float, high: float, what: str = "values") -> None:
    """Require every value in [low, high]; NaN is outside."""
    inside = (values >= low) & (values <= high)
    if not inside.all():
        _require(False, name, f"{what} in [{low:g}, {high:g}]", f"{values[~inside].flat[0]:g}")


def _require_count(name: str, what: str, count: int, max_count: int) -> None:
    _require(count <= max_count, name, f"at most {max_count} {what}", count)


def _require_all(holds: NDArray[np.bool_], values: NDArray, expected: str) -> None:
    """Require a condition (N,) of the points of every element; the text names the first that misses it and its value."""
    if not holds.all():
        row = int(np.argmin(holds))
        _require(False, "points", expected, f"{values[row]:g} in element {row}")


def shorten(value: object) -> str:
    """Format a value on one line, cut where it is long."""
    text = " ".join(str(value).split())
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]} ..."


def _is_covariance(m: Floats) -> bool:
    """Return whether m (3, 3) is symmetric and all its leading minors are positive (Sylvester), relative to its scale."""
    (a, b, c), (d, e, f), (g, h, i) = m.tolist()
    if a <= 0 or e <= 0 or i <= 0:
        return False
    if any(abs(one - two) > 1e-12 + 1e-9 * abs(one) for one, two in ((b, d), (c, g), (f, h))):
        return False
    # As correlations, so that units (m, rad) do not decide.
    r, s, t = b / math.sqrt(a * e), c / math.sqrt(a * i), f / math.sqrt(e * i)
    return 1 - r * r > 1e-12 and 1 + 2 * r * s * t - r * r - s * s - t * t > 1e-12


def is_simple_ring(ring: Floats) -> bool:
    """Return whether no two edges of the open ring (K, 2) cross; edges that only touch at a shared end do not."""
    return not has_crossing_edges(ring)


@njit(cache=True)
def has_crossing_edges(ring: F64x2) -> bool:  # pragma: no cover - compiled
    """Return whether two edges of the open ring (K, 2) cross; for other compiled loops, :func:`is_simple_ring` for the rest."""
    n = len(ring)
    for i in range(n):
        ax, ay = ring[i]
        bx, by = ring[(i + 1) % n]
        for j in range(i + 2, n):
            if i == 0 and j == n - 1:
                continue
            cx, cy = ring[j]
            dx, dy = ring[(j + 1) % n]
            one = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            two = (bx - ax) * (dy - ay) - (by - ay) * (dx - ax)
            three = (dx - cx) * (ay - cy) - (dy - cy) * (ax - cx)
            four = (dx - cx) * (by - cy) - (dy - cy) * (bx - cx)
            if one * two < 0 and three * four < 0:
                return True
    return False


@njit(cache=True)
def _first_crossed_ring(kind: I64x1, first: I64x1, points: F64x2, ring_kind: int) -> int:  # pragma: no cover - compiled
    for i in range(len(kind)):
        if kind[i] == ring_kind and has_crossing_edges(points[first[i] : first[i + 1]]):
            return i
    return -1
