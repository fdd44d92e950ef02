# SPDX-License-Identifier: Apache-2.0
"""One function over many blocks: in this process, over a pool of processes, or on a Dask or Ray cluster.

Blocks are taken from an iterable as workers become free: a few for each worker are under way, whatever their number.

Source: the requirement that a block is a pure function's argument, so that any existing engine runs it and the results do not
depend on which one did, in which order, or on how many workers.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import logging
import multiprocessing
import os
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
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

    def run(self, fn: Callable[[B], R], blocks: Iterable[B]) -> Iterator[tuple[int, R]]:
        """Return every block once, in any order; an exception of the function is raised here."""
        ...


BLOCKS_PER_WORKER = 3
"""Blocks under way for each worker: one that runs and two that wait, so that no worker waits for this process."""


def _run_bounded(
    submit: Callable[[B], Hashable],
    wait_for_some: Callable[[list[Any]], Iterable[tuple[Any, R]]],
    blocks: Iterable[B],
    max_in_flight: int,
) -> Iterator[tuple[int, R]]:
    """Yield (index, result) of every block once, as they finish, with at most so many under way.

    Args:
        submit: starts a block and returns its handle. wait_for_some: waits until any of the handles has finished, and returns those
            that have, with their results.
    """
    in_flight: dict[Any, int] = {}
    waiting = enumerate(blocks)
    while True:
        for index, block in itertools.islice(waiting, max_in_flight - len(in_flight)):
            in_flight[submit(block)] = index
        if not in_flight:
            return
        for handle, result in wait_for_some(list(in_flight)):
            yield in_flight.pop(handle), result


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

    def run(self, fn: Callable[[B], R], blocks: Iterable[B]) -> Iterator[tuple[int, R]]:
        """Yield every block once, in order."""
        for index, block in enumerate(blocks):
            yield index, fn(block)


@dataclass(frozen=True)
class ProcessExecutor:
    """Blocks over processes of this machine; ``workers`` None: one a core.

    Workers are never forks of this process, whose threads of numba or torch would hang them: they are forked from a clean
    server that has imported this package once, or started afresh where the system has no such server.
    A script that calls this needs the usual ``if __name__ == "__main__":``.
    """

    workers: int | None = None

    @contextmanager
    def open(self) -> Iterator[ExecutorSession]:
        """Start the pool; it ends with the context, at once if that ends with an exception."""
        clean = "forkserver" in multiprocessing.get_all_start_methods()
        context = multiprocessing.get_context("forkserver" if clean else "spawn")
        if clean:
            context.set_forkserver_preload([__name__])
        workers = self.workers or _available_cores()
        with ProcessPoolExecutor(workers, mp_context=context, initializer=_keep_freed_memory) as pool:
            try:
                yield _ProcessSession(pool, workers * BLOCKS_PER_WORKER)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


@dataclass(frozen=True)
class _ProcessSession:
    """A process pool that is up, with the number of blocks that may be under way."""

    pool: ProcessPoolExecutor
    max_in_flight: int

    def run(self, fn: Callable[[B], R], blocks: Iterable[B]) -> Iterator[tuple[int, R]]:
        """Yield every block once, as they finish."""
        return _run_bounded(partial(self.pool.submit, fn), self._wait, blocks, self.max_in_flight)

    def _wait(self, handles: list[Any]) -> Iterator[tuple[Any, Any]]:
        for future in wait(handles, return_when=FIRST_COMPLETED).done:
            try:
                yield future, future.result()
            except BrokenProcessPool as error:
                raise WorkerLostError(
                    "A worker process ended, probably out of memory; run again with fewer --workers: finished steps are kept."
                ) from error


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

    def run(self, fn: Callable[[B], R], blocks: Iterable[B]) -> Iterator[tuple[int, R]]:
        """Yield every block once, as they finish."""
        workers = max(1, sum(self.client.nthreads().values()))
        # pure=False: a block is run, never looked up by a hash of its arguments.
        submit = partial(self.client.submit, fn, pure=False)
        return _run_bounded(submit, self._wait, blocks, workers * BLOCKS_PER_WORKER)

    @staticmethod
    def _wait(handles: list[Any]) -> Iterator[tuple[Any, Any]]:
        from dask.distributed import wait as wait_for

        finished: Any = wait_for(handles, return_when="FIRST_COMPLETED")
        for future in finished.done:
            yield future, future.result()


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

    def run(self, fn: Callable[[B], R], blocks: Iterable[B]) -> Iterator[tuple[int, R]]:
        """Yield every block once, as they finish."""
        workers = max(1, int(self.ray.cluster_resources().get("CPU", 1)))
        return _run_bounded(self.ray.remote(fn).remote, self._wait, blocks, workers * BLOCKS_PER_WORKER)

    def _wait(self, handles: list[Any]) -> Iterator[tuple[Any, Any]]:
        done, _ = self.ray.wait(handles, num_returns=1)
        for reference in done:
            yield reference, self.ray.get(reference)


EXECUTORS: tuple[str, ...] = ("inline", "process", "dask", "ray")


def make_executor(name: str, workers: int | None = None, address: str | None = None) -> Executor:
    """Return the executor of a name from the command line: one of ``EXECUTORS``."""
    if address is not None and name in ("inline", "process"):
        raise ConfigError(
            f"The executor '{name}' runs on this machine and has no address; choose dask or ray for {address}."
        )
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


_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of glibc's malloc.h


def _keep_freed_memory() -> None:
    """Keep freed memory in this process, where its C library is glibc.

    Otherwise each large array is given back to the system, which clears the pages of the next one again.
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):
        set_option = ctypes.CDLL(None).mallopt
        set_option(_M_MMAP_MAX, 0)
        set_option(_M_TRIM_THRESHOLD, 2**31 - 1)


def _available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
