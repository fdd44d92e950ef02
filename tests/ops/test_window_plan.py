# SPDX-License-Identifier: Apache-2.0
"""The plan of windows for other devices attends like the plan of many buckets."""

import pytest
import torch

from manyeyes.ops.window_attention import plan_windows, window_attention
from manyeyes.ops.window_plan import plan_on_device


@pytest.mark.parametrize(
    ("num_query", "num_key", "windows"),
    [(300, 200, 20), (5, 7, 3), (1, 1, 1), (40, 0, 5), (0, 4, 3), (900, 700, 4), (50, 50, 100)],
)
@pytest.mark.parametrize("is_same", [True, False])
def test_it_gives_the_attention_of_the_plan_with_many_buckets(num_query, num_key, windows, is_same):
    random = torch.Generator().manual_seed(num_query)
    query = torch.randint(-windows // 2, windows // 2 + 1, (num_query,), generator=random) * 7
    key = query if is_same else torch.randint(-windows // 2, windows // 2 + 1, (num_key,), generator=random) * 7
    if not len(query) + len(key):
        return
    plan, twin = plan_on_device(query, key), plan_windows(query, key)
    shapes = (num_query, len(key), len(key))
    qkv = [torch.randn(n, 2, 4, generator=random, dtype=torch.float64).requires_grad_() for n in shapes]
    results = []
    for each in (plan, twin):
        out = window_attention(*qkv, each)
        results.append((out, *torch.autograd.grad((out * out.detach().cos()).sum(), qkv, allow_unused=True)))
    for mine, its in zip(*results, strict=True):
        assert (mine is None and its is None) or torch.allclose(mine, its, atol=1e-12)
    assert plan.exact == twin.exact and len(plan.groups) <= 2
    assert all(max(g.query_slots, g.key_slots) <= 64 for g in plan.groups[:-1])


def test_a_plan_on_a_device_is_that_of_the_cpu(device):
    ids = torch.randint(0, 9, (500,), generator=torch.Generator().manual_seed(0)).to(device)
    plan = plan_windows(ids, ids)
    twin = plan_on_device(ids.cpu(), ids.cpu())
    assert torch.equal(plan.query_slot.cpu(), twin.query_slot) and plan.groups == twin.groups


def test_the_host_waits_once():
    from tests.emulated_device import DEVICE, emulate

    with emulate() as record:
        ids = torch.randint(0, 9, (500,)).to(DEVICE)
        plan_windows(ids, ids[:100].clone())
        assert record.num_syncs == 1
