# SPDX-License-Identifier: Apache-2.0
"""A map preset overfits a few tiles of a recording: mAP on those tiles, by steps and seconds of training.

The bar: map-tiny above 0.9 on 16 tiles in five minutes on two cores. One process, or for two cores

torchrun --nproc-per-node 2 benchmarks/map_overfit.py [--data data/carla-maps] [--split train] [--tiles 16] [--steps 800]
    [--batch 4] [--rate 4e-3] [--threads 1] [--every 200] [--preset map-tiny]
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist

from manyeyes.datatypes.map_element import KINDS
from manyeyes.evaluation.maps.metrics import evaluate_map
from manyeyes.evaluation.maps.tiles import place_side_by_side
from manyeyes.models.maps.head import RawMap, decode_elements
from manyeyes.models.maps.map_model import MapModel
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.studies.map_recordings import load_true_maps, open_sensor_recording
from manyeyes.training.maps.line_field_targets import dilate_observed
from manyeyes.training.maps.presets import MAP_TRAINING_PRESETS
from manyeyes.training.maps.samples import MapAugmentConfig, MapSample, TileStream
from manyeyes.training.maps.step import extract_features, warp_tokens
from manyeyes.training.maps.targets import select_observed
from manyeyes.training.maps.task import MapTask
from manyeyes.training.trainer import Trainer


@dataclass(frozen=True)
class Few:
    """The same samples over and over, each time in another order: norms of the batch would learn who always comes together."""

    samples: tuple[MapSample, ...]
    towns: tuple[str, ...]

    def draw(self, number: int) -> MapSample:
        turn, place = divmod(number, len(self.samples))
        return self.samples[int(keyed_generator("few", turn).permutation(len(self.samples))[place])]


def mean_ap(model: MapModel, samples: tuple[MapSample, ...]) -> dict[str, float]:
    """mAP in both ways, of the sketch's lines too, and AP of each kind, on the tiles of samples."""
    config, drawn, begun, truth = model.config, [], [], []
    kinds = [KINDS.index(kind) for kind in config.head.kinds]
    model.eval()
    with torch.no_grad():
        for sample in samples:
            features, seen = warp_tokens(model, extract_features(model, [sample]).tokens, [sample])
            ground = model.fuse_features(features, seen)
            sketch = model.predict_line_field(ground)
            point, logit, _ = model.head.init_queries(sketch)
            begun += decode_elements(RawMap(logit, point), config.tile, config.head)
            drawn += decode_elements(model.predict_elements(ground, line_field=sketch)[-1], config.tile, config.head)
            asked = select_observed(sample.truth, dilate_observed(seen.any(1), config.tile)[0], config.tile)
            truth.append(asked.take(np.isin(asked.kind, kinds)))
    quality = evaluate_map(place_side_by_side(drawn), place_side_by_side(truth), ("maptr", "exact"), config.head.kinds)
    mean = {way: round(quality.mean_ap(way, kinds=config.head.kinds), 3) for way in ("maptr", "exact")}
    first = evaluate_map(place_side_by_side(begun), place_side_by_side(truth), ("maptr",), config.head.kinds)
    mean["sketch"] = round(first.mean_ap("maptr", kinds=config.head.kinds), 3)
    return {**mean, **{kind: round(quality.get_ap(kind, "maptr"), 3) for kind in config.head.kinds}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/carla-maps"))
    parser.add_argument("--split", default="train")
    parser.add_argument("--tiles", type=int, default=16)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--rate", type=float, default=4e-3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--every", type=int, default=200)
    parser.add_argument("--preset", default="map-tiny", choices=MAP_TRAINING_PRESETS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        dist.init_process_group("gloo")
    preset = MAP_TRAINING_PRESETS[options.preset]
    recording = open_sensor_recording(options.data, options.split, preset.map_model.bev.sensors)
    stream = TileStream(recording, load_true_maps(recording), preset.map_model, MapAugmentConfig(1, 3, flip=False), 0)
    few = Few(tuple(stream.draw(k) for k in range(options.tiles)), stream.towns)
    if not dist.is_initialized() or dist.get_rank() == 0:
        print(f"{options.tiles} tiles, {sum(len(s.truth) for s in few.samples)} elements", flush=True)
    config = replace(
        preset,
        steps=options.steps,
        batch=options.batch,
        learning_rate=options.rate,
        warmup_steps=30,
        max_token_dropout=0.0,
        ema_decay=0.98,
        # Queries that begin as lines of their own learn from the first step.
        line_field_steps=0 if preset.map_model.head.num_learned_queries else options.steps // 4,
    )
    with tempfile.TemporaryDirectory() as folder:
        run = Trainer(MapTask(config, few), Path(folder))
        while run.step < config.steps:
            progress = run.advance()
            at_last = run.step == config.steps
            if not run.rank and (at_last or run.step % options.every == 0):
                found = mean_ap(run.average, few.samples)
                print(f"{run.step}: loss {progress.loss:.2f}, {found}, {run.seconds:.0f} s", flush=True)
    if dist.is_initialized():
        dist.destroy_process_group()


if __name__ == "__main__":
    main()
