# SPDX-License-Identifier: Apache-2.0
"""CPU time of an agent's step as it is deployed, against commit a6c4d23: share and perceive, by stage.

Drives of Town07 (preset ``carla-towns-small``, split val) are simulated with 16 and with 64 beams. Every agent of a drive shares
and perceives at every instant: tokens as codes of the codebook, the agent's past, the last messages of each sender, velocities
estimated over half a second, and pose correction or none. The ideal channel delivers at once; histories are full when times count.

Both versions run in one process, one thread, each loaded twice in mirrored order, instant by instant in turn (``versions.py``);
the two loads of a version are averaged. Times are CPU milliseconds of one agent's step, means over agents and instants. A ratio
has a 95 % interval by a bootstrap over instants. A stage's time excludes the stages inside it; what no stage names is "other".

The wide case runs the present version alone on 64 beams and OPV2V's range, in turn with a6c4d23 on 16 beams of the same scenes.

``--methods NAME ...`` times the step of the present version with each strategy instead, on 16 beams and without pose correction; so
are the constants of ``evaluation/detection/compute_times.toml`` made.

python benchmarks/step.py [--baseline COMMIT or FOLDER] [--drives 2] [--instants 12] [--cases NAME ...] [--wide-weights NAME]
    [--recordings FOLDER] [--methods NAME ...] [--out benchmarks/results/step.json]
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numba.core import caching
from versions import ROOT, Version, checkout, use_own_cache

CACHE = use_own_cache()
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from manyeyes import AgentFrame  # noqa: E402
from manyeyes.agents.replay import WARMUP_FRAMES  # noqa: E402
from manyeyes.datasets.opv2v.reader import Opv2vRecording  # noqa: E402
from manyeyes.simulator.presets import SIMULATION_PRESETS, make_jobs  # noqa: E402
from manyeyes.simulator.record import record  # noqa: E402
from manyeyes.studies.provenance import write_json  # noqa: E402

PRESENT_STAGES = (
    ("encoder", "models.detector.detector", "Detector.extract_features"),
    ("own boxes", "models.detector.detector", "Detector.predict"),
    ("own boxes", "agents.perception_cache", "decode"),
    ("velocities", "agents.perception_cache", "PerceptionCache._with_estimated_velocity"),
    ("token scores", "agents.strategies.intermediate", "IntermediateFusion.compose_message"),
    ("selection and encoding", "agents.agent", "Agent._select"),
    ("selection and encoding", "comms.wire", "encode_tokens"),
    ("reception", "comms.inbox", "Inbox.push"),
    ("reception", "comms.inbox", "Inbox.received_messages"),
    ("reception", "agents.agent", "decode_tokens"),
    ("pose correction", "agents.pose_correction", "PoseCorrection.correct"),
    ("transform", "agents.strategies.intermediate", "gather_with_past"),
    ("fusion", "agents.perception_cache", "PerceptionCache.fuse"),
    ("decoding", "agents.perception_cache", "PerceptionCache.decode"),
    ("own boxes kept", "agents.agent", "restore_own_boxes"),
)
"""Stage, module below ``manyeyes``, and the function that is timed."""
BASELINE_STAGES = (
    ("encoder", "models.detector", "Detector.see"),
    ("own boxes", "models.detector", "Detector.look"),
    ("own boxes", "agents.eyes", "decode"),
    ("velocities", "agents.eyes", "Eyes._followed"),
    ("token scores", "agents.collaboration.intermediate", "Intermediate.say"),
    ("selection and encoding", "agents.agent", "coded"),
    ("selection and encoding", "agents.agent", "within_budget"),
    ("selection and encoding", "comms.wire", "encode"),
    ("reception", "comms.inbox", "Inbox.push"),
    ("reception", "comms.inbox", "Inbox.receptions"),
    ("reception", "agents.agent", "readable"),
    ("pose correction", "agents.aligner", "Aligner.align"),
    ("transform", "agents.collaboration.intermediate", "tokens_around"),
    ("fusion", "agents.eyes", "Eyes.fuse"),
    ("decoding", "agents.eyes", "Eyes.decode"),
)
"""The same of commit a6c4d23, whose names were others."""
STEPS = ("share", "perceive")


class StageClock:
    """CPU seconds of each stage, without those inside it."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self._open: list[str] = []
        self._since = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count CPU time for a stage of the step that is under way; a step is a stage itself."""
        now = time.process_time()
        if self._open:
            self.spent[self._open[-1]] += now - self._since
        step = self._open[0].partition(":")[0] if self._open else name
        self._open.append(f"{step}: {name}" if self._open else f"{step}: other")
        self._since = time.process_time()
        try:
            yield
        finally:
            now = time.process_time()
            self.spent[self._open.pop()] += now - self._since
            self._since = now

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function, timed as a stage while a step is under way."""

        def timed(*given: Any, **named: Any) -> Any:
            if not self._open:
                return function(*given, **named)
            with self.stage(name):
                return function(*given, **named)

        return timed


@dataclass
class StepVersion(Version):
    """One checkout of the package, and its agents by (case, drive, agent)."""

    agents: dict[tuple[str, int, int], Any] = field(default_factory=dict)
    clock: StageClock = field(default_factory=StageClock)

    @property
    def is_baseline(self) -> bool:
        """Whether it has the names of a6c4d23."""
        return (self.source / "manyeyes" / "agents" / "eyes.py").exists()

    def start(self) -> None:
        """Import the package and time its stages."""
        import importlib

        # a6c4d23 adds its own lock of numba's files, which this version holds already.
        locked = caching.IndexDataCacheFile
        if self.is_baseline:
            caching.IndexDataCacheFile = locked.__base__
        import manyeyes

        assert Path(manyeyes.__file__).is_relative_to(self.source), f"{manyeyes.__file__} is not of {self.source}"
        for name, module, path in BASELINE_STAGES if self.is_baseline else PRESENT_STAGES:
            owner: Any = importlib.import_module(f"manyeyes.{module}")
            *parts, last = path.split(".")
            for part in parts:
                owner = getattr(owner, part)
            setattr(owner, last, self.clock.wrap(name, getattr(owner, last)))
        caching.IndexDataCacheFile = locked

    def make_agent(self, case: Case) -> Any:
        """Return a new agent of a case, as it is deployed."""
        from manyeyes import Agent

        if self.is_baseline:
            from manyeyes.agents.aligner import Aligner  # pyright: ignore[reportMissingImports]

            from manyeyes.models import zoo  # pyright: ignore[reportAttributeAccessIssue]

            return Agent(zoo.load(), aligner=Aligner() if case.corrects_poses else None)  # pyright: ignore[reportCallIssue]
        from manyeyes.agents.pose_correction import PoseCorrection
        from manyeyes.models import pretrained

        detector: Any = pretrained.load(case.weights)
        if case.is_wide:
            from manyeyes.models.detector.presets import OPV2V_GRID

            old = detector.config.grid
            grid = replace(old, x_min=OPV2V_GRID.x_min, x_max=OPV2V_GRID.x_max, y_min=-38.4, y_max=38.4)
            detector.config = replace(detector.config, grid=grid)
            detector.grid, detector.pillars.grid = grid, grid.at(1)
        return Agent(detector, pose_correction=PoseCorrection() if case.corrects_poses else None)

    def frame(self, seen: AgentFrame) -> Any:
        """Return a frame as an object of this version."""
        from manyeyes import AgentFrame as VersionFrame, PointCloud, Transform

        pose = seen.world_from_agent
        return VersionFrame(
            agent_id=seen.agent_id,
            timestamp_ns=seen.timestamp_ns,
            points=PointCloud.of(seen.points.xyz, seen.points.intensity),
            world_from_agent=Transform(pose.rotation, pose.translation),
            pose_covariance=seen.pose_covariance,
            sensor_height_m=seen.sensor_height_m,
            speed_mps=seen.speed_mps,
            is_infrastructure=seen.is_infrastructure,
        )

    def step(self, case: Case, drive: int, seen: Sequence[AgentFrame]) -> Measured:
        """Let all agents share, then all perceive."""
        for frame in seen:
            name = (case.name, drive, frame.agent_id)
            if name not in self.agents:
                self.agents[name] = self.make_agent(case)
        agents = [self.agents[case.name, drive, frame.agent_id] for frame in seen]
        frames = [self.frame(frame) for frame in seen]
        self.clock.spent.clear()
        packets = []
        for agent, frame in zip(agents, frames):
            with self.clock.stage("share"):
                packets.append(agent.share(frame))
        num_boxes = 0
        for n, (agent, frame) in enumerate(zip(agents, frames)):
            received = [packet for m, sent in enumerate(packets) if m != n for packet in sent]
            with self.clock.stage("perceive"):
                num_boxes += len(agent.perceive(frame, received).boxes)
        count = len(seen)
        sent = sum(len(packet) for own in packets for packet in own)
        return Measured({k: s / count for k, s in self.clock.spent.items()}, sent / count, num_boxes / count)


@dataclass(frozen=True)
class Measured:
    """One instant: CPU seconds by stage, bytes of a message and number of boxes, each the mean over agents."""

    seconds: dict[str, float]
    message_bytes: float
    boxes: float


@dataclass(frozen=True)
class Case:
    """What is compared. beams: of the present version; a6c4d23 runs ``costr-small`` on baseline_beams.

    is_wide: OPV2V's range instead of that of the weights. max_ratio: the target.
    """

    name: str
    beams: int
    baseline_beams: int
    corrects_poses: bool = False
    is_wide: bool = False
    weights: str = "costr-small"
    max_ratio: float | None = None


CASES = (
    Case("16 beams", 16, 16, max_ratio=0.45),
    Case("16 beams, pose correction", 16, 16, corrects_poses=True),
    Case("64 beams", 64, 64),
    Case("64 beams, pose correction", 64, 64, corrects_poses=True),
    Case("64 beams, OPV2V's range", 64, 16, is_wide=True, max_ratio=1.2),
)


@dataclass(frozen=True)
class Row:
    """One case on one drive, None for all of them: milliseconds of an agent's step, and their ratio with its 95 % interval."""

    case: str
    weights: str
    drive: int | None
    agents: float
    instants: int
    baseline_ms: float
    present_ms: float
    ratio: float
    low: float
    high: float
    max_ratio: float | None
    baseline_stages_ms: dict[str, float]
    present_stages_ms: dict[str, float]
    baseline_bytes: float
    present_bytes: float
    baseline_boxes: float
    present_boxes: float


Snapshots = list[Sequence[AgentFrame]]


def simulate_drives(beams: int, count: int, folder: Path) -> list[Snapshots]:
    """Return the frames of the first drives of Town07, simulated into a folder unless they are there."""
    preset = SIMULATION_PRESETS["carla-towns-small"]
    splits = [
        replace(p, count=count, lidar_beams=(None if beams == 64 else beams,))
        for p in preset.splits
        if p.split == "val"
    ]
    out = folder / f"beams-{beams}-drives-{count}"
    record(make_jobs(replace(preset, splits=tuple(splits)), seed=0), out, settings={"beams": beams})
    recording = Opv2vRecording(out, "val")
    drives = []
    for scenario in recording.scenarios:
        start = max(0, recording.eval_indices(scenario).start - WARMUP_FRAMES)
        indices = range(start, recording.eval_indices(scenario).stop)
        drives.append([recording.snapshot(scenario, index).frames for index in indices])
    return drives


def compare(
    versions: Sequence[StepVersion], case: Case, drives: dict[int, list[Snapshots]], instants: int
) -> list[Row]:
    """Time a case on every drive; versions: baseline, present, present, baseline."""
    rows, everything = [], []
    for drive, (now, before) in enumerate(zip(drives[case.beams], drives[case.baseline_beams])):
        measured = []
        for instant in range(min(len(now), WARMUP_FRAMES + instants)):
            found: dict[int, Measured] = {}
            for which in sorted(range(len(versions)), reverse=bool(instant % 2)):
                version = versions[which]
                with version.active():
                    found[which] = version.step(case, drive, (before if version.is_baseline else now)[instant])
            if instant >= WARMUP_FRAMES:
                measured.append([found[which] for which in range(len(versions))])
        everything += measured
        rows.append(make_row(case, drive, len(now[0]), measured))
        for version in versions:
            version.agents.clear()
    agents = sum(row.agents * row.instants for row in rows) / sum(row.instants for row in rows)
    return [*rows, make_row(case, None, agents, everything)]


def make_row(case: Case, drive: int | None, agents: float, measured: list[list[Measured]]) -> Row:
    """Return the means over instants, and the interval of the ratio; measured: by instant and version."""
    pairs = [((0, 3), [instant[0] for instant in measured]), ((1, 2), [instant[1] for instant in measured])]
    whole = np.array([[sum(m.seconds.values()) for m in instant] for instant in measured])
    spent = np.stack([whole[:, list(columns)].mean(1) for columns, _ in pairs], 1)
    stages = []
    for columns, _ in pairs:
        names = {k: None for instant in measured for c in columns for k in instant[c].seconds}
        mean = {k: 1e3 * float(np.mean([i[c].seconds.get(k, 0.0) for i in measured for c in columns])) for k in names}
        stages.append(
            {k: round(mean[k], 2) for k in sorted(mean, key=lambda k: (STEPS.index(k.partition(":")[0]), -mean[k]))}
        )
    drawn = spent[np.random.default_rng(0).integers(0, len(spent), (4000, len(spent)))].sum(1)
    low, high = np.quantile(drawn[:, 1] / drawn[:, 0], (0.025, 0.975)).tolist()
    old, new = (1e3 * spent.mean(0)).tolist()
    sizes = [[float(np.mean([getattr(m, n) for m in some])) for n in ("message_bytes", "boxes")] for _, some in pairs]
    (old_bytes, old_boxes), (new_bytes, new_boxes) = sizes
    return Row(
        case.name, case.weights, drive, agents, len(measured), old, new, new / old, low, high, case.max_ratio,
        stages[0], stages[1], old_bytes, new_bytes, old_boxes, new_boxes,
    )  # fmt: skip


def show(row: Row) -> None:
    """Print one row."""
    where = "all drives" if row.drive is None else f"drive {row.drive}"
    target = "" if row.max_ratio is None else f", target {row.max_ratio}"
    print(
        f"{row.case}, {where}, {row.agents:.1f} agents: {row.baseline_ms:.1f} -> {row.present_ms:.1f} ms, "
        f"ratio {row.ratio:.3f} [{row.low:.3f}, {row.high:.3f}]{target}; "
        f"bytes {row.baseline_bytes:.0f} -> {row.present_bytes:.0f}, boxes {row.baseline_boxes:.1f} -> {row.present_boxes:.1f}",
        flush=True,
    )
    if row.drive is None:
        for name in sorted({**row.baseline_stages_ms, **row.present_stages_ms}, reverse=True):
            old, new = (s.get(name, 0.0) for s in (row.baseline_stages_ms, row.present_stages_ms))
            print(f"  {name:<36} {old:8.2f} {new:8.2f} ms")


@dataclass(frozen=True)
class MethodRow:
    """CPU milliseconds of an agent's step with one strategy, and those of its parts, means over agents and instants."""

    method: str
    agents: float
    instants: int
    step_ms: float
    share_ms: float
    perceive_ms: float


def time_method(method: str, snapshots: Snapshots, instants: int) -> MethodRow:
    """Time one strategy on a drive; histories are full when times count."""
    from manyeyes import Agent, get_strategy
    from manyeyes.models import pretrained

    detector, spent = pretrained.load("costr-small"), {"share": 0.0, "perceive": 0.0}
    agents = [Agent(detector, get_strategy(method)) for _ in snapshots[0]]
    for number, frames in enumerate(snapshots[: WARMUP_FRAMES + instants]):
        counts, packets = number >= WARMUP_FRAMES, []
        began = time.process_time()
        for agent, frame in zip(agents, frames):
            packets.append(agent.share(frame))
        shared = time.process_time()
        for n, (agent, frame) in enumerate(zip(agents, frames)):
            agent.perceive(frame, [packet for m, sent in enumerate(packets) if m != n for packet in sent])
        spent["share"] += counts * (shared - began)
        spent["perceive"] += counts * (time.process_time() - shared)
    share_ms, perceive_ms = (1e3 * spent[step] / (instants * len(agents)) for step in STEPS)
    return MethodRow(method, len(agents), instants, share_ms + perceive_ms, share_ms, perceive_ms)


def time_methods(methods: Sequence[str], instants: int, recordings: Path | None, out: Path | None) -> None:
    """Time strategies one after the other on the first drive; the row of "other" is the slowest."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as spare:
        snapshots = simulate_drives(16, 1, recordings or Path(spare))[0]
    time_method(methods[0], snapshots, 1)  # compiles loops
    rows = []
    for method in methods:
        rows.append(time_method(method, snapshots, instants))
        print(f"{method:<32} {rows[-1].step_ms:6.1f} ms", flush=True)
    if out:
        settings = {"drives": 1, "instants": instants, "threads": 1, "beams": 16, "weights": "costr-small"}
        command = shlex.join(["python", *sys.argv])
        write_json(out, {"command": command, "settings": settings, "rows": rows}, settings, seed=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--baseline", default="a6c4d23")
    parser.add_argument("--drives", type=int, default=2)
    parser.add_argument("--instants", type=int, default=12)
    parser.add_argument("--cases", nargs="*", default=[case.name for case in CASES])
    parser.add_argument("--wide-weights", default="costr-small")
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--methods", nargs="*", default=[])
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    if wanted.methods:
        time_methods(wanted.methods, wanted.instants, wanted.recordings, wanted.out)
        return
    torch.set_num_threads(1)
    cases = [replace(c, weights=wanted.wide_weights) if c.is_wide else c for c in CASES if c.name in wanted.cases]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as spare, checkout(wanted.baseline) as code:
        folder = wanted.recordings or Path(spare)
        beams = {b for case in cases for b in (case.beams, case.baseline_beams)}
        drives = {b: simulate_drives(b, wanted.drives, folder) for b in sorted(beams)}
        sources = [code / "src", ROOT / "src", ROOT / "src", code / "src"]
        versions = [StepVersion(source) for source in sources]
        for version in versions:
            with version.active():
                version.start()
        for case in cases:
            rows += compare(versions, case, drives, wanted.instants)
            for row in rows[-wanted.drives - 1 :]:
                show(row)
            if wanted.out:
                save(rows, wanted)


def save(rows: list[Row], wanted: argparse.Namespace) -> None:
    """Write the rows so far; load: runnable processes per processor, on average over the last quarter of an hour."""
    settings = {"baseline": wanted.baseline, "drives": wanted.drives, "instants": wanted.instants, "threads": 1}
    command, load = shlex.join(["python", *sys.argv]), os.getloadavg()[2] / (os.cpu_count() or 1)
    payload = {"command": command, "settings": settings, "load": round(load, 2), "rows": rows}
    write_json(wanted.out, payload, settings, seed=0)


if __name__ == "__main__":
    main()
