# SPDX-License-Identifier: Apache-2.0
"""Inference on a device beside the CPU: clouds and tokens of the CPU in, equal boxes and tokens of the CPU out."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import PointCloud, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.box_head import decode
from manyeyes.models.detector.codebook import CodebookConfig
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.fold_norms import fold_norms
from manyeyes.models.detector.presets import COSTR_OPV2V, COSTR_SMALL, COSTR_TINY
from manyeyes.models.fusion.transform_tokens import AgentTokens, to_ego_frame

FOREIGN = Transform.from_xyz_yaw(3.0, -2.0, 0.1, 0.4)


def make_cloud(seed: int) -> PointCloud:
    generator = torch.Generator().manual_seed(seed)
    xyz = (torch.rand(2000, 3, generator=generator) - 0.5) * torch.tensor([40.0, 40.0, 3.0])
    return PointCloud.of(xyz, torch.rand(2000, generator=generator))


def make_twins(config, device) -> tuple[Detector, Detector]:
    """The same detector on the CPU, folded as it is deployed, and on the device."""
    torch.manual_seed(5)  # of which each of the configurations keeps hundreds of cells
    model = Detector(replace(config, prune_threshold=0.05)).eval().requires_grad_(False)
    model.fingerprint = checkpoint.fingerprint(model)
    ours, theirs = fold_norms(model), fold_norms(model).to(device)
    assert theirs.device == device and ours.device.type == "cpu"
    assert checkpoint.fingerprint(model.to(device)) == ours.fingerprint
    return ours, theirs


@pytest.mark.parametrize(
    ("config", "tolerance"),
    [
        (COSTR_TINY, 5e-6),
        pytest.param(COSTR_SMALL, 5e-6, marks=pytest.mark.slow),
        pytest.param(COSTR_OPV2V, 1e-4, marks=pytest.mark.slow),
    ],
)
def test_clouds_and_tokens_enter_and_boxes_and_tokens_leave_on_the_cpu(device, config, tolerance):
    """Results agree to a tolerance, relative to the largest number of each: some tens of float32's rounding.

    Measured under emulation: at most 2e-6 of costr-tiny and costr-small. Untrained features of costr-opv2v grow to 1,300 through
    its layers, so that softmax and proposals have large arguments, which amplify rounding: 3e-5.
    """
    ours, theirs = make_twins(config, device)
    results, boxes, detected = [], [], []
    with torch.inference_mode():
        for model in (ours, theirs):
            own, raw = model.extract_tokens(make_cloud(0), make_cloud(1))
            sent, _ = model.extract_tokens(make_cloud(2), make_cloud(3))
            score = model.score_tokens(sent)
            parts = [
                AgentTokens(0, own.features, own.sites.xy),
                AgentTokens(0, sent.features, sent.sites.xy, FOREIGN, 0.1),
            ]
            past = to_ego_frame(parts[1:], own.grid, 1)
            fused, refined = model.fuse(to_ego_frame(parts, own.grid, 1), past)
            boxes.append(decode(refined, replace(config.decode, score_threshold=0.0))[0])
            detected.append(model.detect(make_cloud(0), make_cloud(1)))
            values = own.features, own.sites.key, raw.to_rows(), score, fused.bev.features, fused.merged_proposals
            results.append((*values, refined.to_rows()))
    assert len(results[0][0]) > 100
    for mine, its in zip(*results, strict=True):
        assert its.device.type == "cpu" and type(its) is torch.Tensor and mine.shape == its.shape
        bound = tolerance * float(mine.abs().max()) if mine.is_floating_point() else 0.0
        assert float((mine - its).abs().max()) <= bound
    for mine, its in (boxes, detected):
        # Random weights score many boxes alike, so that rounding may change their order, and which one suppresses the other.
        assert type(its.center) is torch.Tensor and its.label.device.type == "cpu" and len(mine) == len(its) > 10
        away = torch.cdist(mine.center, its.center, compute_mode="donot_use_mm_for_euclid_dist").amin(1)
        assert float((away < 1e-3).float().mean()) > 0.9


def test_codes_of_tokens_are_equal_and_stay_on_the_cpu(device):
    ours, theirs = make_twins(replace(COSTR_TINY, codebook=CodebookConfig(2, 16)), device)
    for model in (ours, theirs):
        assert model.codebook is not None
        drawn = torch.randn(model.codebook.centres.shape, generator=torch.Generator().manual_seed(0))
        model.codebook.centres.copy_(drawn)
    assert ours.codebook is not None and theirs.codebook is not None
    tokens = torch.randn(50, ours.token_channels, generator=torch.Generator().manual_seed(1))
    codes = theirs.codebook.encode(tokens)
    assert codes.device.type == "cpu" and torch.equal(codes, ours.codebook.encode(tokens))
    assert torch.equal(theirs.codebook.decode(codes), ours.codebook.decode(codes))
