# SPDX-License-Identifier: Apache-2.0
"""Every executor gives the list that a loop gives, and a block's exception reaches the caller."""

import os
import time

import pytest

from manyeyes.datatypes import ConfigError, MissingExtraError
from manyeyes.maps.engine import Dask, Inline, ProcessPool, Ray, map_blocks, named_executor


def _square_late(value: int) -> tuple[int, int]:
    """The first blocks take longest, so that finishing order is not submission order."""
    time.sleep(0.05 if value < 2 else 0)
    return value * value, os.getpid()


def _fails_at_three(value: int) -> int:
    if value == 3:
        raise ValueError("block three")
    return value


def test_a_process_pool_gives_the_inline_list_in_block_order_and_reports_every_block():
    seen: list[tuple[int, int]] = []
    results = map_blocks(
        _square_late, range(9), ProcessPool(2, ahead=1), lambda done, total: seen.append((done, total))
    )
    assert [square for square, _ in results] == [square for square, _ in map_blocks(_square_late, range(9), Inline())]
    assert os.getpid() not in {pid for _, pid in results}
    assert seen == [(k, 9) for k in range(1, 10)]


@pytest.mark.parametrize("executor", [Inline(), ProcessPool(2)])
def test_an_exception_of_a_block_reaches_the_caller(executor):
    with pytest.raises(ValueError, match="block three"):
        map_blocks(_fails_at_three, range(6), executor)


@pytest.mark.parametrize("executor", [Inline(), ProcessPool(2)])
def test_no_blocks_give_an_empty_list(executor):
    assert map_blocks(_square_late, [], executor) == []


def test_dask_gives_the_inline_list():
    pytest.importorskip("dask.distributed", reason="the dask extra is not installed")
    results = map_blocks(_square_late, range(9), Dask(workers=2))
    assert [square for square, _ in results] == [k * k for k in range(9)]


def test_ray_gives_the_inline_list():
    pytest.importorskip("ray", reason="the ray extra is not installed")
    results = map_blocks(_square_late, range(9), Ray(workers=2))
    assert [square for square, _ in results] == [k * k for k in range(9)]


def test_an_absent_engine_names_its_extra(monkeypatch):
    import builtins

    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.split(".")[0] in ("dask", "ray"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    for name in ("dask", "ray"):
        with pytest.raises(MissingExtraError, match=rf"manyeyes\[{name}\]"):
            map_blocks(_fails_at_three, [1], named_executor(name))


def test_an_unknown_executor_lists_the_known_ones():
    with pytest.raises(ConfigError, match="inline, process, dask, ray"):
        named_executor("spark")
