# SPDX-License-Identifier: Apache-2.0
"""How fast what an agent sees is moving: its own boxes, followed back through its last few sweeps.

What a detector states of a velocity, it reads from two sweeps, a tenth of a second apart: 10 cm of error in a place are 1 m/s.
Half a second of the same boxes says more. A line is laid through the places of each box by weighted least squares; what is
stated, and that vehicles move along their length, is the prior (the MAP estimate of a Gaussian linear model: Bishop, Pattern
Recognition and Machine Learning, 2006, section 3.3). Then the points themselves are asked: of the velocities that the line
leaves open, that one is taken at which the box's points of now meet those of earlier sweeps best
(``ops.point_alignment_cost``). A velocity that is not significantly more than none is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datatypes import Boxes
from manyeyes.ops.point_alignment_cost import MOST, meeting_costs

AHEAD = torch.linspace(-3.0, 3.0, 31)
"""Speeds along a box that are tried, in standard deviations of what the line leaves open."""
ASIDE = torch.tensor([-2.0, -4 / 3, -2 / 3, 2 / 3, 4 / 3, 2.0])
"""Speeds across it, likewise: a heading that is off by a few degrees drives a vehicle aside."""
DRIVES_MPS = 1.0
"""Only a box that is faster is asked about them."""


@dataclass(frozen=True)
class TrackConfig:
    """Limits, and standard deviations of what they are named for.

    gate_m: a box farther from where it should have been is another. place_m: of a centre from sweep to sweep, beside what the
    detector says itself of its error. stated_mps: of the velocity that it states. sideways_mps: of motion across a vehicle's
    length. compared_s: sweeps so old are compared with that of now; trust: what it weighs if no point of an object of many points
    meets another there, in units of half a squared standard deviation. sure: a vehicle whose velocity is fewer standard deviations
    from none stands, and so does one below still_mps.
    """

    gate_m: float = 2.0
    place_m: float = 0.15
    stated_mps: float = 3.0
    sideways_mps: float = 0.2
    compared_s: tuple[float, float] = (0.15, 0.35)
    trust: float = 80.0
    sure: float = 0.7
    still_mps: float = 0.5


FOLLOWING = TrackConfig()
"""How every agent follows its boxes; chosen on Town07."""


@dataclass(frozen=True)
class Earlier:
    """What the agent saw some seconds ago, in its frame of now: boxes, and (Q, 3) float32 points, none where they are not asked."""

    boxes: Boxes
    seconds_ago: float
    points: Tensor | None = None


def followed(boxes: Boxes, earlier: Sequence[Earlier], config: TrackConfig, points: Tensor | None = None) -> Tensor:
    """(N, 2) m/s of boxes, in their frame, from where they were earlier, newest first; as stated where a box was not there.

    A box and one of an earlier sweep are the same where each is the nearest to where the other should be, within the gate.
    points: (P, 3) float32 of now; None: only boxes tell.
    """
    if not len(boxes):
        return boxes.velocity
    line = _Line.through(boxes, config)
    for then in earlier:
        if len(then.boxes):
            apart = torch.cdist(line.at(-then.seconds_ago), then.boxes.center[:, :2])
            nearest = apart.argmin(1)
            mutual = apart.argmin(0)[nearest] == torch.arange(len(boxes))
            same = mutual & (apart.gather(1, nearest[:, None])[:, 0] <= config.gate_m)
            line = line.plus(then.boxes[nearest], -then.seconds_ago, same)
    known, velocity, there = line.known, line.velocity, line.sums[:, 2] > 0
    if points is not None:
        matched = _matched(boxes[there], velocity[there], known[there], earlier, points, config)
        velocity = velocity.index_put((there,), matched)
    sure = (velocity[:, None] @ known @ velocity[:, :, None])[:, 0, 0] >= config.sure**2
    moves = sure & (velocity.norm(dim=1) >= config.still_mps)
    return torch.where(there[:, None], velocity * moves[:, None], boxes.velocity)


def _matched(
    boxes: Boxes, velocity: Tensor, known: Tensor, earlier: Sequence[Earlier], points: Tensor, config: TrackConfig
) -> Tensor:
    """The velocities (N, 2), of those around them, at which sweeps meet best; known as in _Line."""
    open_to = torch.linalg.inv(known)
    along = torch.stack((boxes.yaw.cos(), boxes.yaw.sin()), 1)
    across = torch.stack((-along[:, 1], along[:, 0]), 1)
    long, wide = ((axis[:, None] @ open_to @ axis[:, :, None])[:, 0, 0].sqrt() for axis in (along, across))
    long = long.clamp_max(config.stated_mps)

    def best(rows: Tensor, aside: float) -> tuple[Tensor, Tensor]:
        """For some boxes, at one speed across them: the least cost, and its velocity."""
        some, start = boxes[rows], velocity[rows] + aside * wide[rows, None] * across[rows]
        cost = (AHEAD**2 + aside**2).to(start.dtype).expand(len(some), -1)
        for then in earlier:
            if then.points is not None:
                t = then.seconds_ago
                slack = AHEAD[-1] * long[rows] * t
                missed, asked = meeting_costs(points, then.points, some, start * t, slack, len(AHEAD))
                cost = cost + config.trust * (asked / MOST)[:, None] * missed
        least, at = cost.min(1)
        return least, start + (long[rows] * AHEAD[at])[:, None] * along[rows]

    least, found = best(torch.arange(len(boxes)), 0.0)
    drives = (found.norm(dim=1) > DRIVES_MPS).nonzero()[:, 0]
    if len(drives):
        cost, other = zip((least[drives], found[drives]), *(best(drives, float(aside)) for aside in ASIDE))
        found[drives] = torch.stack(other)[torch.stack(cost).argmin(0), torch.arange(len(drives))]
    return found


@dataclass(frozen=True)
class _Line:
    """N lines through places, as the sums that least squares needs. Seconds from now, metres from where each box is.

    sums: (N, 3), over places, of w, w t, w t^2 with w the inverse variance of a place; moments: (N, 2, 2) of w p, w t p. prior:
    (N, 2, 2), inverse covariance of the velocity beforehand; pull: (N, 2), it times the mean.
    """

    origin: Tensor
    sums: Tensor
    moments: Tensor
    prior: Tensor
    pull: Tensor
    place_m: float

    @classmethod
    def through(cls, boxes: Boxes, config: TrackConfig) -> _Line:
        """Through where the boxes are, with what is known beforehand."""
        n, ahead = len(boxes), torch.stack((boxes.yaw.cos(), boxes.yaw.sin()), 1)
        along = ahead[:, :, None] * ahead[:, None, :]
        across = torch.eye(2) - along
        prior = along / config.stated_mps**2 + across / config.sideways_mps**2
        pull = (along @ boxes.velocity[:, :, None])[..., 0] / config.stated_mps**2
        empty = cls(boxes.center[:, :2], torch.zeros(n, 3), torch.zeros(n, 2, 2), prior, pull, config.place_m)
        return empty.plus(boxes, 0.0, torch.ones(n, dtype=torch.bool))

    def plus(self, boxes: Boxes, t: float, same: Tensor) -> _Line:
        """Through one more place each, where the box is the same, (N,) bool."""
        weight = same / (self.place_m**2 + boxes.sigma_xy**2)
        powers = weight[:, None] * torch.tensor([1.0, t, t * t])
        moments = powers[:, :2, None] * (boxes.center[:, :2] - self.origin)[:, None]
        return replace(self, sums=self.sums + powers, moments=self.moments + moments)

    @property
    def known(self) -> Tensor:
        """(N, 2, 2): the inverse covariance of the velocity."""
        w, wt, wtt = self.sums.unbind(1)
        return self.prior + (wtt - wt * wt / w)[:, None, None] * torch.eye(2)

    @property
    def velocity(self) -> Tensor:
        """(N, 2) m/s."""
        slope = self.moments[:, 1] - self.moments[:, 0] * (self.sums[:, 1] / self.sums[:, 0])[:, None]
        return torch.linalg.solve(self.known, self.pull + slope)

    def at(self, t: float) -> Tensor:
        """(N, 2): where the boxes were."""
        w, wt = self.sums[:, 0, None], self.sums[:, 1, None]
        return self.origin + self.moments[:, 0] / w + self.velocity * (t - wt / w)
