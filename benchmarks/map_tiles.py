# SPDX-License-Identifier: Apache-2.0
"""A map model on held-out towns: tiles of 120 m by 60 m from one look and from more, in mAP and bytes (CrowdMap's Table 2).

One tile a scenario, about its first agent at its first judged frame; the first look is that agent's own, the second to the
fifth are mostly those of others at that instant, later ones come later in the scenario. Truth is the whole tile, seen or not.

python benchmarks/map_tiles.py --weights runs/map-small/weights.safetensors [--data data/towns-small] [--split test]
    [--looks 1 2 5 10] [--budget 131072] [--every 1] [--out benchmarks/results/map_tiles.json]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from manyeyes.apps.provenance import write_json
from manyeyes.apps.train_map import open_looks, true_maps
from manyeyes.evaluation.map_tiles import TileScore, assert_split, judge_tiles, tiles_of
from manyeyes.models import checkpoint
from manyeyes.models.map_presets import FORMAT
from manyeyes.models.mapper import Mapper, MapperConfig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("data/towns-small"))
    parser.add_argument("--split", default="test")
    parser.add_argument("--looks", type=int, nargs="+", default=[1, 2, 5, 10])
    parser.add_argument("--budget", type=int, default=131072)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    mapper = checkpoint.load_as(options.weights, FORMAT, MapperConfig, Mapper)
    mapper.fingerprint = checkpoint.fingerprint(mapper)
    recording = open_looks(options.data, options.split, mapper.config.bev.sensors)
    maps = true_maps(recording)
    assert_split(checkpoint.read_card(options.weights, FORMAT)["towns"], tuple(maps))
    tiles = tiles_of(recording, maps, mapper.config.tile, max(options.looks), options.every)
    rows = []
    for looks in options.looks:
        score = judge_tiles(mapper, tiles, looks, budget_bytes=options.budget)
        rows.append(row_of(score))
        print(rows[-1], flush=True)
    if options.out is not None:
        write_json(options.out, {"tiles": len(tiles), "rows": rows}, {"options": vars(options)}, seed=0)


def row_of(score: TileScore) -> dict[str, float]:
    """One line of the table."""
    ap = {f"{way}_{kind}": round(score.quality.ap(kind, way), 4) for way in ("maptr", "exact") for kind in score.kinds}
    f = {f"F0.5_{kind}": round(score.quality.length(kind).f, 4) for kind in score.kinds}
    mean = {f"{way}_mAP": round(score.mean_ap(way), 4) for way in ("maptr", "exact")}
    return {"looks": score.looks, **mean, **ap, **f, "bytes_per_look": round(score.bytes_per_look)}


if __name__ == "__main__":
    main()
