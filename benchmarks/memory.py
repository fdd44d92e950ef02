# SPDX-License-Identifier: Apache-2.0
"""Peak memory of perceive over the number of agents and the range, and a straight line through it in tokens.

A street's agents share, the ego among them, so that its own sweep is processed, as at every instant of a drive; then the
peak of the process's resident memory while it perceives, above what it held just before, is read from the kernel (Linux:
VmHWM after /proc/self/clear_refs). Weights are random and of costr-small's widths, nothing is pruned and no budget limits a
message, so that tokens are as many as they can be. Each figure is the second of two runs: the first compiles loops. Tokens:
all that meet at the ego, its own and those received within range.

python benchmarks/memory.py [--agents 1 2 3 5 7 10] [--range 50 100 150 200 280] [--out benchmarks/results/memory.json]
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import re
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from street import street

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datatypes import AgentFrame, BevGrid
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.fold_norms import fold_norms
from manyeyes.models.detector.presets import COSTR_SMALL
from manyeyes.models.fusion.token_merge import FusedBev
from manyeyes.models.fusion.transform_tokens import Tokens
from manyeyes.studies.provenance import write_json

HALF_WIDTH_M = 38.4
MIB = 1 << 20


@dataclass(frozen=True)
class Cell:
    """One number of agents and one range: tokens that met, and MiB that perceiving took at its peak."""

    agents: int
    range_m: float
    tokens: int
    peak_mib: float


@dataclass(frozen=True)
class Line:
    """peak = intercept_mib + kib_per_token * tokens; r_squared: the share of the variance that it explains."""

    intercept_mib: float
    kib_per_token: float
    r_squared: float


class CountingCache(PerceptionCache):
    """Counts the tokens that were fused last."""

    tokens = 0

    def fuse(self, tokens: Tokens, past: Tokens | None = None) -> tuple[FusedBev, RawBoxes]:
        self.tokens = len(tokens.features)
        return super().fuse(tokens, past)


def peak_of(call: Callable[[], object]) -> float:
    """MiB of resident memory that a call needs at its peak, above what the process holds before it."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")
    before = _resident("VmRSS")
    call()
    return (_resident("VmHWM") - before) / 1024


def _resident(name: str) -> int:
    """KiB of that line of /proc/self/status."""
    found = re.search(rf"^{name}:\s+(\d+) kB$", Path("/proc/self/status").read_text(), re.MULTILINE)
    if found is None:
        raise RuntimeError(f"/proc/self/status has no line {name}: peak memory is read on Linux only.")
    return int(found[1])


def line_through(cells: list[Cell]) -> Line:
    """Least squares of the peak on tokens."""
    tokens, peak = (np.array([getattr(cell, name) for cell in cells], float) for name in ("tokens", "peak_mib"))
    slope, intercept = np.polyfit(tokens, peak, 1)
    rest = ((peak - intercept - slope * tokens) ** 2).sum()
    return Line(float(intercept), float(slope * 1024), float(1 - rest / ((peak - peak.mean()) ** 2).sum()))


def detector_of(range_m: float) -> Detector:
    """Random weights on a grid that is range_m long."""
    torch.manual_seed(0)
    cell = 32 * COSTR_SMALL.grid.pillar
    half = round(max(1, round(range_m / cell)) * cell / 2, 2)
    grid = BevGrid(-half, -HALF_WIDTH_M, COSTR_SMALL.grid.z_min, half, HALF_WIDTH_M, COSTR_SMALL.grid.z_max)
    model = Detector(replace(COSTR_SMALL, grid=grid, prune_threshold=0.0))
    return fold_norms(model)


def measure(model: Detector, frames: list[AgentFrame], range_m: float) -> Cell:
    """The second of two runs."""
    packets = [p for frame in frames[1:] for p in Agent(model, budget_bytes=None).share(frame)]
    peaks, cache = [], CountingCache(model)
    for _ in range(2):
        cache = CountingCache(model)
        agent = Agent(model, budget_bytes=None, perception_cache=cache)
        agent.share(frames[0])
        peaks.append(peak_of(lambda agent=agent: agent.perceive(frames[0], packets)))
    return Cell(len(frames), range_m, cache.tokens, peaks[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, nargs="+", default=[1, 2, 3, 5, 7, 10])
    parser.add_argument("--range", type=float, nargs="+", default=[50.0, 100.0, 150.0, 200.0, 280.0])
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    frames = list(street(agents=max(wanted.agents)).frames)
    cells = []
    for range_m in wanted.range:
        model = detector_of(range_m)
        for agents in wanted.agents:
            cells.append(measure(model, frames[:agents], range_m))
            cell = cells[-1]
            print(f"{agents:3} agents  {range_m:5.0f} m  {cell.tokens:7} tokens  {cell.peak_mib:8.1f} MiB", flush=True)
    line = line_through(cells)
    print(
        f"peak = {line.intercept_mib:.1f} MiB + {line.kib_per_token:.2f} KiB a token; "
        f"R^2 {line.r_squared:.4f} over {len(cells)} cells"
    )
    if wanted.out:
        settings = {"agents": wanted.agents, "range_m": wanted.range}
        command = shlex.join(["python", *sys.argv])
        write_json(wanted.out, {"command": command, "cells": cells, "line": line}, settings, seed=0)


if __name__ == "__main__":
    main()
