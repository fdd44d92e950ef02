# SPDX-License-Identifier: Apache-2.0
"""Milliseconds a picture: OPV2V's front camera and DAIR-V2X's on a pole, in one scene, by size and rays per pixel.

The scene is made before the clock starts; what shades what is indexed once a frame and timed on its own. With one thread
the process's own time is counted.

python benchmarks/cameras.py [--town Town05] [--rounds 5] [--out benchmarks/results/cameras.json]
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import torch

from manyeyes.simulator.record import make_first_scenario
from manyeyes.simulator.scene.scenario import RSU_ID, ScenarioSpec
from manyeyes.simulator.sensors.camera import CAMERA_RIGS, render_image
from manyeyes.studies.provenance import write_json

VIEWS = (("opv2v", 1), ("opv2v", 2), ("opv2v-small", 1), ("opv2v-small", 2), ("dair-infrastructure-small", 2))


@dataclass(frozen=True)
class Row:
    """least_ms and median_ms of one picture of width x height with samples x samples rays a pixel."""

    rig: str
    width: int
    height: int
    samples: int
    least_ms: float
    median_ms: float


def timed(work: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Least and median milliseconds; a first call compiles and is not counted."""
    work()
    spent = []
    for _ in range(rounds):
        began = time.process_time()
        work()
        spent.append(1e3 * (time.process_time() - began))
    return min(spent), median(spent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--town", default="Town05")
    parser.add_argument("--towns", help="where roads are looked for first")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    load = os.getloadavg()[0]
    spec = ScenarioSpec(
        wanted.town, wanted.seed, "timed", vehicles=1, frames=2, history_frames=1, roadside_chance=1.0, cameras="opv2v"
    )
    scenario = make_first_scenario(spec, wanted.towns, roadside=True)
    stage, pose_of = (
        scenario.lit_scene(0),
        {frame.agent_id: frame.world_from_agent for frame in scenario.snapshot(0).frames},
    )
    index = timed(lambda: scenario.lit_scene(0), wanted.rounds)
    rows = [Row("a stage", 0, 0, 0, *index)]
    for name, samples in VIEWS:
        camera = replace(CAMERA_RIGS[name][0], samples=samples)
        agent = RSU_ID if "infrastructure" in name else scenario.agents[0]
        took = timed(
            lambda camera=camera, agent=agent: render_image(stage, pose_of[agent], camera, agent), wanted.rounds
        )
        rows.append(Row(name, camera.width, camera.height, samples, *took))
    print(f"{wanted.town}, seed {scenario.spec.seed}, 1 thread, load {load:.1f}, {len(stage.scene.solids)} solids")
    for row in rows:
        size = (
            f"{row.width} x {row.height}, {row.samples} x {row.samples} rays a pixel" if row.samples else "once a frame"
        )
        print(f"{row.rig:26} {size:34} {row.least_ms:7.1f} ms (median {row.median_ms:.1f})")
    if wanted.out:
        settings = {"town": wanted.town, "rounds": wanted.rounds, "threads": 1, "load": load}
        command = shlex.join(["python", *sys.argv])
        write_json(wanted.out, {"command": command, "settings": settings, "rows": rows}, settings, wanted.seed)


if __name__ == "__main__":
    main()
