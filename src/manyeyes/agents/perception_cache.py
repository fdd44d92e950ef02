# SPDX-License-Identifier: Apache-2.0
"""Detector and cache of its outputs on an agent's own sweeps: share and perceive run it once a sweep, later frames reuse them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from manyeyes.agents._velocity_kernels import nearest_boxes
from manyeyes.agents.level_frame import FrameLeveller
from manyeyes.agents.velocity import DEFAULT_VELOCITY_CONFIG, PastDetections, VelocityConfig, estimate_velocities
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, PointCloud, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT, DecodeConfig, RawBoxes, decode
from manyeyes.models.detector.proposal import MAX_PROPOSAL, PROPOSAL_DIM
from manyeyes.models.detector.protocols import BoxDetector, TokenDetector, has_tokens, require_tokens
from manyeyes.models.fusion.token_merge import FusedBev
from manyeyes.models.fusion.transform_tokens import AgentTokens, Tokens

MAX_GAP_NS = 250_000_000
"""Maximum time between two consecutive sweeps; a longer gap starts a new scenario."""
MAX_EGO_STEP_M = 30.0
"""Maximum displacement of an agent between two consecutive sweeps; a larger one starts a new scenario."""
HISTORY_FRAMES = 2
"""Number of previous frames whose outputs and messages are fused."""
TRACK_FRAMES = 5
"""Number of previous frames for velocity estimation: half a second at 10 Hz, in which a vehicle hardly changes its speed."""
MAX_TOKEN_TO_BOX_M = 2.0
"""Maximum distance between the centre that a token proposes and the centre of its box."""


@dataclass(frozen=True)
class BoxOutput:
    """Output of a BoxDetector on one agent's own frame: boxes in its frame, by falling score."""

    boxes: Boxes

    def with_velocity(self, velocity: Tensor) -> BoxOutput:
        """Return the same boxes with velocities (N, 2) m/s."""
        return BoxOutput(replace(self.boxes, velocity=velocity))


@dataclass(frozen=True)
class TokenOutput:
    """Output of a TokenDetector on one agent's own frame: tokens to share (N, C + PROPOSAL), and raw boxes.

    tokens_raw_velocity: the tokens with the detector's own velocities, which the token selector was trained on.
    """

    shared_tokens: SparseBev
    tokens_raw_velocity: SparseBev
    raw: RawBoxes
    config: DecodeConfig

    @cached_property
    def boxes(self) -> Boxes:
        """The agent's own boxes, in its frame, by falling score; decoded at first use, because few strategies send them."""
        return decode(self.raw, self.config)[0]

    def with_velocity(self, velocity: Tensor) -> TokenOutput:
        """Return the same output with box velocities (M, 2) m/s, for their tokens too; tokens without a box get velocity 0."""
        place = self.raw.sites.xy + self.raw.offset * self.raw.sites.grid.cell_size_m
        nearest = nearest_boxes(place.float().numpy(), self.boxes.center.float().numpy(), MAX_TOKEN_TO_BOX_M)
        # One more row for tokens without a box.
        of_token = pad(velocity, (0, 0, 0, 1))[torch.from_numpy(nearest)] / SPEED_UNIT
        features = self.shared_tokens.features.clone()
        features[:, -PROPOSAL_DIM:][:, BOX_LAYOUT.velocity] = of_token.clamp(-MAX_PROPOSAL, MAX_PROPOSAL)
        tokens = self.shared_tokens.with_features(features)
        output = replace(self, shared_tokens=tokens, raw=replace(self.raw, velocity=of_token))
        # Decoding does not depend on velocity: reuse the decoded boxes.
        vars(output)["boxes"] = replace(self.boxes, velocity=velocity)
        return output


AgentOutput = BoxOutput | TokenOutput
"""Output of any detector: it has ``boxes``."""
History = tuple[tuple[tuple[AgentFrame, AgentOutput], ...], tuple[AgentFrame, SparseBev] | None]
"""The outputs on the last merged clouds, and the last fused tokens, each with its frame."""


class PerceptionCache:
    """A detector and its outputs on the last frames of one agent. Frames are compared by identity.

    max_frames: number of cached frames; the cache is cleared when time decreases, stands still, or jumps. feature_cache: outputs by
    agent and timestamp, shared by several replays of one recording, which read and extend it. velocity_config: of velocity
    estimation over those frames; None keeps the velocities of the detector. level: levels frames (``agents.level_frame``); all
    other methods take levelled ones. last_fused: the last fused frame and its fused tokens, for strategies that need them.
    """

    def __init__(
        self,
        detector: BoxDetector,
        max_frames: int = 8,
        feature_cache: dict[tuple[int, int], AgentOutput] | None = None,
        velocity_config: VelocityConfig | None = DEFAULT_VELOCITY_CONFIG,
    ) -> None:
        self.detector = detector
        self._max_frames, self._feature_cache, self._velocity_config = max_frames, feature_cache, velocity_config
        self._outputs: list[tuple[AgentFrame, AgentOutput]] = []
        self._merged: PerceptionCache | None = None
        self._sent: list[tuple[AgentFrame, SparseBev]] = []
        self._motions: tuple[AgentFrame | None, list[tuple[AgentFrame, Transform]]] = None, []
        self.level = FrameLeveller()
        self.last_fused: tuple[AgentFrame, SparseBev] | None = None

    @property
    def token_detector(self) -> TokenDetector:
        """The detector; ConfigError if it has no tokens."""
        return require_tokens(self.detector)

    def clear(self) -> None:
        """Remove the states of all frames."""
        self._outputs, self._merged, self._sent, self.last_fused = [], None, [], None
        self._motions = None, []

    def motion_since(self, frame: AgentFrame, before: AgentFrame) -> Transform:
        """Return the motion from the agent's frame of an earlier instant to this one; those to the newest frame are kept."""
        if self._motions[0] is not frame:
            self._motions = frame, []
        known = self._motions[1]
        for earlier, motion in known:
            if earlier is before:
                return motion
        known.append((before, frame.now_from_earlier(before)))
        return known[-1][1]

    def is_consecutive(self, frame: AgentFrame, before: AgentFrame) -> bool:
        """Return whether a frame continues another one: same agent, a small time gap, a small displacement."""
        gap = frame.timestamp_ns - before.timestamp_ns
        if frame.agent_id != before.agent_id or not 0 < gap <= MAX_GAP_NS:
            return False
        return float(self.motion_since(frame, before).translation.norm()) <= MAX_EGO_STEP_M

    def process(self, frame: AgentFrame) -> AgentOutput:
        """Detector output on a frame, with its previous sweep if there is one."""
        for cached_frame, output in self._outputs:
            if cached_frame is frame:
                return output
        if self._outputs and not self.is_consecutive(frame, self._outputs[-1][0]):
            self._outputs = []
        key = frame.agent_id, frame.timestamp_ns
        output = self._feature_cache.get(key) if self._feature_cache is not None else None
        if output is None:
            before = self._outputs[-1][0] if self._outputs else None
            earlier = None if before is None else before.points.transform(self.motion_since(frame, before))
            output = self._with_estimated_velocity(frame, self.run_detector(frame.points, earlier))
        if self._feature_cache is not None:
            self._feature_cache[key] = output
        self._outputs = [*self._outputs, (frame, output)][-self._max_frames :]
        return output

    def process_tokens(self, frame: AgentFrame) -> TokenOutput:
        """``process`` by a detector with tokens; ConfigError if it has none."""
        output = self.process(frame)
        if isinstance(output, TokenOutput):
            return output
        require_tokens(self.detector)
        raise TypeError("A TokenDetector gives a TokenOutput.")

    def _with_estimated_velocity(self, frame: AgentFrame, output: AgentOutput) -> AgentOutput:
        """Return the output with velocities estimated over the last frames that have boxes."""
        if self._velocity_config is None:
            return output
        earlier = [
            PastDetections(
                past_output.boxes.to(torch.float32),
                (frame.timestamp_ns - before.timestamp_ns) / 1e9,
                before.points,
                self.motion_since(frame, before),
            )
            for before, past_output in self._outputs[: -TRACK_FRAMES - 1 : -1]
            if len(past_output.boxes)
        ]
        if not earlier:
            return output
        return output.with_velocity(estimate_velocities(output.boxes, earlier, self._velocity_config, frame.points.xyz))

    def previous_outputs(
        self, frame: AgentFrame, num_frames: int = HISTORY_FRAMES
    ) -> list[tuple[AgentFrame, AgentOutput]]:
        """Outputs of the frames before this one, newest first."""
        at = next((i for i, (cached_frame, _) in enumerate(self._outputs) if cached_frame is frame), 0)
        return self._outputs[max(0, at - num_frames) : at][::-1]

    def previous_tokens(self, frame: AgentFrame, num_frames: int = HISTORY_FRAMES) -> list[AgentTokens]:
        """Return the agent's own tokens of the frames before this one, newest first, for ego 0."""
        parts = []
        for before, output in self.previous_outputs(frame, num_frames):
            if isinstance(output, TokenOutput):
                tokens, age_s = output.shared_tokens, (frame.timestamp_ns - before.timestamp_ns) / 1e9
                motion, roadside = self.motion_since(frame, before), before.is_infrastructure
                part = AgentTokens(0, tokens.features, tokens.sites.xy, motion, age_s, is_infrastructure=roadside)
                parts.append(part)
        return parts

    def record_sent(self, frame: AgentFrame, tokens: SparseBev) -> None:
        """Record the sent tokens (N, C + PROPOSAL) of this frame; a second call for the same frame replaces the first."""
        self._sent = [*(s for s in self._sent if s[0] is not frame), (frame, tokens)][-HISTORY_FRAMES - 1 :]

    def recently_sent(self, frame: AgentFrame) -> list[tuple[AgentFrame, SparseBev]]:
        """Return tokens sent in the frames before this one, oldest first: those still in the receivers' history."""
        earlier = [(then, tokens) for then, tokens in self._sent if then is not frame]
        return [(then, tokens) for then, tokens in earlier[-HISTORY_FRAMES:] if self.is_consecutive(frame, then)]

    @property
    def merged(self) -> PerceptionCache:
        """The cache of merged clouds, for early fusion: frames of this agent with the points of all messages."""
        if self._merged is None:
            self._merged = PerceptionCache(self.detector, self._max_frames, velocity_config=self._velocity_config)
        return self._merged

    @property
    def history(self) -> History:
        """State changed by perception; assign an earlier value to restore it."""
        return () if self._merged is None else tuple(self._merged._outputs), self.last_fused

    @history.setter
    def history(self, history: History) -> None:
        merged, self.last_fused = history
        if self._merged is not None:
            self._merged._outputs = list(merged)

    def run_detector(self, cloud: PointCloud, earlier: PointCloud | None = None) -> AgentOutput:
        """Detector output on any cloud in an agent's frame and on the previous one in the same frame; not cached."""
        with torch.inference_mode():
            if has_tokens(self.detector):
                tokens, raw = self.detector.extract_tokens(cloud, earlier)
                return TokenOutput(tokens, tokens, raw, self.detector.decode_config)
            boxes = self.detector.detect(cloud, earlier)
        if not isinstance(boxes, Boxes):
            raise ConfigError(
                f"{type(self.detector).__name__}.detect needs to return Boxes; got {type(boxes).__name__}."
            )
        return BoxOutput(boxes[boxes.score.argsort(descending=True, stable=True)].to(cloud.xyz.dtype))

    def fuse(self, tokens: Tokens, past: Tokens | None = None) -> tuple[FusedBev, RawBoxes]:
        """Fused tokens around one ego, and raw boxes from them."""
        with torch.inference_mode():
            return self.token_detector.fuse(tokens, past)

    def decode(self, raw: RawBoxes) -> Boxes:
        """Decoded boxes around one ego, in its frame, by falling score."""
        return decode(raw, self.token_detector.decode_config)[0]
