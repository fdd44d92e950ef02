# SPDX-License-Identifier: Apache-2.0
"""Faults of a team of processes on the loopback interface, each with its bar and its outcome, as a table and as JSON.

    python scripts/live_faults.py                      # all rows, with 100 kills: about half an hour
    python scripts/live_faults.py --rows kill flood --kills 3 --agents 3 --seconds 3 --rate 0.25

Faults of packets, certificates, weights and full disks do not need processes: tests/runtime/test_faults.py.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import tyro
from live_team import PLACE, Team, Tick, open_network, rss_bytes, start_team, write_result
from rich.console import Console
from rich.table import Table

from manyeyes.runtime.clock import LiveClock
from manyeyes.viz.study_table import StudyTable

MAX_AGE_NS, FLOOD_PER_S, MB = 500_000_000, 20_000, 1 << 20


@dataclass(frozen=True)
class Options:
    """Which faults, on how many agents."""

    rows: tuple[str, ...] = ("kill", "partition", "sender-clock", "own-clock", "slow", "stop", "flood")
    """Faults, in this order."""
    agents: int = 5
    """Number of processes."""
    kills: int = 100
    """Number of kills of the first row."""
    seconds: float = 10.0
    """Length of the other faults."""
    transport: str = "udp"
    """udp or zenoh."""
    rate: float = 1.0
    """Speed of the clocks; below 1 on machines that other programs share. Without effect on the rows of clocks."""
    out: Path | None = None
    """Write the rows as JSON."""


@dataclass(frozen=True)
class Outcome:
    """One fault: what is demanded, what came, and whether that is enough."""

    fault: str
    bar: str
    result: str
    passed: bool


def flatten(ticks: dict[int, list[Tick]], without: int = 0) -> list[Tick]:
    """Return the ticks of all agents but one."""
    return [tick for agent_id, found in ticks.items() if agent_id != without for tick in found]


def missed_fraction(ticks: list[Tick]) -> float:
    """Return the fraction of ticks beyond their deadline."""
    return sum(tick.missed for tick in ticks) / max(len(ticks), 1)


def max_age_ms(ticks: list[Tick]) -> float:
    """Return the largest age of messages when they were fused, ms."""
    return max((age for tick in ticks for age in tick.fused_ages_ns), default=0) / 1e6


def kill_and_restart(team: Team, options: Options) -> Outcome:
    """Kill an agent, and start it again after a second."""
    victim, missed, delays = team.config.num_agents, list[float](), list[float]()
    for _ in range(options.kills):
        team.kill(victim)
        ticks = flatten(team.collect(1.0))
        team.start(victim)
        began_s, first_s = time.monotonic(), None
        while first_s is None and time.monotonic() - began_s < 60.0 / options.rate:
            found = team.collect(0.2)
            ticks += flatten(found, victim)
            own = found.get(victim, [])
            if own:
                first_s = own[0].sent_s
        found = team.collect(1.0)
        ticks += flatten(found, victim)
        times = [
            tick.time_s for tick in ticks if victim in tick.fused and first_s is not None and tick.time_s > first_s
        ]
        delays.append((min(times) - (first_s or 0.0)) * options.rate if times else float("inf"))
        missed.append(missed_fraction(ticks))
    text = f"missed {sum(missed) / len(missed):.1%}, fused after {max(delays):.2f} s at most, {len(delays)} kills"
    return Outcome(
        "kill -9, restart after 1 s", "no tick missed; fused <= 0.5 s", text, max(missed) == 0 and max(delays) <= 0.5
    )


def partition(team: Team, options: Options) -> Outcome:
    """Separate the first two agents from the others, and heal."""
    everyone = frozenset(team.processes)
    sides = (frozenset({1, 2}), everyone - {1, 2})
    for side in sides:
        team.set(side, "members", side)
    team.collect(1.0)
    apart = flatten(team.collect(options.seconds))
    separated = all(tick.fused <= next(s for s in sides if tick.agent_id in s) for tick in apart)
    team.set(everyone, "members", None)
    healed = team.collect(2.0)
    complete = all(ticks and ticks[-1].fused == everyone - {agent_id} for agent_id, ticks in healed.items())
    age_ms = max_age_ms(apart + flatten(healed))
    text = f"separated {separated}, all again {complete}, age <= {age_ms:.0f} ms"
    return Outcome(
        "partition, heal", "each side alone; all again; age <= 500 ms", text, separated and complete and age_ms <= 500
    )


def sender_clock(team: Team, options: Options) -> Outcome:
    """Step the clock of a sender by 0.3 s, forth and back."""
    victim, text, passed = team.config.num_agents, list[str](), True
    for offset_ms in (300, -300):
        team.set([victim], "offset_ns", offset_ms * 1_000_000)
        team.collect(2.0)
        wrong = flatten(team.collect(2.0), victim)
        team.set([victim], "offset_ns", 0)
        team.collect(2.0)
        repaired = flatten(team.collect(1.0), victim)
        out = not any(victim in tick.fused for tick in wrong)
        others = all(len(tick.fused) >= team.config.num_agents - 2 for tick in wrong)
        back = any(victim in tick.fused for tick in repaired)
        passed &= out and others and back
        text.append(f"{offset_ms:+d} ms: left out {out}, others fused {others}, back {back}")
    return Outcome("clock of a sender +-0.3 s", "left out; others as before; back <= 2 s", "; ".join(text), passed)


def own_clock(team: Team, options: Options) -> Outcome:
    """Step the clock of one ego by 0.3 s."""
    ego = 1
    team.set([ego], "offset_ns", 300_000_000)
    first = team.collect(1.0)[ego]
    team.set([ego], "offset_ns", 0)
    later = team.collect(1.0)[ego] + team.collect(2.0)[ego]
    events = sum(tick.note.startswith("clock_step") for tick in first + later)
    complete = bool(later) and len(later[-1].fused) == team.config.num_agents - 1
    alone = any(not tick.fused for tick in first)
    text = f"{events} events, alone {alone}, all fused afterwards {complete}"
    return Outcome(
        "clock of an ego +0.3 s, back", "event; 1 s alone; no exception", text, events == 2 and alone and complete
    )


def slow_ego(team: Team, options: Options) -> Outcome:
    """Slow an ego down by 80 ms a frame."""
    ego = 1
    team.set([ego], "delay_ns", 80_000_000)
    slow = team.collect(options.seconds)[ego]
    team.set([ego], "delay_ns", 0)
    after = team.collect(1.0)[ego] + team.collect(1.0)[ego]
    age_ms, recovered = max_age_ms(slow), bool(after) and not after[-1].missed
    text = f"age <= {age_ms:.0f} ms, level {max((t.level for t in slow), default=0)}, recovered {recovered}"
    return Outcome("ego slow by 80 ms", "age <= 500 ms; recovery <= 1 s", text, age_ms <= 500 and recovered)


def stopped_ego(team: Team, options: Options) -> Outcome:
    """Stop an ego for five seconds."""
    ego = 1
    team.send_signal(ego, signal.SIGSTOP)
    others = flatten(team.collect(5.0), ego)
    team.send_signal(ego, signal.SIGCONT)
    back = team.collect(1.5)[ego]
    complete = bool(back) and len(back[-1].fused) == team.config.num_agents - 1
    age_ms = max_age_ms(back + others)
    # It may stop while it computes boxes, which then come late, and are marked as missed.
    latest_ms = max((tick.latency_ns for tick in back), default=0) / 1e6
    text = f"all fused {complete}, age <= {age_ms:.0f} ms, others missed {missed_fraction(others):.1%}"
    text += f", its latest boxes {latest_ms:.0f} ms after their sweep"
    return Outcome("SIGSTOP 5 s", "age <= 500 ms; recovery <= 1 s", text, complete and age_ms <= 500)


def flood(team: Team, options: Options) -> Outcome:
    """Send 20,000 forged packets a second from a process without a key of the federation."""
    team.collect(2.0)  # links are known after a second
    before = {agent_id: rss_bytes(process)[0] for agent_id, process in team.processes.items()}
    child = os.fork()
    if child == 0:
        _send_forged(team, options.seconds / options.rate, options.rate)
        os._exit(0)
    ticks = flatten(team.collect(options.seconds))
    os.waitpid(child, 0)
    growth = max(rss_bytes(process)[0] - before[agent_id] for agent_id, process in team.processes.items()) / MB
    honest = sum(len(tick.fused) == team.config.num_agents - 1 for tick in ticks) / max(len(ticks), 1)
    received = max((t.received_packets for t in ticks), default=0) - min((t.received_packets for t in ticks), default=0)
    missed, rate = missed_fraction(ticks), received / options.seconds
    text = f"on time {1 - missed:.1%}, all honest fused {honest:.1%}, RSS {growth:+.0f} MB, {rate:.0f} packets/s read"
    return Outcome(
        f"{FLOOD_PER_S} forged packets/s", "on time >= 99 %; honest fused; RSS <= +64 MB", text,
        missed <= 0.01 and honest >= 0.99 and growth <= 64,
    )  # fmt: skip


def _send_forged(team: Team, seconds: float, rate: float) -> None:
    """Send changed copies of captured packets."""
    network = open_network(replace(team.config, num_agents=0), 10**6, team.port, LiveClock())
    network.join(PLACE)
    captured: list[bytes] = []
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        captured = ([received.packet for received in network.poll()] + captured)[:16]
        began_s = time.monotonic()
        for number in range(round(FLOOD_PER_S * rate / 100) if captured else 0):
            packet = bytearray(captured[number % len(captured)])
            packet[-1 - number % 64] ^= 1 + number % 255
            network.send([bytes(packet)], PLACE)
        time.sleep(max(0.0, 0.01 - (time.monotonic() - began_s)))
    network.close()


ROWS: dict[str, Callable[[Team, Options], Outcome]] = {
    "kill": kill_and_restart,
    "partition": partition,
    "sender-clock": sender_clock,
    "own-clock": own_clock,
    "slow": slow_ego,
    "stop": stopped_ego,
    "flood": flood,
}


def main(options: Options) -> None:
    """Run the rows, and print their table."""
    outcomes, load = list[Outcome](), os.getloadavg()[0]
    for name in options.rows:
        with start_team(options.agents, options.transport, options.rate) as team:
            outcomes.append(ROWS[name](team, options))
    table = Table("fault", "bar", "result", "", box=None)
    for one in outcomes:
        table.add_row(one.fault, one.bar, one.result, "met" if one.passed else "NOT MET")
    Console(width=180).print(table)
    print(
        f"{options.agents} processes, {options.transport}, rate {options.rate:g}; load of the machine before: {load:.1f}"
    )
    rows = {"load_before": load, "rows": [asdict(one) for one in outcomes]}
    lines = tuple((one.fault, one.bar, one.result, "met" if one.passed else "not met") for one in outcomes)
    title = f"Faults of {options.agents} processes, {options.transport}, clocks at rate {options.rate:g}"
    write_result(rows, StudyTable(title, ("fault", "bar", "result", ""), lines), options)


if __name__ == "__main__":
    main(tyro.cli(Options))
