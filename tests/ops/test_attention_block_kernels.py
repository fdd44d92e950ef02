# SPDX-License-Identifier: Apache-2.0
"""A block of attention in one call: what each layer of it gives by itself."""

import pytest
import torch
from torch import nn

from manyeyes.ops._attention_block_kernels import BlockWeights, run_block
from manyeyes.ops._window_attention_kernels import window_runs
from manyeyes.ops.window_attention import plan_windows, sincos_encoding, window_attention


def layers(channels: int, hidden: int) -> tuple[list[nn.Linear], list[nn.LayerNorm]]:
    torch.manual_seed(0)
    linears = [nn.Linear(channels, channels) for _ in range(4)]
    linears += [nn.Linear(channels, hidden), nn.Linear(hidden, channels)]
    norms = [nn.LayerNorm(channels) for _ in range(2)]
    for norm in norms:
        nn.init.normal_(norm.weight)
        nn.init.normal_(norm.bias)
    return linears, norms


@pytest.mark.parametrize(("channels", "hidden", "heads"), ((16, 32, 2), (64, 128, 4), (48, 16, 3)))
@pytest.mark.parametrize("n", (1, 7, 301, 1500))
@torch.no_grad()
def test_equals_layer_after_layer(channels: int, hidden: int, heads: int, n: int) -> None:
    (query, key, value, out, up, down), (norm, norm_ffn) = layers(channels, hidden)
    weights = BlockWeights.of([query, key, value, out, up, down], [norm, norm_ffn], heads)
    assert weights is not None
    x, offsets = 3 * torch.randn(n, channels), 16 * torch.rand(n, 2) - 8
    ids = torch.randint(0, 1 + n // 40, (n,))
    normed = norm(x)
    placed = normed + sincos_encoding(offsets, channels)
    q, k, v = (f.view(n, heads, -1) for f in (query(placed), key(placed), value(normed)))
    wanted = x + out(window_attention(q, k, v, plan_windows(ids, ids)).flatten(1))
    wanted = wanted + down(nn.functional.gelu(up(norm_ffn(wanted))))
    before = x.clone()
    got = run_block(x, offsets, window_runs(ids), weights)
    assert torch.equal(x, before) and float((wanted - x).abs().max()) > 0.5
    assert torch.allclose(got, wanted, atol=1e-5, rtol=1e-5)


def test_no_tokens() -> None:
    weights = BlockWeights.of(*layers(16, 32), 2)
    assert weights is not None
    none = torch.zeros(0, dtype=torch.int64)
    assert run_block(torch.zeros(0, 16), torch.zeros(0, 2), window_runs(none), weights).shape == (0, 16)


def test_widths_that_no_vector_fits_are_left_to_the_layers() -> None:
    assert BlockWeights.of(*layers(24, 48), 2) is None
