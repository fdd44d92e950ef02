# SPDX-License-Identifier: Apache-2.0
"""Cost of misbehaviour detection on honest senders: time, AP and false exclusions, without and with it in turn in one process.

    python benchmarks/trust_cost.py --data DIR --split val --out benchmarks/results/trust_cost.json

Times are of the processor, so that other programs do not disturb them: medians over the same frames, with a detector run for
each. A step is what an ego does in a frame: share, with its own detections, then perceive. AP is of every agent as ego. Each
method is measured alone, and beside a pose corrector.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from unittest.mock import patch

import torch
import tyro

from manyeyes import load_detector, open_recording
from manyeyes.agents import replay
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.replay import DetectionReplay, ReplayConfig, ReplayStep
from manyeyes.agents.trust.interface import Evidence
from manyeyes.agents.trust.registry import get_misbehaviour_detector
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import Snapshot
from manyeyes.evaluation.detection.accumulator import MetricAccumulator
from manyeyes.evaluation.detection.benchmark import make_own_protocol
from manyeyes.studies import provenance


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is measured, of every how manieth scenario and of how many frames of each."""

    data: Path
    split: str = "val"
    weights: str = "costr-small"
    methods: tuple[str, ...] = ("intermediate-temporal", "intermediate", "late")
    correctors: tuple[str, ...] = ("off", "voting")
    misbehaviour: str = "ray-evidence"
    scenario_stride: int = 3
    frames: int = 12
    noise_xy_m: float = 0.0
    noise_yaw_deg: float = 0.0
    out: Path = Path("out/trust_cost.json")


@dataclass(frozen=True)
class Row:
    """One method and corrector. AP in percent; times in milliseconds; evidence: percent of claims of score 0.5 or more."""

    method: str
    corrector: str
    ap50_without: float
    ap50_with: float
    ap70_without: float
    ap70_with: float
    share_ms: float
    perceive_without_ms: float
    perceive_with_ms: float
    num_sender_frames: int
    num_excluded: int
    min_trust: float
    evidence: dict[str, float]

    @property
    def perceive_ratio(self) -> float:
        """Time of perceive, with to without."""
        return self.perceive_with_ms / self.perceive_without_ms

    @property
    def step_ratio(self) -> float:
        """Time of share and perceive, with to without."""
        return (self.share_ms + self.perceive_with_ms) / (self.share_ms + self.perceive_without_ms)


@dataclass
class Counts:
    """Counts of the assessments of one method."""

    kinds: Counter[str] = field(default_factory=Counter[str])
    trust: list[float] = field(default_factory=list[float])
    num_excluded: int = 0

    def add(self, step: ReplayStep) -> None:
        """Count one perception."""
        found = step.perception.assessment
        assert found is not None
        for sender in found.senders:
            self.trust.append(sender.trust)
            self.num_excluded += sender.weight == 0
        for claims in found.claims or ():
            self.kinds.update(Evidence(kind).name.lower() for kind in claims.kinds[claims.claims.score >= 0.5])


def measure(method: str, corrector: str, options: Options) -> Row:
    """Replay some scenarios without and with the detector, frame by frame in turn."""
    detector, recording = load_detector(options.weights), open_recording(options.data, options.split)
    noise = PoseNoise(
        mode="all_agents", sigma_xy_m=options.noise_xy_m, sigma_yaw_rad=math.radians(options.noise_yaw_deg)
    )
    is_noisy = bool(options.noise_xy_m or options.noise_yaw_deg)
    perturb: Callable[[Snapshot], Snapshot] = partial(_add_noise, noise if is_noisy else None)
    tallies = [MetricAccumulator(method, make_own_protocol(detector)) for _ in range(2)]
    counts, share_s = Counts(), list[float]()
    correction = None if corrector == "off" else PoseCorrection(corrector)
    for scenario in recording.scenarios[:: options.scenario_stride]:
        configs = [
            ReplayConfig(all_egos=True, pose_correction=correction, misbehaviour=found)
            for found in (None, get_misbehaviour_detector(options.misbehaviour))
        ]
        players = [DetectionReplay(method, detector, config) for config in configs]
        for index in recording.eval_indices(scenario)[: options.frames]:
            snapshot = perturb(recording.snapshot(scenario, index))
            for number, (player, tally) in enumerate(zip(players, tallies)):
                for step in player.step(snapshot):
                    tally.add(step)
                    share_s += [sent.seconds for sent in step.sent]
                    if number:
                        counts.add(step)
    results = [tally.compute_results()[0] for tally in tallies]
    total = max(1, sum(counts.kinds.values()))
    return Row(
        method,
        corrector,
        *(100 * results[0].ap[0].ap, 100 * results[1].ap[0].ap),
        *(100 * results[0].ap[1].ap, 100 * results[1].ap[1].ap),
        1e3 * median(share_s),
        *(1e3 * median(tallies[0].perceive_s), 1e3 * median(tallies[1].perceive_s)),
        len(counts.trust),
        counts.num_excluded,
        min(counts.trust, default=math.nan),
        {kind: 100 * number / total for kind, number in sorted(counts.kinds.items())},
    )


def _add_noise(noise: PoseNoise | None, snapshot: Snapshot) -> Snapshot:
    return snapshot if noise is None else noise.apply(snapshot, 0)


def main(options: Options) -> None:
    """Measure all methods, print and store them."""
    torch.set_num_threads(1)
    rows = list[Row]()
    with patch.object(replay, "time", _CpuClock):
        for method, corrector in product(options.methods, options.correctors):
            rows.append(measure(method, corrector, options))
            row = rows[-1]
            print(f"{row}\n  perceive x {row.perceive_ratio:.2f}, step x {row.step_ratio:.2f}", flush=True)
    ratios = [
        {"method": row.method, "corrector": row.corrector, "perceive": row.perceive_ratio, "step": row.step_ratio}
        for row in rows
    ]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    provenance.write_json(options.out, {"rows": rows, "ratios": ratios}, options, 0)


class _CpuClock:
    """Processor time of the thread in place of the clock."""

    perf_counter = staticmethod(time.thread_time)


if __name__ == "__main__":
    main(tyro.cli(Options))
