# SPDX-License-Identifier: Apache-2.0
"""Scalars and pictures of a run for TensorBoard, in a folder beside its log; a resumed run replaces the steps after its state."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from manyeyes.datatypes.extras import import_extra
from manyeyes.training.monitor import Monitor, Progress
from manyeyes.viz.loss_curve import save_loss_curve

if TYPE_CHECKING:
    from PIL.Image import Image

FOLDER = "tensorboard"
EXTRA = "train"
STEPS_PER_RATE = 10
"""Minimum number of steps over which steps per second are measured."""


class TensorBoardMonitor(Monitor):
    """Writes events to a folder of a run.

    Scalars: loss/total and loss/TERM, learning_rate and steps_per_second (of the wall clock, without steps that validate), and
    validation/MEASURE. Pictures, after a validation: loss, the curves of log.jsonl, and frame/NAME, what the task draws.

    folder: of the run. step: of the state that the run goes on from; events of later steps are dropped by TensorBoard.
    """

    def __init__(self, folder: Path, step: int = 0) -> None:
        module = import_extra("torch.utils.tensorboard", EXTRA, "--tensorboard")
        self._folder = folder
        self._writer = module.SummaryWriter(str(folder / FOLDER), purge_step=step + 1)
        self._rated: tuple[int, float] | None = None  # step and time from which the rate is measured

    @property
    def draws(self) -> bool:
        """Whether pictures are wanted."""
        return True

    def record(self, progress: Progress) -> None:
        """Write the scalars of a step, and the curves of the loss where it was validated."""
        step = progress.step
        self._write_scalars("loss", {"total": progress.loss, **progress.terms}, step)
        self._writer.add_scalar("learning_rate", progress.learning_rate, step)
        self._write_scalars("validation", progress.validation, step)
        self._write_rate(progress)
        if progress.validation:
            path = self._folder / "loss.png"
            save_loss_curve(self._folder / "log.jsonl", path)
            self._write_picture("loss", _read_png(path), step)
        # So that a state that is saved next has its events, also where the run is killed.
        self._writer.flush()

    def show(self, step: int, pictures: dict[str, Image]) -> None:
        """Write pictures of the weights after a step."""
        for name, picture in pictures.items():
            self._write_picture(f"frame/{name}", np.asarray(picture.convert("RGB")), step)

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()

    def _write_scalars(self, group: str, values: dict[str, float], step: int) -> None:
        for name, value in values.items():
            self._writer.add_scalar(f"{group}/{name}", value, step)

    def _write_rate(self, progress: Progress) -> None:
        now = time.monotonic()
        if self._rated is None or progress.validation:
            self._rated = progress.step, now
            return
        steps, seconds = progress.step - self._rated[0], now - self._rated[1]
        if steps >= STEPS_PER_RATE:
            self._writer.add_scalar("steps_per_second", steps / max(seconds, 1e-9), progress.step)
            self._rated = progress.step, now

    def _write_picture(self, tag: str, picture: np.ndarray, step: int) -> None:
        self._writer.add_image(tag, picture, step, dataformats="HWC")


@contextmanager
def open_tensorboard(folder: Path, step: int) -> Iterator[TensorBoardMonitor]:
    """Yield a monitor of a run, closed with the block."""
    monitor = TensorBoardMonitor(folder, step)
    try:
        yield monitor
    finally:
        monitor.close()


def _read_png(path: Path) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 of a file."""
    with import_extra("PIL.Image", EXTRA, "--tensorboard").open(path) as picture:
        return np.asarray(picture.convert("RGB"))
