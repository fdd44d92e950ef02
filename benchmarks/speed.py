# SPDX-License-Identifier: Apache-2.0
"""The sparse detector against a dense PointPillars with attention fusion, at equal widths and OPV2V's full range.

Five agents: each shares (cloud to bytes), then one of them perceives (its own features and four messages to boxes after
NMS). Both are timed in turn in one process, with random weights, and both judge as many candidate boxes. Widths and
layers a stage are equal (strides 2, 4, 8); the sparse one has two more layers each at strides 16 and 32, the merge, the
way up to its head's stride, window attention, and the look that each agent takes by itself before it tells. The dense
one's bytes are its float32 maps (the copy is counted, no codec) and it never warps a map; the sparse one's are whole
packets within 2^17 bytes a message. Both look at one sweep (the shipped model looks at two: its pruning is that of two, of a
street that stands still), and the ego has no past. Both sides' norms are folded into their convolutions. With one thread the
process's own time is counted, with more the wall clock; each figure is the least over the rounds, and bars are judged on five
shares and one perceive. Head stride 8 is the paper's letter, 4 the shipped model's, each with its own lines; tokens are
projected to 128 channels (wide) or 64 (small) before attention, and the dense heads work at stride 2. Under the table stand
the shares of the sparse detector's stages (five share, one perceives) and the pairs of query and key of its window attention
(Eq. 14: exact, padded, the bound S^2 N, windows of all cells).

python benchmarks/speed.py [--quick] [--rounds 5] [--threads 1] [--head-stride 8 4] [--weights FILE]
    [--out benchmarks/results/speed.json]
"""

from __future__ import annotations

import argparse
import copy
import math
import os
import shlex
import sys
import time
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import torch
from dense_pointpillars import DenseConfig, DensePointPillars
from street import street
from torch import Tensor

from manyeyes.agents.agent import Agent
from manyeyes.agents.own_detections import remove_own_body
from manyeyes.agents.perception_cache import PerceptionCache, TokenOutput
from manyeyes.agents.strategies.intermediate import gather_tokens
from manyeyes.agents.strategies.message_header import make_header
from manyeyes.agents.strategies.redundancy import novelty_score
from manyeyes.comms import wire
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.token_selection import select_within_budget
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, Sites, Snapshot, SparseBev
from manyeyes.models import pretrained
from manyeyes.models.detector.box_head import DecodeConfig, decode
from manyeyes.models.detector.detector import Detector, DetectorConfig
from manyeyes.models.detector.encoder import STRIDES, EncoderConfig
from manyeyes.models.detector.fold_norms import fold_norms
from manyeyes.models.detector.layers import ActiveNorm
from manyeyes.models.detector.presets import OPV2V_GRID
from manyeyes.models.detector.pruning import FocalPrune, PruneOutput
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.transform_tokens import AgentTokens, to_ego_frame
from manyeyes.ops.window_attention import AttentionCost, attention_cost, plan_windows, window_ids
from manyeyes.studies.provenance import write_json
from manyeyes.training.detector.targets import TargetConfig, find_nearby_objects

CANDIDATES = 200
PRUNED_AT = (2, 4)
"""Strides at which both prune, those of the shipped model."""


@dataclass(frozen=True)
class Widths:
    """A backbone: channels and layers after the strided one at strides 2, 4, 8, and channels of the dense way up."""

    channels: tuple[int, int, int]
    extra_layers: tuple[int, int, int]
    pillar_channels: int
    up: int
    tokens: int
    bar_unpruned: float
    bar_pruned: float


WIDE = Widths((64, 128, 256), (3, 5, 8), 64, 128, 128, 3.0, 8.0)
SMALL = Widths((32, 64, 128), (2, 2, 2), 32, 64, 64, 1.8, 3.0)


def dense_baseline(widths: Widths) -> DensePointPillars:
    return DensePointPillars(
        DenseConfig(OPV2V_GRID, widths.pillar_channels, widths.channels, widths.extra_layers, widths.up)
    )


def sparse_config(widths: Widths, head_stride: int) -> DetectorConfig:
    a, b, c = widths.channels
    encoder = EncoderConfig(
        channels=(widths.pillar_channels, a, b, c, c, c),
        layers=(0, *widths.extra_layers, 2, 2),
        prune_strides=PRUNED_AT,
        head_stride=head_stride,
        token_channels=widths.tokens,
    )
    return DetectorConfig(
        grid=OPV2V_GRID,
        pillars="points",
        pillar_channels=widths.pillar_channels,
        encoder=encoder,
        dast=AttentionConfig(),
        fusion="fast",
        head_channels=64,
    )


class GivenPrune(FocalPrune):
    """Scores cells as always, then keeps those it was told to: random weights prune as a trained model does."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels)
        self.kept: Tensor | None = None

    def forward(self, x: SparseBev, threshold: float) -> tuple[SparseBev, PruneOutput]:
        pruned = PruneOutput(x.sites, self.score(x.features)[:, 0])
        likely = torch.sigmoid(pruned.logit) > threshold
        if self.kept is None:
            return x, pruned
        return x.keep(torch.index_select(self.kept, 0, x.sites.key, out=likely)), pruned


@dataclass(frozen=True)
class Kept:
    """Which cells one agent's pruning leaves: flat masks over the grid at each stride that prunes, and over the tokens'."""

    levels: tuple[Tensor, ...]
    tokens: Tensor


def random_detector(config: DetectorConfig, frames: list[AgentFrame]) -> Detector:
    """Random weights whose activations are of order one, and a threshold that lets so many candidates through."""
    torch.manual_seed(0)
    model = Detector(config)
    for name, layer in list(model.encoder.prune.items()):
        assert isinstance(layer, FocalPrune)
        model.encoder.prune[name] = GivenPrune(layer.score.in_features)
    model.token_prune = GivenPrune(model.encoder.out_channels)
    norms = [m for m in model.modules() if isinstance(m, ActiveNorm)]
    momenta = [m.momentum for m in norms]
    for norm in norms:
        norm.momentum = 1.0
    cache = PerceptionCache(model.train())
    with torch.inference_mode():
        cache.run_detector(frames[0].points)
    for norm, momentum in zip(norms, momenta):
        norm.momentum = momentum
    return fold_norms(model, in_bfloat16=True)


def set_kept(model: Detector, kept: Kept | None) -> None:
    prunes = [*model.encoder.prune.values(), model.token_prune]
    masks = [*kept.levels, kept.tokens] if kept else [None] * len(prunes)
    for layer, mask in zip(prunes, masks):
        layer.kept = mask  # pyright: ignore[reportAttributeAccessIssue, reportArgumentType]


@dataclass(frozen=True)
class Times:
    """Milliseconds: five shares and one perceive, one share (mean of the five), one perceive."""

    together: float
    share: float
    perceive: float


class Sparse:
    """The sparse detector as an agent runs it; kept: what pruning leaves of each agent's cells, None for all."""

    def __init__(self, model: Detector, frames: list[AgentFrame], kept: list[Kept] | None) -> None:
        self.model, self.frames, self.kept = model, frames, kept
        self.sites, self.message_bytes = self._count_sites()

    def _count_sites(self) -> tuple[tuple[int, ...], float]:
        counts, sizes = [], []
        for i, frame in enumerate(self.frames):
            set_kept(self.model, self.kept[i] if self.kept else None)
            agent = Agent(self.model)
            sizes.append(sum(map(len, agent.share(frame))))
            encoded = self.model.extract_features([frame.points])
            counts.append((*encoded.sites_per_stride, len(encoded.pruned[-1].sites), len(encoded.tokens.sites)))
        return tuple(sum(c) for c in zip(*counts)), sum(sizes) / len(sizes)

    def once(self) -> Times:
        agents, packets, began = [Agent(self.model) for _ in self.frames], [], _clock()
        for i, (agent, frame) in enumerate(zip(agents, self.frames)):
            set_kept(self.model, self.kept[i] if self.kept else None)
            packets.append(agent.share(frame))
        shared = _clock()
        agents[0].perceive(self.frames[0], (p for message in packets[1:] for p in message))
        ended = _clock()
        return _times(began, shared, ended, len(self.frames))


class Dense:
    """The rival; as the sparse agent, it remembers its own maps between share and perceive."""

    def __init__(self, model: DensePointPillars, frames: list[AgentFrame]) -> None:
        self.model, self.frames = model, frames
        self.message_bytes = sum(map(len, model.share(frames[0].points)))

    def once(self) -> Times:
        began, messages = _clock(), []
        own = self.model.extract_maps(self.frames[0].points)
        messages.append(self.model.pack(own))
        messages += [self.model.share(frame.points) for frame in self.frames[1:]]
        shared = _clock()
        self.model.perceive(own, messages[1:], CANDIDATES)
        return _times(began, shared, _clock(), len(self.frames))


STAGES = (
    "pillars",
    "encoder",
    "DAST",
    "head",
    "selection",
    "to bytes",
    "from bytes",
    "gather, FAST",
    "refine",
    "boxes, NMS",
)


class Stopwatch:
    """Milliseconds spent in each stage."""

    def __init__(self) -> None:
        self.spent, self._last = dict.fromkeys(STAGES, 0.0), _clock()

    def lap(self, stage: str) -> None:
        """What has passed since the last lap was this stage."""
        now = _clock()
        self.spent[stage] += 1e3 * (now - self._last)
        self._last = now


@dataclass(frozen=True)
class Staged:
    """milliseconds by stage; attention by name; boxes: what the ego perceived, before its own body is left out."""

    milliseconds: dict[str, float]
    attention: dict[str, AttentionCost]
    boxes: Boxes


def staged(model: Detector, frames: list[AgentFrame], kept: list[Kept] | None) -> Staged:
    """The path of share and perceive, written out stage by stage."""
    stopwatch, messages, own = Stopwatch(), [], None
    attention = {}
    for i, frame in enumerate(frames):
        set_kept(model, kept[i] if kept else None)
        x = model.pillars([frame.points])
        stopwatch.lap("pillars")
        tokens = model.encoder(x, model.config.prune_threshold).tokens
        stopwatch.lap("encoder")
        sites = tokens.sites
        tokens = tokens.with_features(model.dast(tokens.features, sites.xy, sites.batch, sites.grid, sites.cache))
        stopwatch.lap("DAST")
        if not i:
            attention["DAST, the ego's tokens"] = pairs(model.config.dast, sites.xy, sites.batch, sites.grid)
        tokens, _ = model.token_prune(tokens, model.config.prune_threshold)
        raw = model.predict(tokens)
        shared_tokens = model.make_tokens(tokens, raw)
        stopwatch.lap("head")
        output = TokenOutput(shared_tokens, shared_tokens, raw, model.config.decode)
        cache = PerceptionCache(model, feature_cache={(frame.agent_id, frame.timestamp_ns): output})
        some, score = select_within_budget(shared_tokens, novelty_score(cache, frame), 1 << 17, "float16")
        stopwatch.lap("selection")
        message = replace(make_header(frame, model.fingerprint), tokens=some, token_score=score)
        messages.append(wire.encode(message, token_encoding="float16"))
        stopwatch.lap("to bytes")
        own = own or cache
    assert own is not None
    inbox = Inbox(model.fingerprint)
    for packet in (p for packets in messages[1:] for p in packets):
        inbox.push(packet)
    messages_received = inbox.messages()
    stopwatch.lap("from bytes")
    together = gather_tokens(own, frames[0], messages_received)
    fused = model.fusion(together)
    stopwatch.lap("gather, FAST")
    raw = model.refine(fused.bev, fused.merged_proposals)
    stopwatch.lap("refine")
    boxes = decode(raw, model.config.decode)[0]
    stopwatch.lap("boxes, NMS")
    attention["FAST, all agents' tokens"] = pairs(
        model.config.fusion_attention, together.xy, together.ego, together.grid
    )
    return Staged(stopwatch.spent, attention, boxes)


def pairs(config: AttentionConfig, xy: Tensor, batch: Tensor, grid: BevGrid) -> AttentionCost:
    """Of one layer with windows that are not shifted."""
    ids = window_ids(xy, batch, (grid.x_min, grid.y_min), config.window * grid.cell_size_m)
    return attention_cost(plan_windows(ids, ids), config.window, math.prod(grid.shape))


def _clock() -> float:
    """Seconds. With one thread the process's own time, so that other work on the machine hits neither side."""
    return time.process_time() if torch.get_num_threads() == 1 else time.perf_counter()


def _times(began: float, shared: float, ended: float, agents: int) -> Times:
    return Times(1e3 * (ended - began), 1e3 * (shared - began) / agents, 1e3 * (ended - shared))


def aim_threshold(model: Detector, frames: list[AgentFrame], kept: list[Kept] | None) -> None:
    """Set the score threshold so that CANDIDATES cells, or all if fewer, pass it in the ego's frame."""
    parts, cache = [], PerceptionCache(model)
    for i, frame in enumerate(frames):
        set_kept(model, kept[i] if kept else None)
        shared_tokens = cache.run_detector(frame.points).shared_tokens
        motion = frames[0].world_from_agent.inverse() @ frame.world_from_agent if i else None
        parts.append(AgentTokens(0, shared_tokens.features, shared_tokens.sites.xy, motion))
    _, raw = cache.fuse(to_ego_frame(parts, model.token_grid, 1))
    power = DecodeConfig().iou_score_weight
    best = (
        (torch.sigmoid(raw.heatmap_logit) ** (1 - power) * torch.sigmoid(raw.iou_logit) ** power)
        .sort(descending=True)
        .values
    )
    threshold = float(best[CANDIDATES]) if len(best) > CANDIDATES else 0.0
    model.config = replace(model.config, decode=DecodeConfig(score_threshold=threshold))


def kept_by_model(model: Detector, frames: list[AgentFrame], head_stride: int) -> list[Kept]:
    """The cells that trained weights keep of each agent's cloud at their own threshold, over OPV2V's whole range.

    The weights see no absolute position, so they run on any extent; their own limits of height stay.
    """
    config = model.config
    grid = replace(OPV2V_GRID, z_min=config.grid.z_min, z_max=config.grid.z_max)
    wide = copy.deepcopy(model)
    wide.config, wide.pillars.grid = replace(config, grid=grid), grid.at(1)
    kept = []
    for frame in frames:
        pruned = wide.extract_features([frame.points], [frame.points]).pruned
        masks = [_mask(p.sites, torch.sigmoid(p.logit) > config.prune_threshold) for p in pruned]
        kept.append(Kept(tuple(masks[:-1]), _restride(masks[-1], wide.token_grid, head_stride)))
    return kept


def kept_by_truth(snapshot: Snapshot, head_stride: int, background_fraction: float = 0.1) -> list[Kept]:
    """Emulated: the cells near a listed box, as pruning is taught, and a tenth of all others."""
    assert snapshot.truth is not None
    random = torch.Generator().manual_seed(0)

    def mask(stride: int, boxes: Boxes) -> Tensor:
        grid = OPV2V_GRID.at(stride)
        every = Sites(torch.arange(grid.shape[0] * grid.shape[1]), grid)
        rest = torch.rand(len(every), generator=random) < background_fraction
        return (find_nearby_objects(every, [boxes], TargetConfig()) >= 0) | rest

    kept = []
    for i, frame in enumerate(snapshot.frames):
        boxes = snapshot.truth.boxes[snapshot.truth.seen[i]].transform(frame.world_from_agent.inverse())
        kept.append(Kept(tuple(mask(s, boxes) for s in PRUNED_AT), mask(head_stride, boxes)))
    return kept


def _mask(sites: Sites, chosen: Tensor) -> Tensor:
    rows, columns = sites.grid.shape
    mask = torch.zeros(rows * columns, dtype=torch.bool)
    mask[sites.key[chosen]] = True
    return mask


def _restride(mask: Tensor, grid: BevGrid, stride: int) -> Tensor:
    """A mask over the cells of one stride to those of another: parents of what is marked, or all children of it."""
    ratio = max(1, stride // grid.stride)
    image = mask.view(1, 1, *grid.shape).float()
    image = torch.nn.functional.max_pool2d(image, ratio, ceil_mode=True)
    finer = max(1, grid.stride // stride)
    return (image.repeat_interleave(finer, 2).repeat_interleave(finer, 3) > 0).flatten()


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    widths: str
    head_stride: int | None
    contender: str
    times: Times
    ratio: Times | None
    bar: float | None
    message_bytes: float
    sites: tuple[int, ...]
    stages_ms: dict[str, float] = field(default_factory=dict)
    attention_pairs: dict[str, AttentionCost] = field(default_factory=dict)


def compare(widths: Widths, snapshot: Snapshot, kept: list[Kept], head_stride: int, rounds: int) -> list[Row]:
    """The least time of each contender over the rounds; they run in turn."""
    frames = list(snapshot.frames)
    dense = Dense(dense_baseline(widths), frames)
    contenders: list[Dense | Sparse] = [dense]
    for cells in (None, kept):
        model = random_detector(sparse_config(widths, head_stride), frames)
        aim_threshold(model, frames, cells)
        contenders.append(Sparse(model, frames, cells))
    spent: list[list[Times]] = [[] for _ in contenders]
    for i in range(rounds + 1):
        for contender, times in zip(contenders, spent):
            took = contender.once()
            if i:
                times.append(took)
    best = [Times(*(min(getattr(t, f.name) for t in times) for f in fields(Times))) for times in spent]
    name = "/".join(map(str, widths.channels))
    rows = [Row(name, None, "dense", best[0], None, None, dense.message_bytes, ())]
    for label, bar, sparse, times in zip(
        ("unpruned", "pruned"), (widths.bar_unpruned, widths.bar_pruned), contenders[1:], best[1:]
    ):
        ratio = Times(*(getattr(best[0], f.name) / getattr(times, f.name) for f in fields(Times)))
        assert isinstance(sparse, Sparse)
        stages = min(
            (staged(sparse.model, frames, sparse.kept) for _ in range(rounds)),
            key=lambda one: sum(one.milliseconds.values()),
        )
        _check(stages, sparse)
        measured = (times, ratio, bar, sparse.message_bytes, sparse.sites, stages.milliseconds, stages.attention)
        rows.append(Row(name, head_stride, f"sparse, {label}", *measured))
    return rows


def _check(stages: Staged, sparse: Sparse) -> None:
    """The path written out must give what agents give; else its shares are those of something else."""
    agents, packets = [Agent(sparse.model) for _ in sparse.frames], []
    for i, (agent, frame) in enumerate(zip(agents, sparse.frames)):
        set_kept(sparse.model, sparse.kept[i] if sparse.kept else None)
        packets.append(agent.share(frame))
    found = agents[0].perceive(sparse.frames[0], (p for message in packets[1:] for p in message)).boxes
    if not torch.equal(remove_own_body(stages.boxes, sparse.frames[0]).center, found.center):
        raise RuntimeError(
            "The stages of the benchmark are no longer those of share and perceive; bring them up to date."
        )


def _stride_name(stride: int | None) -> str:
    return "" if stride is None else {8: "8 (the paper's)", 4: "4 (as shipped)"}.get(stride, str(stride))


def show(rows: list[Row]) -> None:
    print(
        f"{'widths':<11} {'head stride':<16} {'contender':<17} "
        f"{'5 share + 1 perceive':>21} {'one share':>17} {'one perceive':>17} {'bytes':>9}"
    )
    for row in rows:
        cells = []
        for part in fields(Times):
            ms = f"{getattr(row.times, part.name):.1f} ms"
            cells.append(ms if row.ratio is None else f"{ms} {getattr(row.ratio, part.name):>5.1f}x")
        bar = (
            ""
            if row.bar is None or row.ratio is None
            else f"  bar {row.bar}x {'met' if row.ratio.together >= row.bar else 'MISSED'}"
        )
        print(
            f"{row.widths:<11} {_stride_name(row.head_stride):<16} {row.contender:<17} "
            f"{cells[0]:>21} {cells[1]:>17} {cells[2]:>17} {row.message_bytes:>9.0f}{bar}"
        )
    for row in rows:
        if row.sites:
            levels = ", ".join(f"{s}x {n}" for s, n in zip(STRIDES, row.sites))
            print(
                f"sites, {row.widths}, head stride {row.head_stride}, {row.contender}: {levels}; "
                f"tokens {row.sites[-2]}, of which sent or fused {row.sites[-1]}"
            )
        if row.stages_ms:
            whole = sum(row.stages_ms.values())
            shares = ", ".join(f"{stage} {100 * ms / whole:.1f} %" for stage, ms in row.stages_ms.items())
            print(f"  stages of {whole:.1f} ms: {shares}")
            for where, cost in row.attention_pairs.items():
                print(
                    f"  pairs a layer, {where}: exact {cost.exact}, padded {cost.padded}, "
                    f"S^2 N {cost.bound}, all cells {cost.dense}"
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one round after the warm-up")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--head-stride", type=int, nargs="+", default=[8, 4], choices=(2, 4, 8))
    parser.add_argument("--only", choices=("wide", "small"))
    parser.add_argument("--weights", help="whose pruning is timed: a name, a .safetensors file, or truth")
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    torch.set_num_threads(wanted.threads)
    snapshot = street()
    load = os.getloadavg()[0]
    with torch.inference_mode():
        if wanted.weights != "truth" and (wanted.weights or pretrained.DEFAULT_DETECTOR in pretrained.list_detectors()):
            source = f"kept as {wanted.weights or pretrained.DEFAULT_DETECTOR} does"
            weights = pretrained.load(wanted.weights or pretrained.DEFAULT_DETECTOR)
            kept = {s: kept_by_model(weights, list(snapshot.frames), s) for s in wanted.head_stride}
        else:
            source = "pruning emulated from truth: cells near a listed box and a tenth of the rest"
            kept = {s: kept_by_truth(snapshot, s) for s in wanted.head_stride}
        points = [len(frame.points) for frame in snapshot.frames]
        print(
            f"torch {torch.__version__}, {wanted.threads} thread(s), load {load:.1f}, clouds of {points} points; {source}"
        )
        rows: list[Row] = []
        for name, widths in (("wide", WIDE), ("small", SMALL)):
            if wanted.only in (None, name):
                for stride in wanted.head_stride:
                    rows += compare(widths, snapshot, kept[stride], stride, 1 if wanted.quick else wanted.rounds)
    show(rows)
    if wanted.out:
        settings = {
            "threads": wanted.threads,
            "load": load,
            "head_stride": wanted.head_stride,
            "points": points,
            "pruning": source,
        }
        command = shlex.join(["python", *sys.argv])
        write_json(wanted.out, {"command": command, "settings": settings, "rows": rows}, settings, seed=0)


if __name__ == "__main__":
    main()
