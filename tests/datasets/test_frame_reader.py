# SPDX-License-Identifier: Apache-2.0
"""Single frames of a recording that knows snapshots alone; OPV2V's own are in test_opv2v."""

from __future__ import annotations

import torch

from manyeyes.datasets.base import Recording
from manyeyes.datasets.frame_reader import FrameReader, SnapshotFrameReader, as_frame_reader
from manyeyes.datatypes import AgentFrame, PointCloud, Snapshot, Transform


class Apart:
    """One scenario of two snapshots; the second lacks an agent. Whole snapshots only."""

    scenarios = ("a",)

    def length(self, scenario: str) -> int:
        return 2

    def eval_indices(self, scenario: str) -> range:
        return range(2)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (4, 7)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        ids = (4, 7)[: 2 - index]
        frames = [AgentFrame.of(PointCloud.of(torch.full((1, 3), float(i))), Transform.identity(), i) for i in ids]
        return Snapshot(scenario, index, tuple(frames))


def test_frames_are_taken_from_snapshots_by_default() -> None:
    recording: Recording = Apart()
    frames: FrameReader = as_frame_reader(recording)
    assert isinstance(frames, SnapshotFrameReader)
    assert [frames.present_agents("a", i) for i in range(2)] == [(4, 7), (4,)]
    assert frames.frame("a", 0, 7).points.xyz.tolist() == [[7.0, 7.0, 7.0]]
