# SPDX-License-Identifier: Apache-2.0
"""How often a training step calls an operator, and how often the host waits for the device: what limits a step on a GPU."""

from dataclasses import replace

import pytest
from tests.emulated_device import DEVICE, emulate

from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.presets import TRAINING_PRESETS
from manyeyes.training.trainer import Trainer

MAX_CALLS, MAX_SYNCS = 6000, 60
"""Of one step of costr-opv2v. They were 21,514 and 1,155 with a loop over cells and one call a tap: never raise them."""


@pytest.mark.slow
@pytest.mark.training
def test_a_step_of_costr_opv2v_makes_few_calls_and_waits_rarely(toy, tmp_path):
    config = TRAINING_PRESETS["costr-opv2v"]
    assert isinstance(config, DetectorTrainConfig)
    config = replace(config, prune_warmup_start=-1.0, prune_warmup_end=-0.5, steps=100)
    recording = toy(agents_n=5, frames=6, cars=12, radius_m=30.0, points_per_car=40, ground_points=200)
    with emulate() as record:
        trainer = Trainer(DetectorTask(config, recording, 0), tmp_path, DEVICE)
        views = sum(len(trainer.task.draw(number).views) for number in range(config.batch))
        trainer._advance()
        assert views > 15 and config.batch == 4
        for counts in (record.calls, record.syncs, record.uploads):
            counts.clear()
        trainer._advance()
    # The backward pass, our own autograd functions and the optimiser are among the calls.
    names = {name for _, name in record.calls}
    assert {"native_batch_norm_backward", "_fused_adamw_", "_foreach_lerp_", "_foreach_mul_"} <= names
    assert any(place.startswith("ops/gathered_conv.py") for place, _ in record.calls)
    assert 3000 < record.num_calls <= MAX_CALLS, record.report()
    assert 10 < record.num_syncs <= MAX_SYNCS, record.report()
