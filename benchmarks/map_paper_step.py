# SPDX-License-Identifier: Apache-2.0
"""A map preset of any size takes a step, is saved, is loaded again and takes the next: loss, seconds and peak memory of each.

For map-paper as it stands, on a processor: eight tiles of ten looks, every picture of each brought to 480 x 640 pixels. The two
steps must be those of a run that was never interrupted (tests/training/test_map_loop.py holds that bit by bit on a narrow one).

python benchmarks/map_paper_step.py [--data data/carla-maps-camera] [--split train] [--preset map-paper] [--batch 8] [--threads 2]
"""

from __future__ import annotations

import argparse
import gc
import resource
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from manyeyes.studies.map_recordings import load_true_maps, open_sensor_recording
from manyeyes.training.maps.presets import MAP_TRAINING_PRESETS
from manyeyes.training.maps.samples import TileStream
from manyeyes.training.maps.task import MapTask
from manyeyes.training.trainer import Trainer

GIB = 1 << 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/carla-maps-camera"))
    parser.add_argument("--split", default="train")
    parser.add_argument("--preset", default="map-paper", choices=MAP_TRAINING_PRESETS)
    parser.add_argument("--batch", type=int, help="tiles a step instead of the preset's")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    preset = MAP_TRAINING_PRESETS[options.preset]
    config = replace(preset, batch=options.batch or preset.batch)
    recording = open_sensor_recording(options.data, options.split, config.map_model.bev.sensors)
    stream = TileStream(recording, load_true_maps(recording), config.map_model, config.augment, 0)
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(2):
            run = Trainer(MapTask(config, stream), Path(folder))
            begun, spent = run.step, run.seconds
            if not begun:
                size = sum(p.numel() for p in run.model.parameters())
                print(
                    f"{options.preset}: {size:,} parameters, batch of {config.batch}, {config.micro_batch} at once",
                    flush=True,
                )
            progress = run.advance()
            run.save()
            terms = ", ".join(
                f"{name} {value:.3f}" for name, value in progress.to_record().items() if name not in ("step", "lr")
            )
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / GIB
            print(
                f"step {begun} to {run.step}: {terms}; {run.seconds - spent:.0f} s, peak {peak:.1f} GiB",
                flush=True,
            )
            del run
            gc.collect()


if __name__ == "__main__":
    main()
