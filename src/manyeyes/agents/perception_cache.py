# SPDX-License-Identifier: Apache-2.0
"""What a detector made of an agent's own sweeps, remembered: sharing and perceiving see each once, and later ones look back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from manyeyes.agents.velocity import DEFAULT_VELOCITY_CONFIG, PastDetections, VelocityConfig, estimate_velocities
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, PointCloud, SparseBev
from manyeyes.models.detector.box_head import SPEED_UNIT, DecodeConfig, RawBoxes, decode
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL_DIM, make_proposals
from manyeyes.models.fusion.transform_tokens import AgentTokens, Tokens

MAX_GAP_NS = 250_000_000
"""A sweep that lies farther back than this, or one of another agent or scenario, says nothing of the motion since."""
MAX_EGO_STEP_M = 30.0
"""An agent that moved farther between two sweeps did not drive there: another scenario has begun."""
HISTORY_FRAMES = 2
"""So many instants back what was seen or heard takes part in what is perceived."""
TRACK_FRAMES = 5
"""So many instants back boxes are followed: half a second at 10 Hz, in which a vehicle hardly changes its speed."""
MAX_TOKEN_TO_BOX_M = 2.0
"""A token belongs to the box whose centre is the nearest to the one that it proposes, if it is no farther."""


@dataclass(frozen=True)
class AgentOutput:
    """One agent's own view: what it can tell others (N, C + PROPOSAL), and its raw boxes.

    tokens_raw_velocity: what it would tell without its past, with velocities as the detector states them: the selector has learned
    on that.
    """

    shared_tokens: SparseBev
    tokens_raw_velocity: SparseBev
    raw: RawBoxes
    config: DecodeConfig

    @cached_property
    def boxes(self) -> Boxes:
        """The agent's own boxes, in its frame, best first; decoded when first asked for, since not everybody sends them."""
        return decode(self.raw, self.config)[0]

    def with_velocity(self, velocity: Tensor) -> AgentOutput:
        """The same view, its boxes as fast as (M, 2) m/s says, and so their tokens; what belongs to no box stands still."""
        place = self.raw.sites.xy + self.raw.offset * self.raw.sites.grid.cell_size_m
        distance = torch.cdist(place, self.boxes.center[:, :2])
        # One more column, for those that belong to none.
        nearest = pad(distance, (0, 1), value=MAX_TOKEN_TO_BOX_M).argmin(1)
        raw = replace(self.raw, velocity=pad(velocity, (0, 0, 0, 1))[nearest] / SPEED_UNIT)
        features = torch.cat((self.shared_tokens.features[:, :-PROPOSAL_DIM], make_proposals(raw)), 1)
        output = replace(self, shared_tokens=self.shared_tokens.with_features(features), raw=raw)
        # Speed decides nothing in decoding: the boxes are the same, and need not be found again.
        vars(output)["boxes"] = replace(self.boxes, velocity=velocity)
        return output


History = tuple[tuple[AgentFrame, PointCloud] | None, tuple[AgentFrame, SparseBev] | None]
"""The last merged cloud and the last fused tokens, each with its frame."""


class PerceptionCache:
    """A detector and the last few frames that it saw, of one agent. Frames are told apart by identity.

    max_frames: how many. They are forgotten where time goes back, stands still, or jumps: a scenario has ended.
    feature_cache: views by agent and time of capture, which are taken as they are and added to, so that several players of one
    recording look at each sweep once between them. last_fused: the last frame in which the agent fused what it heard, and the fused
    tokens, where a method keeps them. velocity_config: how boxes are followed through those frames; None leaves the velocities that
    the detector states.
    """

    def __init__(
        self,
        detector: Detector,
        max_frames: int = 8,
        feature_cache: dict[tuple[int, int], AgentOutput] | None = None,
        velocity_config: VelocityConfig | None = DEFAULT_VELOCITY_CONFIG,
    ) -> None:
        self.detector = detector
        self._max_frames, self._feature_cache, self._velocity_config = max_frames, feature_cache, velocity_config
        self._outputs: list[tuple[AgentFrame, AgentOutput]] = []
        self._merged: tuple[AgentFrame, PointCloud] | None = None
        self._sent: list[tuple[AgentFrame, SparseBev]] = []
        self.last_fused: tuple[AgentFrame, SparseBev] | None = None

    @property
    def grid(self) -> BevGrid:
        """The range that the detector sees around the agent."""
        return self.detector.config.grid

    def process(self, frame: AgentFrame) -> AgentOutput:
        """The agent's own view of its frame, with the sweep before it where there is one."""
        for cached_frame, output in self._outputs:
            if cached_frame is frame:
                return output
        if self._outputs and not is_consecutive(frame, self._outputs[-1][0]):
            self._outputs = []
        key = frame.agent_id, frame.timestamp_ns
        output = self._feature_cache.get(key) if self._feature_cache is not None else None
        if output is None:
            before = self._outputs[-1][0] if self._outputs else None
            earlier = None if before is None else before.points.transform(frame.now_from_earlier(before))
            output = self._with_estimated_velocity(frame, self.run_detector(frame.points, earlier))
        if self._feature_cache is not None:
            self._feature_cache[key] = output
        self._outputs = [*self._outputs, (frame, output)][-self._max_frames :]
        return output

    def _with_estimated_velocity(self, frame: AgentFrame, output: AgentOutput) -> AgentOutput:
        """The view with its boxes as fast as the last frames in which there were any tell."""
        if self._velocity_config is None:
            return output
        earlier = []
        for before, past_output in self._outputs[: -TRACK_FRAMES - 1 : -1]:
            if len(past_output.boxes):
                age_s, motion = (frame.timestamp_ns - before.timestamp_ns) / 1e9, frame.now_from_earlier(before)
                match_points = (
                    self._velocity_config.point_match_window_s[0]
                    <= age_s
                    <= self._velocity_config.point_match_window_s[1]
                )
                points = before.points.transform(motion).xyz if match_points else None
                earlier.append(PastDetections(past_output.boxes.transform(motion).to(torch.float32), age_s, points))
        if not earlier:
            return output
        return output.with_velocity(estimate_velocities(output.boxes, earlier, self._velocity_config, frame.points.xyz))

    def previous_outputs(
        self, frame: AgentFrame, num_frames: int = HISTORY_FRAMES
    ) -> list[tuple[AgentFrame, AgentOutput]]:
        """What the agent saw at its last instants before this frame, newest first."""
        at = next((i for i, (cached_frame, _) in enumerate(self._outputs) if cached_frame is frame), 0)
        return self._outputs[max(0, at - num_frames) : at][::-1]

    def previous_tokens(self, frame: AgentFrame, num_frames: int = HISTORY_FRAMES) -> list[AgentTokens]:
        """What the agent itself told at its last instants before this frame, newest first, for the ego 0."""
        parts = []
        for before, output in self.previous_outputs(frame, num_frames):
            age_s = (frame.timestamp_ns - before.timestamp_ns) / 1e9
            parts.append(
                AgentTokens(
                    0,
                    output.shared_tokens.features,
                    output.shared_tokens.sites.xy,
                    frame.now_from_earlier(before),
                    age_s,
                )
            )
        return parts

    def record_sent(self, frame: AgentFrame, tokens: SparseBev) -> None:
        """Keeps which tokens (N, C + PROPOSAL) of this frame went out; who says the same frame anew takes the first word back."""
        self._sent = [*(s for s in self._sent if s[0] is not frame), (frame, tokens)][-HISTORY_FRAMES - 1 :]

    def recently_sent(self, frame: AgentFrame) -> list[tuple[AgentFrame, SparseBev]]:
        """What the agent said at its last instants before this frame, oldest first: what others still remember."""
        earlier = [(then, tokens) for then, tokens in self._sent if then is not frame]
        return [(then, tokens) for then, tokens in earlier[-HISTORY_FRAMES:] if is_consecutive(frame, then)]

    def previous_merged_cloud(self, frame: AgentFrame, merged: PointCloud) -> PointCloud | None:
        """What was merged around the agent at its last instant, moved to this one; what is merged now is kept for the next."""
        last, self._merged = self._merged, (frame, merged)
        if last is None or not is_consecutive(frame, last[0]):
            return None
        return last[1].transform(frame.now_from_earlier(last[0]))

    @property
    def history(self) -> History:
        """What perceiving leaves behind; assign it to take a perception back."""
        return self._merged, self.last_fused

    @history.setter
    def history(self, history: History) -> None:
        self._merged, self.last_fused = history

    def run_detector(self, cloud: PointCloud, earlier: PointCloud | None = None) -> AgentOutput:
        """The view of any cloud in an agent's frame, and of the one before it in the same frame; not remembered."""
        with torch.inference_mode():
            before = PointCloud.of(torch.zeros(0, 3)) if earlier is None else earlier
            extracted = self.detector.extract_features([cloud], [before])
            raw = self.detector.predict(extracted.tokens)
            shared_tokens = self.detector.make_tokens(extracted.tokens, raw)
            return AgentOutput(shared_tokens, shared_tokens, raw, self.detector.config.decode)

    def fuse(self, tokens: Tokens, past: Tokens | None = None) -> RawBoxes:
        """Raw boxes around one ego."""
        with torch.inference_mode():
            return self.detector.fuse(tokens, past)

    def decode(self, raw: RawBoxes) -> Boxes:
        """Boxes around one ego, in its frame, best first."""
        return decode(raw, self.detector.config.decode)[0]


def is_consecutive(frame: AgentFrame, before: AgentFrame) -> bool:
    """Whether one frame is the continuation of another: the same agent, a little later, about there."""
    gap = frame.timestamp_ns - before.timestamp_ns
    if frame.agent_id != before.agent_id or not 0 < gap <= MAX_GAP_NS:
        return False
    return float(frame.now_from_earlier(before).translation.norm()) <= MAX_EGO_STEP_M
