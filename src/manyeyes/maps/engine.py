# SPDX-License-Identifier: Apache-2.0
"""One function over many blocks: in this process, over a pool of processes, or on a Dask or Ray cluster.

Source: the requirement that a block is a pure function's argument, so that any existing engine runs it and the results do not
depend on which one did, in which order, or on how many workers.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from manyeyes.datatypes import ConfigError, MissingExtraError

B = TypeVar("B")
R = TypeVar("R")

#: Called after each finished block with (finished, all).
Progress = Callable[[int, int], None]


class Executor(Protocol):
    """Runs a function over blocks and yields (index of the block, result) as they finish, in any order."""

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once; an exception of the function is raised here."""
        ...


@dataclass(frozen=True)
class Inline:
    """One block after the other in this process: the slow twin of the others, and what a debugger wants."""

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once, in order."""
        for index, block in enumerate(blocks):
            yield index, fn(block)


@dataclass(frozen=True)
class ProcessPool:
    """Blocks over processes of this machine; ``workers`` None: one a core.

    Workers are never forks of this process, whose threads of numba or torch would hang them: they are forked from a clean
    server that has imported the function's module once, or started afresh where the system has no such server.
    A script that calls this needs the usual ``if __name__ == "__main__":``.
    At most ``ahead`` blocks a worker wait in the queue, so that large blocks are not all pickled at once.
    """

    workers: int | None = None
    ahead: int = 2

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once, as they finish."""
        workers = min(self.workers or _cores(), max(len(blocks), 1))
        clean = "forkserver" in multiprocessing.get_all_start_methods()
        context = multiprocessing.get_context("forkserver" if clean else "spawn")
        if clean:
            context.set_forkserver_preload([getattr(fn, "__module__", __name__)])
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            try:
                yield from _windowed(lambda block: pool.submit(fn, block), blocks, workers * (1 + self.ahead))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


@dataclass(frozen=True)
class Dask:
    """Blocks over a Dask cluster: ``address`` of a scheduler, or None for one on this machine with ``workers`` processes."""

    address: str | None = None
    workers: int | None = None

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once, as they finish."""
        try:
            from dask.distributed import Client, LocalCluster, as_completed
        except ImportError:
            raise MissingExtraError("dask", "Running on a Dask cluster") from None
        cluster = None
        if self.address is None:
            workers = self.workers or _cores()
            cluster = LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None)
        client: Any = Client(cluster if cluster is not None else self.address)
        try:
            # pure=False: a block is run, never looked up by a hash of its arguments.
            futures = [client.submit(fn, block, pure=False) for block in blocks]
            index_of = {future.key: index for index, future in enumerate(futures)}
            for future in as_completed(futures):
                yield index_of[future.key], future.result()
        finally:
            client.close()
            if cluster is not None:
                cluster.close()


@dataclass(frozen=True)
class Ray:
    """Blocks over a Ray cluster: ``address`` of a head node, or None for one on this machine with ``workers`` processes.

    A cluster that this process is already connected to is used as it is and left running.
    """

    address: str | None = None
    workers: int | None = None

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Every block once, as they finish."""
        try:
            import ray  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise MissingExtraError("ray", "Running on a Ray cluster") from None
        started = not ray.is_initialized()
        if started:
            local = {"num_cpus": self.workers or _cores(), "include_dashboard": False} if self.address is None else {}
            ray.init(address=self.address, log_to_driver=False, logging_level="ERROR", **local)
        try:
            remote = ray.remote(fn)
            index_of = {remote.remote(block): index for index, block in enumerate(blocks)}
            waiting = list(index_of)
            while waiting:
                done, waiting = ray.wait(waiting, num_returns=1)
                for reference in done:
                    yield index_of[reference], ray.get(reference)
        finally:
            if started:
                ray.shutdown()


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
    fn: Callable[[B], R], blocks: Sequence[B], executor: Executor | None = None, progress: Progress | None = None
) -> list[R]:
    """``[fn(block) for block in blocks]`` on an executor (a process pool if None), in the blocks' order.

    ``fn`` and the blocks must pickle; ``fn`` must be pure: an engine may run a block again on another worker.
    """
    chosen = ProcessPool() if executor is None else executor
    results: dict[int, R] = {}
    for index, result in chosen.run(fn, blocks):
        results[index] = result
        if progress is not None:
            progress(len(results), len(blocks))
    return [results[index] for index in range(len(blocks))]


def _windowed(submit: Callable[[B], Future[R]], blocks: Sequence[B], window: int) -> Iterator[tuple[int, R]]:
    """Submit blocks so that at most ``window`` are under way, and yield them as they finish."""
    under_way: dict[Future[R], int] = {}
    next_block = 0
    while next_block < len(blocks) or under_way:
        while next_block < len(blocks) and len(under_way) < window:
            under_way[submit(blocks[next_block])] = next_block
            next_block += 1
        done, _ = wait(under_way, return_when=FIRST_COMPLETED)
        for future in done:
            yield under_way.pop(future), future.result()


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
