# SPDX-License-Identifier: Apache-2.0
"""Loading from disk at OPV2V's size: CPU time of the index, and snapshots and training samples a second of one worker.

The frames of a small simulated recording in OPV2V's layout are linked to scenarios of 150 frames, to and fro in time, until there
are 6,700 frames; links take no space. The index: opening the recording, and the length of an epoch. Rates are those of one
process by its CPU time, with wall time beside, over random frames: whole snapshots, and samples of the preset costr-opv2v
(two sweeps of several agents, levelled and augmented). Each is measured on the first reading, which parses metadata and, with
--ascii, clouds that are text, and by a second opening, which has both from the cache of arrays, as all epochs but the first.

python benchmarks/loading.py RECORDING [--scratch FOLDER] [--frames 6700] [--samples 60] [--ascii] [--out FILE]
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np
import torch

from manyeyes.datasets.formats.pcd import read_table
from manyeyes.datasets.opv2v.reader import Opv2vRecording
from manyeyes.datatypes import Snapshot
from manyeyes.studies.provenance import write_json
from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
from manyeyes.training.detector.samples import AugmentConfig, SampleStream, epoch_length

SCENARIO_FRAMES = 150
MIN_RATE, MAX_INDEX_S = 25.0, 10.0
"""Frames a second of a worker, and CPU time of the index (issue 23, section 3)."""


@dataclass(frozen=True)
class Rate:
    """How many of something one process reads in a second of CPU time, and of wall time."""

    what: str
    count: int
    per_cpu_s: float
    per_wall_s: float


@dataclass(frozen=True)
class Loading:
    """Result: sizes, CPU time of the index in seconds, and rates."""

    scenarios: int
    frames: int
    agent_frames: int
    points_per_cloud: float
    is_ascii: bool
    index_cpu_s: float
    rates: tuple[Rate, ...]


def link_frames(source: Path, target: Path, num_frames: int) -> None:
    """Make a folder of scenarios with this many frames from hard links to those of a folder of scenarios."""
    folders = cycle(sorted(path for path in source.iterdir() if path.is_dir()))
    for number, first in enumerate(range(0, num_frames, SCENARIO_FRAMES)):
        folder, scenario = next(folders), target / f"copy_{number:04d}"
        scenario.mkdir(parents=True)
        shutil.copy(folder / "data_protocol.yaml", scenario)
        for agent in sorted(path for path in folder.iterdir() if path.is_dir()):
            stems = sorted(path.stem for path in agent.glob("*.pcd"))
            there_and_back = cycle([*stems, *stems[-2:0:-1]])
            (scenario / agent.name).mkdir()
            for frame in range(min(SCENARIO_FRAMES, num_frames - first)):
                stem = next(there_and_back)
                for suffix in (".pcd", ".yaml"):
                    path = agent / f"{stem}{suffix}"
                    (scenario / agent.name / f"{2 * frame:06d}{suffix}").hardlink_to(path)


def write_ascii(source: Path, target: Path) -> None:
    """Copy a folder of scenarios with its clouds as text."""
    shutil.copytree(source, target)
    for path in sorted(target.rglob("*.pcd")):
        table = np.stack([np.asarray(column, np.float32) for column in read_table(path).columns], 1)
        header = path.read_bytes().split(b"DATA")[0].decode()
        with path.open("w", encoding="ascii") as file:
            file.write(header + "DATA ascii\n")
            np.savetxt(file, table, fmt="%.9g")


def measure_rate(what: str, read: Callable[[int], object], numbers: range) -> Rate:
    """Measure how many calls of read run in a second."""
    cpu, wall = time.process_time(), time.perf_counter()
    for number in numbers:
        read(number)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return Rate(what, len(numbers), len(numbers) / cpu, len(numbers) / wall)


def read_chosen(recording: Opv2vRecording, places: list[tuple[str, int]], number: int) -> Snapshot:
    """Read the snapshot at one of the places."""
    return recording.snapshot(*places[number])


def measure(root: Path, cache: Path, num_samples: int, is_ascii: bool) -> Loading:
    """Measure index and rates of the linked frames."""
    warm = Opv2vRecording(root, use_cache=False)
    SampleStream(warm, DETECTOR_TRAINING_PRESETS["costr-opv2v"].detector.grid, AugmentConfig(), 1).draw(
        0
    )  # compiles loops
    start = time.process_time()
    recording = Opv2vRecording(root, cache_folder=cache)
    frames = epoch_length(recording)
    index = time.process_time() - start
    config = DETECTOR_TRAINING_PRESETS["costr-opv2v"]
    places = [(name, at) for name in recording.scenarios for at in range(recording.length(name))]
    rng = np.random.default_rng(0)
    chosen = [places[i] for i in rng.permutation(len(places))[:num_samples]]
    rates = []
    for name in ("first reading", "cached"):
        again = Opv2vRecording(root, cache_folder=cache)
        stream = SampleStream(again, config.detector.grid, config.augment, 0)
        rates.append(measure_rate(f"samples, {name}", stream.draw, range(num_samples)))
    for name in ("first reading", "cached"):
        again = Opv2vRecording(root, cache_folder=cache / "snapshots")
        rates.append(measure_rate(f"snapshots, {name}", partial(read_chosen, again, chosen), range(num_samples)))
    agents = sum(len(recording.agents(name)) * recording.length(name) for name in recording.scenarios)
    points = [len(frame.points) for frame in recording.snapshot(*chosen[0]).frames]
    return Loading(len(recording.scenarios), frames, agents, float(np.mean(points)), is_ascii, index, tuple(rates))


def main() -> None:
    """Link, measure, print, store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, help="a folder of scenarios in OPV2V's layout")
    parser.add_argument("--scratch", type=Path, default=None, help="on the file system of the recording")
    parser.add_argument("--frames", type=int, default=6700)
    parser.add_argument("--samples", type=int, default=60)
    parser.add_argument("--ascii", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/loading.json"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(dir=given.scratch or given.recording.parent) as folder:
        source = given.recording
        if given.ascii:
            source = Path(folder) / "ascii"
            write_ascii(given.recording, source)
        link_frames(source, Path(folder) / "linked", given.frames)
        result = measure(Path(folder) / "linked", Path(folder) / "cache", given.samples, given.ascii)
    print(f"index of {result.frames:,} frames: {result.index_cpu_s:.2f} s of CPU time (bar {MAX_INDEX_S:.0f} s)")
    for rate in result.rates:
        print(
            f"{rate.what}: {rate.per_cpu_s:.1f} per CPU second, {rate.per_wall_s:.1f} per second (bar {MIN_RATE:.0f})"
        )
    write_json(given.out, result, {"frames": given.frames, "samples": given.samples, "ascii": given.ascii}, 0)


if __name__ == "__main__":
    main()
