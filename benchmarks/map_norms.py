# SPDX-License-Identifier: Apache-2.0
"""Effect of the norm on a network over BEV rasters of sweeps, most of whose cells are empty.

Four convolutions predict for each observed cell which kinds of element it holds: average precision over the cells of held-out
frames, by norm.

python benchmarks/map_norms.py [--data data/carla-maps] [--tiles 60] [--steps 120] [--looks 6] [--rate 3e-3] [--held 20]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from manyeyes.models.maps.bev import rasterise_clouds
from manyeyes.studies.map_recordings import load_true_maps, open_sensor_recording
from manyeyes.training.maps.losses import segmentation_loss
from manyeyes.training.maps.presets import MAP_TRAINING_PRESETS
from manyeyes.training.maps.samples import MapAugmentConfig, TileStream

NORMS: dict[str, Callable[[int], nn.Module]] = {
    "batch": nn.BatchNorm2d,
    "each channel of a look": lambda channels: nn.GroupNorm(channels, channels),
    "group, all channels": lambda channels: nn.GroupNorm(1, channels),
    "none": lambda channels: nn.Identity(),
}


def network(inputs: int, kinds: int, norm: Callable[[int], nn.Module]) -> nn.Sequential:
    """From pillars to tokens' cells, twice as wide."""
    layers: list[nn.Module] = []
    for before, after, stride in ((inputs, 16, 1), (16, 32, 2), (32, 32, 1), (32, 32, 1)):
        layers += [nn.Conv2d(before, after, 3, stride, 1), norm(after), nn.ReLU()]
    last = nn.Conv2d(32, kinds, 1)
    assert last.bias is not None
    nn.init.constant_(last.bias, -3.0)
    return nn.Sequential(*layers, last)


def average_precision(logit: Tensor, drawn: Tensor) -> float:
    """Of cells by their logits (N,): the mean precision at each cell that is truly drawn (N,)."""
    hit = drawn[logit.argsort(descending=True, stable=True)].double()
    precision = hit.cumsum(0) / torch.arange(1, len(hit) + 1)
    return float((precision * hit).sum() / hit.sum().clamp_min(1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/carla-maps"))
    parser.add_argument("--tiles", type=int, default=60)
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--looks", type=int, default=6)
    parser.add_argument("--rate", type=float, default=3e-3)
    parser.add_argument("--held", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(1)
    mapper = MAP_TRAINING_PRESETS["map-small-lidar"].map_model
    recording = open_sensor_recording(options.data, "train", ("lidar",))
    stream = TileStream(recording, load_true_maps(recording), mapper, MapAugmentConfig(3, 6), 3)
    samples = [stream.draw(number) for number in range(options.tiles)]
    raster, hit = rasterise_clouds([frame.points for sample in samples for frame in sample.frames], mapper.bev.grid)
    drawn = torch.cat([sample.line_mask for sample in samples])
    seen = F.max_pool2d(hit[:, None].float(), 5, 2, 2)[:, 0] > 0
    learnt = len(raster) - options.held
    print(f"{learnt} looks to learn from, {options.held} held out; kinds: {', '.join(mapper.head.kinds)}", flush=True)
    for name, norm in NORMS.items():
        torch.manual_seed(0)
        net = network(raster.shape[1], drawn.shape[1], norm)
        optimiser = torch.optim.AdamW(net.parameters(), lr=options.rate, betas=(0.9, 0.98))
        rng, began = np.random.default_rng(0), time.process_time()
        for step in range(options.steps):
            rows = torch.from_numpy(rng.choice(learnt, options.looks, replace=False))
            where = seen[rows]
            logits = net(raster[rows]).permute(0, 2, 3, 1)[where]
            loss = segmentation_loss(logits, drawn[rows].permute(0, 2, 3, 1)[where].float())
            for group in optimiser.param_groups:
                group["lr"] = options.rate * min(1.0, (step + 1) / 10) * (1 - step / options.steps)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        net.eval()
        with torch.inference_mode():
            logits = net(raster[learnt:]).permute(0, 2, 3, 1)[seen[learnt:]]
        true = drawn[learnt:].permute(0, 2, 3, 1)[seen[learnt:]]
        kinds = [round(average_precision(logits[:, k], true[:, k]), 3) for k in range(true.shape[1])]
        print(f"{name}: {kinds}, {time.process_time() - began:.0f} s of processor", flush=True)


if __name__ == "__main__":
    main()
