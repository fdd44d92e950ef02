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
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from manyeyes.datatypes import ConfigError, ManyeyesError, MissingExtraError

B = TypeVar("B")
R = TypeVar("R")

#: Called after each finished block with (finished, all).
Progress = Callable[[int, int], None]


class WorkerLostError(ManyeyesError):
    """A worker process ended before it returned its result."""


class ExecutorSession(Protocol):
    """An engine that is up: runs a function over blocks and yields (index of the block, result) as they finish."""

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Return every block once, in any order; an exception of the function is raised here."""
        ...


class Executor(Protocol):
    """Where blocks may run; opening it starts the engine, which then serves any number of calls."""

    def open(self) -> AbstractContextManager[ExecutorSession]:
        """Return the engine, up until the context ends."""
        ...


@dataclass(frozen=True)
class InlineExecutor:
    """Run one block after the other in this process: reference of the other executors, and suited to debugging."""

    @contextmanager
    def open(self) -> Iterator[ExecutorSession]:
        """Return this executor, which needs no engine."""
        yield self

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Yield every block once, in order."""
        for index, block in enumerate(blocks):
            yield index, fn(block)


@dataclass(frozen=True)
class ProcessExecutor:
    """Blocks over processes of this machine; ``workers`` None: one a core.

    Workers are never forks of this process, whose threads of numba or torch would hang them: they are forked from a clean
    server that has imported this package once, or started afresh where the system has no such server.
    A script that calls this needs the usual ``if __name__ == "__main__":``.
    At most ``queued_per_worker`` blocks a worker wait in the queue, so that large blocks are not all pickled at once.
    """

    workers: int | None = None
    queued_per_worker: int = 2

    @contextmanager
    def open(self) -> Iterator[ExecutorSession]:
        """Start the pool; it ends with the context, at once if that ends with an exception."""
        clean = "forkserver" in multiprocessing.get_all_start_methods()
        context = multiprocessing.get_context("forkserver" if clean else "spawn")
        if clean:
            context.set_forkserver_preload([__name__])
        workers = self.workers or _available_cores()
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            try:
                yield _ProcessSession(pool, workers * (1 + self.queued_per_worker))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


@dataclass(frozen=True)
class _ProcessSession:
    """A process pool that is up, with the number of blocks that may be under way."""

    pool: ProcessPoolExecutor
    max_in_flight: int

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Yield every block once, as they finish."""
        in_flight: dict[Future[R], int] = {}
        next_block = 0
        while next_block < len(blocks) or in_flight:
            while next_block < len(blocks) and len(in_flight) < self.max_in_flight:
                in_flight[self.pool.submit(fn, blocks[next_block])] = next_block
                next_block += 1
            done, _ = wait(in_flight, return_when=FIRST_COMPLETED)
            for future in done:
                try:
                    result = future.result()
                except BrokenProcessPool as error:
                    raise WorkerLostError(
                        "A worker process ended, probably out of memory; run again with fewer --workers: finished steps are kept."
                    ) from error
                yield in_flight.pop(future), result


@dataclass(frozen=True)
class DaskExecutor:
    """Blocks over a Dask cluster: ``address`` of a scheduler, or None for one on this machine with ``workers`` processes."""

    address: str | None = None
    workers: int | None = None

    @contextmanager
    def open(self) -> Iterator[ExecutorSession]:
        """Connect, or start a cluster that ends with the context."""
        try:
            from dask.distributed import Client, LocalCluster
        except ImportError:
            raise MissingExtraError("dask", "Running on a Dask cluster") from None
        if self.address is not None:
            with Client(self.address) as client:
                yield _DaskSession(client)
            return
        local: dict[str, Any] = {"n_workers": self.workers or _available_cores(), "dashboard_address": None}
        with LocalCluster(processes=True, threads_per_worker=1, **local) as cluster, Client(cluster) as client:
            yield _DaskSession(client)


@dataclass(frozen=True)
class _DaskSession:
    """A connection to a Dask scheduler."""

    client: Any

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Yield every block once, as they finish."""
        from dask.distributed import as_completed

        # pure=False: a block is run, never looked up by a hash of its arguments.
        futures = [self.client.submit(fn, block, pure=False) for block in blocks]
        index_of = {future.key: index for index, future in enumerate(futures)}
        for future in as_completed(futures):
            yield index_of[future.key], future.result()


@dataclass(frozen=True)
class RayExecutor:
    """Blocks over a Ray cluster: ``address`` of a head node, or None for one on this machine with ``workers`` processes.

    A cluster that this process is already connected to is used as it is and left running.
    """

    address: str | None = None
    workers: int | None = None

    @contextmanager
    def open(self) -> Iterator[ExecutorSession]:
        """Connect, or start a cluster that ends with the context."""
        try:
            import ray  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise MissingExtraError("ray", "Running on a Ray cluster") from None
        started = not ray.is_initialized()
        if started:
            local = (
                {"num_cpus": self.workers or _available_cores(), "include_dashboard": False}
                if self.address is None
                else {}
            )
            ray.init(address=self.address, log_to_driver=False, logging_level=logging.ERROR, **local)
        try:
            yield _RaySession(ray)
        finally:
            if started:
                ray.shutdown()


@dataclass(frozen=True)
class _RaySession:
    """The ray module, connected."""

    ray: Any

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        """Yield every block once, as they finish."""
        remote = self.ray.remote(fn)
        index_of = {remote.remote(block): index for index, block in enumerate(blocks)}
        waiting = list(index_of)
        while waiting:
            done, waiting = self.ray.wait(waiting, num_returns=1)
            for reference in done:
                yield index_of[reference], self.ray.get(reference)


EXECUTORS: tuple[str, ...] = ("inline", "process", "dask", "ray")


def make_executor(name: str, workers: int | None = None, address: str | None = None) -> Executor:
    """Return the executor of a name from the command line: one of ``EXECUTORS``."""
    if name == "inline":
        return InlineExecutor()
    if name == "process":
        return ProcessExecutor(workers)
    if name == "dask":
        return DaskExecutor(address, workers)
    if name == "ray":
        return RayExecutor(address, workers)
    raise ConfigError(f"No executor '{name}'; choose one of {', '.join(EXECUTORS)}.")


def map_blocks(
    fn: Callable[[B], R], blocks: Sequence[B], session: ExecutorSession | None = None, progress: Progress | None = None
) -> list[R]:
    """``[fn(block) for block in blocks]`` on an engine that is up (a process pool for this call if None), in the blocks' order.

    ``fn`` and the blocks must pickle; ``fn`` must be pure: an engine may run a block again on another worker.
    """
    if session is None:
        with ProcessExecutor(min(_available_cores(), max(len(blocks), 1))).open() as pool:
            return map_blocks(fn, blocks, pool, progress)
    results: dict[int, R] = {}
    for index, result in session.run(fn, blocks):
        results[index] = result
        if progress is not None:
            progress(len(results), len(blocks))
    return [results[index] for index in range(len(blocks))]


def _available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
