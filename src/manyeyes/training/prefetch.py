# SPDX-License-Identifier: Apache-2.0
"""Draw the samples of a run ahead of its steps, in processes; drawn by number, they are the same in any process."""

from __future__ import annotations

import pickle
import signal
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

Sample = TypeVar("Sample")

SAMPLES_AHEAD = 2
"""Samples that each worker holds ready at most."""


class _Drawn(Dataset[bytes], Generic[Sample]):
    """Samples by number, pickled: as tensors, each of their many parts would be an open file and shared memory."""

    def __init__(self, draw: Callable[[int], Sample]) -> None:
        self._draw = draw

    def __getitem__(self, number: int) -> bytes:
        try:
            return pickle.dumps(self._draw(number), pickle.HIGHEST_PROTOCOL)
        except Exception as error:
            # The loader would wrap the text of an error in a traceback.
            return pickle.dumps(_Failure(error))


class _Failure:
    """An error of a worker, raised where its sample is due."""

    def __init__(self, error: Exception) -> None:
        self.error = error


def _keep(sample: Any) -> Any:
    return sample


def _leave_signals(worker: int) -> None:
    """Leave signals to the process of the run: it finishes its step, and ends its workers."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def prefetch(draw: Callable[[int], Sample], numbers: Iterable[int], workers: int) -> Generator[Callable[[int], Sample]]:
    """Yield a function that returns the samples of these numbers, called in their order; without workers, draw itself.

    Workers are forks of this process and end with the block. An error of draw is raised where its sample is due.
    """
    if not workers:
        yield draw
        return
    loader: DataLoader[Any] = DataLoader(
        _Drawn(draw),
        batch_size=None,
        sampler=numbers,
        num_workers=workers,
        prefetch_factor=SAMPLES_AHEAD,
        collate_fn=_keep,
        worker_init_fn=_leave_signals,
        multiprocessing_context="fork",
        # A generator of its own: that of torch is the model's.
        generator=torch.Generator(device="cpu"),
    )
    samples = iter(loader)

    def take(number: int) -> Sample:
        sample = pickle.loads(next(samples))
        if isinstance(sample, _Failure):
            raise sample.error
        return sample

    try:
        yield take
    finally:
        samples._shutdown_workers()  # pyright: ignore[reportAttributeAccessIssue]
