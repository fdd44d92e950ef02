# SPDX-License-Identifier: Apache-2.0
"""Communication volume, from the bytes that were really sent.

A record is one message as it left its sender (header, sections, checksums: everything), whether or not it arrived. An
empty message counts as 0 bytes in every mean. ``ab_log2_of_mean`` is the papers' "AB": the base-2 logarithm of the mean
bytes of a message; ``ab_mean_of_log2`` averages the logarithms and is smaller (Jensen), and is over non-empty messages
only, since an empty one has no logarithm. Rates suppose ten frames a second unless told otherwise.

:func:`paper_bytes` is CoSTr's Eq. 13: float32 features and two float32 indices for each token; no header, no pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class MessageRecord:
    """One message that was sent in a frame. agent ids name sender and ego; ego is who it was counted for."""

    scenario: str
    index: int
    sender: int
    bytes: int
    tokens: int = 0
    channels: int = 0
    objects: int = 0
    points: int = 0
    ego: int = 0

    def __post_init__(self) -> None:
        if min(self.bytes, self.tokens, self.channels, self.objects, self.points) < 0:
            raise ConfigError(f"A MessageRecord counts bytes and contents, none below 0; got {self}.")


@dataclass(frozen=True)
class Communication:
    """What a run sent; NaN where nothing was.

    bytes_per_message: mean over messages. bytes_per_ego_frame: all senders of an ego's frame together, mean over ego
    frames. megabits_per_s: the latter at the frame rate. paper_ab: log2 of the mean of Eq. 13 over the same messages.
    """

    messages: int
    empty_messages: int
    ego_frames: int
    bytes_per_message: float
    bytes_per_ego_frame: float
    megabits_per_s: float
    ab_log2_of_mean: float
    ab_mean_of_log2: float
    paper_ab: float
    tokens_per_message: float


def paper_bytes(n_tokens: int, channels: int) -> int:
    """Bytes of n tokens of c channels by the papers' formula: n (c + 2) 4. Source: CoSTr, Eq. 13."""
    return n_tokens * (channels + 2) * 4


def summarise(records: Sequence[MessageRecord], ego_frames: int | None = None, rate_hz: float = 10.0) -> Communication:
    """The volume of a run. ego_frames: how many (ego, frame) there were; without it, those that have a record."""
    heard = len({(r.scenario, r.index, r.ego) for r in records})
    if ego_frames is not None and ego_frames < heard:
        raise ConfigError(f"ego_frames is {ego_frames}, but the records alone name {heard}.")
    frames = heard if ego_frames is None else ego_frames
    total = sum(r.bytes for r in records)
    mean = _ratio(total, len(records))
    logarithms = [math.log2(r.bytes) for r in records if r.bytes > 0]
    return Communication(
        messages=len(records),
        empty_messages=len(records) - len(logarithms),
        ego_frames=frames,
        bytes_per_message=mean,
        bytes_per_ego_frame=_ratio(total, frames),
        megabits_per_s=_ratio(total, frames) * 8 * rate_hz / 1e6,
        ab_log2_of_mean=_log2(mean),
        ab_mean_of_log2=_ratio(sum(logarithms), len(logarithms)),
        paper_ab=_log2(_ratio(sum(paper_bytes(r.tokens, r.channels) for r in records), len(records))),
        tokens_per_message=_ratio(sum(r.tokens for r in records), len(records)),
    )


def _ratio(total: float, count: int) -> float:
    return total / count if count else math.nan


def _log2(value: float) -> float:
    return math.log2(value) if value > 0 else math.nan
