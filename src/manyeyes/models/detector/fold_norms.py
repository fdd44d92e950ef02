# SPDX-License-Identifier: Apache-2.0
"""Fold normalisation layers with running statistics into the preceding weights, for inference."""

from __future__ import annotations

import copy

from manyeyes.models.detector.codebook import Codebook
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.encoder import SparseEncoder
from manyeyes.models.detector.layers import DownLayer, SubmanifoldLayer, SubmanifoldStage, UpLayer
from manyeyes.models.detector.transformer import WindowBlock
from manyeyes.models.fusion.flow_aware import PastAttention
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.token_merge import TokenMerge

_FOLDED = (
    SparseEncoder,
    SubmanifoldStage,
    SubmanifoldLayer,
    DownLayer,
    UpLayer,
    WindowBlock,
    SpatioTemporalEncoding,
    PastAttention,
    TokenMerge,
    Codebook,
)


def fold_norms(model: Detector, in_bfloat16: bool = False) -> Detector:
    """Copy a detector in evaluation mode, without gradients, with its norms folded into the convolutions.

    Outputs are equal and inference is faster. in_bfloat16: convolutions of the encoder and linear layers of attention blocks
    multiply bfloat16 with float32 sums where the processor has such products; then outputs differ by its rounding. Norms, softmax
    and heads stay in float32. Configuration and fingerprint are kept, so that messages of the original model can be decoded. The
    copy cannot be saved or trained.
    """
    copied = copy.deepcopy(model).eval().requires_grad_(False)
    # Parts before what they are part of.
    for layer in reversed(list(copied.modules())):
        if isinstance(layer, _FOLDED):
            layer.fold(in_bfloat16)
    return copied
