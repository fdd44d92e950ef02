# SPDX-License-Identifier: Apache-2.0
"""Attention in compiled loops against the padded twin: any order of tokens, windows of one token and of many."""

import pytest
import torch

from manyeyes.datatypes import ShapeError
from manyeyes.ops._window_attention_kernels import attend_in_windows, window_runs
from manyeyes.ops.keyed_random import keyed_torch_generator
from manyeyes.ops.window_attention import window_attention


@pytest.mark.parametrize(
    ("tokens", "windows", "width"), [(1, 1, 4), (40, 40, 8), (150, 3, 16), (300, 60, 32), (390, 2, 12)]
)
def test_loops_equal_the_padded_twin(tokens: int, windows: int, width: int) -> None:
    random = keyed_torch_generator("loops", tokens)
    window = torch.randint(windows, (tokens,), generator=random) * 7 - 3
    q, k, v = (torch.randn(tokens, 2, width, generator=random) * 2 for _ in range(3))
    ours = attend_in_windows(q, k, v, window_runs(window))
    assert torch.allclose(ours, window_attention(q, k, v, window, window), atol=1e-5)


@pytest.mark.parametrize(
    ("tokens", "windows", "width"), [(1, 1, 4), (40, 40, 8), (150, 3, 16), (300, 60, 32), (390, 2, 12), (131, 1, 4)]
)
def test_gradients_equal_those_of_the_padded_twin(tokens: int, windows: int, width: int) -> None:
    random = keyed_torch_generator("gradients", tokens)
    window = torch.randint(windows, (tokens,), generator=random) * 7 - 3
    given = [torch.randn(tokens, 2, width, generator=random) * 1.5 for _ in range(4)]
    found = []
    for double in (False, True):
        q, k, v = (t.to(torch.float64 if double else torch.float32).requires_grad_() for t in given[:3])
        out = window_attention(q, k, v, window, window) if double else attend_in_windows(q, k, v, window_runs(window))
        found.append(torch.autograd.grad(out, (q, k, v), given[3].to(out.dtype)))
    for ours, twin in zip(*found, strict=True):
        assert ours.dtype == torch.float32
        # One token alone has weight 1 whatever its score: its query and key have no gradient.
        assert float((ours - twin).norm()) <= 2e-6 * max(1.0, float(twin.norm()))


def test_gradients_of_no_token() -> None:
    none = torch.zeros(0, 2, 8, requires_grad=True)
    out = attend_in_windows(none, none, none, window_runs(torch.zeros(0, dtype=torch.int64)))
    assert torch.autograd.grad(out.sum(), none)[0].shape == none.shape


def test_scores_of_any_size_do_not_overflow() -> None:
    q = torch.full((5, 1, 4), 90.0)
    out = attend_in_windows(q, q, torch.arange(20.0).view(5, 1, 4), window_runs(torch.zeros(5, dtype=torch.int64)))
    assert torch.allclose(out[3, 0], torch.arange(4.0) + 8)


def test_any_window_size_up_to_a_tile_and_beyond() -> None:
    random = keyed_torch_generator("loops", 1)
    for size in (*range(1, 22), 63, 64, 65, 68, 128, 131):
        window = torch.tensor([7] * size + [9, 8, 9])
        q, k, v = (torch.randn(size + 3, 1, 4, generator=random) * 3 for _ in range(3))
        ours = attend_in_windows(q, k, v, window_runs(window))
        exact = (q[:size, 0].double() @ k[:size, 0].double().T / 2).softmax(1) @ v[:size, 0].double()
        assert torch.allclose(ours[:size, 0].double(), exact, rtol=0, atol=2e-5)
        assert torch.allclose(ours[-2], v[-2], rtol=1e-6)


def test_far_lower_scores_have_no_weight() -> None:
    q = torch.tensor([[[30.0, 0, 0, 0]], [[-30.0, 0, 0, 0]], [[0.0, 0, 0, 0]]])
    out = attend_in_windows(q, q, torch.arange(12.0).view(3, 1, 4), window_runs(torch.zeros(3, dtype=torch.int64)))
    assert torch.allclose(out[:2, 0], torch.arange(8.0).view(2, 4), rtol=1e-7, atol=1e-30)
    assert torch.allclose(out[2, 0], torch.arange(4.0) + 4)


def test_a_width_that_does_not_come_in_fours_is_refused() -> None:
    x = torch.zeros(3, 2, 6)
    with pytest.raises(ShapeError, match="divisible by 4"):
        attend_in_windows(x, x, x, window_runs(torch.zeros(3, dtype=torch.int64)))


def test_no_token_gives_no_row() -> None:
    none = torch.zeros(0, 2, 8)
    assert attend_in_windows(none, none, none, window_runs(torch.zeros(0, dtype=torch.int64))).shape == (0, 2, 8)


def test_windows_begin_where_ids_change() -> None:
    runs = window_runs(torch.tensor([5, -1, 5, 5]))
    assert runs.order.tolist() == [1, 0, 2, 3]
    assert runs.start.tolist() == [0, 1, 4]
