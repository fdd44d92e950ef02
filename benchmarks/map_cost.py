# SPDX-License-Identifier: Apache-2.0
"""Cost of predicting the map of an area: tile by tile from tokens, or at once on one dense BEV of the whole area.

Ten looks a tile of 120 m by 60 m lie all over the area; all are one simulated sweep's, since only their cost is of interest, and
weights are random. ``tiles``: for each tile, the looks that reach it are fused and its elements drawn; what is held of a look are
its tokens. ``dense``: one ground and one decoder over the whole area, with as many queries a square metre as a tile has; every
look is a dense BEV, warped onto the area and folded into a running maximum one by one, so that looks are never held side by side
there. Both get the same looks and have the same cells. Seconds are of the processor, one thread; the peak is resident memory above
what the process held before (``memory.py``), looks among it. Each figure is the second of two runs.

python benchmarks/map_cost.py [--preset small] [--areas 120x60 300x300] [--out benchmarks/results/map_cost.json]
"""

from __future__ import annotations

import argparse
import math
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from memory import peak_of
from street import street
from torch import Tensor

from manyeyes.datatypes import BevGrid, Sites, SparseBev, Transform
from manyeyes.models.maps.map_model import FRAMES_PER_TILE, MapModel, MapModelConfig
from manyeyes.models.maps.presets import MAP_MODELS, get_map_model_config
from manyeyes.ops.bev_warp import warp_bev
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.studies.provenance import write_json

MIB = 1 << 20


@dataclass(frozen=True)
class Cost:
    """One area in one way. queries: elements that are drawn at most; looks_mib: what is held of all looks, float32."""

    area: str
    way: str
    looks: int
    cells: int
    queries: int
    looks_mib: float
    seconds: float
    peak_mib: float


def tiles_over(length_m: float, width_m: float, tile: BevGrid) -> Tensor:
    """(T, 2) middles of the tiles that cover an area about the origin; those at its far edges reach beyond it."""
    size = torch.tensor([tile.x_max - tile.x_min, tile.y_max - tile.y_min], dtype=torch.float64)
    whole = torch.tensor([length_m, width_m], dtype=torch.float64)
    counts = [math.ceil(num_tiles - 1e-9) for num_tiles in (whole / size).tolist()]
    places = torch.cartesian_prod(*(torch.arange(count, dtype=torch.float64) for count in counts)).view(-1, 2)
    return (places + 0.5) * size - whole / 2


def poses_over(length_m: float, width_m: float, count: int) -> Transform:
    """So many looks, all over an area about the origin, of all headings; keyed."""
    x, y, yaw = keyed_uniform((3, count), "map_cost", count)
    return Transform.stack(
        [
            Transform.from_xyz_yaw(float(a - 0.5) * length_m, float(b - 0.5) * width_m, 0.0, float(c) * 2 * math.pi)
            for a, b, c in zip(x, y, yaw, strict=True)
        ]
    )


def by_tiles(mapper: MapModel, frame_features: SparseBev, poses: Transform, middles: Tensor) -> int:
    """Draws each tile from the tokens of those looks that may reach it; how many elements it was asked for in all."""
    tile, grid = mapper.config.tile, frame_features.grid
    reach = math.hypot(grid.x_max - grid.x_min, grid.y_max - grid.y_min) / 2
    half = torch.tensor([tile.x_max - tile.x_min, tile.y_max - tile.y_min], dtype=torch.float64) / 2
    drawn = 0
    for middle in middles:
        near = (((poses.translation[:, :2] - middle).abs() - half).clamp_min(0).norm(dim=1) <= reach).nonzero()[:, 0]
        moved = Transform(poses.rotation[near], poses.translation[near] - torch.cat((middle, middle.new_zeros(1))))
        tokens = batch_features([frame_features] * len(near))
        ground = mapper.fuse(tokens, moved, torch.zeros(len(near), dtype=torch.int64), 1)
        drawn += mapper.predict_elements(ground)[-1].logit.shape[1]
    return drawn


def at_once(mapper: MapModel, frame_features: Tensor, seen: Tensor, grid: BevGrid, poses: Transform) -> int:
    """Draws the whole area, which is the mapper's one tile, from dense looks folded in one by one."""
    tile = mapper.config.tile
    greatest = frame_features.new_full((1, frame_features.shape[1], *tile.shape), -torch.inf)
    anybody = torch.zeros(1, *tile.shape, dtype=torch.bool)
    for k in range(len(poses.translation)):
        motion = Transform(poses.rotation[k : k + 1], poses.translation[k : k + 1])
        moved, there = warp_bev(frame_features, seen, grid, tile, motion)
        greatest = torch.maximum(greatest, moved.masked_fill(~there[:, None], -torch.inf))
        anybody |= there
    ground = mapper.fuse_features(greatest[:, None], anybody[:, None])
    return mapper.predict_elements(ground)[-1].logit.shape[1]


def batch_features(frames: list[SparseBev]) -> SparseBev:
    """Tokens of several looks on a batch of as many grids."""
    grid = frames[0].grid
    cells = grid.shape[0] * grid.shape[1]
    key = torch.cat([one.sites.key + i * cells for i, one in enumerate(frames)])
    return SparseBev(torch.cat([one.features for one in frames]), Sites(key, grid, len(frames)))


def over_all(config: MapModelConfig, length_m: float, width_m: float, tiles: int) -> MapModelConfig:
    """The same model with the whole area for its one tile, and the queries of all tiles."""
    cell, tile = config.tile.pillar, config.tile
    # Whole cells: an area that is no multiple of a cell is a little larger.
    half = [math.ceil(side / cell - 1e-9) * cell / 2 for side in (length_m, width_m)]
    area = BevGrid(-half[0], -half[1], tile.z_min, half[0], half[1], tile.z_max, pillar=cell)
    return replace(config, tile=area, head=replace(config.head, num_queries=config.head.num_queries * tiles))


def second_of_two(call: Callable[[], int]) -> tuple[float, float]:
    """Processor seconds and peak MiB of the second run."""
    seconds, peak = 0.0, 0.0

    def timed() -> None:
        nonlocal seconds
        began = time.process_time()
        call()
        seconds = time.process_time() - began

    for _ in range(2):
        peak = peak_of(timed)
    return seconds, peak


@torch.inference_mode()
def measure(config: MapModelConfig, length_m: float, width_m: float) -> list[Cost]:
    """Both ways."""
    torch.manual_seed(0)
    mapper = MapModel(config).eval()
    tokens = mapper.extract_features([street(agents=1).frames[0].points]).tokens
    middles = tiles_over(length_m, width_m, config.tile)
    count = round(FRAMES_PER_TILE * length_m * width_m / 7200)
    poses = poses_over(length_m, width_m, count)
    whole = MapModel(over_all(config, length_m, width_m, len(middles))).eval()
    frame_features = tokens.dense()
    seen = torch.zeros(frame_features.shape[0] * frame_features.shape[2] * frame_features.shape[3], dtype=torch.bool)
    seen[tokens.sites.key] = True
    seen = seen.view(frame_features.shape[0], *frame_features.shape[2:])
    ways = {
        "tiles": (
            lambda: by_tiles(mapper, tokens, poses, middles),
            len(middles) * math.prod(config.tile.shape),
            tokens.features.nbytes + tokens.sites.key.nbytes,
        ),
        "dense": (
            lambda: at_once(whole, frame_features, seen, tokens.grid, poses),
            math.prod(whole.config.tile.shape),
            frame_features.nbytes + seen.nbytes,
        ),
    }
    costs = []
    for way, (call, cells, held) in ways.items():
        seconds, peak = second_of_two(call)
        queries = config.head.num_queries * len(middles)
        mib = count * held / MIB
        costs.append(Cost(f"{length_m:g} x {width_m:g} m", way, count, cells, queries, mib, seconds, peak + mib))
        print(
            f"{costs[-1].area}  {way}: {count} looks, {queries} queries, {seconds:.2f} s, {peak + mib:.0f} MiB at the peak",
            flush=True,
        )
    return costs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="small", choices=MAP_MODELS)
    parser.add_argument("--areas", nargs="+", default=["120x60", "300x300"])
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    config = get_map_model_config(wanted.preset)
    costs = [cost for area in wanted.areas for cost in measure(config, *map(float, area.split("x")))]
    if wanted.out:
        settings = {"preset": wanted.preset, "areas": wanted.areas}
        write_json(wanted.out, {"command": shlex.join(["python", *sys.argv]), "costs": costs}, settings, seed=0)


if __name__ == "__main__":
    main()
