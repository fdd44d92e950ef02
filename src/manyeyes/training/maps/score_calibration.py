# SPDX-License-Identifier: Apache-2.0
"""Calibrate the scores of a map model after training to the fraction of an element that is correct and not a
duplicate.

Map fusion (maps/fusion/existence.py) uses scores of several models as probabilities, which training does not provide. A repeated
line carries no new information. Source: Platt, "Probabilistic outputs for support vector machines", 1999: a linear function of the
logits, here per class.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datatypes.map_element import CROSSING, KINDS, MapElements
from manyeyes.models.maps.head import decode_elements
from manyeyes.models.maps.map_model import MapModel
from manyeyes.ops.polyline import close_rings, resample_spaced
from manyeyes.training.maps.samples import MapSample
from manyeyes.training.maps.step import extract_features, warp_tokens

MATCH_RADIUS_M, SPACING_M = 1.0, 0.5
"""Maximum distance to a ground truth element of the same class, and spacing of the sampled points."""
PRIOR_WEIGHT = 3.0
"""Weight of the identity in the fit, as a number of elements."""
MIN_SLOPE = 0.1
"""Minimum slope: calibration never changes the ranking within a class."""


@torch.no_grad()
def calibrate_scores(model: MapModel, samples: Iterable[MapSample]) -> None:
    """Set logit_scale and logit_shift of the model from its predictions on the samples."""
    config, was = model.config, model.training
    model.eval()
    model.logit_scale.fill_(1.0)
    model.logit_shift.fill_(0.0)
    results: list[tuple[MapElements, NDArray[np.float64]]] = []
    for sample in samples:
        ground = model.fuse_features(*warp_tokens(model, extract_features(model, [sample]).tokens, [sample]))
        drawn = decode_elements(model.predict_elements(ground)[-1], config.tile, config.head)[0]
        results.append((drawn, novel_fraction(drawn, sample.truth)))
    for row, kind in enumerate(config.head.kinds):
        own = [(drawn.kind == KINDS.index(kind), drawn, share) for drawn, share in results]
        score = np.concatenate([drawn.score[which] for which, drawn, _ in own] or [np.zeros(0)])
        share = np.concatenate([share[which] for which, _, share in own] or [np.zeros(0)])
        scale, shift = fit_platt(torch.logit(torch.from_numpy(score), 1e-6), torch.from_numpy(share))
        model.logit_scale[row], model.logit_shift[row] = scale, shift
    model.train(was)


def novel_fraction(drawn: MapElements, truth: MapElements) -> NDArray[np.float64]:
    """Return the fraction (N,) of each element's length that is correct and not covered by an element before it.

    drawn: predictions in descending order of score. Correct is within MATCH_RADIUS_M of a ground truth element of the
    same class.
    """
    out = np.zeros(len(drawn))
    for kind in np.unique(drawn.kind):
        rows = np.flatnonzero(drawn.kind == kind)
        mine, first = _points(drawn.take(rows))
        theirs, _ = _points(truth.take(truth.kind == kind))
        if not len(theirs):
            continue
        points = torch.from_numpy(mine)
        news = torch.cdist(points, torch.from_numpy(theirs)).amin(1) <= MATCH_RADIUS_M
        owner = torch.from_numpy(np.repeat(np.arange(len(rows)), np.diff(first)))
        is_duplicate = (torch.cdist(points, points) <= MATCH_RADIUS_M) & (owner[None] < owner[:, None])
        news &= ~is_duplicate.any(1)
        out[rows] = np.add.reduceat(news.numpy().astype(np.float64), first[:-1]) / np.diff(first)
    return out


def fit_platt(logit: Tensor, fraction: Tensor) -> tuple[float, float]:
    """Fit scale and shift of logits (N,) by cross entropy against fractions (N,), regularised towards the identity."""
    start = torch.tensor([1.0, 0.0], dtype=torch.float64, device="cpu")
    x = torch.stack((logit.double(), torch.ones_like(logit, dtype=torch.float64)), 1)
    line = start.clone()
    for _ in range(50):
        p = (x @ line).sigmoid()
        gradient = x.T @ (p - fraction) + PRIOR_WEIGHT * (line - start)
        hessian = (x * (p * (1 - p))[:, None]).T @ x + PRIOR_WEIGHT * torch.eye(2, dtype=torch.float64, device="cpu")
        line = line - torch.linalg.solve(hessian, gradient).clamp(-1.0, 1.0)
    return max(MIN_SLOPE, float(line[0])), float(line[1])


def _points(elements: MapElements) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    points, first = close_rings(elements.points, elements.offsets, elements.kind == CROSSING)
    return resample_spaced(points, first, SPACING_M)
