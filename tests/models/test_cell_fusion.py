# SPDX-License-Identifier: Apache-2.0
"""Laws of every fusion rule, inside and bare: one agent, order of messages, egos of a batch, gradients, and the detector."""

import dataclasses

import pytest
import torch
from tests.models.fusion_cases import CHANNELS, CONFIG, draw_agent, tokens_of

from manyeyes.datatypes import ConfigError, Sites, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.codebook import CodebookConfig
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.fusion.by_cell import gather_by_cell, standing_cells
from manyeyes.models.fusion.registry import get_fusion, list_fusion_modules
from manyeyes.models.fusion.transform_tokens import AgentTokens, to_ego_frame

BARE = tuple(name for name in list_fusion_modules() if name.endswith("/bare"))
RULES = tuple(name for bare in BARE if (name := bare.removesuffix("/bare")) in list_fusion_modules())
ALL = (*RULES, *BARE)
IDENTITY_ALONE = ("max/bare", "attfuse", "attfuse/bare", "disconet", "disconet/bare")
"""Fusions that return the features of one agent as they are."""


def fusion(name: str, draw: bool = True) -> torch.nn.Module:
    """A fusion in evaluation mode; draw: with what is zero at the start drawn."""
    torch.manual_seed(0)
    model = get_fusion(name)(CHANNELS, CONFIG)
    if draw:
        for parameter in model.parameters():
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.1)
    return model.eval().requires_grad_(False)


def agents() -> list[AgentTokens]:
    """The ego, two vehicles and a roadside unit, each at a pose of its own."""
    poses = [None, (1.6, -3.2, 0.4, 0.6), (4.0, 1.0, 0.0, -2.0), (-2.0, 6.0, 3.0, 1.2)]
    some = [draw_agent(k, k > 0, roadside=k == 3) for k in range(4)]
    return [
        a if p is None else dataclasses.replace(a, ego_from_sender=Transform.from_xyz_yaw(*p))
        for a, p in zip(some, poses)
    ]


def test_every_rule_has_both_modes() -> None:
    assert {"attfuse", "attfuse/bare", "max/bare"} <= set(ALL) and len(RULES) == len(BARE)


@pytest.mark.parametrize("name", ALL)
def test_no_message_equals_one_agent_and_so_does_an_empty_one(name: str) -> None:
    model, own = fusion(name), draw_agent(0, False)
    alone, empty = model(tokens_of(own)), model(tokens_of(own, draw_agent(1, True, n=0)))
    assert torch.equal(alone.bev.sites.key, empty.bev.sites.key)
    assert torch.equal(alone.bev.features, empty.bev.features)
    assert bool(torch.isfinite(alone.bev.features).all())


@pytest.mark.parametrize("name", IDENTITY_ALONE)
def test_features_of_one_agent_pass_as_they_are(name: str) -> None:
    model, own = fusion(name), draw_agent(0, False)
    tokens = tokens_of(own)
    fused = model.rule(gather_by_cell(tokens.features, tokens, standing_cells(tokens))[0])
    assert torch.allclose(fused, tokens.features[standing_cells(tokens).argsort()], atol=1e-6)


@pytest.mark.parametrize("name", ALL)
def test_the_order_of_messages_changes_nothing(name: str) -> None:
    model, (own, a, b, c) = fusion(name), agents()
    first, second = model(tokens_of(own, a, b, c)), model(tokens_of(own, c, a, b))
    assert torch.equal(first.bev.sites.key, second.bev.sites.key)
    assert torch.allclose(first.bev.features, second.bev.features, atol=2e-5)
    assert torch.allclose(first.merged_proposals, second.merged_proposals, atol=2e-5)


@pytest.mark.parametrize("name", ALL)
def test_messages_change_the_features_and_egos_of_a_batch_do_not(name: str) -> None:
    model, (own, a, b, c) = fusion(name), agents()
    others = [dataclasses.replace(part, ego=1) for part in (b, a)]
    others[0] = dataclasses.replace(others[0], ego_from_sender=None)
    together = model(tokens_of(own, *others, c, batch_size=2)).bev
    alone = model(tokens_of(own, c)).bev
    of_first = together.sites.batch == 0
    assert torch.equal(together.sites.key[of_first], alone.sites.key)
    assert torch.allclose(together.features[of_first], alone.features, atol=2e-5)
    without = model(tokens_of(own)).bev
    shared = torch.isin(alone.sites.key, without.sites.key)
    assert not torch.allclose(alone.features[shared], without.features[torch.isin(without.sites.key, alone.sites.key)])


@pytest.mark.parametrize("name", ALL)
def test_gradients_reach_every_parameter_and_every_feature(name: str) -> None:
    model = fusion(name).train().requires_grad_(True)
    if name.startswith("disconet"):
        # Logits of either sign: a bias of all of them together does not change a softmax.
        model.rule.weigh[-2].bias.data.fill_(-0.1)
    parts = agents()
    parts[1] = dataclasses.replace(parts[1], age_s=0.1)
    # Another ego is a roadside unit.
    parts += [dataclasses.replace(draw_agent(4 + k, k > 0, roadside=k == 0), ego=1) for k in range(2)]
    for part in parts:
        part.tokens[:, :CHANNELS] *= 2
        part.tokens.requires_grad_(True)
    fused = model(tokens_of(*parts, batch_size=2))
    weight = torch.randn(fused.bev.features.shape, generator=torch.Generator().manual_seed(1))
    ((fused.bev.features * weight).sum() + fused.merged_proposals.square().sum()).backward()
    # The sender's side has tests of its own (test_clusters).
    missing = [name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.abs().sum() > 0)]
    assert not [name for name in missing if "compression." not in name]
    assert all(part.tokens.grad is not None and bool(part.tokens.grad[:, :CHANNELS].any()) for part in parts)


@pytest.mark.parametrize("name", BARE)
def test_a_bare_fusion_needs_no_proposal(name: str) -> None:
    """Offsets, velocities and boxes of a message change nothing; its cells are those where its tokens lie."""
    model, (own, a, _, _) = fusion(name), agents()
    wild = a.tokens.clone()
    wild[:, CHANNELS + 1 :] = torch.randn(len(wild), PROPOSAL_DIM - 1)
    first, second = model(tokens_of(own, a)), model(tokens_of(own, dataclasses.replace(a, tokens=wild)))
    assert torch.equal(first.bev.features, second.bev.features)
    tokens = tokens_of(own, a)
    assert torch.equal(first.bev.sites.key, standing_cells(tokens).unique())


@pytest.mark.parametrize("name", BARE)
def test_a_bare_detector_sends_features_and_what_its_rule_needs_of_proposals(name: str) -> None:
    torch.manual_seed(0)
    detector = Detector(dataclasses.replace(COSTR_TINY, fusion=name)).eval()
    channels = detector.encoder.out_channels
    assert detector.refine is None and detector.packed_channels in (channels, channels + 1, channels + 3)
    grid = detector.token_grid
    tokens = SparseBev(torch.randn(5, detector.token_channels), Sites(torch.arange(5), grid))
    packed = detector.pack_tokens(tokens)
    assert packed.features.shape == (5, detector.packed_channels)
    received = detector.unpack_tokens(packed)
    assert received.features.shape == tokens.features.shape
    assert torch.equal(received.features[:, :channels], packed.features[:, :channels])
    assert torch.equal(detector.pack_tokens(received).features, packed.features)
    velocity = received.features[:, channels:][:, BOX_LAYOUT.velocity].any()
    assert bool(velocity) == (name == "how2comm/bare")
    received.features[:, channels:][:, BOX_LAYOUT.velocity] = 0
    assert not received.features[:, channels + 1 :].any()
    fused, raw = detector.fuse(to_ego_frame([AgentTokens(0, tokens.features, tokens.sites.xy)], grid, 1))
    assert torch.equal(raw.to_rows(), detector.head(fused.bev).to_rows())
    with pytest.raises(ConfigError, match="no codebook"):
        Detector(dataclasses.replace(COSTR_TINY, fusion=name, codebook=CodebookConfig()))


@pytest.mark.parametrize("name", RULES)
def test_inside_tokens_are_packed_whole(name: str) -> None:
    detector = Detector(dataclasses.replace(COSTR_TINY, fusion=name)).eval()
    tokens = SparseBev(torch.randn(5, detector.token_channels), Sites(torch.arange(5), detector.token_grid))
    assert detector.pack_tokens(tokens) is tokens and detector.unpack_tokens(tokens) is tokens
    assert detector.packed_channels == detector.token_channels
