# SPDX-License-Identifier: Apache-2.0
"""Run a whole team on this machine: a process for each agent of a drive, signed packets, one network, one table.

Without a recording, the drive of 'manyeyes demo' is simulated, with as many vehicles as the agents need. Where the processes do not
fit on the cores, the clock is slowed down, and the rate is printed. Each run is recorded, and computed again from its recording.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from manyeyes._bounds import InputPath, OutputFolder, PlaybackRate, PositiveInt, Seed, WorkerCount
from manyeyes.cli.live.options import MethodOptions

if TYPE_CHECKING:
    from rich.console import Console

START_TIMEOUT_S, START_DELAY_S, END_TIMEOUT_S = 600.0, 1.0, 60.0
DEFAULT_MAP_WEIGHTS = "map-small-lidar"


@dataclass(frozen=True)
class Options:
    """How many agents of which drive."""

    agents: WorkerCount = 4
    """Number of agents, the first ones of the drive; for more than 4 a drive with so many is simulated."""
    recording: InputPath | None = None
    """A recording; by default the drive of 'manyeyes demo' is simulated."""
    split: str | None = None
    """Which split of a data set, such as test."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frames: PositiveInt = 40
    """At most so many frames."""
    rate: PlaybackRate | None = None
    """Speed of the clock; by default 1, or what the cores allow."""
    transport: Literal["zenoh", "udp"] = "zenoh"
    """The network between the processes."""
    security: Literal["off", "warn", "require"] = "require"
    """Signatures; keys are made for the run."""
    out: OutputFolder = Path("out/live")
    """Folder for keys, recordings and summaries."""
    map: bool = False
    """Agents send local maps, too, and a map server fuses them to one map, in the folder map of --out."""
    check: bool = True
    """Compute each recorded run again, and compare bit for bit."""
    seed: Seed = 0
    """Of the simulated drive."""
    method: MethodOptions = field(default_factory=MethodOptions)
    """What is sent and fused."""


def main(options: Options) -> None:
    """Run the team, and print its table."""
    from rich.console import Console

    from manyeyes._lock import hold_folder

    with hold_folder(options.out):
        _run_team(options, Console())


def _run_team(options: Options, console: Console) -> None:
    from manyeyes.cli.live.replay import check_run
    from manyeyes.cli.live.table import load_summary, print_summaries
    from manyeyes.datasets.frame_reader import as_frame_reader
    from manyeyes.datasets.registry import open_recording
    from manyeyes.datatypes import ConfigError
    from manyeyes.studies.replay_options import make_excerpt

    root, split = _find_drive(options, console)
    recording = open_recording(root, split)
    scenario = make_excerpt(recording, options.scenario).scenario
    present = recording.agents(scenario)
    if len(present) < options.agents:
        raise ConfigError(f"--agents {options.agents}: scenario {scenario} has {len(present)}; choose at most so many.")
    agents = present[: options.agents]
    for old in options.out.glob("agent-*.*"):
        old.unlink()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    drive = [str(root), *(["--split", split] if split else []), "--scenario", scenario]
    commands = [_make_command(options, drive, agent, number) for number, agent in enumerate(agents)]
    if options.map:
        x, y, _ = as_frame_reader(recording).frame(scenario, 0, agents[0]).world_from_agent.translation.tolist()
        commands.append(_make_map_command(options, (x, y)))
    _make_keys(options, agents)
    rate, text = _run_processes(commands, len(agents), options, load, console)
    files = [options.out / f"agent-{agent}.json" for agent in agents]
    print_summaries([load_summary(file) for file in files], console)
    reason = "as given" if options.rate else "that many agents do not fit on these cores"
    pace = "in real time" if rate == 1 else f"at {rate:.3g} of real time: {reason}"
    console.print(f"{len(agents)} processes, {options.transport}, security {options.security}, {pace}", soft_wrap=True)
    if text:
        console.print(f"map: {text}", highlight=False, markup=False, soft_wrap=True)
    for agent in agents if options.check else ():
        console.print(check_run(options.out / f"agent-{agent}.mcap"), highlight=False, markup=False, soft_wrap=True)


def _find_drive(options: Options, console: Console) -> tuple[Path, str | None]:
    """Return a recording and its split; simulate one where none is given."""
    if options.recording is not None:
        return options.recording, options.split
    from manyeyes.simulator.presets import make_jobs, simulation_preset
    from manyeyes.simulator.record import record

    preset = simulation_preset("demo")
    # All its vehicles, and the roadside unit.
    if options.agents > preset.vehicles[1] + 1:
        preset = replace(preset, vehicles=(options.agents - 1, options.agents - 1))
    num_agents = preset.vehicles[1] + 1
    folder = options.out / "recording" / f"seed-{options.seed}-{num_agents}-agents"
    made_of = {"preset": "demo", "seed": options.seed, "agents": num_agents}
    with console.status("Simulating a drive"):
        record(make_jobs(preset, options.seed), folder, 1, None, made_of)
    return folder, "test"


def _make_keys(options: Options, agents: Sequence[int]) -> None:
    """Make a federation of the agents, in place of that of an earlier run."""
    if options.security == "off":
        return
    from manyeyes.runtime.federation import make_demo_federation

    folder = options.out / "keys"
    for old in folder.glob("*"):
        old.unlink()
    make_demo_federation(folder, agents, 1_440)


def _make_command(options: Options, drive: Sequence[str], agent: int, number: int) -> list[str]:
    """Return the command of one process; the first one listens, the others connect to it, or all share a port."""
    keys, method = options.out / "keys", options.method
    words = [sys.executable, "-m", "manyeyes.cli.main", "live", "run", *drive, "--agent", str(agent), "--await-start"]
    words += ["--frames", str(options.frames)]
    words += ["--record", str(options.out / f"agent-{agent}.mcap"), "--out", str(options.out / f"agent-{agent}.json")]
    words += ["--weights", method.weights, "--method", method.method, "--budget-bytes", str(method.budget_bytes)]
    words += ["--pose-correction", method.pose_correction] if method.pose_correction else []
    words += ["--sight"] if method.sight else []
    words += ["--misbehaviour", method.misbehaviour] if method.misbehaviour else []
    map_weights = method.map_weights or (DEFAULT_MAP_WEIGHTS if options.map else None)
    words += ["--map-weights", map_weights, "--map-period-s", str(method.map_period_s)] if map_weights else []
    words += _make_security_words(options)
    words += ["--key", str(keys / f"agent-{agent}.key")] if options.security != "off" else []
    return [*words, *_make_network_words(options, is_seed=number == 0)]


def _make_map_command(options: Options, position_m: tuple[float, float]) -> list[str]:
    """Return the command of the map server."""
    words = [
        sys.executable,
        "-m",
        "manyeyes.cli.main",
        "live",
        "map",
        "--await-start",
        "--out",
        str(options.out / "map"),
    ]
    words += ["--position-m", *(f"{value:.1f}" for value in position_m)]
    return [*words, *_make_security_words(options), *_make_network_words(options, is_seed=False)]


def _make_security_words(options: Options) -> list[str]:
    if options.security == "off":
        return []
    return ["--security", options.security, "--trust", str(options.out / "keys" / "trust.toml")]


def _make_network_words(options: Options, is_seed: bool) -> list[str]:
    words = ["--net", f"demo-{os.getpid()}", "--transport", options.transport]
    if options.transport == "udp":
        return [*words, "--port", str(_FREE_PORT.number)]
    return [*words, "--listen" if is_seed else "--connect", f"tcp/127.0.0.1:{_FREE_PORT.number}"]


class _FreePort:
    """A port of this machine that is free now; the same for all processes of the team."""

    def __init__(self) -> None:
        self._number = 0

    @property
    def number(self) -> int:
        """The port, chosen at first use."""
        if not self._number:
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                self._number = int(probe.getsockname()[1])
        return self._number


_FREE_PORT = _FreePort()


def _run_processes(
    commands: Sequence[Sequence[str]], num_agents: int, options: Options, load: float, console: Console
) -> tuple[float, str]:
    """Start the processes together, wait for the end of the agents, and end the map server after them.

    load: of the machine before. Returns the rate of their clock, and what the map server printed.
    """
    from manyeyes.cli.live.rate import FRAME_S, choose_rate
    from manyeyes.runtime.clock import read_tai_ns
    from manyeyes.viz.progress import track

    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    # The end of this process ends those of the agents, too.
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    processes = [subprocess.Popen(command, env=environment, **pipes) for command in commands]
    try:
        with console.status("Starting the agents"):
            seconds = [_read_ready(process) for process in processes]
        rate = options.rate or choose_rate(seconds[:num_agents], os.cpu_count() or 1, load)
        start_ns, text = read_tai_ns() + round(1e9 * START_DELAY_S), ""
        for process in processes:
            assert process.stdin is not None
            process.stdin.write(f"{start_ns} {rate!r}\n")
            process.stdin.flush()
        with track(console, f"{num_agents} agents on the network", options.frames) as show:
            _show_frames(processes[:num_agents], options.frames, rate / FRAME_S, show)
            for process in processes[:num_agents]:
                process.communicate(timeout=START_DELAY_S + options.frames * FRAME_S / rate * 3 + END_TIMEOUT_S)
            for process in processes[num_agents:]:
                process.terminate()
                # Its fusion compiles at first use, which takes longer than the end of an agent.
                text = process.communicate(timeout=START_TIMEOUT_S)[0].strip()
        return rate, text
    finally:
        _end(processes)
        signal.signal(signal.SIGTERM, before)


def _show_frames(
    processes: Sequence[subprocess.Popen[str]], total: int, frames_per_s: float, show: Callable[[int, int], None]
) -> None:
    """Show the frames that are due by the clock, until the last one or the end of a process."""
    began = time.monotonic()
    while all(process.poll() is None for process in processes):
        due = int((time.monotonic() - began - START_DELAY_S) * frames_per_s)
        if due >= total:
            break
        show(max(0, due), total)
        time.sleep(0.2)
    show(total, total)


def _read_ready(process: subprocess.Popen[str]) -> float:
    """Return the seconds of a frame that a process reports when it is ready."""
    from manyeyes.cli.live.start import READY
    from manyeyes.datatypes import ManyeyesError

    assert process.stdout is not None
    readable, _, _ = select.select([process.stdout], [], [], START_TIMEOUT_S)
    word, _, seconds = (process.stdout.readline() if readable else "").partition(" ")
    if word != READY:
        raise ManyeyesError("An agent ended, or did not start in time; its error is above.")
    return max(float(seconds), 1e-3)


def _end(processes: Sequence[subprocess.Popen[str]]) -> None:
    """End the processes that run, and report those that failed."""
    from manyeyes.datatypes import ManyeyesError

    is_cut = [process.poll() is None for process in processes]
    for process, running in zip(processes, is_cut):
        if running:
            process.terminate()
    for process, running in zip(processes, is_cut):
        if running:
            try:
                process.wait(END_TIMEOUT_S / 10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
    if sys.exc_info()[0] is None and any(process.returncode for process in processes):
        raise ManyeyesError("An agent failed; its error is above.")
