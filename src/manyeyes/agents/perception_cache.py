# SPDX-License-Identifier: Apache-2.0
"""What a detector made of an agent's own sweeps, remembered: sharing and perceiving see each once, and later ones look back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from manyeyes.agents.velocity import FOLLOWING, Earlier, TrackConfig, followed
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, PointCloud, SparseBev
from manyeyes.models.detector.box_head import SPEED_UNIT, DecodeConfig, RawBoxes, decode
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL, propose
from manyeyes.models.fusion.transform_tokens import Part, Tokens

LONGEST_GAP_NS = 250_000_000
"""A sweep that lies farther back than this, or one of another agent or scenario, says nothing of the motion since."""
FASTEST_M = 30.0
"""An agent that moved farther between two sweeps did not drive there: another scenario has begun."""
REMEMBERED = 2
"""So many instants back what was seen or heard takes part in what is perceived."""
FOLLOWED = 5
"""So many instants back boxes are followed: half a second at 10 Hz, in which a vehicle hardly changes its speed."""
OWN_M = 2.0
"""A token belongs to the box whose centre is the nearest to the one that it proposes, if it is no farther."""


@dataclass(frozen=True)
class Sight:
    """One agent's own view: what it can tell others (N, C + PROPOSAL), and its raw boxes.

    stated: what it would tell without its past, with velocities as the detector states them: the selector has learned on that.
    """

    told: SparseBev
    stated: SparseBev
    raw: RawBoxes
    config: DecodeConfig

    @cached_property
    def boxes(self) -> Boxes:
        """The agent's own boxes, in its frame, best first; decoded when first asked for, since not everybody sends them."""
        return decode(self.raw, self.config)[0]

    def moving(self, velocity: Tensor) -> Sight:
        """The same view, its boxes as fast as (M, 2) m/s says, and so their tokens; what belongs to no box stands still."""
        place = self.raw.sites.xy + self.raw.offset * self.raw.sites.grid.cell
        apart = torch.cdist(place, self.boxes.center[:, :2])
        # One more column, for those that belong to none.
        nearest = pad(apart, (0, 1), value=OWN_M).argmin(1)
        raw = replace(self.raw, velocity=pad(velocity, (0, 0, 0, 1))[nearest] / SPEED_UNIT)
        told = torch.cat((self.told.features[:, :-PROPOSAL], propose(raw)), 1)
        moved = replace(self, told=self.told.with_features(told), raw=raw)
        # Speed decides nothing in decoding: the boxes are the same, and need not be found again.
        vars(moved)["boxes"] = replace(self.boxes, velocity=velocity)
        return moved


History = tuple[tuple[AgentFrame, PointCloud] | None, tuple[AgentFrame, SparseBev] | None]
"""The last merged cloud and the last fused tokens, each with its frame."""


class Eyes:
    """A detector and the last few frames that it saw, of one agent. Frames are told apart by identity.

    remember: how many. They are forgotten where time goes back, stands still, or jumps: a scenario has ended.
    known: views by agent and time of capture, which are taken as they are and added to, so that several players of one recording
    look at each sweep once between them. perceived: the last frame in which the agent fused what it heard, and the fused
    tokens, where a method keeps them. tracks: how boxes are followed through those frames; None leaves the velocities that the
    detector states.
    """

    def __init__(
        self,
        detector: Detector,
        remember: int = 8,
        known: dict[tuple[int, int], Sight] | None = None,
        tracks: TrackConfig | None = FOLLOWING,
    ) -> None:
        self.detector = detector
        self._remember, self._known, self._tracks = remember, known, tracks
        self._seen: list[tuple[AgentFrame, Sight]] = []
        self._merged: tuple[AgentFrame, PointCloud] | None = None
        self._said: list[tuple[AgentFrame, SparseBev]] = []
        self.perceived: tuple[AgentFrame, SparseBev] | None = None

    @property
    def grid(self) -> BevGrid:
        """The range that the detector sees around the agent."""
        return self.detector.config.grid

    def see(self, frame: AgentFrame) -> Sight:
        """The agent's own view of its frame, with the sweep before it where there is one."""
        for known, sight in self._seen:
            if known is frame:
                return sight
        if self._seen and not follows(frame, self._seen[-1][0]):
            self._seen = []
        key = frame.agent_id, frame.timestamp_ns
        sight = self._known.get(key) if self._known is not None else None
        if sight is None:
            before = self._seen[-1][0] if self._seen else None
            earlier = None if before is None else before.points.transform(frame.from_earlier(before))
            sight = self._followed(frame, self.see_cloud(frame.points, earlier))
        if self._known is not None:
            self._known[key] = sight
        self._seen = [*self._seen, (frame, sight)][-self._remember :]
        return sight

    def _followed(self, frame: AgentFrame, sight: Sight) -> Sight:
        """The view with its boxes as fast as the last frames in which there were any tell."""
        if self._tracks is None:
            return sight
        earlier = []
        for before, seen in self._seen[: -FOLLOWED - 1 : -1]:
            if len(seen.boxes):
                ago, motion = (frame.timestamp_ns - before.timestamp_ns) / 1e9, frame.from_earlier(before)
                compared = self._tracks.compared_s[0] <= ago <= self._tracks.compared_s[1]
                points = before.points.transform(motion).xyz if compared else None
                earlier.append(Earlier(seen.boxes.transform(motion).to(torch.float32), ago, points))
        if not earlier:
            return sight
        return sight.moving(followed(sight.boxes, earlier, self._tracks, frame.points.xyz))

    def before(self, frame: AgentFrame, instants: int = REMEMBERED) -> list[tuple[AgentFrame, Sight]]:
        """What the agent saw at its last instants before this frame, newest first."""
        at = next((i for i, (known, _) in enumerate(self._seen) if known is frame), 0)
        return self._seen[max(0, at - instants) : at][::-1]

    def past(self, frame: AgentFrame, instants: int = REMEMBERED) -> list[Part]:
        """What the agent itself told at its last instants before this frame, newest first, for the ego 0."""
        parts = []
        for before, sight in self.before(frame, instants):
            age_s = (frame.timestamp_ns - before.timestamp_ns) / 1e9
            parts.append(Part(0, sight.told.features, sight.told.sites.xy, frame.from_earlier(before), age_s))
        return parts

    def said(self, frame: AgentFrame, told: SparseBev) -> None:
        """Keeps which tokens (N, C + PROPOSAL) of this frame went out; who says the same frame anew takes the first word back."""
        self._said = [*(s for s in self._said if s[0] is not frame), (frame, told)][-REMEMBERED - 1 :]

    def said_before(self, frame: AgentFrame) -> list[tuple[AgentFrame, SparseBev]]:
        """What the agent said at its last instants before this frame, oldest first: what others still remember."""
        earlier = [(then, told) for then, told in self._said if then is not frame]
        return [(then, told) for then, told in earlier[-REMEMBERED:] if follows(frame, then)]

    def earlier_merged(self, frame: AgentFrame, merged: PointCloud) -> PointCloud | None:
        """What was merged around the agent at its last instant, moved to this one; what is merged now is kept for the next."""
        last, self._merged = self._merged, (frame, merged)
        if last is None or not follows(frame, last[0]):
            return None
        return last[1].transform(frame.from_earlier(last[0]))

    @property
    def history(self) -> History:
        """What perceiving leaves behind; assign it to take a perception back."""
        return self._merged, self.perceived

    @history.setter
    def history(self, history: History) -> None:
        self._merged, self.perceived = history

    def see_cloud(self, cloud: PointCloud, earlier: PointCloud | None = None) -> Sight:
        """The view of any cloud in an agent's frame, and of the one before it in the same frame; not remembered."""
        with torch.inference_mode():
            before = PointCloud.of(torch.zeros(0, 3)) if earlier is None else earlier
            seen = self.detector.see([cloud], [before])
            raw = self.detector.look(seen.tokens)
            told = self.detector.tell(seen.tokens, raw)
            return Sight(told, told, raw, self.detector.config.decode)

    def fuse(self, tokens: Tokens, past: Tokens | None = None) -> RawBoxes:
        """Raw boxes around one ego."""
        with torch.inference_mode():
            return self.detector.fuse(tokens, past)

    def decode(self, raw: RawBoxes) -> Boxes:
        """Boxes around one ego, in its frame, best first."""
        return decode(raw, self.detector.config.decode)[0]


def follows(frame: AgentFrame, before: AgentFrame) -> bool:
    """Whether one frame is the continuation of another: the same agent, a little later, about there."""
    gap = frame.timestamp_ns - before.timestamp_ns
    if frame.agent_id != before.agent_id or not 0 < gap <= LONGEST_GAP_NS:
        return False
    return float(frame.from_earlier(before).translation.norm()) <= FASTEST_M
