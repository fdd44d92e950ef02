# SPDX-License-Identifier: Apache-2.0
"""H7: the smallest preset learns one frame of two agents by heart."""

import pytest
import torch

from manyeyes.evaluation.detection.average_precision import PROTOCOLS, FrameResult, average_precision
from manyeyes.models.detector.box_head import DecodeConfig, decode
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.training.detector.samples import AugmentConfig
from manyeyes.training.detector.step import forward
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.trainer import Trainer

pytestmark = pytest.mark.training


def test_one_frame_can_be_overfitted(toy, tmp_path):
    recording = toy(agents_n=2, scenarios=("toy_0",), frames=1, ground_points=100)
    schedule = {"steps": 200, "batch": 1, "learning_rate": 6e-3, "warmup_steps": 10, "ema_decay": 0.9}
    config = DetectorTrainConfig(COSTR_TINY, augment=AugmentConfig.none(), **schedule)
    run = Trainer(DetectorTask(config, recording), tmp_path)
    losses = [run.advance() for _ in range(config.steps)]
    heats = [progress.terms["heat"] for progress in (losses[0], losses[-1])]
    assert heats[1] < 0.01 * heats[0]
    sample = run.task.draw(0)
    with torch.no_grad():
        # At this rate of learning the running statistics lag behind the weights by some tens of steps: let them catch up.
        for _ in range(100):
            forward(run.average.train(), [sample])
        outcome = forward(run.average.eval(), [sample])
    together = decode(outcome.fused_boxes, DecodeConfig())[0]
    frame = FrameResult("toy_0", 0, together, sample.merged_gt_boxes)
    for iou in (0.5, 0.7):
        assert average_precision([frame], iou, PROTOCOLS["global-sort"]).ap == 1.0
    best = together[:6]
    nearest = torch.cdist(best.center[:, :2], sample.merged_gt_boxes.center[:, :2].float()).argmin(1)
    truth = sample.merged_gt_boxes[nearest]
    assert sorted(nearest.tolist()) == [*range(6)]
    assert float(best.score.min()) > 0.3 and not (together.score[6:] > 0.5 * best.score.min()).any()
    # The heading too, and not only the axis, is right where p_flip is low; it is low for most boxes.
    sure = best.p_flip < 0.3
    assert int(sure.sum()) >= 4 and bool(((best.yaw - truth.yaw.float()).cos()[sure] > 0.95).all())
    error = (best.center[:, :2] - truth.center[:, :2].float()).norm(dim=1)
    assert float(error.max()) < 0.6 and float(best.sigma_xy.max()) < 0.5
