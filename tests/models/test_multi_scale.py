# SPDX-License-Identifier: Apache-2.0
"""FeaKM's Eq. 7 on sparse tokens: a loop over cells, the start, and what a shifted collaborator changes at each scale."""

from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.fusion.max_fusion import MaxFusion
from manyeyes.models.fusion.multi_scale import CoarseScale, MultiScaleFusion
from manyeyes.models.fusion.token_merge import assign_cells
from manyeyes.models.fusion.transform_tokens import POSE_CONTEXT_DIM, Tokens

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS = 8


def tokens(n: int = 50, batch: int = 2, seed: int = 0) -> Tokens:
    """Tokens that stay where they are, several on one cell."""
    rng = torch.Generator().manual_seed(seed)
    proposal = torch.randn(n, PROPOSAL_DIM, generator=rng)
    proposal[:, BOX_LAYOUT.heatmap_logit] = -9.0
    xy = (torch.rand(n, 2, generator=rng) - 0.5) * 30
    ego = torch.randint(0, batch, (n,), generator=rng)
    return Tokens(
        torch.randn(n, CHANNELS, generator=rng),
        xy,
        ego,
        torch.zeros(n, POSE_CONTEXT_DIM),
        proposal,
        torch.ones(n),
        torch.arange(n),
        torch.zeros(n, dtype=torch.bool),
        xy,
        GRID,
        batch,
    )


def fusion(levels: int = 3, trained: bool = True) -> MultiScaleFusion:
    torch.manual_seed(0)
    model = MultiScaleFusion(CHANNELS, levels=levels).eval().requires_grad_(False)
    if trained:
        torch.nn.init.normal_(model.out.weight)
    return model


def test_a_scale_is_the_maximum_over_its_wider_cells():
    torch.manual_seed(0)
    scale, some = CoarseScale(CHANNELS, 2).requires_grad_(False), tokens()
    scale.conv = torch.nn.Identity()
    fine = MaxFusion(CHANNELS).requires_grad_(False)(some).bev.sites
    row = torch.searchsorted(fine.key, assign_cells(some)[0])
    found = scale(some.features, row, fine)
    wide = GRID.at(8)
    place = torch.cat((fine.batch[:, None], wide.cells(fine.xy)), 1).tolist()
    down = scale.down(some.features)
    for site, cell in enumerate(place):
        mates = [t for t in range(len(row)) if place[row[t]] == cell]
        torch.testing.assert_close(found[site], down[mates].amax(0))
    assert len({tuple(p) for p in place}) < len(place)


def test_initial_weights_equal_maximum_fusion():
    some, model = tokens(), fusion(trained=False)
    plain = MaxFusion(CHANNELS).eval().requires_grad_(False)
    plain.load_state_dict({k: v for k, v in model.state_dict().items() if not k.startswith(("coarse_scales", "out"))})
    torch.testing.assert_close(model(some).bev.features, plain(some).bev.features)
    assert torch.equal(model(some).merged_proposals, plain(some).merged_proposals)
    assert not torch.equal(fusion()(some).bev.features, plain(some).bev.features)


def test_invariant_to_token_order_and_egos_are_independent():
    some, model = tokens(), fusion()
    order = torch.randperm(50, generator=torch.Generator().manual_seed(1))
    columns = ("features", "xy", "ego", "pose_context", "proposal", "selection_mask")

    def take(index):
        return replace(some, **{name: getattr(some, name)[index] for name in columns})

    torch.testing.assert_close(model(take(order)).bev.features, model(some).bev.features, atol=1e-5, rtol=1e-5)
    first = model(take(some.ego == 0))
    together = model(some)
    torch.testing.assert_close(
        first.bev.features, together.bev.features[together.bev.sites.batch == 0], atol=1e-5, rtol=1e-5
    )


def test_pose_error_of_one_cell_shares_a_cell_at_the_coarser_scale():
    """Cells (8, 8) and (8, 9) at stride 4 are apart; at stride 8 both lie nearest to one centre, columns 9 and 10 do not."""
    own, other = GRID.centers(torch.tensor([[8, 9]])), GRID.centers(torch.tensor([[8, 10]]))
    wide = GRID.at(8)
    assert wide.cells(own).tolist() == wide.cells(other).tolist()
    some = tokens(2, 1)
    apart = replace(some, xy=torch.cat((own, other)))
    met = replace(some, xy=torch.cat((own, own)))
    model = fusion(2)
    coarse = []
    for case in (apart, met):
        sites = model(case).bev.sites
        row = torch.searchsorted(sites.key, assign_cells(case)[0])
        coarse.append(model.coarse_scales[0](case.features, row, sites)[0])
    assert len(model(apart).bev.sites) == 2 and len(model(met).bev.sites) == 1
    torch.testing.assert_close(coarse[0], coarse[1])


def test_gradients_reach_every_scale_and_empty_input_passes():
    model = fusion().requires_grad_(True)
    some = tokens()
    model(some).bev.features.square().sum().backward()
    assert all(p.grad is not None for p in model.coarse_scales.parameters())
    none = tokens(0)
    assert model(none).bev.features.shape == (0, CHANNELS)


def test_one_level_is_refused():
    with pytest.raises(ConfigError, match="at least two levels"):
        MultiScaleFusion(CHANNELS, levels=1)
