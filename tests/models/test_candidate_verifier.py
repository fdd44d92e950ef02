# SPDX-License-Identifier: Apache-2.0
"""The learned verification: masks, standardised features, and its file."""

from __future__ import annotations

from pathlib import Path

import torch

from manyeyes.models import checkpoint
from manyeyes.models.pose.candidate_verifier import (
    FORMAT,
    MASKED_LOGIT,
    NUM_FEATURES,
    CandidateVerifier,
    CandidateVerifierConfig,
    load,
)


def test_candidates_that_do_not_exist_are_masked_and_the_others_are_judged_alone() -> None:
    torch.manual_seed(1)
    net = CandidateVerifier(CandidateVerifierConfig(hidden=8)).eval()
    features, exists = torch.randn(2, 3, NUM_FEATURES), torch.tensor([[True, True, False], [True, False, False]])
    odds = net(features, exists)
    assert (odds[~exists] == MASKED_LOGIT).all() and odds[exists].abs().max() < 100
    torch.testing.assert_close(net(features[:1, :1], exists[:1, :1])[0, 0], odds[0, 0])


def test_the_unit_of_a_feature_does_not_matter_once_it_is_standardised() -> None:
    torch.manual_seed(1)
    net = CandidateVerifier(CandidateVerifierConfig(hidden=8)).eval()
    features, exists = torch.randn(50, NUM_FEATURES), torch.ones(50, dtype=torch.bool)
    net.standardise(features)
    odds = net(features, exists)
    changed = features * torch.linspace(0.5, 9.0, NUM_FEATURES) + 3.0
    assert (net(changed, exists) - odds).abs().max() > 1e-3
    net.standardise(changed)
    torch.testing.assert_close(net(changed, exists), odds, atol=1e-4, rtol=1e-4)


def test_outliers_are_bounded() -> None:
    net = CandidateVerifier(CandidateVerifierConfig(hidden=8)).eval()
    exists = torch.ones(1, dtype=torch.bool)
    far, farther = (net(torch.full((1, NUM_FEATURES), value), exists) for value in (1e3, 1e9))
    assert torch.equal(far, farther)


def test_the_file_holds_the_configuration_and_the_standardisation(tmp_path: Path) -> None:
    net = CandidateVerifier(CandidateVerifierConfig(hidden=8)).eval()
    net.standardise(5.0 + 2.0 * torch.randn(100, NUM_FEATURES))
    checkpoint.save(net, tmp_path / "net.safetensors", {}, half=False, format=FORMAT)
    loaded = load(tmp_path / "net.safetensors")
    assert loaded.config == net.config and not loaded.training
    torch.testing.assert_close(loaded.mean, net.mean)
