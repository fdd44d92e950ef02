# SPDX-License-Identifier: Apache-2.0
"""Shifts of senders: one that is displaced comes back, one without common objects stays; ambiguity, outliers, hostile values.

y
|   o        o        o: objects of the ego      x: the same objects, as a displaced sender states them
|     x        x
|   o    o              all x lie 0.8 m beside their o
|     x    x
+---------------- x
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from tests.models.fusion_cases import CHANNELS, CONFIG, GRID, tokens_of

from manyeyes.datatypes import Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.fusion.registry import get_fusion
from manyeyes.models.fusion.sender_shift import DEFAULT_SHIFT, Peaks, align_senders, estimate_shift, find_peaks
from manyeyes.models.fusion.transform_tokens import AgentTokens

OBJECTS = torch.tensor([[4.0, 3.0], [-9.0, 7.0], [12.0, -6.0], [-3.0, -12.0], [15.0, 11.0], [-16.0, -2.0], [0.5, 16.0]])


def agent(centres: torch.Tensor, pose: Transform | None = None, heat: float = 4.0) -> AgentTokens:
    """One token an object, half a cell beside its centre, in the agent's own frame."""
    proposal = torch.zeros(len(centres), PROPOSAL_DIM)
    proposal[:, BOX_LAYOUT.heatmap_logit] = heat
    proposal[:, BOX_LAYOUT.offset] = 0.5
    proposal[:, BOX_LAYOUT.log_sigma_xy] = -2.0
    rows = torch.cat((torch.randn(len(centres), CHANNELS, generator=torch.Generator().manual_seed(0)), proposal), 1)
    return AgentTokens(0, rows, centres - 0.5 * GRID.cell_size_m, pose)


def sender(pose: Transform, stated: Transform, centres: torch.Tensor = OBJECTS) -> AgentTokens:
    """An agent that is at a pose and states another one; centres in the ego's frame."""
    xyz = torch.cat((centres, torch.zeros(len(centres), 1)), 1).double()
    local = agent(pose.inverse().apply(xyz)[:, :2].float())
    half = torch.tensor([[0.5, 0.5]]) * GRID.cell_size_m
    return replace(local, xy=pose.inverse().apply(xyz)[:, :2].float() - half, ego_from_sender=stated)


def pose(x: float, y: float, yaw: float = 0.0) -> Transform:
    return Transform.from_xyz_yaw(x, y, 0.0, yaw)


def centres(tokens, number: int = 1) -> torch.Tensor:
    """Centres that the tokens of a sender propose."""
    place = tokens.xy + tokens.proposal[:, BOX_LAYOUT.offset] * GRID.cell_size_m
    return place[tokens.sender == number]


@pytest.mark.parametrize(
    ("dx", "dy", "yaw"), [(0.8, 0.0, 0.0), (-0.5, 0.9, 0.0), (0.6, -0.6, 0.014), (0.0, 1.4, -0.02)]
)
def test_a_displaced_sender_is_brought_back(dx: float, dy: float, yaw: float) -> None:
    true, stated = pose(8.0, -4.0, 2.0), pose(8.0 + dx, -4.0 + dy, 2.0 + yaw)
    before = tokens_of(agent(OBJECTS), sender(true, stated))
    after = align_senders(before)
    error = [(centres(t) - OBJECTS).norm(dim=1).max() for t in (before, after)]
    assert error[1] < 0.25 < error[0] and error[1] < 0.25 * error[0]
    own = before.sender == 0
    assert torch.equal(after.xy[own], before.xy[own])
    # What is left is stated as the position sigma of the tokens that were moved, and of no others.
    assert bool((after.sigma_m[~own] > 0).all()) and not after.sigma_m[own].any()
    assert float(after.sigma_m.max()) < 0.5


def test_each_sender_has_its_own_shift_and_the_batch_its_own_egos() -> None:
    a, b = pose(5.0, 5.0, 0.3), pose(-6.0, 1.0, -2.0)
    parts = [agent(OBJECTS), sender(a, pose(5.9, 5.0, 0.3)), sender(b, pose(-6.0, 0.1, -2.0))]
    other = [replace(agent(OBJECTS[:2]), ego=1), replace(sender(a, pose(5.9, 5.0, 0.3)), ego=1)]
    both = align_senders(tokens_of(*parts, *other, batch_size=2))
    first = both.ego == 0
    for number in (1, 2):
        mine = first & (both.sender == number)
        place = both.xy[mine] + both.proposal[mine][:, BOX_LAYOUT.offset] * GRID.cell_size_m
        assert float((place - OBJECTS).norm(dim=1).max()) < 0.25
    # Two common objects are too few: nothing moves.
    before = tokens_of(*other, batch_size=2)
    assert torch.equal(both.xy[~first], before.xy)


@pytest.mark.parametrize(
    "others",
    [
        OBJECTS + torch.tensor([3.6, 3.0]),
        OBJECTS[:2],
        OBJECTS[:0],
        # Without any error.
        OBJECTS,
    ],
    ids=["no common object", "two objects", "nothing", "true pose"],
)
def test_a_sender_without_evidence_is_left_alone(others: torch.Tensor) -> None:
    true = pose(3.0, 2.0, 0.5)
    before = tokens_of(agent(OBJECTS), sender(true, true, others))
    after = align_senders(before)
    assert torch.equal(after.xy, before.xy) and torch.equal(after.pose_context, before.pose_context)


def test_a_row_of_equal_distances_is_ambiguous() -> None:
    """Parked vehicles 4 m apart, and a sender that is half a distance off: either neighbour would do."""
    row = torch.stack((torch.arange(6) * 4.0 - 10, torch.full((6,), 5.0)), 1)
    true = pose(0.0, 0.0)
    before = tokens_of(agent(row), sender(true, pose(2.0, 0.0), row))
    assert torch.equal(align_senders(before).xy, before.xy)


def test_two_wrong_objects_do_not_carry_the_others_away() -> None:
    true, stated = pose(8.0, -4.0), pose(8.8, -4.0)
    moved = OBJECTS.clone()
    moved[:2] += torch.tensor([-1.5, 0.8])
    after = align_senders(tokens_of(agent(OBJECTS), sender(true, stated, moved)))
    assert float((centres(after)[2:] - OBJECTS[2:]).norm(dim=1).max()) < 0.35


def test_hostile_values_stay_bounded() -> None:
    g = torch.Generator().manual_seed(3)
    true = pose(3.0, 2.0)
    for scale in (0.0, 1e3, 1e30):
        part = sender(true, pose(3.9, 2.0))
        part.tokens[:, CHANNELS:] = scale * torch.randn(len(OBJECTS), PROPOSAL_DIM, generator=g)
        before = tokens_of(agent(OBJECTS), part)
        after = align_senders(before)
        assert bool(torch.isfinite(after.xy).all()) and bool(torch.isfinite(after.pose_context).all())
        assert float((after.xy - before.xy).norm(dim=1).max()) < 2 * DEFAULT_SHIFT.max_shift_m
    many = torch.rand(3000, 2, generator=g) * 40 - 20
    crowd = tokens_of(agent(OBJECTS), sender(true, true, many))
    assert float((align_senders(crowd).xy - crowd.xy).norm(dim=1).max()) < 2 * DEFAULT_SHIFT.max_shift_m


def test_features_keep_their_gradient_when_a_moved_token_leaves_the_grid() -> None:
    true, stated, x_max = pose(8.0, -4.0), pose(6.6, -4.0), float(GRID.x_max)
    edge = torch.cat((OBJECTS, torch.tensor([[x_max + 0.7 + 0.5 * GRID.cell_size_m, 0.0]])))
    part = sender(true, stated, edge)
    part = replace(part, tokens=part.tokens.requires_grad_())
    before = tokens_of(agent(OBJECTS), part)
    after = align_senders(before)
    assert len(after.xy) < len(before.xy) == len(OBJECTS) + len(edge)
    after.features.sum().backward()
    assert part.tokens.grad is not None
    assert part.tokens.grad[: len(OBJECTS), :CHANNELS].eq(1).all() and not part.tokens.grad[-1].any()


def slow_shift(ego: Peaks, other: Peaks, origin: np.ndarray) -> tuple[np.ndarray, int] | None:
    """The estimate (3,) and its pairs, in loops."""
    c, near = DEFAULT_SHIFT, lambda d: d @ d <= DEFAULT_SHIFT.max_shift_m**2
    pairs = [
        (i, j)
        for i, j in product(range(len(other.center)), range(len(ego.center)))
        if near(ego.center[j] - other.center[i])
    ]
    if len({i for i, _ in pairs}) < c.min_pairs:
        return None
    away = {p: ego.center[p[1]] - other.center[p[0]] for p in pairs}
    strength = {(i, j): (other.weight[i] * ego.weight[j]) ** 0.5 for i, j in pairs}

    def vote(d: np.ndarray) -> float:
        total = 0.0
        for i in {i for i, _ in pairs}:
            total += max(
                strength[p] * np.exp(-((away[p] - d) @ (away[p] - d)) / (2 * c.vote_m**2)) for p in pairs if p[0] == i
            )
        return total * np.exp(-(d @ d) / (8 * c.prior_sigma_m**2))

    candidates = [np.zeros(2), *(away[p] for p in pairs)]
    votes = [vote(d) for d in candidates]
    mode = candidates[int(np.argmax(votes))]
    apart = [v for v, d in zip(votes, candidates) if (d - mode) @ (d - mode) > (2 * c.match_m) ** 2]
    if apart and max(apart) > c.max_second * max(votes):
        return None
    for _ in range(3):
        share = {p: strength[p] * np.exp(-((away[p] - mode) @ (away[p] - mode)) / (2 * c.vote_m**2)) for p in pairs}
        mode = sum(share[p] * away[p] for p in pairs) / sum(share.values())
    far = {p: (away[p] - mode) @ (away[p] - mode) for p in pairs}
    chosen = [
        p
        for p in pairs
        if far[p] == min(far[q] for q in pairs if q[0] == p[0]) == min(far[q] for q in pairs if q[1] == p[1])
        if far[p] <= c.match_m**2
    ]
    if len(chosen) < c.min_pairs:
        return None
    prior = np.diag([c.prior_sigma_m**-2, c.prior_sigma_m**-2, c.prior_sigma_yaw_rad**-2])
    robust, estimate = dict.fromkeys(chosen, 1.0), np.zeros(3)
    for _ in range(4):
        normal, right = prior.copy(), np.zeros(3)
        for i, j in chosen:
            x, y = other.center[i] - origin
            h = np.array([[1, 0, -y], [0, 1, x]])
            scale = strength[i, j] / (c.object_sigma_m**2 + other.sigma[i] ** 2 + ego.sigma[j] ** 2)
            normal += robust[i, j] * scale * h.T @ h
            right += robust[i, j] * scale * h.T @ away[i, j]
        estimate = np.linalg.solve(normal, right)
        for i, j in chosen:
            x, y = other.center[i] - origin
            rest = away[i, j] - np.array([[1, 0, -y], [0, 1, x]]) @ estimate
            scale = strength[i, j] / (c.object_sigma_m**2 + other.sigma[i] ** 2 + ego.sigma[j] ** 2)
            robust[i, j] = 1 / (1 + scale * rest @ rest / 4)
    chi2 = estimate @ (normal - prior) @ estimate
    return (estimate, len(chosen)) if chi2 >= c.min_chi2 else None


def test_the_estimate_is_that_of_loops() -> None:
    found_any = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        own = rng.uniform(-30, 30, (20, 2))
        seen = own[: 3 + seed % 12] + rng.normal(0, 0.25, (3 + seed % 12, 2)) - rng.normal(0, 0.8, 2)
        ego = Peaks(own, rng.uniform(0.3, 1, 20), rng.uniform(0.1, 0.5, 20))
        other = Peaks(seen, rng.uniform(0.3, 1, len(seen)), rng.uniform(0.1, 0.5, len(seen)))
        origin = rng.normal(0, 10, 2)
        fast, slow = estimate_shift(ego, other, origin), slow_shift(ego, other, origin)
        assert (fast is None) == (slow is None)
        if fast is not None and slow is not None:
            found_any += 1
            assert np.allclose([*fast.shift, fast.yaw], slow[0], atol=1e-9) and fast.num_pairs == slow[1]
    assert found_any > 15


def test_a_peak_is_the_most_confident_token_of_its_surroundings() -> None:
    xy = np.array([[0.0, 0], [1.0, 0], [5.0, 0], [9.0, 0], [np.nan, 0]])
    peaks = find_peaks(xy, np.array([1.0, 3.0, 2.0, -5.0, 9.0]), np.full(5, 0.2))
    assert peaks.center.tolist() == [[1.0, 0.0], [5.0, 0.0]]


def test_the_fusion_of_that_name_aligns_and_has_the_same_weights() -> None:
    torch.manual_seed(0)
    plain, aligned = get_fusion("fast")(CHANNELS, CONFIG).eval(), get_fusion("shift/fast")(CHANNELS, CONFIG).eval()
    aligned.load_state_dict(plain.state_dict())
    tokens = tokens_of(agent(OBJECTS), sender(pose(8.0, -4.0), pose(8.9, -4.0)))
    with torch.no_grad():
        expected, found = plain(align_senders(tokens)), aligned(tokens)
    assert torch.equal(found.bev.features, expected.bev.features)
    assert not torch.equal(found.merged_proposals, plain(tokens).merged_proposals)
