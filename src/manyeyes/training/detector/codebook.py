# SPDX-License-Identifier: Apache-2.0
"""Fits the codebook of a detector to the tokens that it tells of training scenes. The detector itself stays as it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datasets.base import Recording, iter_eval_frames
from manyeyes.datatypes import ConfigError
from manyeyes.models.checkpoint import fingerprint
from manyeyes.models.detector.codebook import FREQUENCY_TOTAL, Codebook, CodebookConfig, nearest_centre
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.ops.keyed_random import keyed_uniform

_KMEANS_ITERATIONS = 20


def fit_centres(features: Tensor, config: CodebookConfig, seed: int) -> Tensor:
    """Centres (stages, size, C) of residual vector quantisation of features (N, C): k-means of what each stage leaves over."""
    residual, stages = features, []
    for stage in range(config.stages):
        centres = k_means(residual, config.size, (seed, "codebook", stage))
        residual = residual - centres[nearest_centre(residual, centres)]
        stages.append(centres)
    return torch.stack(stages)


def k_means(x: Tensor, size: int, key: tuple[int | str, ...], iterations: int = _KMEANS_ITERATIONS) -> Tensor:
    """Centres (size, C) of rows x (N, C): Lloyd's rounds (1982) from k-means++ (Arthur and Vassilvitskii 2007) drawn by key.

    A centre that nobody is nearest to is put where the error is largest. Where there are fewer rows than centres, some
    centres are the same.
    """
    centres = _init_centres(x, size, key)
    for _ in range(iterations):
        owner = nearest_centre(x, centres)
        count = torch.bincount(owner, minlength=size)
        total = torch.zeros_like(centres).index_add_(0, owner, x)
        error = (x - centres[owner]).square().sum(1)
        centres = total / count.clamp_min(1)[:, None]
        empty = (count == 0).nonzero()[:, 0]
        worst = error.topk(min(len(empty), len(x))).indices
        centres[empty] = x[worst[torch.arange(len(empty)) % max(1, len(worst))]]
    return centres


def _init_centres(x: Tensor, size: int, key: tuple[int | str, ...]) -> Tensor:
    """Rows to begin with: each is drawn with the square of its distance from those before it."""
    draws = keyed_uniform((size,), *key)
    chosen = [int(draws[0] * len(x))]
    distance = (x - x[chosen[0]]).square().sum(1)
    for draw in draws[1:]:
        so_far = distance.double().cumsum(0)
        row = min(int(torch.searchsorted(so_far, draw * so_far[-1])), len(x) - 1)
        chosen.append(row)
        distance = torch.minimum(distance, (x - x[row]).square().sum(1))
    return x[chosen]


def fit_frequencies(codes: Tensor) -> Tensor:
    """How often each value occurs in each column of codes (N, W) uint8: (W, 256) int16, none 0, a column FREQUENCY_TOTAL."""
    columns = []
    for column in codes.T:
        share = torch.bincount(column.long(), minlength=256).double() / max(1, len(column))
        # One for every value, so that all can be written; the rest by share, what rounding leaves to the most frequent.
        spare = FREQUENCY_TOTAL - 256
        frequency = 1 + (share * spare).floor().long()
        frequency[frequency.argmax()] += FREQUENCY_TOTAL - frequency.sum()
        columns.append(frequency.to(torch.int16))
    return torch.stack(columns)


def collect_shared_tokens(detector: Detector, recording: Recording, frame_stride: int) -> Iterator[Tensor]:
    """Rows (n, C + PROPOSAL) that each agent tells at every such judged frame, having seen the frame before it too."""
    for number, (scenario, index) in enumerate(iter_eval_frames(recording)):
        if number % frame_stride:
            continue
        earlier = recording.snapshot(scenario, index - 1) if index else None
        snapshot = recording.snapshot(scenario, index)
        for frame in snapshot.frames:
            cache = PerceptionCache(detector)
            for before in earlier.frames if earlier else ():
                if before.agent_id == frame.agent_id:
                    cache.process(before)
            yield cache.process(frame).shared_tokens.features


def fit_codebook(
    detector: Detector,
    recording: Recording,
    seed: int = 0,
    config: CodebookConfig | None = None,
    frame_stride: int = 10,
    report: Callable[[int], None] = lambda tokens: None,
) -> Detector:
    """The detector with a codebook fitted to every such judged frame of a recording; its fingerprint is another.

    report: is told how many tokens have been gathered.
    """
    rows: list[Tensor] = []
    for tokens in collect_shared_tokens(detector, recording, frame_stride):
        rows.append(tokens)
        report(sum(map(len, rows)))
    if not any(map(len, rows)):
        raise ConfigError(
            "No agent tells a token in these frames, so there is nothing to fit a codebook to: train first."
        )
    return with_codebook(detector, torch.cat(rows), seed, config or CodebookConfig())


def with_codebook(detector: Detector, tokens: Tensor, seed: int, config: CodebookConfig) -> Detector:
    """The detector with a codebook fitted to told rows (N, C + PROPOSAL)."""
    fitted = Detector(replace(detector.config, codebook=config))
    book = Codebook(tokens.shape[1] - PROPOSAL_DIM, config)
    # As files of half precision keep them, so that saving changes nothing.
    book.centres.copy_(fit_centres(tokens[:, :-PROPOSAL_DIM], config, seed).half())
    book.frequencies.copy_(fit_frequencies(book.encode(tokens)))
    weights = {k: v for k, v in detector.state_dict().items() if not k.startswith("codebook.")}
    fitted.load_state_dict(weights | {f"codebook.{k}": v for k, v in book.state_dict().items()})
    fitted.eval().requires_grad_(False)
    fitted.fingerprint = fingerprint(fitted)
    return fitted
