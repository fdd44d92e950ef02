# SPDX-License-Identifier: Apache-2.0
"""A pool gives the list that a loop gives, and a block's exception reaches the caller; clusters: see test_tiles.py."""

import contextlib
import os
import platform
import sys
import time

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError, MissingExtraError
from manyeyes.maps.store.executors import (
    BLOCKS_PER_WORKER,
    DaskExecutor,
    InlineExecutor,
    ProcessExecutor,
    make_executor,
    map_blocks,
)


def _square_late(value: int) -> tuple[int, int]:
    """The first blocks take longest, so that finishing order is not submission order."""
    time.sleep(0.05 if value < 2 else 0)
    return value * value, os.getpid()


def _fails_at_three(value: int) -> int:
    if value == 3:
        raise ValueError("block three")
    return value


def _run(executor, fn, blocks, progress=None):
    with executor.open() as runner:
        return map_blocks(fn, blocks, runner, progress)


def test_a_process_pool_gives_the_inline_list_in_block_order_and_reports_every_block():
    seen: list[tuple[int, int]] = []
    with ProcessExecutor(2).open() as runner:
        results = map_blocks(_square_late, range(9), runner, lambda done, total: seen.append((done, total)))
        again = map_blocks(_square_late, range(3), runner)
        with pytest.raises(ValueError, match="block three"):
            map_blocks(_fails_at_three, range(6), runner)
    assert [square for square, _ in results] == [square for square, _ in _run(InlineExecutor(), _square_late, range(9))]
    assert os.getpid() not in {pid for _, pid in results}
    assert {pid for _, pid in again} <= {pid for _, pid in results}
    assert seen == [(k, 9) for k in range(1, 10)]


def _count_page_faults(value: int) -> int:
    """Page faults while large arrays are made and freed, once the first is there."""
    import resource

    np.ones(4_000_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        np.ones(4_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="memory is kept with glibc alone")
def test_a_worker_uses_the_memory_of_a_freed_array_again():
    assert _run(ProcessExecutor(1), _count_page_faults, [0])[0] < 100


@pytest.mark.parametrize("executor", [InlineExecutor(), ProcessExecutor(2)], ids=["inline", "process"])
def test_blocks_are_taken_as_workers_become_free(executor):
    taken: list[int] = []

    def blocks():
        for k in range(40):
            taken.append(k)
            yield k

    with executor.open() as session:
        for done, (index, _) in enumerate(session.run(_square_late, blocks())):
            assert index in taken and len(taken) - done <= 2 * BLOCKS_PER_WORKER
    assert len(taken) == 40 and done == 39


def test_an_exception_of_a_block_reaches_the_caller_inline():
    with pytest.raises(ValueError, match="block three"):
        _run(InlineExecutor(), _fails_at_three, range(6))


def test_without_a_runner_a_pool_of_its_own_runs_the_blocks():
    assert map_blocks(_fails_at_three, [5]) == [5]
    assert map_blocks(_fails_at_three, []) == []


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
            _run(make_executor(name), _fails_at_three, [1])


class FakeRay:
    """What the executor uses of ray, without a cluster."""

    def __init__(self, initialized: bool) -> None:
        self.initialized, self.calls = initialized, list[str]()

    def is_initialized(self) -> bool:
        return self.initialized

    def init(self, **options: object) -> None:
        self.calls.append(f"init at {options['address']} with {options.get('num_cpus')}")

    def shutdown(self) -> None:
        self.calls.append("shutdown")


@pytest.mark.parametrize("fails", [False, True])
def test_a_ray_cluster_is_ended_by_the_process_that_began_it(monkeypatch, fails):
    for initialized, address, wanted in (
        (True, None, []),
        (False, None, ["init at None with 3", "shutdown"]),
        (False, "head:1", ["init at head:1 with None", "shutdown"]),
    ):
        fake = FakeRay(initialized)
        monkeypatch.setitem(sys.modules, "ray", fake)
        with contextlib.suppress(KeyError), make_executor("ray", 3, address).open():
            if fails:
                raise KeyError
        assert fake.calls == wanted


def test_an_address_is_of_a_cluster():
    assert make_executor("dask", 2, "tcp://a:1") == DaskExecutor("tcp://a:1", 2)
    with pytest.raises(ConfigError, match=r"has no address; choose dask or ray for tcp://a:1"):
        make_executor("process", address="tcp://a:1")


def test_an_unknown_executor_lists_the_known_ones():
    with pytest.raises(ConfigError, match="inline, process, dask, ray"):
        make_executor("spark")
