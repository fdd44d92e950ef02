# SPDX-License-Identifier: Apache-2.0
"""A detector for inference: what its norms do to every row alike is done to the weights before them, once."""

from __future__ import annotations

import copy

from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.layers import DownLayer, SubmanifoldLayer, SubmanifoldStage, UpLayer
from manyeyes.models.detector.transformer import WindowBlock


def fold_norms(model: Detector) -> Detector:
    """A copy in evaluation mode, without gradients, whose convolutions hold their norms: the same answers, sooner.

    It keeps configuration and fingerprint, so that it understands the messages of the model it was made of; it is not a
    model to save or to train.
    """
    copied = copy.deepcopy(model).eval().requires_grad_(False)
    for layer in copied.modules():
        if isinstance(layer, SubmanifoldStage | SubmanifoldLayer | DownLayer | UpLayer | WindowBlock):
            layer.fold()
    return copied
