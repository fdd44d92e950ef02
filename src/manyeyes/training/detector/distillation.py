# SPDX-License-Identifier: Apache-2.0
"""DiscoNet's distillation (Li et al., NeurIPS 2021): fused features from those of a frozen teacher on merged clouds.

The teacher is the single-agent network of the initial weights, whose training has merged clouds too. Its cloud is that of the views
that are neither delayed nor displaced. Only cells that student and teacher both have count. The paper distils decoder layers too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.datatypes import PointCloud, SparseBev
from manyeyes.models.detector.detector import Detector
from manyeyes.training.detector.samples import AgentView, Sample


def teacher_features(teacher: Detector, samples: Sequence[Sample], prune_threshold: float | None = None) -> SparseBev:
    """Return the teacher's features (N, C) of the merged cloud of each sample, one grid a sample, without gradient."""
    clouds = [_merge(sample, lambda view: view.cloud) for sample in samples]
    previous = [_merge(sample, lambda view: view.previous_cloud) for sample in samples]
    with torch.no_grad():
        return teacher.extract_features(clouds, previous, prune_threshold).tokens


def _merge(sample: Sample, cloud_of: Callable[[AgentView], PointCloud]) -> PointCloud:
    """Return one cloud of each view that is of the present and in place, in the frame of the ego."""
    own, *others = sample.views
    parts = [cloud_of(own)]
    for view in others:
        if not (view.age_s or view.sigma_xy_m or view.sigma_yaw_rad):
            parts.append(cloud_of(view).transform(view.ego_from_view))
    return PointCloud.cat(parts)


def distillation_loss(student: SparseBev, teacher: SparseBev) -> Tensor:
    """Return KL(softmax(teacher) || softmax(student)) over the channels, the mean over common cells; 0 without any."""
    keys, mine = teacher.sites.key, student.sites.key
    at = torch.searchsorted(keys, mine).clamp_max(max(len(keys) - 1, 0))
    common = (keys[at] == mine).nonzero()[:, 0] if len(keys) else mine.new_zeros(0)
    if not len(common):
        return student.features.sum() * 0
    expected = teacher.features.detach().index_select(0, at[common]).softmax(1)
    found = student.features.index_select(0, common).log_softmax(1)
    return functional.kl_div(found, expected, reduction="batchmean")
