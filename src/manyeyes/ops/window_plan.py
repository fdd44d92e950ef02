# SPDX-License-Identifier: Apache-2.0
"""Where tokens sit in padded batches of windows, computed by whole tensors for devices where each question to the device is a wait.

``ops.window_attention.plan_windows`` is the twin for the CPU: it pads less, in many buckets, and asks for every one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

DEVICE_BUCKETS = (64,)
"""Windows of more tokens are padded apart from those of at most so many."""


@dataclass(frozen=True)
class WindowGroup:
    """Windows padded alike: how many, and the slots of each for queries and for keys."""

    windows: int
    query_slots: int
    key_slots: int


@dataclass(frozen=True, eq=False)
class WindowPlan:
    """Where each query and key sits in the padded batches; shared by all layers over one set of tokens.

    query_slot: (slots,) int64, the query in each slot, Nq where empty; query_place: (Nq,) int64, its slot, the number
    of slots when its window has no key. key_slot, key_place: the same for keys. exact: sum of queries x keys.
    """

    groups: tuple[WindowGroup, ...]
    query_slot: Tensor
    query_place: Tensor
    key_slot: Tensor
    key_place: Tensor
    exact: int


def plan_on_device(query_window: Tensor, key_window: Tensor, buckets: tuple[int, ...] = DEVICE_BUCKETS) -> WindowPlan:
    """Group windows by the bucket of their larger side, as ``plan_windows``; the host waits once, for the sizes of groups.

    query_window: (Nq,) and key_window: (Nk,) int64, ids of windows; at least one token in all.
    """
    is_same = key_window is query_window
    ids = query_window if is_same else torch.cat((query_window, key_window))
    num_query, num_token = len(query_window), len(ids)
    window, rank = _number_windows(ids)
    ones = torch.ones_like(window)
    count = torch.zeros_like(window)
    query_count = count.index_add(0, window[:num_query], ones[:num_query])
    key_count = query_count if is_same else count.index_add(0, window[num_query:], ones[num_query:])
    edges = torch.tensor(buckets, device=ids.device)
    bucket = torch.bucketize(torch.maximum(query_count, key_count), edges)
    # Numbers of windows are at most those of tokens: what remains has no tokens, and a window of one side has no pair.
    bucket = torch.where((query_count > 0) & (key_count > 0), bucket, len(buckets) + 1)
    member = bucket[:, None] == torch.arange(len(buckets) + 2, device=ids.device)
    order = member.cumsum(0).gather(1, bucket[:, None])[:, 0] - 1
    largest = (torch.where(member, part[:, None], 0).amax(0) for part in (query_count, key_count))
    exact = (query_count * key_count).sum().expand(len(buckets) + 2)
    sizes = torch.stack((member.sum(0), *largest, exact)).tolist()
    groups = [WindowGroup(*size) for size in list(zip(*sizes[:3]))[:-1]]
    starts, query_end, key_end = [], 0, 0
    for group in groups:
        starts.append((query_end, group.query_slots, key_end, group.key_slots))
        query_end += group.windows * group.query_slots
        key_end += group.windows * group.key_slots
    place_of = torch.tensor([*starts, (query_end, 0, key_end, 0)], device=ids.device).index_select(0, bucket)
    first = torch.stack((place_of[:, 0] + order * place_of[:, 1], place_of[:, 2] + order * place_of[:, 3]))
    is_paired = (bucket <= len(buckets)).index_select(0, window)
    ends = torch.tensor([[query_end], [key_end]], device=ids.device)
    place = torch.where(is_paired, first.index_select(1, window) + rank, ends)
    query_place = place[0, :num_query]
    query_slot = _invert(query_place, query_end)
    if is_same:
        key_place, key_slot = query_place, query_slot
    else:
        key_place = place[1, num_query:] - query_count.index_select(0, window[num_query:]) * is_paired[num_query:]
        key_slot = _invert(key_place, key_end)
    found = tuple(group for group in groups if group.windows)
    return WindowPlan(found, query_slot, query_place, key_slot, key_place, sizes[3][0] if num_token else 0)


def _number_windows(ids: Tensor) -> tuple[Tensor, Tensor]:
    """Return the number (N,) of the window of each token, ascending with ids (N,), and the token's rank (N,) in it by row."""
    ordered, order = ids.sort(stable=True)
    place = torch.arange(len(ids), device=ids.device)
    is_first = torch.cat((ordered[:1] == ordered[:1], ordered[1:] != ordered[:-1]))
    rank = place - torch.where(is_first, place, 0).cummax(0).values
    both = torch.stack((is_first.cumsum(0) - 1, rank))
    window, rank = torch.empty_like(both).index_copy_(1, order, both).unbind()
    return window, rank


def _invert(place: Tensor, slots: int) -> Tensor:
    """Return (slots,): the token at each slot, their number where there is none; a place beyond the slots counts for none."""
    tokens = torch.arange(len(place), device=place.device)
    return place.new_full((slots + 1,), len(place)).index_copy_(0, place, tokens)[:slots]
