# SPDX-License-Identifier: Apache-2.0
"""What a detector made of an agent's own cloud, remembered so that sharing and perceiving see it once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from manyeyes.datatypes import AgentFrame, Boxes, PointCloud, SparseBev
from manyeyes.models.box_head import DecodeConfig, RawBoxes, decode
from manyeyes.models.detector import Detector
from manyeyes.models.fusion.gather import Tokens


@dataclass(frozen=True)
class Sight:
    """One agent's own view: what it can tell others (N, C + PROPOSAL), the worth (N,) of each token, and its raw boxes."""

    told: SparseBev
    worth: Tensor
    raw: RawBoxes
    config: DecodeConfig

    @cached_property
    def boxes(self) -> Boxes:
        """The agent's own boxes, in its frame, best first; decoded when first asked for, since not everybody sends them."""
        return decode(self.raw, self.config)[0]


class Eyes:
    """A detector and the last few frames that it saw. Frames are told apart by identity."""

    def __init__(self, detector: Detector, remember: int = 8) -> None:
        self.detector = detector
        self._remember = remember
        self._seen: list[tuple[AgentFrame, Sight]] = []

    def see(self, frame: AgentFrame) -> Sight:
        """The agent's own view of its frame."""
        for known, sight in self._seen:
            if known is frame:
                return sight
        sight = self.see_cloud(frame.points)
        self._seen = [*self._seen, (frame, sight)][-self._remember :]
        return sight

    def see_cloud(self, cloud: PointCloud) -> Sight:
        """The view of any cloud in an agent's frame; not remembered."""
        with torch.inference_mode():
            seen = self.detector.see([cloud])
            raw = self.detector.look(seen.tokens)
        return Sight(self.detector.tell(seen.tokens, raw), seen.worth, raw, self.detector.config.decode)

    def fuse(self, tokens: Tokens) -> RawBoxes:
        """Raw boxes around one ego."""
        with torch.inference_mode():
            return self.detector.fuse(tokens)

    def decode(self, raw: RawBoxes) -> Boxes:
        """Boxes around one ego, in its frame, best first."""
        return decode(raw, self.detector.config.decode)[0]
