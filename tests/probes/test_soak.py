# SPDX-License-Identifier: Apache-2.0
"""Memory of a receiver over many frames, with five agents that come and go; each that comes back has a new id.

Short: what Python and the allocator have in use after a whole number of cycles of the drive, once all histories are full, does not
grow. Long (``make probes``): the slope of resident memory over 10,000 frames with its interval is below 1 kB a frame.

oneDNN, which torch multiplies matrices with, keeps a compiled kernel of about 40 kB for each shape of its arguments, up to
ONEDNN_PRIMITIVE_CACHE_CAPACITY of them (1,024 by default); each frame has its own shapes. So the memory of a process grows in its
first thousands of frames, to a bound. The soak keeps KEPT_KERNELS, so that all other growth shows.

``python -m tests.probes.test_soak STRATEGY FRAMES OUT.json`` prints and stores the slope.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.agents.conftest import TENTH_NS, Drive, tiny_detector
from tests.probes.hostile import BODY_OFFSET, Header, kind_of
from tests.probes.memory import Sample, sample_memory

from manyeyes import Agent, AgentFrame, PointCloud, Transform
from manyeyes.agents.exchange import Exchange
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.replay import EXPIRE_NS
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.comms.channel import channel_preset
from manyeyes.datatypes import Sites, SparseBev
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.detector import Detector

NUM_AGENTS, INSTANTS, POINTS = 5, 16, 40
"""The recorded instants are replayed forwards and backwards."""
PRESENT, ABSENT = 23, 7
"""Frames that a sender stays, and frames until the next one."""
PERIOD = PRESENT + ABSENT
assert PERIOD == 2 * INSTANTS - 2, "after PERIOD frames everything is as before, but for ids and times"
MAX_KB_PER_FRAME = 1.0
EVERY = 3 * PERIOD
"""Frames between samples."""
WARMUP = 2 * EVERY
"""Frames until all histories are full: the bus keeps packets for 10 s, 100 frames."""
KEPT_KERNELS = 16


@dataclass(frozen=True)
class Slope:
    """Least-squares slope, kB a frame, with its 95 % interval by a bootstrap of blocks of residuals; over so many frames."""

    kb_per_frame: float
    low: float
    high: float
    frames: int


Clouds = list[list[tuple[PointCloud, Transform]]]
"""Cloud and pose of each agent in each instant."""


def recorded_clouds() -> Clouds:
    """Thin clouds and poses of all agents in all instants of the cycle."""
    drive, cycle = Drive(), []
    for index in range(INSTANTS):
        points, row = drive.points(index), []
        points = points[:: len(points) // POINTS]
        for agent in range(NUM_AGENTS):
            yaw = 1.3 * agent
            x, y = 9.0 * math.cos(2.0 * agent) * (agent > 0), 9.0 * math.sin(2.0 * agent) * (agent > 0)
            pose = Transform.from_xyz_yaw(x + 0.5 * index * math.cos(yaw), y + 0.5 * index * math.sin(yaw), 0.0, yaw)
            row.append((PointCloud.of(pose.inverse().apply(points)), drive.world @ pose))
        cycle.append(row)
    return cycle


def recorded_detector() -> Detector:
    """The tiny detector, which processes each recorded cloud once; tokens and boxes are copies, as new as those of a new cloud."""
    detector, found = tiny_detector(), dict[int, tuple[SparseBev, RawBoxes]]()
    extract = detector.extract_tokens

    def extract_tokens(points: PointCloud, previous: PointCloud | None = None) -> tuple[SparseBev, RawBoxes]:
        tokens, raw = found.get(id(points)) or found.setdefault(id(points), extract(points, None))
        sites = Sites(tokens.sites.key.clone(), tokens.grid)
        values = ((f.name, getattr(raw, f.name)) for f in fields(raw) if f.name != "sites")
        columns = {name: value.clone() for name, value in values if isinstance(value, torch.Tensor)}
        return SparseBev(tokens.features.clone(), sites), replace(raw, sites=sites, **columns)

    vars(detector)["extract_tokens"] = extract_tokens
    return detector


def recorded_packets(detector: Detector, strategy: str, clouds: Clouds) -> list[list[list[bytes]]]:
    """The packets of every sender in every instant, by instant and sender; stamps and ids are those of the recording."""
    senders = [Agent(detector, get_strategy(strategy)) for _ in range(NUM_AGENTS)]
    return [
        [
            agent.share(AgentFrame.of(*row[n], agent_id=n, timestamp_ns=index * TENTH_NS))
            for n, agent in enumerate(senders)
        ]
        for index, row in enumerate(clouds)
    ]


def restamp(packets: list[bytes], agent_id: int, timestamp_ns: int) -> list[bytes]:
    """Return packets as of another sender and time."""
    head = replace(Header.read(packets[0]), agent_id=agent_id, time_ns=timestamp_ns)
    return head.message([(kind_of(packet), packet[BODY_OFFSET:-4]) for packet in packets])


def soak(strategy: str, frames: int, every: int, pose_correction: PoseCorrection | None = None) -> Iterator[Sample]:
    """Yield the memory every so many frames of one receiver; its senders stay for PRESENT frames, out of step with each other."""
    detector, clouds, ids = recorded_detector(), recorded_clouds(), count(1)
    recorded = recorded_packets(detector, strategy, clouds)
    order = [*range(INSTANTS), *range(INSTANTS - 2, 0, -1)]
    ego = Agent(detector, get_strategy(strategy), pose_correction=pose_correction)
    exchange, senders = Exchange(channel_preset("nr-sidelink"), 0, lambda agent_id: ego.inbox(EXPIRE_NS)), {}
    for n in range(frames):
        instant, stamp = order[n % len(order)], n * TENTH_NS
        own = AgentFrame.of(*clouds[instant][0], agent_id=0, timestamp_ns=stamp)
        present = [(own, ego.share(own))]
        for place in range(1, NUM_AGENTS):
            if (n + 6 * place) % PERIOD < PRESENT:
                agent_id = senders.setdefault(place, next(ids))
                frame = AgentFrame.of(*clouds[instant][place], agent_id=agent_id, timestamp_ns=stamp)
                present.append((frame, restamp(recorded[instant][place], agent_id, stamp)))
            else:
                senders.pop(place, None)
        positions = {frame.agent_id: (0.0, 0.0) for frame, _ in present}
        for frame, packets in present:
            exchange.send(frame, packets, positions)
        deadline = stamp + TENTH_NS // 2
        perception = ego.perceive(own, exchange.receive(0, deadline, positions), deadline)
        assert not perception.rejected, perception.rejected
        if n % every == every - 1:
            yield sample_memory(n + 1)


def corrections(strategy: str) -> PoseCorrection | None:
    """Pose correction, of the strategy that needs it most."""
    return PoseCorrection() if strategy == "intermediate-temporal" else None


def fit_slope(samples: list[Sample], draws: int = 2000, block: int = 10) -> Slope:
    """Return the slope of resident memory over the samples."""
    x, y = (np.array([getattr(s, name) for s in samples], float) for name in ("frame", "resident_kb"))
    centred = x - x.mean()
    slope = float(centred @ y / (centred @ centred))
    residual = y - y.mean() - slope * centred
    random, number = np.random.default_rng(0), -(-len(x) // block)
    starts = random.integers(0, max(1, len(x) - block + 1), (draws, number))
    drawn = residual[(starts[..., None] + np.arange(block)).reshape(draws, -1)[:, : len(x)] % len(x)]
    low, high = np.quantile(slope + drawn @ centred / (centred @ centred), (0.025, 0.975)).tolist()
    return Slope(slope, low, high, int(x[-1] - x[0]))


def run_soak(strategy: str, frames: int, out: Path) -> list[Sample]:
    """Return the samples of a soak in a process of its own whose oneDNN keeps few compiled kernels."""
    command = [sys.executable, "-m", "tests.probes.test_soak", strategy, str(frames), str(out)]
    environment = os.environ | {"ONEDNN_PRIMITIVE_CACHE_CAPACITY": str(KEPT_KERNELS)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [Sample(**sample) for sample in json.loads(out.read_text())["samples"]]


@pytest.mark.slow
def test_a_receiver_holds_no_more_after_many_frames(tmp_path: Path) -> None:
    """Everything is as some periods before, but for ids and times: so are the tensors, and what the allocators have in use."""
    first, *_, last = run_soak("intermediate-temporal", WARMUP + 6 * PERIOD, tmp_path / "soak.json")[
        WARMUP // EVERY - 1 :
    ]
    assert last.tensors == first.tensors
    assert last.in_use_kb - first.in_use_kb < MAX_KB_PER_FRAME * (last.frame - first.frame)
    assert last.blocks - first.blocks < last.frame - first.frame


@pytest.mark.long
@pytest.mark.parametrize("strategy", ["late-temporal", "intermediate-temporal"])
def test_resident_memory_does_not_grow(strategy: str, tmp_path: Path) -> None:
    samples = run_soak(strategy, 10_000, tmp_path / "soak.json")
    slope = fit_slope(samples[len(samples) // 10 :])
    assert slope.high < MAX_KB_PER_FRAME, slope


def test_the_slope_is_that_of_a_line_with_noise() -> None:
    random = np.random.default_rng(0)
    noise = np.convolve(random.normal(0, 30, 180), np.ones(3) / 3, "valid")
    samples = [Sample(60 * n, round(400_000 + 0.5 * 60 * n + y), 0, 0, 0) for n, y in enumerate(noise)]
    slope = fit_slope(samples)
    assert slope.low < 0.5 < slope.high < 0.52 and slope.low > 0.48


def main() -> None:
    """Print the memory as the frames pass, then the slope after the first tenth; store both."""
    torch.set_num_threads(1)
    strategy, frames, out = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
    samples, began = list[Sample](), time.process_time()
    for sample in soak(strategy, frames, EVERY, corrections(strategy)):
        samples.append(sample)
        print(json.dumps({**asdict(sample), "cpu_s": round(time.process_time() - began, 1)}), flush=True)
        if len(samples) > 2:
            slope = fit_slope(samples[len(samples) // 10 :])
            out.write_text(json.dumps({"slope": asdict(slope), "samples": [asdict(s) for s in samples]}))


if __name__ == "__main__":
    main()
