# SPDX-License-Identifier: Apache-2.0
"""CPU time of share and perceive against an older commit, and time and memory of perceive with one hostile sender.

Both versions of the package run in one process: each has its own modules, which are exchanged in ``sys.modules`` around its calls.
Four agents stand in a street (``street.py``) and share at 10 Hz; each instant is computed by both versions in turn, and the first
one alternates. A difference is the ratio of summed CPU times less one, with a 95 % interval by a bootstrap over instants.

Hostile senders are the ATTACKS of ``tests/probes/hostile.py``, one at a time beside the three honest ones, in each instant after
the first. Ratio: CPU time of perceive (reception included) with the attack over the time without, medians in turn. Peak: resident
memory of the process while it receives and perceives, above what it holds before.

python benchmarks/receiver.py [--baseline COMMIT or FOLDER] [--instants 40] [--attacks NAME ...]
    [--out benchmarks/results/receiver.json]
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from versions import ROOT, Version as Checkout, checkout, use_own_cache

CACHE = use_own_cache()
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from street import street  # noqa: E402
from tests.probes.hostile import ATTACKS, attack_packets  # noqa: E402
from tests.probes.memory import release_memory, resident_kb  # noqa: E402

from manyeyes import Agent, AgentFrame  # noqa: E402
from manyeyes.agents.own_detections import MIN_RESTORED_SCORE  # noqa: E402
from manyeyes.agents.strategies.registry import get_strategy  # noqa: E402
from manyeyes.models import pretrained  # noqa: E402
from manyeyes.studies.provenance import write_json  # noqa: E402

TENTH_NS = 100_000_000
NUM_AGENTS = 4
STRATEGIES = ("intermediate-temporal", "late")
WARMUP = 3


@dataclass
class Version(Checkout):
    """One checkout of the package. agents: by strategy; they keep their histories."""

    agents: dict[str, list[Any]] = field(default_factory=dict)

    def start(self) -> None:
        """Load the shipped weights, and make the agents."""
        import manyeyes
        from manyeyes import Agent as VersionAgent
        from manyeyes.agents.strategies.registry import get_strategy as get_version_strategy
        from manyeyes.models import pretrained as version_pretrained

        assert Path(manyeyes.__file__).is_relative_to(self.source), f"{manyeyes.__file__} is not of {self.source}"
        detector = version_pretrained.load()
        self.agents = {
            name: [VersionAgent(detector, get_version_strategy(name)) for _ in range(NUM_AGENTS)] for name in STRATEGIES
        }

    def frames(self, seen: Sequence[AgentFrame], instant: int) -> list[Any]:
        """Return the frames of an instant as objects of this version."""
        from manyeyes import AgentFrame as VersionFrame, PointCloud, Transform

        return [
            VersionFrame.of(
                PointCloud.of(f.points.xyz, f.points.intensity),
                Transform(f.world_from_agent.rotation, f.world_from_agent.translation),
                agent_id=n,
                timestamp_ns=(instant + 1) * TENTH_NS,
            )
            for n, f in enumerate(seen)
        ]

    def step(self, strategy: str, seen: Sequence[AgentFrame], instant: int) -> tuple[float, float, torch.Tensor]:
        """Return CPU seconds of all shares and of the ego's perceive, and its boxes (N, 5)."""
        frames, agents = self.frames(seen, instant), self.agents[strategy]
        began = time.process_time()
        packets = [agent.share(frame) for agent, frame in zip(agents, frames)]
        shared = time.process_time()
        boxes = agents[0].perceive(frames[0], [packet for sent in packets[1:] for packet in sent]).boxes
        return shared - began, time.process_time() - shared, boxes.bev()


@dataclass(frozen=True)
class Difference:
    """Ratio of the present CPU time to the baseline's, less one, with its 95 % interval; milliseconds of both an instant."""

    strategy: str
    step: str
    baseline_ms: float
    present_ms: float
    difference: float
    low: float
    high: float
    instants: int
    equal_boxes: int


def compare(baseline: Version, present: Version, seen: Sequence[AgentFrame], instants: int) -> list[Difference]:
    """Time both versions in turn, each loaded twice: the one that is loaded later is slower by some percent, even of equal code."""
    versions = [baseline, present, Version(present.source), Version(baseline.source)]
    for version in versions:
        with version.active():
            version.start()
    found = []
    for strategy in STRATEGIES:
        spent, equal = np.zeros((instants, len(versions), 2)), 0
        for instant in range(-WARMUP, instants):
            boxes: dict[int, torch.Tensor] = {}
            for which in sorted(range(len(versions)), reverse=bool(instant % 2)):
                with versions[which].active():
                    share, perceive, boxes[which] = versions[which].step(strategy, seen, instant + WARMUP)
                if instant >= 0:
                    spent[instant, which] = share, perceive
            equal += instant >= 0 and torch.equal(boxes[0], boxes[1])
        both = np.stack((spent[:, 0] + spent[:, 3], spent[:, 1] + spent[:, 2]), 1) / 2
        for step, columns in (("share", [0]), ("perceive", [1]), ("both", [0, 1])):
            found.append(difference(strategy, step, both[..., columns].sum(-1), int(equal)))
            print(found[-1], flush=True)
    return found


def difference(strategy: str, step: str, spent: np.ndarray, equal: int) -> Difference:
    """Return the difference of CPU seconds (instants, 2) of the baseline and of the present version."""
    rows = np.random.default_rng(0).integers(0, len(spent), (4000, len(spent)))
    drawn = spent[rows].sum(1)
    low, high = np.quantile(drawn[:, 1] / drawn[:, 0] - 1, (0.025, 0.975)).tolist()
    old, new = (1e3 * spent.mean(0)).tolist()
    return Difference(strategy, step, old, new, new / old - 1, low, high, len(spent), equal)


@dataclass(frozen=True)
class Attack:
    """One hostile sender beside three honest ones: ratio of the time of perceive, and MiB at the peak with and without it.

    share_kept: of the boxes of the honest drive of score 0.3 or more, those within 1 m of a box under attack, the least over the
    instants.
    """

    strategy: str
    name: str
    ratio: float
    peak_mib: float
    honest_peak_mib: float
    share_kept: float


def measure_attack(name: str, strategy: str, seen: Sequence[AgentFrame], instants: int) -> Attack:
    """Perceive the same drive with and without the attack, in turn."""
    detector = pretrained.load()
    senders = [Agent(detector, get_strategy(strategy)) for _ in range(NUM_AGENTS - 1)]
    struck, clean = (Agent(detector, get_strategy(strategy)) for _ in range(2))
    version = Version(ROOT / "src")
    rows, kept = [], [1.0]
    for instant in range(instants):
        ego, *others = version.frames(seen, instant)
        honest = [agent.share(frame) for agent, frame in zip(senders, others)]
        packets = [packet for sent in honest for packet in sent]
        hostile = attack_packets(name, honest[0], ego.timestamp_ns) if instant else []
        for agent in (struck, clean):
            agent.perception_cache.process(ego)
        found, row = [], []
        for agent, content in ((clean, packets), (struck, [*hostile, *packets])):
            release_memory()
            Path("/proc/self/clear_refs").write_text("5")
            before, began = resident_kb(), time.process_time()
            found.append(agent.perceive(ego, content).boxes)
            row += [time.process_time() - began, (resident_kb("VmHWM") - before) / 1024]
        if instant:
            rows.append(row)
            detected = found[0][found[0].score >= MIN_RESTORED_SCORE]
            if len(detected):
                nearest = torch.cdist(detected.center[:, :2], found[1].center[:, :2]).amin(1)
                kept.append(float((nearest <= 1.0).float().mean()))
    median = np.median(np.array(rows), 0)
    peaks = np.array(rows).max(0)
    return Attack(strategy, name, float(median[2] / median[0]), float(peaks[3]), float(peaks[1]), min(kept))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--baseline", default="16f55c8")
    parser.add_argument("--instants", type=int, default=40)
    parser.add_argument("--attacks", nargs="*", default=list(ATTACKS))
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    seen = list(street(agents=NUM_AGENTS).frames)
    result: dict[str, Any] = {"command": shlex.join(["python", *sys.argv])}
    if wanted.instants:
        with checkout(wanted.baseline) as code:
            result["differences"] = compare(Version(code / "src"), Version(ROOT / "src"), seen, wanted.instants)
    result["attacks"] = []
    for strategy in STRATEGIES:
        for name in wanted.attacks:
            result["attacks"].append(measure_attack(name, strategy, seen, 4))
            print(result["attacks"][-1], flush=True)
    if wanted.out:
        settings = {"baseline": wanted.baseline, "instants": wanted.instants, "attacks": wanted.attacks}
        write_json(wanted.out, result, settings, seed=0)


if __name__ == "__main__":
    main()
