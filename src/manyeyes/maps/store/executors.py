# SPDX-License-Identifier: Apache-2.0
"""One function over many blocks: in this process, over a pool of processes, or on a Dask or Ray cluster.

Source: the requirement that a block is a pure function's argument, so that any existing engine runs it and the results do not
depend on which one did, in which order, or on how many workers.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from manyeyes.datatypes import ConfigError, MissingExtraError

B = TypeVar("B")
R = TypeVar("R")

#: Called after each finished block with (finished, all).
Progress = Callable[[int, int], None]


class Runner(Protocol):
    """An engine that is up: runs a function over blocks and yields (index of the block, result) as they finish."""

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once, in any order; an exception of the function is raised here."""
        ...


class Executor(Protocol):
    """Where blocks may run; opening it starts the engine, which then serves any number of calls."""

    def open(self) -> AbstractContextManager[Runner]:
        """The engine, up until the context ends."""
        ...


@dataclass(frozen=True)
class Inline:
    """One block after the other in this process: the slow twin of the others, and what a debugger wants."""

    @contextmanager
    def open(self) -> Iterator[Runner]:
        """Nothing is started."""
        yield self

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once, in order."""
        for index, block in enumerate(blocks):
            yield index, fn(block)


@dataclass(frozen=True)
class ProcessPool:
    """Blocks over processes of this machine; ``workers`` None: one a core.

    Workers are never forks of this process, whose threads of numba or torch would hang them: they are forked from a clean
    server that has imported this package once, or started afresh where the system has no such server.
    A script that calls this needs the usual ``if __name__ == "__main__":``.
    At most ``ahead`` blocks a worker wait in the queue, so that large blocks are not all pickled at once.
    """

    workers: int | None = None
    ahead: int = 2

    @contextmanager
    def open(self) -> Iterator[Runner]:
        """Start the pool; it ends with the context, at once if that ends with an exception."""
        clean = "forkserver" in multiprocessing.get_all_start_methods()
        context = multiprocessing.get_context("forkserver" if clean else "spawn")
        if clean:
            context.set_forkserver_preload([__name__])
        workers = self.workers or _cores()
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            try:
                yield _Pool(pool, workers * (1 + self.ahead))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


@dataclass(frozen=True)
class _Pool:
    """A process pool that is up, with the number of blocks that may be under way."""

    pool: ProcessPoolExecutor
    window: int

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once, as they finish."""
        under_way: dict[Future[R], int] = {}
        next_block = 0
        while next_block < len(blocks) or under_way:
            while next_block < len(blocks) and len(under_way) < self.window:
                under_way[self.pool.submit(fn, blocks[next_block])] = next_block
                next_block += 1
            done, _ = wait(under_way, return_when=FIRST_COMPLETED)
            for future in done:
                yield under_way.pop(future), future.result()


@dataclass(frozen=True)
class Dask:
    """Blocks over a Dask cluster: ``address`` of a scheduler, or None for one on this machine with ``workers`` processes."""

    address: str | None = None
    workers: int | None = None

    @contextmanager
    def open(self) -> Iterator[Runner]:
        """Connect, or start a cluster that ends with the context."""
        try:
            from dask.distributed import Client, LocalCluster
        except ImportError:
            raise MissingExtraError("dask", "Running on a Dask cluster") from None
        if self.address is not None:
            with Client(self.address) as client:
                yield _DaskClient(client)
            return
        local: dict[str, Any] = {"n_workers": self.workers or _cores(), "dashboard_address": None}
        with LocalCluster(processes=True, threads_per_worker=1, **local) as cluster, Client(cluster) as client:
            yield _DaskClient(client)


@dataclass(frozen=True)
class _DaskClient:
    """A connection to a Dask scheduler."""

    client: Any

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once, as they finish."""
        from dask.distributed import as_completed

        # pure=False: a block is run, never looked up by a hash of its arguments.
        futures = [self.client.submit(fn, block, pure=False) for block in blocks]
        index_of = {future.key: index for index, future in enumerate(futures)}
        for future in as_completed(futures):
            yield index_of[future.key], future.result()


@dataclass(frozen=True)
class Ray:
    """Blocks over a Ray cluster: ``address`` of a head node, or None for one on this machine with ``workers`` processes.

    A cluster that this process is already connected to is used as it is and left running.
    """

    address: str | None = None
    workers: int | None = None

    @contextmanager
    def open(self) -> Iterator[Runner]:
        """Connect, or start a cluster that ends with the context."""
        try:
            import ray  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise MissingExtraError("ray", "Running on a Ray cluster") from None
        started = not ray.is_initialized()
        if started:
            local = {"num_cpus": self.workers or _cores(), "include_dashboard": False} if self.address is None else {}
            ray.init(address=self.address, log_to_driver=False, logging_level=logging.ERROR, **local)
        try:
            yield _RayClient(ray)
        finally:
            if started:
                ray.shutdown()


@dataclass(frozen=True)
class _RayClient:
    """The ray module, connected."""

    ray: Any

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once, as they finish."""
        remote = self.ray.remote(fn)
        index_of = {remote.remote(block): index for index, block in enumerate(blocks)}
        waiting = list(index_of)
        while waiting:
            done, waiting = self.ray.wait(waiting, num_returns=1)
            for reference in done:
                yield index_of[reference], self.ray.get(reference)


EXECUTORS: tuple[str, ...] = ("inline", "process", "dask", "ray")


def named_executor(name: str, workers: int | None = None, address: str | None = None) -> Executor:
    """The executor of a name from the command line: one of ``EXECUTORS``."""
    if name == "inline":
        return Inline()
    if name == "process":
        return ProcessPool(workers)
    if name == "dask":
        return Dask(address, workers)
    if name == "ray":
        return Ray(address, workers)
    raise ConfigError(f"No executor '{name}'; choose one of {', '.join(EXECUTORS)}.")


def map_blocks(
    fn: Callable[[B], R], blocks: Sequence[B], runner: Runner | None = None, progress: Progress | None = None
) -> list[R]:
    """``[fn(block) for block in blocks]`` on an engine that is up (a process pool for this call if None), in the blocks' order.

    ``fn`` and the blocks must pickle; ``fn`` must be pure: an engine may run a block again on another worker.
    """
    if runner is None:
        with ProcessPool(min(_cores(), max(len(blocks), 1))).open() as pool:
            return map_blocks(fn, blocks, pool, progress)
    results: dict[int, R] = {}
    for index, result in runner.run(fn, blocks):
        results[index] = result
        if progress is not None:
            progress(len(results), len(blocks))
    return [results[index] for index in range(len(blocks))]


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
