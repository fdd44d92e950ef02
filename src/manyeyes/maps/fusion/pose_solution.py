# SPDX-License-Identifier: Apache-2.0
"""The state of the pose optimization: corrected poses of a set of observations, and the sums of their pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import take_rows
from manyeyes.maps.fusion.observation_arrays import ObservationArrays

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

REJECTED_WEIGHT = 1e-6
"""Weight of a rejected agent; not 0, so that elements seen by such an agent alone still get a position."""


@dataclass(frozen=True, eq=False)
class PairSums:
    """Sums over the pairs of points of O observations, each with the N other observations that its points meet.

    own: (O, 11) upper triangle (xx, xy, xt, yy, yt, tt) and right side (x, y, t) of the observation's own block, weighted sum of
    squared residuals (m²), sum of votes of its points. offsets: (O + 1,) of the pairs. other_ids: (N, 16) observation of each pair.
    shared: (N, 12) of each pair: xx, xy, yy, xt', yt', t't', tx, ty, tt' and right side (x, y, t'), t' by the heading of the other
        observation; the right side of that one, and the block between both, are the negative of these.
    """

    own: Floats
    offsets: Ints
    other_ids: NDArray[np.uint8]
    shared: Floats


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """Corrected poses of O observations, ids ascending.

    ids: (O,) hexadecimal. agents, drives: (O,) names; a drive belongs to one agent. time_ns: (O,).
    prior_pose: (O, 3) and prior_covariance: (O, 3, 3) of it. initial_pose: (O, 3) after the coarse search, the prior pose where it
        found no shift.
    pose: (O, 3). covariance: (O, 3, 3) of it given the poses of all other observations. common_covariance: (O, 3, 3) what
        the marginal covariance adds, which observations nearby share.
    drive_bias: (O, 3) metres, metres, radians, estimated bias of the drive's prior poses here.
    scale: (O,) metres, robust residual scale of the agent's lines.
    agent_error: (O,) mean correction of the agent's prior poses in standard deviations; agent_weight: (O,) in (0, 1] of it, see
        :mod:`manyeyes.maps.fusion.agent_weights`.
    is_surveyed: (O,) 1 for surveyed poles.
    pairs: sums of a step before its parts are merged, else None.
    """

    ids: tuple[str, ...]
    agents: tuple[str, ...]
    drives: tuple[str, ...]
    time_ns: Ints
    prior_pose: Floats
    prior_covariance: Floats
    initial_pose: Floats
    pose: Floats
    covariance: Floats
    common_covariance: Floats
    drive_bias: Floats
    scale: Floats
    agent_error: Floats
    agent_weight: Floats
    is_surveyed: Floats
    pairs: PairSums | None = field(default=None, kw_only=True)

    @property
    def correction(self) -> Floats:
        """The corrections (O, 3) of the prior poses: metres, metres, radians within half a turn."""
        moved = self.pose - self.prior_pose
        moved[:, 2] = (moved[:, 2] + np.pi) % (2 * np.pi) - np.pi
        return moved

    def row_indices(self, ids: Sequence[str]) -> Ints:
        """Return the rows of these ids."""
        place = {name: k for k, name in enumerate(self.ids)}
        return np.array([place[name] for name in ids], np.int64)

    def take(self, rows: Ints) -> PoseSolution:
        """Return the chosen rows without pairs, in the order given."""
        columns: dict[str, Any] = {name: getattr(self, name).take(rows, 0) for name in _COLUMNS}
        for name in ("ids", "agents", "drives"):
            columns[name] = tuple(getattr(self, name)[k] for k in rows.tolist())
        return PoseSolution(**columns)

    def take_with_pairs(self, rows: Ints) -> PoseSolution:
        """Return the chosen rows with their pairs, also those with observations that are left out."""
        if np.array_equal(rows, np.arange(len(self.ids))):
            return self
        return replace(self.take(rows), pairs=None if self.pairs is None else take_pairs(self.pairs, rows))

    def with_agents(self, agent_error: Floats, agent_weight: Floats, scale: Floats) -> PoseSolution:
        """Return the same with the error, the weight and the residual scale (O,) of each observation's agent."""
        return replace(self, agent_error=agent_error, agent_weight=agent_weight, scale=scale)

    @classmethod
    def cat(cls, parts: Sequence[PoseSolution]) -> PoseSolution:
        """Concatenate disjoint parts, ids ascending, with their pairs if all have them."""
        if len(parts) == 1:
            return parts[0].take_with_pairs(_argsort(parts[0].ids))
        columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        for name in ("ids", "agents", "drives"):
            columns[name] = tuple(text for part in parts for text in getattr(part, name))
        joined = cls(**columns)
        order = _argsort(joined.ids)
        sums = [part.pairs for part in parts if part.pairs is not None]
        return replace(joined.take(order), pairs=_merge_pairs(sums, order) if len(sums) == len(parts) else None)


_COLUMNS = (
    "time_ns",
    "prior_pose",
    "prior_covariance",
    "initial_pose",
    "pose",
    "covariance",
    "common_covariance",
    "drive_bias",
    "scale",
    "agent_error",
    "agent_weight",
    "is_surveyed",
)


def _argsort(ids: Sequence[str]) -> Ints:
    return np.array(sorted(range(len(ids)), key=ids.__getitem__), np.int64)


def _merge_pairs(parts: Sequence[PairSums], order: Ints) -> PairSums:
    """Return the pairs of all parts, in the order given of the rows of one after the other; each is copied once."""
    counts = np.concatenate([np.diff(part.offsets) for part in parts])
    offsets = np.concatenate(([0], np.cumsum(counts[order])))
    begins = np.empty(len(order), np.int64)
    begins[order] = offsets[:-1]
    other_ids = np.empty((offsets[-1], *parts[0].other_ids.shape[1:]), np.uint8)
    shared = np.empty((offsets[-1], *parts[0].shared.shape[1:]))
    first = 0
    for part in parts:
        begin = begins[first : first + len(part.own)]
        first += len(part.own)
        places = np.arange(len(part.shared)) + np.repeat(begin - part.offsets[:-1], np.diff(part.offsets))
        other_ids[places], shared[places] = part.other_ids, part.shared
    return PairSums(np.concatenate([part.own for part in parts]).take(order, 0), offsets, other_ids, shared)


def take_pairs(pairs: PairSums, order: Ints) -> PairSums:
    """Return the pairs of the chosen observations, in the order given."""
    offsets, places = take_rows(pairs.offsets, order)
    # numpy.take copies rows several times as fast as an index does.
    return PairSums(pairs.own.take(order, 0), offsets, pairs.other_ids.take(places, 0), pairs.shared.take(places, 0))


def make_initial_solution(arrays: ObservationArrays) -> PoseSolution:
    """Make the solution at the prior poses, ids ascending."""
    count = len(arrays)
    pose, covariance = np.array(arrays.pose), np.array(arrays.covariance)
    start = PoseSolution(
        ids=arrays.ids,
        agents=tuple(arrays.agents[a] for a in arrays.agent.tolist()),
        drives=arrays.drives,
        time_ns=np.array(arrays.time_ns),
        prior_pose=pose,
        prior_covariance=covariance,
        initial_pose=pose,
        pose=pose,
        covariance=covariance,
        common_covariance=np.zeros((count, 3, 3)),
        drive_bias=np.zeros((count, 3)),
        scale=np.full(count, 0.2),
        agent_error=np.zeros(count),
        agent_weight=np.ones(count),
        is_surveyed=np.asarray(arrays.trusted).astype(np.float64),
    )
    return start.take(_argsort(arrays.ids))
