# SPDX-License-Identifier: Apache-2.0
"""A team of agents as processes on the loopback interface, for fault tests and soaks: started, killed, stopped and put out of time.

Each process runs ``manyeyes.runtime.live`` at 10 Hz with signed packets. The detector finds one car, so that five agents fit on two
cores; ``weights`` takes a real one, on the frames of a recording.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from manyeyes import Agent, AgentFrame, BevGrid, BoxDetector, Boxes, PointCloud, Transform, get_strategy
from manyeyes.comms.network.interface import Network, ReceivedPacket
from manyeyes.comms.signatures.envelope import is_signed, split_signed
from manyeyes.comms.wire import open_packet
from manyeyes.runtime.clock import LiveClock, read_tai_ns
from manyeyes.runtime.federation import make_demo_federation
from manyeyes.runtime.live import LiveRun, LiveTick
from manyeyes.runtime.pseudonyms import PseudonymPool
from manyeyes.runtime.security import Security
from manyeyes.runtime.summary import Quantiles
from manyeyes.runtime.transports.faulty import FaultPlan, FaultyNetwork
from manyeyes.runtime.transports.udp import UdpConfig, UdpNetwork
from manyeyes.runtime.transports.zenoh import ZenohConfig, ZenohNetwork
from manyeyes.studies.provenance import write_json
from manyeyes.viz.study_table import StudyTable

FRAME_NS, PLACE = 100_000_000, (100.0, 100.0)


@dataclass(frozen=True)
class TeamConfig:
    """folder: of the keys. rate: of the clocks; below 1 for machines that other programs share. weights: None is one car."""

    folder: Path
    num_agents: int = 5
    transport: str = "udp"
    rate: float = 1.0
    weights: str | None = None
    recording: tuple[str, str] | None = None
    plan: FaultPlan = field(default_factory=FaultPlan)
    start_ns: int = field(default_factory=read_tai_ns)


@dataclass(frozen=True)
class Tick:
    """What a process reports of a frame.

    time_s: monotonic, at its end; sent_s: when its packets were sent. ages_ns: of each fused message when the boxes were there,
    fused_ages_ns: when it was fused. dropped: refused packets so far, by reason.
    """

    agent_id: int
    time_s: float
    sent_s: float
    fused: frozenset[int]
    ages_ns: tuple[int, ...]
    fused_ages_ns: tuple[int, ...]
    latency_ns: int
    missed: bool
    level: int
    note: str
    rejected: tuple[str, ...]
    dropped: dict[str, int]
    received_packets: int
    num_threads: int
    num_files: int


class OneCar(BoxDetector):
    """One car around the middle of all points."""

    grid = BevGrid(-70.4, -38.4, 0.3, 70.4, 38.4, 2.5)

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        """Return the car."""
        centre = points.xyz.mean(0, keepdim=True)
        return Boxes.of(centre, torch.tensor([[4.5, 1.9, 1.6]]), torch.zeros(1), torch.tensor([0.9]))


def claimed_agent(packet: bytes) -> int:
    """Return the agent id in the header of a packet."""
    return open_packet(split_signed(packet).packet if is_signed(packet) else packet).header.agent_id


def free_port() -> int:
    """Return a port of this machine that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def open_network(config: TeamConfig, agent_id: int, port: int, clock: LiveClock) -> Network:
    """Join the network of the team; agent 1 is the seed of the others, and agent 2 of agent 1."""
    name = f"team-{port}"
    if config.transport == "udp":
        return UdpNetwork(UdpConfig(name, port=port), clock.now_ns)
    seeds = tuple(f"tcp/127.0.0.1:{port + k}" for k in range(config.num_agents))
    own = (seeds[agent_id - 1],) if agent_id <= len(seeds) else ("tcp/127.0.0.1:0",)
    others = tuple(seed for seed in seeds if seed not in own)
    return ZenohNetwork(ZenohConfig(name, own, others), agent_id, clock.now_ns)


class _Control:
    """What the parent sets in a process while it runs."""

    def __init__(self, pipe: Connection) -> None:
        self.pipe, self.offset_ns, self.delay_ns, self.stopped = pipe, 0, 0, False
        self.members: frozenset[int] | None = None
        threading.Thread(target=self._read, name="control", daemon=True).start()

    def _read(self) -> None:
        while not self.stopped:
            try:
                name, value = self.pipe.recv()
            except (EOFError, OSError):
                os._exit(1)
            setattr(self, name, value)

    def accepts(self, received: ReceivedPacket) -> bool:
        """Return whether a packet comes from the agent's side of a partition."""
        return self.members is None or claimed_agent(received.packet) in self.members

    def reference_ns(self) -> int:
        """The system clock, put out of time."""
        return read_tai_ns() + self.offset_ns


def make_frames(config: TeamConfig, agent_id: int, clock: LiveClock, control: _Control) -> Iterator[AgentFrame]:
    """Yield frames at 10 Hz, until the parent stops the process."""
    clouds: list[AgentFrame] = []
    if config.recording is not None:
        from manyeyes.datasets.registry import open_recording
        from manyeyes.runtime.sources import play_recording

        recording = open_recording(Path(config.recording[0]), config.recording[1])
        large = (name for name in recording.scenarios if len(recording.agents(name)) >= config.num_agents)
        scenario = next(large, None)
        if scenario is None:
            raise SystemExit(
                f"{config.recording[0]}: no scenario has {config.num_agents} agents; take fewer with --agents."
            )
        clouds = list(play_recording(recording, scenario, recording.agents(scenario)[agent_id - 1], 0, 10))
    generator, number = torch.Generator().manual_seed(agent_id), 0
    stamp_ns = -(-clock.now_ns() // FRAME_NS) * FRAME_NS
    while not control.stopped:
        # After a step of the clock, or a pause, frames go on at its time.
        now_ns = clock.now_ns()
        stamp_ns = stamp_ns + FRAME_NS if abs(now_ns - stamp_ns) < 5 * FRAME_NS else now_ns
        if clouds:
            yield replace(clouds[number % len(clouds)], agent_id=agent_id, timestamp_ns=stamp_ns)
        else:
            points = torch.tensor([10.0, 3.0 * agent_id, 0.8]) + 0.1 * torch.randn(20, 3, generator=generator)
            pose = Transform.from_xyz_yaw(PLACE[0], PLACE[1] + 3.0 * agent_id, 0.0)
            yield AgentFrame.of(PointCloud.of(points), pose, agent_id, stamp_ns)
        number += 1


def run_agent(config: TeamConfig, agent_id: int, port: int, pipe: Connection) -> None:
    """Run one agent; the body of its process."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    control = _Control(pipe)
    # In slow motion, all clocks count from one start.
    clock = LiveClock(config.start_ns, config.rate, control.reference_ns)
    if config.weights is None:
        agent = Agent(OneCar(), get_strategy("late"))
    else:
        from manyeyes.models import pretrained

        agent = Agent(pretrained.load(config.weights), get_strategy("intermediate"), budget_bytes=4_096)
    keys = config.folder
    security = Security("require", PseudonymPool.load(keys / f"agent-{agent_id}.key"), keys / "trust.toml")
    plan = replace(config.plan, seed=config.plan.seed + agent_id)
    network = FaultyNetwork(open_network(config, agent_id, port, clock), clock.now_ns, plan)
    network.accepts = control.accepts
    network.join(PLACE)
    run = LiveRun(make_frames(config, agent_id, clock, control), agent, network, clock, security=security)
    for tick in run:
        if control.delay_ns:
            clock.sleep(control.delay_ns)
        pipe.send(_report(agent_id, tick, config.rate))
    network.close()


def _report(agent_id: int, tick: LiveTick, rate: float) -> Tick:
    now_s = time.monotonic()
    sent_s = now_s - (tick.wait_ns + tick.perceive_ns) / 1e9 / rate
    dropped = {name: count for name, count in vars(tick.dropped).items() if count}
    fused = frozenset(one.message.agent_id for one in tick.perception.received)
    fused_ages = tuple(age - tick.perceive_ns for age in tick.ages_ns)
    rejected = tuple(one.reason for one in tick.perception.rejected)
    files = len(list(Path("/proc/self/fd").iterdir())) if Path("/proc/self/fd").exists() else 0
    return Tick(
        agent_id, now_s, sent_s, fused, tick.ages_ns, fused_ages, tick.latency_ns, tick.missed, tick.level, tick.note, rejected,
        dropped, tick.received_packets, threading.active_count(), files,
    )  # fmt: skip


class Team:
    """Processes by agent id. Used as a context, it ends them all."""

    def __init__(self, config: TeamConfig) -> None:
        self.config, self.port = config, free_port()
        self._context = multiprocessing.get_context("spawn")
        self._pipes: dict[int, Connection] = {}
        self.processes: dict[int, Any] = {}
        make_demo_federation(config.folder, range(1, config.num_agents + 1), 1_440)

    def __enter__(self) -> Team:
        for agent_id in range(1, self.config.num_agents + 1):
            self.start(agent_id)
        self.wait_until_all_fuse(120.0)
        return self

    def __exit__(self, *_: object) -> None:
        for agent_id in list(self.processes):
            self.kill(agent_id)

    def start(self, agent_id: int) -> None:
        """Start the process of an agent."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=run_agent, args=(self.config, agent_id, self.port, theirs), daemon=True)
        process.start()
        theirs.close()
        self._pipes[agent_id], self.processes[agent_id] = ours, process

    def kill(self, agent_id: int) -> None:
        """End the process of an agent, as ``kill -9`` does."""
        process = self.processes.pop(agent_id)
        process.kill()
        process.join()
        self._pipes.pop(agent_id).close()

    def send_signal(self, agent_id: int, number: int) -> None:
        """Send a signal to the process of an agent."""
        os.kill(self.processes[agent_id].pid, number)

    def set(self, agent_ids: Collection[int], name: str, value: Any) -> None:
        """Set offset_ns, delay_ns, members or stopped in processes."""
        for agent_id in agent_ids:
            self._pipes[agent_id].send((name, value))

    def collect(self, seconds: float) -> dict[int, list[Tick]]:
        """Return the ticks of the next seconds of the run, by agent."""
        ticks: dict[int, list[Tick]] = {agent_id: [] for agent_id in self.processes}
        until_s = time.monotonic() + seconds / self.config.rate
        while time.monotonic() < until_s:
            for agent_id, pipe in list(self._pipes.items()):
                with contextlib.suppress(EOFError, OSError):
                    while pipe.poll():
                        ticks.setdefault(agent_id, []).append(pipe.recv())
            time.sleep(0.01)
        return ticks

    def wait_until_all_fuse(self, timeout_s: float) -> None:
        """Wait until the last frame of each agent fused all others."""
        everyone, last = frozenset(self.processes), dict[int, frozenset[int]]()
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            last |= {agent_id: ticks[-1].fused for agent_id, ticks in self.collect(0.3).items() if ticks}
            if all(last.get(agent_id) == everyone - {agent_id} for agent_id in everyone):
                return
        raise TimeoutError(f"After {timeout_s:.0f} s agents fuse {last}; the machine may be too slow: give --rate.")


@contextlib.contextmanager
def start_team(
    num_agents: int,
    transport: str,
    rate: float = 1.0,
    weights: str | None = None,
    recording: tuple[str, str] | None = None,
) -> Iterator[Team]:
    """Run a team with keys in a folder that is removed at the end."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        yield stack.enter_context(Team(TeamConfig(folder, num_agents, transport, rate, weights, recording)))


def quantiles_ms(values_ns: list[int]) -> dict[str, float]:
    """Return p50, p95 and p99, ms; nothing of nothing."""
    if not values_ns:
        return {}
    found = Quantiles.of(values_ns)
    return {"p50": found.p50_ms, "p95": found.p95_ms, "p99": found.p99_ms}


def summarise(ticks: Sequence[Tick]) -> dict[str, Any]:
    """Return frames, fractions of missed deadlines and of level 0, and the times of boxes and ages, ms."""
    num = max(len(ticks), 1)
    return {
        "frames": len(ticks),
        "missed_fraction": sum(tick.missed for tick in ticks) / num,
        "level_0_fraction": sum(tick.level == 0 for tick in ticks) / num,
        "boxes_ms": quantiles_ms([tick.latency_ns for tick in ticks]),
        "age_ms": quantiles_ms([age for tick in ticks for age in tick.ages_ns]),
    }


def write_result(result: dict[str, Any], table: StudyTable, options: Any, seed: int = 0) -> None:
    """Write a result and its table for documents as JSON, where the options name a file."""
    if options.out is not None:
        write_json(options.out, {"study": table.title, **result, "tables": [table]}, {"options": options}, seed)


def rss_bytes(process: Any) -> tuple[int, int]:
    """Return the resident and the proportional memory of a process, bytes."""
    rss = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    try:
        lines = Path(f"/proc/{process.pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return rss, 0
    return rss, next((1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:")), 0)
