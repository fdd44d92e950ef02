# SPDX-License-Identifier: Apache-2.0
import multiprocessing

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_generator, keyed_normal, keyed_torch_generator, keyed_uniform

GOLDEN_UNIFORM = [0.15037508439886949, 0.029495797181276928, 0.297712293602009]
GOLDEN_NORMAL = [-1.034826020376807, -1.8882559761167284, -0.5309916186182277]


def draw(key):
    return keyed_normal((3,), *key).tolist()


def test_a_draw_depends_on_its_key_alone():
    keys = [(1, "scene", f, a) for f in range(5) for a in range(4)]
    forward = {key: draw(key) for key in keys}
    np.random.default_rng(3).shuffle(keys)
    torch.manual_seed(99)
    assert {key: draw(key) for key in keys} == forward
    assert len({tuple(v) for v in forward.values()}) == 20
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert dict(zip(keys, pool.map(draw, keys), strict=True)) == forward


def test_global_generators_are_left_alone():
    torch.manual_seed(0)
    before = torch.random.get_rng_state()
    keyed_normal((10,), 1)
    keyed_torch_generator(1)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_golden_numbers():
    """Recordings, noise and weights are made from these: a change of the stream must be deliberate."""
    assert keyed_uniform((3,), 7, "golden").tolist() == GOLDEN_UNIFORM
    assert keyed_normal((3,), 7, "golden").tolist() == pytest.approx(GOLDEN_NORMAL, abs=1e-12)


@pytest.mark.parametrize(
    ("a", "b"), [(("a", "b"), ("ab",)), ((1,), ("1",)), ((1, 2), (12,)), ((), ("",)), ((1,), (-1,)), (("",), ("", ""))]
)
def test_different_keys_are_never_written_alike(a, b):
    assert draw(a) != draw(b)


def test_big_and_numpy_integers_are_keys():
    assert draw((np.int64(5), "x")) == draw((5, "x"))
    assert draw((2**200,)) != draw((2**200 + 1,))
    with pytest.raises(ConfigError, match="float"):
        keyed_normal((1,), 0.5)  # pyright: ignore


def test_a_longer_draw_begins_with_the_shorter():
    assert torch.equal(keyed_normal((2, 3), 4).flatten(), keyed_normal((10,), 4)[:6])
    assert keyed_uniform((), 4).item() == keyed_uniform((1,), 4).item()


def test_moments():
    uniform, normal = keyed_uniform((200_000,), 0), keyed_normal((200_000,), 1)
    assert uniform.dtype == normal.dtype == torch.float64
    assert abs(uniform.mean() - 0.5) < 0.003 and abs(uniform.var() - 1 / 12) < 0.001
    assert uniform.min() > 0 and uniform.max() < 1
    assert abs(normal.mean()) < 0.01 and abs(normal.std() - 1) < 0.01 and abs((normal**4).mean() - 3) < 0.1
    across = torch.cat([keyed_normal((1,), 0, f) for f in range(3000)])
    assert abs(across.mean()) < 0.06 and abs(across.std() - 1) < 0.05


def test_torch_and_numpy_generators():
    assert torch.equal(
        torch.randperm(50, generator=keyed_torch_generator(1, "x")),
        torch.randperm(50, generator=keyed_torch_generator(1, "x")),
    )
    assert keyed_torch_generator(1).initial_seed() != keyed_torch_generator(2).initial_seed()
    assert keyed_generator(3).integers(1 << 60) == keyed_generator(3).integers(1 << 60)
