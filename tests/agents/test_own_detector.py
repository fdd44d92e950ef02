# SPDX-License-Identifier: Apache-2.0
"""A detector of the user's own in the agent, the replay and the benchmark: points in, boxes out."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import BoxOutput, PerceptionCache
from manyeyes.agents.replay import ReplayConfig, replay
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.detection.benchmark import benchmark
from manyeyes.models import pretrained
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.protocols import BoxDetector, has_tokens, require_tokens

BOX_STRATEGIES = ("no-fusion", "late", "late-temporal", "early")


class BlobDetector(BoxDetector):
    """One box of a car around all points above 1 m, with a score that grows with their number."""

    grid = BevGrid(-60.0, -60.0, -3.0, 60.0, 60.0, 3.0)

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        high = points.xyz[points.xyz[:, 2] > 1.0]
        rows = range(min(1, len(high)))
        center = torch.stack([high.mean(0) for _ in rows]) if len(high) else torch.zeros(0, 3)
        score = torch.tensor([len(high) / (len(high) + 5) for _ in rows])
        return Boxes.of(center, torch.tensor([[4.5, 1.9, 1.6]]).expand(len(center), 3), torch.zeros(len(center)), score)


def frame_of(agent_id: int, *objects: tuple[float, float], index: int = 0) -> AgentFrame:
    """An agent at the origin with four points on each object; agents are 10 m apart along y, index in tenths of a second."""
    corners = torch.tensor([[-1.0, -0.5, 1.5], [1.0, -0.5, 1.5], [-1.0, 0.5, 1.5], [1.0, 0.5, 1.5]])
    xyz = torch.cat([torch.zeros(1, 3), *(corners + torch.tensor([x, y - 10.0 * agent_id, 0.0]) for x, y in objects)])
    pose = Transform.from_xyz_yaw(0.0, 10.0 * agent_id)
    return AgentFrame.of(PointCloud.of(xyz), pose, agent_id=agent_id, timestamp_ns=index * 100_000_000)


class Crossing:
    """Two agents; the second detects a car at (20, 5) that the first does not."""

    scenarios = ("crossing",)

    def length(self, scenario: str) -> int:
        return 2

    def eval_indices(self, scenario: str) -> range:
        return range(2)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return 0, 1

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        frames = frame_of(0, index=index), frame_of(1, (20.0, 5.0), index=index)
        car = Boxes.of(torch.tensor([[20.0, 5.0, 1.5]]), torch.tensor([[4.5, 1.9, 1.6]]), torch.zeros(1)).to(
            torch.float64
        )
        seen = torch.tensor([[False], [True]])
        return Snapshot(
            scenario, index, frames, GroundTruth(car, seen, Transform.stack([f.world_from_agent for f in frames]))
        )


@pytest.mark.parametrize("name", ["late", "late-temporal", "early"])
def test_strategies_of_boxes_and_points_fuse_an_own_detector(name: str) -> None:
    sender, ego = (Agent(BlobDetector(), get_strategy(name)) for _ in range(2))
    packets = sender.share(frame_of(1, (20.0, 5.0)))
    found = ego.perceive(frame_of(0), packets).boxes
    assert found.center[:, :2].tolist() == [pytest.approx([20.0, 5.0], abs=0.02)]
    assert len(Agent(BlobDetector(), get_strategy(name)).perceive(frame_of(0)).boxes) == 0


def test_an_own_detector_alone_sends_nothing() -> None:
    agent = Agent(BlobDetector(), get_strategy("no-fusion"))
    frame = frame_of(0, (20.0, 5.0))
    assert agent.share(frame) == [] and len(agent.perceive(frame).boxes) == 1


def test_strategies_of_tokens_refuse_a_detector_of_boxes() -> None:
    needs_tokens = [name for name in list_strategies() if name.startswith("intermediate")]
    assert {"intermediate", "intermediate-multihop", "intermediate-where2comm"} <= set(needs_tokens)
    for name in needs_tokens:
        with pytest.raises(
            ConfigError, match="BlobDetector is a BoxDetector: it has no tokens, which intermediate fusion"
        ):
            Agent(BlobDetector(), get_strategy(name))
    with pytest.raises(ConfigError, match="no tokens"):
        PerceptionCache(BlobDetector()).process_tokens(frame_of(0))
    with pytest.raises(ConfigError, match="no tokens"):
        Agent(BlobDetector(), get_strategy("late"), token_encoding="codebook")


def test_the_shipped_architecture_is_both_a_box_detector_and_a_token_detector(drive, detector: Detector) -> None:
    frame = drive(1).frame(0, 3)
    assert not has_tokens(BlobDetector()) and require_tokens(detector) is detector
    boxes = detector.detect(frame.points)
    assert len(boxes) and torch.equal(boxes.bev(), PerceptionCache(detector).run_detector(frame.points).boxes.bev())


def test_tokens_of_others_are_rejected_and_boxes_of_other_detectors_are_fused(drive, detector: Detector) -> None:
    some = drive(2)
    ego = Agent(BlobDetector(), get_strategy("late"))
    perception = ego.perceive(some.frame(0, 3), Agent(detector).share(some.frame(1, 3)))
    assert all(m.message.tokens is None for m in perception.received)
    assert [r.reason for r in perception.rejected] == ["wrong_model"]
    late = Agent(detector, get_strategy("late"))
    message = late.share(some.frame(1, 3))
    alone = len(ego.perceive(some.frame(0, 3)).boxes)
    assert len(ego.perceive(some.frame(0, 3), message).boxes) > alone


def test_boxes_are_ranked_by_falling_score_and_have_the_dtype_of_the_points() -> None:
    class Unsorted(BlobDetector):
        def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
            center = torch.tensor([[10.0, 0.0, 0.8], [20.0, 0.0, 0.8], [30.0, 0.0, 0.8]], dtype=torch.float64)
            return Boxes.of(
                center, center * 0 + 2, center[:, 0] * 0, torch.tensor([0.2, 0.9, 0.5], dtype=torch.float64)
            )

    boxes = PerceptionCache(Unsorted()).process(frame_of(0)).boxes
    assert boxes.center[:, 0].tolist() == [20.0, 30.0, 10.0] and boxes.center.dtype == torch.float32


def test_velocities_are_estimated_from_the_boxes_of_the_last_sweeps() -> None:
    cache, outputs = PerceptionCache(BlobDetector()), []
    for index in range(5):
        outputs.append(cache.process(frame_of(0, (20.0 + index, 0.0), index=index)))
    assert all(isinstance(output, BoxOutput) for output in outputs)
    assert float(outputs[-1].boxes.velocity[0, 0]) == pytest.approx(10.0, abs=1.0)


def test_the_default_fingerprint_names_class_and_version() -> None:
    class Newer(BlobDetector):
        version = "2"

    class Named(BlobDetector):
        fingerprint = b"my-model"

    first, second = BlobDetector(), BlobDetector()
    assert first.fingerprint == second.fingerprint and len(first.fingerprint) == 8
    assert len({first.fingerprint, Newer().fingerprint, Named().fingerprint}) == 3
    packet = Agent(Named(), get_strategy("late")).share(frame_of(0, (20.0, 0.0)))[0]
    assert b"my-model" in packet


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"detect": None}, r"Broken is no detector: it needs a method detect\(points, previous\)"),
        ({"grid": (0, 1)}, r"Broken\.grid needs a BevGrid"),
        ({"fingerprint": b"four"}, r"Broken\.fingerprint needs 8 bytes"),
        ({"detect": lambda self, points, previous: [1, 2]}, r"Broken\.detect needs to return Boxes; got list"),
    ],
)
def test_what_a_detector_lacks_is_named(change: dict[str, object], text: str) -> None:
    broken = type("Broken", (BlobDetector,), change)()
    with pytest.raises(ConfigError, match=text):
        Agent(broken, get_strategy("no-fusion")).perceive(frame_of(0))


def test_replay_takes_an_own_detector() -> None:
    steps = list(replay(Crossing(), "crossing", BlobDetector(), BOX_STRATEGIES, ReplayConfig()))
    assert {step.method: len(step.boxes) for step in steps} == {
        "no-fusion": 0,
        "late": 1,
        "late-temporal": 1,
        "early": 1,
    }


def test_benchmark_takes_an_own_detector_and_returns_a_table() -> None:
    result = benchmark(Crossing(), BlobDetector(), BOX_STRATEGIES)
    assert [row.method for row in result.methods] == list(BOX_STRATEGIES)
    assert result["no-fusion"].ap[0].ap == 0.0 and result["late"].ap[0].ap == 1.0
    heading, *rows = str(result).splitlines()
    assert heading.split() == ["method", "AP@0.5", "AP@0.7", "bytes/message"]
    assert [row.split()[:2] for row in rows][:2] == [["no-fusion", "0.000"], ["late", "1.000"]] and rows[0].endswith(
        "-"
    )
    # Boxes beyond the range of the detector are not evaluated.
    assert result.protocol.gt_range == (-60.0, -60.0, -3.0, 60.0, 60.0, 3.0)


def test_a_registered_detector_is_loaded_by_name_wherever_weights_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(pretrained._DETECTORS._items, "blob", BlobDetector)
    assert isinstance(pretrained.load("blob"), BlobDetector) and pretrained.list_detectors()[-1] == "blob"
    assert benchmark(Crossing(), "blob", ["early"])["early"].ap[0].ap == 1.0
    monkeypatch.setitem(pretrained._DETECTORS._items, "broken", lambda: replace)
    with pytest.raises(ConfigError, match="function is no detector"):
        pretrained.load("broken")
