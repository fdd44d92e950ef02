# SPDX-License-Identifier: Apache-2.0
"""Compute what a renaming must not change, and save it: ``python tests/equivalence/probe.py OUT.npz DATA``.

``compare.py`` runs this file of two commits, each on its own code, and compares the arrays bit for bit. Keys of arrays hold names
of the package; ``compare.py`` maps those that changed. DATA: a folder in which the probes simulate, kept between runs of one code.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.datatypes import Transform
from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.evaluation.maps.registry import fuse_observations, make_tuned_settings
from manyeyes.models import pretrained
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import list_correctors, load_corrector
from manyeyes.pose.types import PosePrior
from manyeyes.simulator.fleet.landmark_errors import BoxNoise
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene
from manyeyes.training.detector.samples import AugmentConfig
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.trainer import Trainer

Arrays = Iterator[tuple[str, np.ndarray]]

FINGERPRINT = slice(56, 64)


def flat(value: Any) -> Iterator[float | str]:
    """All numbers and strings of a nested value, in order; names of fields play no part."""
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from flat(getattr(value, field.name))
    elif isinstance(value, dict):
        for item in value.values():
            yield from flat(item)
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from flat(item)
    elif isinstance(value, (bool, int, float)):
        yield float(value)


def fresh(folder: Path) -> Path:
    """The same path, with nothing there."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def content(packets: list[bytes]) -> np.ndarray:
    """The bytes of packets without fingerprint and checksum, which hash names, and the lengths."""
    kept = [p[: FINGERPRINT.start] + p[FINGERPRINT.stop : -4] for p in packets]
    return np.frombuffer(b"".join(len(p).to_bytes(4, "little") + p for p in kept), np.uint8)


def strategies(data: Path) -> Arrays:
    """Packets of every strategy and token encoding on one drive, and the boxes of every strategy."""
    if not (data / "tiny" / "manifest.json").is_file():
        assert cli.main(["simulate", "--preset", "smoke-opv2v", "--out", str(data / "tiny"), "--workers", "1"]) == 0
    recording, detector = Opv2vRecording(data / "tiny", "test", use_cache=False), pretrained.load()
    scenario = recording.scenarios[0]
    snapshots = [recording.snapshot(scenario, index) for index in range(recording.length(scenario))]
    for number, frame in enumerate(snapshots[0].frames):
        yield f"simulator/points/{number}", frame.points.xyz.numpy()
    for key in list_strategies():
        for encoding in ("float32", "float16", "int8", "codebook"):
            agents = {
                f.agent_id: Agent(detector, get_strategy(key), token_encoding=encoding) for f in snapshots[0].frames
            }
            for time, snapshot in enumerate(snapshots):
                sent = {f.agent_id: agents[f.agent_id].share(f) for f in snapshot.frames}
                yield f"packets/{key}/{encoding}/{time}", content([p for packets in sent.values() for p in packets])
                ego = snapshot.frames[0]
                received = [p for sender, packets in sent.items() if sender != ego.agent_id for p in packets]
                boxes = agents[ego.agent_id].perceive(ego, received).boxes
                yield (
                    f"boxes/{key}/{encoding}/{time}",
                    torch.cat((boxes.bev(), boxes.score[:, None], boxes.velocity), 1).numpy(),
                )


def corrected_poses(data: Path) -> Arrays:
    """Answers of every pose corrector on 50 scenes of landmarks, with a prior and without."""
    spec = LandmarkSpec(num_common=6, num_ego_only=4, num_other_only=4, noise=BoxNoise(0.3, np.radians(2.0), 0.05, 0.1))
    for number in range(50):
        scene = make_landmark_scene(spec, 7, number)
        ego, other = Landmarks.of_boxes(scene.ego[0]), Landmarks.of_boxes(scene.other[0])
        x, y, yaw = (scene.ego_from_other + np.array([0.8, -0.5, 0.02])).tolist()
        wrong = Transform.from_xyz_yaw(x, y, 0.0, yaw)
        for key in list_correctors("landmarks"):
            for prior_key, prior in (("prior", PosePrior(wrong, np.diag([0.5, 0.5, 0.01]))), ("none", None)):
                found = load_corrector(key)(ego, other, prior)
                pose = np.full(3, np.nan) if found.pose is None else np.asarray(found.pose)
                numbers = [found.inliers, found.runner_up, found.margin, found.mahalanobis_squared]
                yield f"pose/{key}/{prior_key}/{number}", np.concatenate((pose, found.covariance.ravel(), numbers))


def fused_maps(data: Path) -> Arrays:
    """The fused map of two places."""
    for place in ("cross", "Town07"):
        scene = run_trial(FleetTrial(place, 24, 3, 150.0))
        made = fuse_observations("manyeyes", scene.observations, make_tuned_settings(), scene.place.frame)
        for field in ("points", "score", "sigma", "style", "kind", "offsets"):
            yield f"map/{place}/{field}", np.asarray(getattr(made.elements, field))


def trained_weights(data: Path) -> Arrays:
    """Weights after 20 training steps, in the order of the state dictionary."""
    config = DetectorTrainConfig(COSTR_TINY, steps=20, batch=1, augment=AugmentConfig(max_agents=2))
    task = DetectorTask(config, Opv2vRecording(data / "tiny", "train", use_cache=False), seed=5)
    run = Trainer(task, fresh(data / "run"))
    for step in range(20):
        yield f"training/loss/{step}", np.array([*flat(run.advance())][:2])
    for number, value in enumerate(run.model.state_dict().values()):
        yield f"training/weights/{number}", value.numpy()


FORMER_ERRORS = ("--noise-in-time", "independent", "--claimed-covariance", "true", "--no-odometry-drift")
"""Pose errors as they were in older code."""
STUDIES: dict[str, tuple[str, ...]] = {
    "evaluate": ("evaluate", "--methods", "no-fusion", "late", "intermediate-temporal"),
    "robustness": ("study", "robustness", "--methods", "late", "--perturbations", "0.8 m", *FORMER_ERRORS),
    "budget": (
        "study",
        "bandwidth",
        "--methods",
        "late",
        "--token-selection",
        "intermediate-confidence-temporal",
        "--budgets",
        "4096",
        *FORMER_ERRORS,
    ),
    "agents": ("study", "num-agents", "--methods", "intermediate-temporal", *FORMER_ERRORS),
    "pose": ("study", "pose-noise-ap", "--correctors", "voting", "--perturbations", "0.8 m", *FORMER_ERRORS),
}
UNTIMED = ("evaluate",)
LEFT_OUT = ("_ms", "_s", "seconds", "iou", "bar")


def studies(data: Path) -> Arrays:
    """The numbers of one cell of each study, on a drive of a few frames; times are left out."""
    for key, words in STUDIES.items():
        out = fresh(data / f"study-{key}")
        timing = ("--timing-frames", "0") if key in UNTIMED else ()
        common = ("--data", str(data / "tiny"), "--split", "test", "--workers", "1", *timing, "--out", str(out))
        assert cli.main([*words, *common]) == 0, key
        for path in sorted(out.glob("*.json")):
            yield f"study/{key}", np.array([*flat(without_times(json.loads(path.read_text())["result"]))])


def without_times(value: Any) -> Any:
    """The same without fields of measured time, whose names end in a unit of time, and without thresholds and targets."""
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if not k.endswith(LEFT_OUT)}
    return [without_times(item) for item in value] if isinstance(value, list) else value


PROBES = (strategies, corrected_poses, fused_maps, trained_weights, studies)


def main() -> None:
    # Products of float32, whatever the processor.
    os.environ["MANYEYES_BFLOAT16"] = "0"
    torch.set_num_threads(1)
    out, data = Path(sys.argv[1]), Path(sys.argv[2])
    data.mkdir(parents=True, exist_ok=True)
    wanted = sys.argv[3:]
    found: dict[str, np.ndarray] = {}
    for probe in PROBES:
        if wanted and probe.__name__ not in wanted:
            continue
        for key, value in probe(data):
            assert key not in found, key
            found[key] = value
        print(f"{probe.__name__}: {len(found)} arrays so far", flush=True)
    np.savez_compressed(out, **found)


if __name__ == "__main__":
    main()
