# SPDX-License-Identifier: Apache-2.0
"""Observers: trusted senders whose sight states free space where another sender claims an object that the ego cannot see.

Source of the idea: free space that agents share, in Zhang et al. (CAD, USENIX Security 2024), and the perception regions of
ETSI TS 103 324. A sight can be false, so one observer has no effect. Observers that copy each other, or state one place, are one.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.strategies.message_header import age_s
from manyeyes.agents.trust.association import Floats, Rows, associate
from manyeyes.agents.trust.claims import SIGMA_VELOCITY_MPS, Claims
from manyeyes.datatypes import AgentFrame, Message
from manyeyes.ops.lidar.free_range import find_free

MIN_COPIED_CLAIMS = 2
"""Number of claims of both senders from which on equal ones make them one source."""


@dataclass(frozen=True)
class ObserverConfig:
    """When the sights of others refute a claim.

    min_observers: trusted, independent, and neither the claimer nor accused. margin_m, num_sigmas: the footprint of the claim is
    enlarged by margin_m and so many standard deviations of claim and observer together, of min_sigma_m or more, to max_margin_m;
    beyond it nothing is concluded.
    max_height_m: of the ground of the claim above or below that of the observer.
    min_own_score: of a detection of the ego; a sight that states it to be free is not used.
    """

    min_observers: int = 2
    margin_m: float = 0.3
    num_sigmas: float = 2.0
    min_sigma_m: float = 0.3
    max_margin_m: float = 2.5
    max_height_m: float = 0.5
    min_own_score: float = 0.5


@dataclass(frozen=True)
class PlacedBoxes:
    """Boxes in the ego's frame at its time. columns: (N, 7) centre, size, yaw; velocity: (N, 2) m/s; sigma_m: (N,) of centres."""

    columns: Floats
    velocity: Floats
    sigma_m: Floats


def count_observers(
    frame: AgentFrame,
    messages: Sequence[Message],
    claims: Sequence[Claims],
    own: PlacedBoxes,
    trusted: Set[int],
    sources: tuple[float, float, float],
    config: ObserverConfig,
) -> list[Rows]:
    """Return (N,) for the claims of each sender, how many independent observers state that their places are free.

    Args:
        messages: of the senders of the claims, in their order. own: the ego's detections of min_own_score. trusted: senders whose
            sights are used.
        sources: copy_m, max_copied and min_apart_m. Senders with a fraction of claims above max_copied within copy_m of each other,
            or nearer to each other than min_apart_m, are one source.
    """
    sights = [row for row, message in enumerate(messages) if message.sight is not None and message.agent_id in trusted]
    sights = [row for row in sights if not _states_free(frame, messages[row], own, config).any()]
    if len(sights) < config.min_observers:
        return [np.zeros(len(one), np.int64) for one in claims]
    source = _find_sources(claims, *sources)
    counts = list[Rows]()
    for row, one in enumerate(claims):
        placed = PlacedBoxes(one.columns, one.velocity, one.sigma_m)
        states = dict[int, NDArray[np.bool_]]()
        for observer in sights:
            if source[observer] != source[row]:
                found = _states_free(frame, messages[observer], placed, config)
                states[source[observer]] = states.get(source[observer], np.zeros(len(one), np.bool_)) | found
        counts.append(np.sum([np.zeros(len(one), np.int64), *states.values()], axis=0))
    return counts


def _states_free(frame: AgentFrame, message: Message, boxes: PlacedBoxes, config: ObserverConfig) -> NDArray[np.bool_]:
    """Return (N,) which boxes the sight of a message states to be free."""
    if message.sight is None or not len(boxes.columns):
        return np.zeros(len(boxes.columns), np.bool_)
    here, there, seconds = frame.world_from_agent, message.world_from_agent, age_s(frame, message)
    from_world = there.rotation.numpy().T
    rotation = from_world @ here.rotation.numpy()
    origin = from_world @ (here.translation.numpy() - there.translation.numpy())
    # A sight is of the time of its sweep.
    columns = boxes.columns.copy()
    columns[:, :2] -= boxes.velocity * seconds
    columns[:, :3] = columns[:, :3] @ rotation.T + origin
    columns[:, 6] += np.arctan2(rotation[1, 0], rotation[0, 0])
    covariance = frame.pose_covariance.numpy() + message.pose_covariance.numpy()
    x, y, yaw = (max(float(covariance[k, k]), 0.0) for k in range(3))
    variance = (x + y) / 2 + (SIGMA_VELOCITY_MPS * seconds) ** 2 + yaw * np.square(columns[:, :2]).sum(1)
    sigma_m = np.maximum(np.sqrt(boxes.sigma_m**2 + variance), config.min_sigma_m)
    margin_m = config.margin_m + config.num_sigmas * sigma_m
    is_tested = (margin_m <= config.max_margin_m) & (np.abs(columns[:, 2] - columns[:, 5] / 2) <= config.max_height_m)
    is_free = np.zeros(len(columns), np.bool_)
    is_free[is_tested] = find_free(message.sight, columns[is_tested], margin_m[is_tested])
    return is_free


def _find_sources(claims: Sequence[Claims], copy_m: float, max_copied: float, min_apart_m: float) -> list[int]:
    """Return the number of the source of each sender: senders that copy each other, or are at one place, have the same."""
    source = list(range(len(claims)))
    for row, one in enumerate(claims):
        for earlier in range(row):
            if source[earlier] != source[row] and _is_one_source(one, claims[earlier], copy_m, max_copied, min_apart_m):
                merged = source[row]
                source = [source[earlier] if number == merged else number for number in source]
    return source


def _is_one_source(one: Claims, other: Claims, copy_m: float, max_copied: float, min_apart_m: float) -> bool:
    dx, dy = one.sender_xy[0] - other.sender_xy[0], one.sender_xy[1] - other.sender_xy[1]
    if dx * dx + dy * dy < min_apart_m * min_apart_m:
        return True
    fewest = min(len(one), len(other))
    num_equal = int((associate(one.xy, other.xy, copy_m) >= 0).sum())
    return fewest >= MIN_COPIED_CLAIMS and num_equal > max_copied * fewest
