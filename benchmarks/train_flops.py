# SPDX-License-Identifier: Apache-2.0
"""Estimate of the operations of a training run of the published presets, and of its hours on named GPUs.

Counted: products of matrices, two operations per multiply-add. A linear layer has 2 * rows * inputs * outputs; a sparse convolution
2 * pairs * inputs * outputs, where a pair is an active input that meets an active output through one tap of the kernel; attention
4 * channels * the sum of squared numbers of tokens over windows. Rows, pairs and windows are measured: those of training samples of
a simulated recording of 64 beams, with all its agents and without pruning, which is their maximum there. A step has three
times the operations of its forward pass. Traffic: 4 bytes for each number that is gathered, multiplied and added again by tap, and
six passes over each output for norms, activations and gradients.

Device time = operations / (peak * UTILISATION) + bytes / (bandwidth * BANDWIDTH_SHARE). Peaks of float32 are recalled and
not checked against data sheets. Host time: what one process needs to issue the operators of a step.
Hours = steps * max(host, device). Nothing here is measured on a GPU.

python benchmarks/train_flops.py OPV2V_LIKE DAIR_LIKE [--samples 3] [--out benchmarks/results/train_flops.json]
python benchmarks/train_flops.py --write-pages    # tables of docs/guides/train-*.md from the stored results
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from manyeyes.models.detector.layers import DownLayer, SubmanifoldLayer, UpLayer
from manyeyes.models.detector.transformer import WindowBlock
from manyeyes.ops.sparse_conv import same_sites_map, strided_map
from manyeyes.ops.sparse_index import NeighbourMap, Window
from manyeyes.ops.window_attention import window_ids

ROOT = Path(__file__).resolve().parents[1]
STORED = ROOT / "benchmarks" / "results" / "train_flops.json"
GUIDES = ROOT / "docs" / "guides"
EPOCHS, BATCH = 90, 4
UTILISATION, BANDWIDTH_SHARE = 0.35, 0.8
"""Fractions of a data sheet's figures that products of gathered rows, and copies, reach: assumptions."""


@dataclass(frozen=True)
class Dataset:
    """A published data set: preset, page, training frames, and whether scenes with DAIR-V2X's sensors stand for it."""

    preset: str
    page: str
    frames: int
    is_dair: bool = False


DATASETS = (
    Dataset("costr-opv2v", "train-opv2v.md", 6764),
    Dataset("costr-v2xset", "train-v2xset.md", 6694),
    Dataset("costr-dair", "train-dair-v2x.md", 4811, is_dair=True),
    Dataset("costr-v2x-real", "train-v2x-real.md", 23379),
)


@dataclass(frozen=True)
class Gpu:
    """A data sheet: 10^12 operations of float32 and 10^12 bytes a second."""

    name: str
    tflops: float
    terabytes: float


GPUS = (Gpu("RTX 4090", 82.6, 1.008), Gpu("A100 80 GB", 19.5, 2.039), Gpu("H100 SXM", 66.9, 3.35))
HOST_MS = (165.0, 80.0, 40.0)
"""Host time of a step: at 21,500 operator calls; without loops in assignment and optimiser; with batched taps and windows."""


@dataclass(frozen=True)
class StepWork:
    """Work of a step of BATCH samples, forward and backward: 10^9 operations by part of the model, 10^9 bytes.

    views: agents per sample. pillars, tokens: active cells of a view at stride 1 and at the head.
    """

    preset: str
    frames: int
    parameters: int
    samples: int
    views: float
    pillars: float
    tokens: float
    gflop: dict[str, float]
    gigabytes: float


def count_linear(layer: nn.Linear, inputs: tuple[Any, ...], output: Tensor) -> tuple[float, float]:
    """Return operations and bytes of a linear layer."""
    rows = output.numel() / layer.out_features
    return 2 * rows * layer.in_features * layer.out_features, 4 * rows * (layer.in_features + layer.out_features)


def count_pairs(table: NeighbourMap) -> int:
    """Return the number of pairs of active cells that meet through a tap."""
    pairs = sum(block.size for block in table.blocks(1 << 30)[1])
    return pairs + (table.n_out if table.is_symmetric else 0)


def _conv_work(pairs: int, rows: int, inputs: int, outputs: int) -> tuple[float, float]:
    return 2.0 * pairs * inputs * outputs, 4.0 * (3 * pairs * (inputs + outputs) + 6 * rows * outputs)


def count_submanifold(layer: SubmanifoldLayer, inputs: tuple[Any, ...], output: Any) -> tuple[float, float]:
    """Return operations and bytes of a submanifold convolution."""
    outputs, channels, kernel, _ = layer.weight.shape
    rows = len(output.sites)
    pairs = rows if kernel == 1 else count_pairs(same_sites_map(output.sites, kernel))
    return _conv_work(pairs, rows, channels, outputs)


def count_down(layer: DownLayer, inputs: tuple[Any, ...], output: Any) -> tuple[float, float]:
    """Return operations and bytes of a convolution of stride 2."""
    pairs = count_pairs(strided_map(inputs[0].sites, Window(3, 2, 1), layer.dilating)[1])
    return _conv_work(pairs, len(output.sites), layer.weight.shape[1], layer.weight.shape[0])


def count_up(layer: UpLayer, inputs: tuple[Any, ...], output: Any) -> tuple[float, float]:
    """Return operations and bytes of an inverse convolution; its linear layer is counted by itself."""
    coarse, fine = inputs[0].sites, output.sites
    table = NeighbourMap(coarse.key, coarse.grid.shape, fine.key, fine.grid.shape, fine.batch_size, Window(3, 2, 1))
    return _conv_work(count_pairs(table), len(fine), layer.weight.shape[0], layer.weight.shape[1])


def count_attention(block: WindowBlock, inputs: tuple[Any, ...], output: Tensor) -> tuple[float, float]:
    """Return operations and bytes of scores and weighted sums; linear layers are counted by themselves."""
    _, xy, batch, grid = inputs[:4]
    edge = block.window * grid.cell_size_m
    ids = window_ids(xy, batch, (grid.x_min, grid.y_min), edge, edge / 2 if block.shifted else 0.0)
    sizes = ids.unique(return_counts=True)[1].double()
    return 4.0 * output.shape[1] * float(sizes.square().sum()), 4.0 * 12 * output.numel()


COUNTS: dict[type[nn.Module], Callable[..., tuple[float, float]]] = {
    nn.Linear: count_linear,
    SubmanifoldLayer: count_submanifold,
    DownLayer: count_down,
    UpLayer: count_up,
    WindowBlock: count_attention,
}


class WorkCounter:
    """Adds up operations, by part, and bytes of the forward passes of a model."""

    def __init__(self, model: nn.Module) -> None:
        self.flop: dict[str, float] = {}
        self.bytes = 0.0
        for name, module in model.named_modules():
            if type(module) in COUNTS:
                module.register_forward_hook(self._make_hook(name.split(".")[0], COUNTS[type(module)]))

    def _make_hook(self, part: str, count: Callable[..., tuple[float, float]]) -> Callable[..., None]:
        def add(module: nn.Module, inputs: tuple[Any, ...], output: Any) -> None:
            flop, size = count(module, inputs, output)
            self.flop[part] = self.flop.get(part, 0.0) + flop
            self.bytes += size

        return add


def measure(dataset: Dataset, recording: Path, samples: int) -> StepWork:
    """Count the work of a preset on samples of a recording."""
    from manyeyes.datasets.registry import open_recording
    from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
    from manyeyes.training.detector.samples import AugmentConfig
    from manyeyes.training.detector.step import forward
    from manyeyes.training.detector.task import DetectorTask

    torch.set_num_threads(1)
    config = replace(DETECTOR_TRAINING_PRESETS[dataset.preset], steps=1, augment=AugmentConfig.none())
    task = DetectorTask(config, open_recording(recording, "train"))
    torch.manual_seed(0)
    model = task.make_model().train()
    counter, views, pillars, tokens = WorkCounter(model), 0, 0, 0
    for number in range(samples):
        sample = task.draw(number)
        with torch.no_grad():
            features = forward(model, [sample], 0.0).features
        views += len(sample.views)
        pillars, tokens = pillars + features.sites_per_stride[0], tokens + len(features.tokens.sites)
    scale = 3 * BATCH / samples / 1e9
    gflop = {part: round(flop * scale, 2) for part, flop in sorted(counter.flop.items())}
    parameters = sum(p.numel() for p in model.parameters())
    means = (views / samples, round(pillars / views), round(tokens / views))
    return StepWork(dataset.preset, dataset.frames, parameters, samples, *means, gflop, round(counter.bytes * scale, 2))


def device_ms(work: dict[str, Any], gpu: Gpu) -> float:
    """Return the time of a step's products and traffic on a GPU, milliseconds."""
    tflop, terabytes = sum(work["gflop"].values()) / 1e3, work["gigabytes"] / 1e3
    return 1e3 * (tflop / (gpu.tflops * UTILISATION) + terabytes / (gpu.terabytes * BANDWIDTH_SHARE))


def format_table(work: dict[str, Any]) -> str:
    """Return the table of a page in Markdown: hours on each GPU by host time."""
    steps = EPOCHS * work["frames"] / BATCH
    heads = [f"hours at {ms:.0f} ms" for ms in HOST_MS]
    lines = [f"| GPU | device [ms a step] | {' | '.join(heads)} |", "|---" * (2 + len(heads)) + "|"]
    for gpu in GPUS:
        device = device_ms(work, gpu)
        hours = [f"{steps * max(device, host) / 3.6e6:.1f}" for host in HOST_MS]
        lines.append(f"| {gpu.name} | {device:.0f} | {' | '.join(hours)} |")
    total = sum(work["gflop"].values()) / 1e3
    text = (
        f"{steps:,.0f} steps of {BATCH} samples; a step has {total:.2f} TFLOP and {work['gigabytes']:.0f} GB of traffic"
    )
    return "\n".join([f"{text}, {work['views']:.1f} agents a sample.", "", *lines])


def find_works(path: Path = STORED) -> dict[str, dict[str, Any]]:
    """Return the stored work of each preset."""
    return {work["preset"]: work for work in json.loads(path.read_text(encoding="utf-8"))["result"]}


def replace_table(page: str, table: str) -> str:
    """Return the text of a page with this table between its marks."""
    marks = ("<!-- hours -->", "<!-- end of hours -->")
    return re.sub(f"{marks[0]}.*?{marks[1]}", lambda _: f"{marks[0]}\n{table}\n{marks[1]}", page, flags=re.DOTALL)


def main() -> None:
    """Measure and store, or write the pages."""
    from manyeyes.studies.provenance import write_json

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="*", help="scenes like OPV2V's, and scenes like DAIR-V2X's")
    parser.add_argument("--samples", type=int, default=3)
    parser.add_argument("--out", type=Path, default=STORED)
    parser.add_argument("--write-pages", action="store_true")
    given = parser.parse_args()
    if len(given.recordings) == 2:
        works = [measure(d, given.recordings[d.is_dair], given.samples) for d in DATASETS]
        write_json(given.out, works, {"samples": given.samples, "epochs": EPOCHS, "batch": BATCH}, 0)
    for dataset in DATASETS:
        table = format_table(find_works(given.out)[dataset.preset])
        print(f"{dataset.preset}\n{table}\n")
        if given.write_pages:
            page = GUIDES / dataset.page
            page.write_text(replace_table(page.read_text(encoding="utf-8"), table), encoding="utf-8")


if __name__ == "__main__":
    main()
