# SPDX-License-Identifier: Apache-2.0
"""What a detector made of an agent's own cloud, remembered so that sharing and perceiving see it once."""

from __future__ import annotations

import torch

from manyeyes.datatypes import AgentFrame, Boxes, PointCloud, SparseBev
from manyeyes.models.box_head import decode
from manyeyes.models.detector import Detector, Seen
from manyeyes.models.fusion.gather import Tokens, own_tokens


class Eyes:
    """A detector and the last few frames that it saw. Frames are told apart by identity."""

    def __init__(self, detector: Detector, remember: int = 8) -> None:
        self.detector = detector
        self._remember = remember
        self._seen: list[tuple[AgentFrame, Seen]] = []

    def see(self, frame: AgentFrame) -> Seen:
        """Tokens of the frame's own cloud, in the agent's frame."""
        for known, seen in self._seen:
            if known is frame:
                return seen
        seen = self.see_cloud(frame.points)
        self._seen = [*self._seen, (frame, seen)][-self._remember :]
        return seen

    def see_cloud(self, cloud: PointCloud) -> Seen:
        """Tokens of any cloud in an agent's frame; not remembered."""
        with torch.inference_mode():
            return self.detector.see([cloud])

    def own(self, bev: SparseBev) -> Boxes:
        """What these tokens alone say."""
        return self.detect(own_tokens(bev))

    def detect(self, tokens: Tokens) -> Boxes:
        """Boxes around one ego, in its frame, best first."""
        with torch.inference_mode():
            return decode(self.detector.fuse(tokens), self.detector.config.decode)[0]
