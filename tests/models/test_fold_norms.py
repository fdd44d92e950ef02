# SPDX-License-Identifier: Apache-2.0
"""A folded detector gives equal outputs, leaves the original unchanged, and has no batch norm in its convolutions."""

from dataclasses import replace

import pytest
import torch

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datatypes import PointCloud
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.fold_norms import fold_norms
from manyeyes.models.detector.layers import ActiveNorm
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.ops._sparse_conv_kernels import HAS_BFLOAT16


def _model(head_stride: int) -> tuple[Detector, PointCloud]:
    torch.manual_seed(3)
    encoder = replace(COSTR_TINY.encoder, head_stride=head_stride, token_channels=16)
    model = Detector(replace(COSTR_TINY, encoder=encoder, prune_threshold=0.0))
    xyz = torch.rand(3000, 3) * torch.tensor([50.0, 50.0, 4.0]) - torch.tensor([25.0, 25.0, 2.0])
    cloud = PointCloud.of(xyz, torch.rand(3000))
    model.train()
    with torch.no_grad():
        for norm in (m for m in model.modules() if isinstance(m, ActiveNorm)):
            norm.momentum = 0.5
            norm.weight.uniform_(0.5, 1.5)
            norm.bias.uniform_(-0.5, 0.5)
        model.extract_features([cloud])
    return model.eval(), cloud


@pytest.mark.parametrize("head_stride", [2, 4, 8])
def test_folded_copy_gives_same_outputs(head_stride: int) -> None:
    model, cloud = _model(head_stride)
    before = {k: v.clone() for k, v in model.state_dict().items()}
    ours, theirs = PerceptionCache(fold_norms(model)).run_detector(cloud), PerceptionCache(model).run_detector(cloud)
    assert torch.equal(ours.shared_tokens.sites.key, theirs.shared_tokens.sites.key)
    scale = theirs.shared_tokens.features.abs().max()
    assert scale > 0.1
    assert torch.allclose(
        ours.shared_tokens.features, theirs.shared_tokens.features, atol=1e-5 * float(scale.clamp_min(1))
    )
    assert torch.allclose(ours.raw.heatmap_logit, theirs.raw.heatmap_logit, atol=1e-5)
    after = model.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(after[k], v) for k, v in before.items())


def test_no_norm_is_left_in_the_encoder_and_the_head_keeps_its_own() -> None:
    model, _ = _model(4)
    copied = fold_norms(model)
    assert not [m for m in copied.encoder.modules() if isinstance(m, ActiveNorm)]
    assert [m for m in model.encoder.modules() if isinstance(m, ActiveNorm)]
    assert [m for m in copied.head.modules() if isinstance(m, torch.nn.LayerNorm)]
    assert copied.fingerprint == model.fingerprint
    assert copied.config == model.config


@pytest.mark.skipif(not HAS_BFLOAT16, reason="this processor has no products of bfloat16")
def test_products_of_bfloat16_change_little_and_leave_the_heads_in_float32() -> None:
    model, cloud = _model(4)
    rounded, exact = fold_norms(model, in_bfloat16=True), fold_norms(model)
    with torch.inference_mode():
        ours, theirs = (m.extract_features([cloud], prune_threshold=0.0).tokens for m in (rounded, exact))
    difference = float((ours.features - theirs.features).abs().max())
    assert 1e-4 < difference < 0.1 * float(theirs.features.abs().max())
    for copied, dtype in ((rounded, torch.int32), (exact, torch.float32)):
        assert {layer.folded.weight.dtype for layer in copied.encoder.down} == {dtype}
        assert {layer.folded.weight.dtype for layer in (*copied.head.shared, *copied.refine.shared)} == {torch.float32}
