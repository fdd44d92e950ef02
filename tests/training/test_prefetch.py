# SPDX-License-Identifier: Apache-2.0
"""Samples drawn ahead in processes: the same weights, errors where they are due, and no process that outlives the run."""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import RecordingError
from manyeyes.training.detector.task import DetectorTask
from manyeyes.training.prefetch import SAMPLES_AHEAD, prefetch
from manyeyes.training.presets import TRAINING_PRESETS
from manyeyes.training.trainer import Trainer

pytestmark = pytest.mark.training


def make_task(toy, **changes) -> DetectorTask:
    return DetectorTask(replace(TRAINING_PRESETS["costr-tiny"], steps=3, **changes), toy(frames=4), 0)


@pytest.mark.slow
def test_weights_are_the_same_at_any_number_of_workers(toy, tmp_path):
    runs = [Trainer(make_task(toy, micro_batch=1), tmp_path / str(n), workers=n) for n in (0, 1, 3)]
    for run in runs:
        run.run()
        assert not multiprocessing.active_children()
    first, *others = ([*run.model.state_dict().values(), *run.average.state_dict().values()] for run in runs)
    assert all(torch.equal(a, b) for other in others for a, b in zip(first, other, strict=True))


def fail_at_three(number: int) -> int:
    if number == 3:
        raise RecordingError("scene_3: frame 7 is truncated; copy it again.")
    return number * 10


def test_an_error_is_raised_where_its_sample_is_due():
    with prefetch(fail_at_three, range(6), 2) as draw:
        assert [draw(n) for n in range(3)] == [0, 10, 20]
        with pytest.raises(RecordingError, match=r"^scene_3: frame 7 is truncated; copy it again\.$"):
            draw(3)
    assert not multiprocessing.active_children()


def test_samples_ahead_are_bounded(tmp_path):
    def note(number: int) -> int:
        (tmp_path / str(number)).touch()
        return number

    with prefetch(note, range(1000), 1) as draw:
        assert draw(0) == 0
        assert draw(1) == 1
    assert len(list(tmp_path.iterdir())) <= 2 + SAMPLES_AHEAD


def test_an_interrupted_run_ends_its_workers_and_goes_on(toy, tmp_path):
    run = Trainer(make_task(toy), tmp_path, workers=2)

    def interrupt(progress) -> None:
        if progress.step == 1:
            for child in multiprocessing.active_children():
                os.kill(child.pid or 0, signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run.run(report=interrupt)
    assert not multiprocessing.active_children()
    resumed = Trainer(make_task(toy), tmp_path, workers=2)
    assert resumed.step >= 1
    resumed.run()
    assert resumed.step == 3
