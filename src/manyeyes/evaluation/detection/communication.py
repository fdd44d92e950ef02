# SPDX-License-Identifier: Apache-2.0
"""Communication volume, from the bytes that were really sent.

A record is one message as it left its sender (header, sections, checksums: everything), whether or not it arrived. An
empty message counts as 0 bytes in every mean. ``log2_mean_bytes`` is the papers' "AB": the base-2 logarithm of the mean
bytes of a message; ``mean_log2_bytes`` averages the logarithms and is smaller (Jensen), and is over non-empty messages
only, since an empty one has no logarithm. Rates assume ten frames a second by default.

:func:`compute_paper_bytes` is CoSTr's Eq. 13: float32 features and two float32 indices for each token; no header, no pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class MessageRecord:
    """One message that was sent in a frame. agent ids name sender and ego; ego is who it was counted for. Contents are those of the
    sent packets; num_channels: of a row of tokens at the receiver, 0 where no tokens arrived in the frame.
    """

    scenario: str
    index: int
    sender: int
    num_bytes: int
    num_tokens: int = 0
    num_channels: int = 0
    num_objects: int = 0
    num_points: int = 0
    ego: int = 0

    def __post_init__(self) -> None:
        if min(self.num_bytes, self.num_tokens, self.num_channels, self.num_objects, self.num_points) < 0:
            raise ConfigError(f"A MessageRecord counts bytes and contents, none below 0; got {self}.")


@dataclass(frozen=True)
class Communication:
    """What a run sent; NaN where nothing was.

    bytes_per_message: mean over messages. bytes_per_ego_frame: all senders of an ego's frame together, mean over ego
    frames. megabits_per_s: the latter at the frame rate. log2_paper_bytes: log2 of the mean of Eq. 13 over the same messages.
    """

    num_messages: int
    num_empty_messages: int
    num_ego_frames: int
    bytes_per_message: float
    bytes_per_ego_frame: float
    megabits_per_s: float
    log2_mean_bytes: float
    mean_log2_bytes: float
    log2_paper_bytes: float
    tokens_per_message: float
    objects_per_message: float = math.nan
    points_per_message: float = math.nan


def compute_paper_bytes(num_tokens: int, num_channels: int) -> int:
    """Return bytes of n tokens of c channels by the papers' formula: n (c + 2) 4. Source: CoSTr, Eq. 13."""
    return num_tokens * (num_channels + 2) * 4


def summarize_messages(
    records: Sequence[MessageRecord], num_ego_frames: int | None = None, rate_hz: float = 10.0
) -> Communication:
    """Return the volume of a run. num_ego_frames: how many (ego, frame) there were; without it, those that have a record."""
    num_recorded_frames = len({(r.scenario, r.index, r.ego) for r in records})
    if num_ego_frames is not None and num_ego_frames < num_recorded_frames:
        raise ConfigError(f"ego_frames is {num_ego_frames}, but the records alone name {num_recorded_frames}.")
    num_frames = num_recorded_frames if num_ego_frames is None else num_ego_frames
    total = sum(r.num_bytes for r in records)
    mean = _ratio(total, len(records))
    logarithms = [math.log2(r.num_bytes) for r in records if r.num_bytes > 0]
    return Communication(
        num_messages=len(records),
        num_empty_messages=len(records) - len(logarithms),
        num_ego_frames=num_frames,
        bytes_per_message=mean,
        bytes_per_ego_frame=_ratio(total, num_frames),
        megabits_per_s=_ratio(total, num_frames) * 8 * rate_hz / 1e6,
        log2_mean_bytes=_log2(mean),
        mean_log2_bytes=_ratio(sum(logarithms), len(logarithms)),
        log2_paper_bytes=_log2(
            _ratio(sum(compute_paper_bytes(r.num_tokens, r.num_channels) for r in records), len(records))
        ),
        tokens_per_message=_ratio(sum(r.num_tokens for r in records), len(records)),
        objects_per_message=_ratio(sum(r.num_objects for r in records), len(records)),
        points_per_message=_ratio(sum(r.num_points for r in records), len(records)),
    )


def _ratio(total: float, count: int) -> float:
    return total / count if count else math.nan


def _log2(value: float) -> float:
    return math.log2(value) if value > 0 else math.nan
