# SPDX-License-Identifier: Apache-2.0
"""Fit the codebook of a detector to the tokens that it shares in training scenes; other weights are unchanged."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

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
    """Fit centres (stages, size, C) of residual vector quantisation to features (N, C): k-means of each stage's
    residuals.
    """
    residual, stages = features, []
    for stage in range(config.stages):
        centres = k_means(residual, config.size, (seed, "codebook", stage))
        residual = residual - centres[nearest_centre(residual, centres)]
        stages.append(centres)
    return torch.stack(stages)


def k_means(x: Tensor, size: int, key: tuple[int | str, ...], iterations: int = _KMEANS_ITERATIONS) -> Tensor:
    """Cluster rows x (N, C) to centres (size, C): Lloyd (1982) from k-means++ (Arthur and Vassilvitskii 2007), drawn
    by key.

    An empty cluster is moved to the row of largest error. With fewer rows than centres, some centres are equal.
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
        centres[empty] = x[worst[torch.arange(len(empty), device=x.device) % max(1, len(worst))]]
    return centres


def _init_centres(x: Tensor, size: int, key: tuple[int | str, ...]) -> Tensor:
    """Draw initial centres, each with probability proportional to the squared distance from those before it."""
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
    """Count the values of each column of codes (N, W) uint8: (W, 256) int16, none 0, with sum FREQUENCY_TOTAL per
    column.
    """
    columns = []
    for column in codes.T:
        share = torch.bincount(column.long(), minlength=256).double() / max(1, len(column))
        # One for every value, so that all can be encoded; the rest in proportion, the rounding error to the most
        # frequent.
        spare = FREQUENCY_TOTAL - 256
        frequency = 1 + (share * spare).floor().long()
        frequency[frequency.argmax()] += FREQUENCY_TOTAL - frequency.sum()
        columns.append(frequency.to(torch.int16))
    return torch.stack(columns)


@dataclass(frozen=True)
class CollectionProgress:
    """frames: with collected tokens, of total; tokens: collected so far."""

    frames: int
    total: int
    tokens: int


def collect_shared_tokens(detector: Detector, recording: Recording, frame_stride: int) -> Iterator[Tensor]:
    """Yield the shared tokens (n, C + PROPOSAL_DIM) of each agent at every frame_stride-th evaluated frame.

    The agent processes the preceding frame too.
    """
    for scenario, index in _select_frames(recording, frame_stride):
        yield from _share_tokens(detector, recording, scenario, index)


def _select_frames(recording: Recording, frame_stride: int) -> list[tuple[str, int]]:
    return list(iter_eval_frames(recording))[::frame_stride]


def _share_tokens(detector: Detector, recording: Recording, scenario: str, index: int) -> Iterator[Tensor]:
    earlier = recording.snapshot(scenario, index - 1) if index else None
    snapshot = recording.snapshot(scenario, index)
    for frame in snapshot.frames:
        cache = PerceptionCache(detector)
        level = cache.level
        for before in earlier.frames if earlier else ():
            if before.agent_id == frame.agent_id:
                cache.process(level(before).levelled)
        yield cache.process_tokens(level(frame).levelled).shared_tokens.features


def fit_codebook(
    detector: Detector,
    recording: Recording,
    seed: int = 0,
    config: CodebookConfig | None = None,
    frame_stride: int = 10,
    report: Callable[[CollectionProgress], None] = lambda progress: None,
) -> Detector:
    """Fit a codebook to every frame_stride-th evaluated frame; returns the detector with it, under a new fingerprint.

    report: called before the first frame, and after every one.

    Raises:
        ConfigError: the fusion sends features without proposals and so has no codebook, or no agent shares a token.
    """
    detector.check_has_proposals()
    rows: list[Tensor] = []
    frames = _select_frames(recording, frame_stride)
    report(CollectionProgress(0, len(frames), 0))
    for number, (scenario, index) in enumerate(frames, 1):
        rows += _share_tokens(detector, recording, scenario, index)
        report(CollectionProgress(number, len(frames), sum(map(len, rows))))
    if not any(map(len, rows)):
        raise ConfigError(
            "No agent shares a token in these frames, so no codebook can be fitted: train the detector first."
        )
    return with_codebook(detector, torch.cat(rows), seed, config or CodebookConfig())


def with_codebook(detector: Detector, tokens: Tensor, seed: int, config: CodebookConfig) -> Detector:
    """Fit a codebook to shared tokens (N, C + PROPOSAL_DIM) and return the detector with it."""
    book = Codebook(tokens.shape[1] - PROPOSAL_DIM, config)
    # Rounded to float16 as in the file, so that saving changes nothing.
    book.centres.copy_(fit_centres(tokens[:, :-PROPOSAL_DIM], config, seed).half())
    book.frequencies.copy_(fit_frequencies(book.encode(tokens)))
    return _attach(detector, book, config)


def attach_codebook(detector: Detector, source: Detector) -> Detector:
    """Return the detector with the codebook of another one with tokens of as many channels, under a new fingerprint."""
    book, config = source.codebook, source.config.codebook
    if book is None or config is None:
        raise ConfigError("The detector that gives its codebook has none; fit one first.")
    return _attach(detector, book, config)


def _attach(detector: Detector, book: Codebook, config: CodebookConfig) -> Detector:
    fitted = Detector(replace(detector.config, codebook=config))
    weights = {k: v for k, v in detector.state_dict().items() if not k.startswith("codebook.")}
    fitted.load_state_dict(weights | {f"codebook.{k}": v for k, v in book.state_dict().items()})
    fitted.eval().requires_grad_(False)
    fitted.fingerprint, fitted.token_peaks = fingerprint(fitted), detector.token_peaks
    return fitted
