# SPDX-License-Identifier: Apache-2.0
"""Soak of a team of processes: slope of memory with its interval, threads and files, deadlines, ages; agents come and go.

    python scripts/live_soak.py                                   # five agents for an hour
    python scripts/live_soak.py --minutes 2 --warm-up-minutes .5  # a short run proves nothing about slopes

The slope is Theil and Sen's median of pairs; its interval is that of a bootstrap of blocks of 60 s.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tyro
from live_team import Team, Tick, rss_bytes, start_team, summarise, write_result
from numpy.typing import NDArray

from manyeyes.viz.study_table import StudyTable

MB, SAMPLE_S, BLOCK_S, NUM_DRAWS, MAX_POINTS = 1 << 20, 5.0, 60.0, 500, 400


@dataclass(frozen=True)
class Options:
    """Length and team."""

    minutes: float = 60.0
    """Length of the run."""
    warm_up_minutes: float = 10.0
    """Samples of the first minutes are not in the slope."""
    agents: int = 5
    """Number of processes; the last one leaves and comes back."""
    turnover_s: float = 30.0
    """Time from one departure, or arrival, to the next."""
    transport: str = "udp"
    """udp or zenoh."""
    rate: float = 1.0
    """Speed of the clocks."""
    weights: str | None = None
    """Weights of a detector, with --recording; by default a detector of one car."""
    recording: tuple[str, str] | None = None
    """Folder and split of a recording whose frames are played again and again."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Write the result as JSON."""


@dataclass(frozen=True)
class Slope:
    """Slope of memory, MB an hour, with its 95 % interval. num: of samples."""

    mb_per_h: float
    low: float
    high: float
    num: int


def theil_sen(time_s: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    """Return the median of the slopes of all pairs."""
    first, second = np.triu_indices(len(values), 1)
    apart = time_s[second] != time_s[first]
    slopes = (values[second] - values[first])[apart] / (time_s[second] - time_s[first])[apart]
    return float(np.median(slopes)) if len(slopes) else float("nan")


def estimate_slope(time_s: NDArray[np.float64], values_mb: NDArray[np.float64], seed: int = 0) -> Slope:
    """Return the slope and its interval: the residuals of the line are drawn in blocks of BLOCK_S."""
    keep = np.linspace(0, len(values_mb) - 1, min(len(values_mb), MAX_POINTS)).astype(int)
    time_s, values_mb = time_s[keep], values_mb[keep]
    slope = theil_sen(time_s, values_mb)
    residuals = values_mb - slope * time_s
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else SAMPLE_S
    size = max(1, min(len(values_mb), round(BLOCK_S / max(step_s, 1e-9))))
    rng, drawn = np.random.default_rng(seed), list[float]()
    for _ in range(NUM_DRAWS):
        starts = rng.integers(0, len(values_mb) - size + 1, -(-len(values_mb) // size))
        rows = (starts[:, None] + np.arange(size)).reshape(-1)[: len(values_mb)]
        drawn.append(theil_sen(time_s, slope * time_s + residuals[rows]))
    low, high = np.quantile(drawn, (0.025, 0.975)) if drawn else (np.nan, np.nan)
    return Slope(*(round(3_600 * float(value), 3) for value in (slope, low, high)), len(values_mb))


@dataclass
class _Samples:
    time_s: list[float]
    rss_mb: dict[int, list[float]]
    pss_mb: dict[int, list[float]]

    def add(self, now_s: float, team: Team, stable: range) -> None:
        """Sample the memory of the agents that stay."""
        self.time_s.append(now_s)
        for agent_id in stable:
            rss, pss = rss_bytes(team.processes[agent_id])
            self.rss_mb[agent_id].append(rss / MB)
            self.pss_mb[agent_id].append(pss / MB)


def run_team(options: Options) -> tuple[_Samples, list[Tick], int]:
    """Run the team; return samples of memory, all ticks of agents that stay, and the number of departures."""
    stable, changing = range(1, options.agents), options.agents
    samples = _Samples([], {k: [] for k in stable}, {k: [] for k in stable})
    ticks, departures = list[Tick](), 0
    with start_team(options.agents, options.transport, options.rate, options.weights, options.recording) as team:
        began_s = changed_s = time.monotonic()
        while (now_s := time.monotonic()) - began_s < 60 * options.minutes:
            found = team.collect(min(SAMPLE_S, options.turnover_s) * options.rate)
            ticks += [tick for agent_id in stable for tick in found.get(agent_id, [])]
            samples.add(now_s - began_s, team, stable)
            if now_s - changed_s >= options.turnover_s:
                changed_s = now_s
                if changing in team.processes:
                    team.kill(changing)
                    departures += 1
                else:
                    team.start(changing)
    return samples, ticks, departures


def main(options: Options) -> None:
    """Run the soak, and print what it found."""
    load = os.getloadavg()[0]
    samples, ticks, departures = run_team(options)
    time_s = np.array(samples.time_s)
    warm = time_s >= 60 * options.warm_up_minutes
    slopes = {
        str(agent_id): estimate_slope(time_s[warm], np.array(values)[warm], options.seed)
        for agent_id, values in samples.rss_mb.items()
        if warm.sum() > 2
    }
    late = [tick for tick in ticks if tick.time_s - ticks[0].time_s >= 60 * options.warm_up_minutes] or ticks
    result = {
        "minutes": options.minutes,
        "agents": options.agents,
        "transport": options.transport,
        "rate": options.rate,
        "weights": options.weights,
        "load_before": load,
        "departures": departures,
        **summarise(ticks),
        "rss_mb_per_h": {name: asdict(slope) for name, slope in slopes.items()},
        "rss_mb_last": {str(k): round(values[-1], 1) for k, values in samples.rss_mb.items()},
        "pss_mb_last": {str(k): round(values[-1], 1) for k, values in samples.pss_mb.items()},
        "threads": sorted({tick.num_threads for tick in late}),
        "files": [min(tick.num_files for tick in late), max(tick.num_files for tick in late)],
    }
    print(json.dumps(result, indent=2))
    files, threads = "{} to {}".format(*result["files"]), ", ".join(map(str, result["threads"]))
    lines = tuple(
        (name, f"{slope.mb_per_h:.2f} [{slope.low:.2f}, {slope.high:.2f}]", str(result["rss_mb_last"][name]))
        for name, slope in slopes.items()
    )
    title = (
        f"{options.minutes:g} min, {options.agents} agents, {departures} departures, {result['frames']} frames, "
        f"{result['missed_fraction']:.2%} of deadlines missed, threads {threads}, files {files}"
    )
    headings = ("agent", "memory [MB/h]; bar: upper end at most 2", "memory at the end [MB]")
    write_result(result, StudyTable(title, headings, lines), options, options.seed)


if __name__ == "__main__":
    main(tyro.cli(Options))
