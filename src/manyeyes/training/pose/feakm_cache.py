# SPDX-License-Identifier: Apache-2.0
"""What a frozen detector sees of a recording, kept on disk: FeaKM's matcher is trained on it, never on clouds.

One file a snapshot, written under a temporary name and renamed, in a folder named by the fingerprint of the weights: views of
other weights are never taken for these. A build that was stopped goes on where it was.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from manyeyes._io import atomic_write
from manyeyes.agents.perception_cache import Eyes, Sight
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import (
    BevGrid,
    Boxes,
    ConfigError,
    RecordingError,
    Sites,
    Snapshot,
    SparseBev,
    Transform,
)
from manyeyes.models.detector.detector import Detector
from manyeyes.models.pose.keypoint_net import View
from manyeyes.ops.keyed_random import keyed_generator


@dataclass(frozen=True)
class Scene:
    """views of all agents at one instant, each in its own frame, and their true poses, batch shape (agents,)."""

    views: tuple[View, ...]
    world_from_agent: Transform


@dataclass(frozen=True)
class Pair:
    """Views of two agents at one instant and where the second truly is, seen from the first."""

    ego: View
    other: View
    ego_from_other: Transform


@dataclass(frozen=True)
class FeatureCache:
    """Snapshots (scenario, index) whose views lie in a folder."""

    folder: Path
    snapshots: tuple[tuple[str, int], ...]

    def scene(self, number: int) -> Scene:
        """All agents of the snapshot of that number."""
        return read_scene(_file(self.folder, *self.snapshots[number]))

    def draw(self, seed: int, number: int) -> Pair:
        """Pair of that number of an endless, keyed stream: a snapshot and two of its agents, uniform."""
        rng = keyed_generator("feakm pair", seed, number)
        scene = self.scene(int(rng.integers(len(self.snapshots))))
        ego, other = rng.permutation(len(scene.views))[:2].tolist()
        return pair(scene, ego, other)

    def pairs(self) -> Iterator[Pair]:
        """Every two agents of every snapshot, the first of them as ego."""
        for number in range(len(self.snapshots)):
            scene = self.scene(number)
            for other in range(1, len(scene.views)):
                yield pair(scene, 0, other)


def pair(scene: Scene, ego: int, other: int) -> Pair:
    """Two agents of a scene."""
    poses = scene.world_from_agent
    return Pair(scene.views[ego], scene.views[other], poses[ego].inverse() @ poses[other])


def wanted(recording: Recording, every: int = 3) -> list[tuple[str, int]]:
    """Every so many judged snapshots of at least two agents: neighbours in time show nearly the same."""
    if every < 1:
        raise ConfigError(f"Every how many snapshots is at least 1; got {every}.")
    found = [
        (scenario, index)
        for scenario in recording.scenarios
        if len(recording.agents(scenario)) > 1
        for index in recording.judged(scenario)[::every]
    ]
    if not found:
        raise RecordingError("No snapshot of this recording has two agents; matching needs two.")
    return found


def build(recording: Recording, detector: Detector, root: Path, every: int = 3) -> Iterator[FeatureCache]:
    """See what is not yet kept under root, giving what is there after each snapshot; the last one given is the whole.

    Each agent sees the snapshot before as well, so that a detector of several sweeps has both.
    """
    folder, done = root / detector.fingerprint.hex(), []
    for scenario, index in wanted(recording, every):
        path = _file(folder, scenario, index)
        if not path.exists():
            eyes = {agent: Eyes(detector) for agent in recording.agents(scenario)}
            for before in range(max(0, index - 1), index):
                _see(eyes, recording.snapshot(scenario, before))
            snapshot = recording.snapshot(scenario, index)
            views = tuple(View.of(sight.told, sight.boxes) for sight in _see(eyes, snapshot))
            write_scene(path, Scene(views, _poses(snapshot)))
        done.append((scenario, index))
        yield FeatureCache(folder, tuple(done))


def _see(eyes: dict[int, Eyes], snapshot: Snapshot) -> list[Sight]:
    return [eyes[frame.agent_id].see(frame) for frame in snapshot.frames]


def _poses(snapshot: Snapshot) -> Transform:
    if snapshot.truth is None:
        raise RecordingError(
            f"Snapshot {snapshot.index} of '{snapshot.scenario}' has no truth; a matcher is taught by true poses."
        )
    return snapshot.truth.world_from_agent


def _file(folder: Path, scenario: str, index: int) -> Path:
    return folder / scenario / f"{index:06d}.safetensors"


def write_scene(path: Path, scene: Scene) -> None:
    """One snapshot's views: features and confidence as float16, boxes as they are."""
    state: dict[str, Tensor] = {"world_from_agent": scene.world_from_agent.matrix().contiguous()}
    for i, view in enumerate(scene.views):
        state |= {
            f"{i}.features": view.tokens.features.half().contiguous(),
            f"{i}.key": view.tokens.sites.key,
            f"{i}.confidence": view.confidence.half().contiguous(),
        }
        state |= {f"{i}.boxes.{f.name}": getattr(view.boxes, f.name).contiguous() for f in fields(Boxes)}
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, save(state, {"grid": json.dumps(asdict(scene.views[0].tokens.grid))}), durable=False)


def read_scene(path: Path) -> Scene:
    """The inverse of write_scene."""
    try:
        with safe_open(path, "pt") as file:
            grid = BevGrid(**json.loads(file.metadata()["grid"]))
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise RecordingError(
            f"{path}: not a whole file of views ({error}); delete it, and it is made again."
        ) from error
    poses = Transform.from_matrix(state["world_from_agent"])
    views = []
    for i in range(len(poses.translation)):
        tokens = SparseBev(state[f"{i}.features"].float(), Sites(state[f"{i}.key"], grid))
        boxes = Boxes(**{f.name: state[f"{i}.boxes.{f.name}"] for f in fields(Boxes)})
        views.append(View(tokens, state[f"{i}.confidence"].float(), boxes))
    return Scene(tuple(views), poses)
