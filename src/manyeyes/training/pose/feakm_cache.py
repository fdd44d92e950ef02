# SPDX-License-Identifier: Apache-2.0
"""Cache the outputs of a frozen detector on a recording, on which FeaKM's matcher is trained.

One file per snapshot, written atomically, in a folder named by the detector's fingerprint, so that views of other weights are never
mixed. An interrupted build resumes.
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
from manyeyes.agents.level_frame import SnapshotLeveller
from manyeyes.agents.perception_cache import PerceptionCache, TokenOutput
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import BevGrid, Boxes, ConfigError, RecordingError, Sites, Snapshot, SparseBev, Transform
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.models.pose.keypoint_net import DetectorView
from manyeyes.ops.keyed_random import keyed_generator


@dataclass(frozen=True)
class CachedSnapshot:
    """Views of all agents at one instant, each in its own frame, and their true poses, batch shape (agents,)."""

    views: tuple[DetectorView, ...]
    world_from_agent: Transform


@dataclass(frozen=True)
class ViewPair:
    """Views of two agents at one instant and their true relative pose."""

    ego: DetectorView
    other: DetectorView
    ego_from_other: Transform


@dataclass(frozen=True)
class FeatureCache:
    """Snapshots (scenario, index) whose views are stored in a folder."""

    folder: Path
    snapshots: tuple[tuple[str, int], ...]

    def load_snapshot(self, number: int) -> CachedSnapshot:
        """Load the snapshot of this number with all agents."""
        return read_cached_snapshot(_file(self.folder, *self.snapshots[number]))

    def draw(self, seed: int, number: int) -> ViewPair:
        """Draw the pair of this number from an endless, keyed stream: a snapshot and two of its agents, uniform."""
        rng = keyed_generator("feakm pair", seed, number)
        scene = self.load_snapshot(int(rng.integers(len(self.snapshots))))
        ego, other = rng.permutation(len(scene.views))[:2].tolist()
        return make_pair(scene, ego, other)

    def pairs(self) -> Iterator[ViewPair]:
        """Iterate over pairs of the first agent of every snapshot, as ego, and each other agent."""
        for number in range(len(self.snapshots)):
            scene = self.load_snapshot(number)
            for other in range(1, len(scene.views)):
                yield make_pair(scene, 0, other)


def make_pair(scene: CachedSnapshot, ego: int, other: int) -> ViewPair:
    """Pair two agents of a snapshot."""
    poses = scene.world_from_agent
    return ViewPair(scene.views[ego], scene.views[other], poses[ego].inverse() @ poses[other])


def select_snapshots(recording: Recording, frame_stride: int = 3) -> list[tuple[str, int]]:
    """Select every frame_stride-th evaluated snapshot with at least two agents; consecutive ones are nearly equal."""
    if frame_stride < 1:
        raise ConfigError(f"frame_stride must be at least 1; got {frame_stride}.")
    found = [
        (scenario, index)
        for scenario in recording.scenarios
        if len(recording.agents(scenario)) > 1
        for index in recording.eval_indices(scenario)[::frame_stride]
    ]
    if not found:
        raise RecordingError("No snapshot of this recording has two agents; matching needs two.")
    return found


def build_cache(
    recording: Recording, detector: BoxDetector, root: Path, frame_stride: int = 3
) -> Iterator[FeatureCache]:
    """Run the detector on snapshots that are not yet cached under root, and yield the growing cache after each.

    Each agent processes the preceding snapshot too, for detectors with several sweeps.
    """
    folder, done, level = root / detector.fingerprint.hex(), [], SnapshotLeveller()
    for scenario, index in select_snapshots(recording, frame_stride):
        path = _file(folder, scenario, index)
        if not path.exists():
            caches = {agent: PerceptionCache(detector) for agent in recording.agents(scenario)}
            for before in range(max(0, index - 1), index):
                _run_detectors(caches, level(recording.snapshot(scenario, before)))
            snapshot = level(recording.snapshot(scenario, index))
            views = tuple(
                DetectorView.of(sight.shared_tokens, sight.boxes) for sight in _run_detectors(caches, snapshot)
            )
            write_cached_snapshot(path, CachedSnapshot(views, _poses(snapshot)))
        done.append((scenario, index))
        yield FeatureCache(folder, tuple(done))


def _run_detectors(caches: dict[int, PerceptionCache], snapshot: Snapshot) -> list[TokenOutput]:
    return [caches[frame.agent_id].process_tokens(frame) for frame in snapshot.frames]


def _poses(snapshot: Snapshot) -> Transform:
    if snapshot.truth is None:
        raise RecordingError(
            f"Snapshot {snapshot.index} of '{snapshot.scenario}' has no truth; a matcher is trained with true poses."
        )
    return snapshot.truth.world_from_agent


def _file(folder: Path, scenario: str, index: int) -> Path:
    return folder / scenario / f"{index:06d}.safetensors"


def write_cached_snapshot(path: Path, scene: CachedSnapshot) -> None:
    """Write the views of one snapshot: features and confidence as float16, boxes unchanged."""
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


def read_cached_snapshot(path: Path) -> CachedSnapshot:
    """Read a file of write_cached_snapshot."""
    try:
        with safe_open(path, "pt") as file:
            grid = BevGrid(**json.loads(file.metadata()["grid"]))
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise RecordingError(f"{path}: not a whole file of views ({error}); delete it to have it rebuilt.") from error
    poses = Transform.from_matrix(state["world_from_agent"])
    views = []
    for i in range(len(poses.translation)):
        tokens = SparseBev(state[f"{i}.features"].float(), Sites(state[f"{i}.key"], grid))
        boxes = Boxes(**{f.name: state[f"{i}.boxes.{f.name}"] for f in fields(Boxes)})
        views.append(DetectorView(tokens, state[f"{i}.confidence"].float(), boxes))
    return CachedSnapshot(tuple(views), poses)
