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

import numpy as np
import pytest
import torch
from tests.models.fusion_cases import CHANNELS, CONFIG, GRID, tokens_of

from manyeyes.datatypes import Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.fusion.registry import get_fusion
from manyeyes.models.fusion.sender_shift import (
    DEFAULT_SHIFT,
    Peaks,
    SenderShift,
    align_senders,
    estimate_shift,
    find_peaks,
    find_probabilities_off,
)
from manyeyes.models.fusion.transform_tokens import AgentTokens, split_last

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


def test_evidence_of_others_decides_what_weak_evidence_means() -> None:
    """Two common objects 0.9 m off: nothing moves where three others are exact, the sender comes back where they are off, too."""
    true, stated = pose(5.0, 5.0, 0.3), pose(5.6, 5.0, 0.3)
    part = sender(true, stated, OBJECTS[:1])
    part.tokens[:, CHANNELS:][:, BOX_LAYOUT.log_sigma_xy] = -1.2
    exact = [sender(pose(x, 1.0), pose(x, 1.0)) for x in (-6.0, 2.0, 7.0)]
    off = [sender(pose(x, 1.0), pose(x + 0.9, 1.0)) for x in (-6.0, 2.0, 7.0)]
    before, among_exact, among_off = (tokens_of(agent(OBJECTS), part, *others) for others in ([], exact, off))
    mine = [t.sender == 1 for t in (before, among_exact, among_off)]
    assert torch.equal(align_senders(among_exact).xy[mine[1]], before.xy[mine[0]])
    moved = align_senders(among_off).xy[mine[2]] - before.xy[mine[0]]
    assert float(moved[0, 0]) < -0.3


def test_the_egos_own_earlier_tokens_are_no_evidence_and_stay() -> None:
    """They are exact but for odometry; counted as senders they would show that poses are reliable."""
    true, stated = pose(5.0, 5.0, 0.3), pose(5.6, 5.0, 0.3)
    part = sender(true, stated, OBJECTS[:1])
    part.tokens[:, CHANNELS:][:, BOX_LAYOUT.log_sigma_xy] = -1.2
    earlier = [sender(pose(-x, 0.0), pose(-x, 0.0)) for x in (1.0, 2.0, 3.0)]
    tokens, alone = tokens_of(agent(OBJECTS), part, *earlier), tokens_of(agent(OBJECTS), part)
    past = split_last(tokens, 2)
    found, want = align_senders(tokens, past), align_senders(alone)
    assert torch.equal(found.xy[found.sender <= 1], want.xy) and torch.equal(found.xy[found.sender > 1], past.xy)
    assert not torch.equal(align_senders(tokens).xy[tokens.sender == 1], want.xy[alone.sender == 1])


def test_each_sender_has_its_own_shift_and_the_batch_its_own_egos() -> None:
    a, b = pose(5.0, 5.0, 0.3), pose(-6.0, 1.0, -2.0)
    parts = [agent(OBJECTS), sender(a, pose(5.9, 5.0, 0.3)), sender(b, pose(-6.0, 0.1, -2.0))]
    other = [replace(agent(OBJECTS[:0]), ego=1), replace(sender(a, pose(5.9, 5.0, 0.3)), ego=1)]
    both = align_senders(tokens_of(*parts, *other, batch_size=2))
    first = both.ego == 0
    for number in (1, 2):
        mine = first & (both.sender == number)
        place = both.xy[mine] + both.proposal[mine][:, BOX_LAYOUT.offset] * GRID.cell_size_m
        assert float((place - OBJECTS).norm(dim=1).max()) < 0.25
    # The other ego detects nothing: its senders stay.
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
    row = torch.stack((torch.arange(12) * 4.0 - 23, torch.full((12,), 5.0)), 1)
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


def slow_log_likelihood(ego: Peaks, other: Peaks, origin: np.ndarray, error: np.ndarray, sigma_yaw: float) -> float:
    """The logarithm of the ratio of probabilities, in loops over all pairs of peaks."""
    c, total = DEFAULT_SHIFT, 0.0
    for i in range(len(other.center)):
        x, y = other.center[i] - origin
        expected = np.array([[1, 0, -y], [0, 1, x]]) @ error
        density = 0.0
        for j in range(len(ego.center)):
            away = ego.center[j] - other.center[i]
            variance = other.sigma[i] ** 2 + ego.sigma[j] ** 2 + c.min_sigma_m**2 + sigma_yaw**2 * (x * x + y * y) / 2
            square = (away - expected) @ (away - expected) / variance
            if away @ away <= (2 * c.max_shift_m) ** 2 and square <= c.max_deviation**2:
                normal = np.exp(-square / 2) / (2 * np.pi * variance)
                density += (other.weight[i] * ego.weight[j]) ** 0.5 * normal
        total += np.log(1 + density / c.clutter_per_m2)
    return total


def slow_shift(ego: Peaks, other: Peaks, origin: np.ndarray) -> tuple[np.ndarray, float, float] | None:
    """The estimate (3,), the number of pairs and the evidence, by general linear algebra."""
    c = DEFAULT_SHIFT
    away = (ego.center[None] - other.center[:, None]).reshape(-1, 2)
    if not (np.linalg.norm(away, axis=1) <= 2 * c.max_shift_m).any():
        return None
    candidates = [np.zeros(2), *away[np.linalg.norm(away, axis=1) <= c.max_shift_m]]
    found = np.array(
        [
            slow_log_likelihood(ego, other, origin, np.array([*d, 0]), c.prior_sigma_yaw_rad)
            - d @ d / (2 * c.prior_sigma_m**2)
            for d in candidates
        ]
    )
    best = candidates[int(found.argmax())]
    is_apart = np.array([np.linalg.norm(d - best) > c.apart_m for d in candidates])
    if (found[is_apart] > found.max() * c.max_second).any():
        return None
    prior = np.diag([c.prior_sigma_m**-2, c.prior_sigma_m**-2, c.prior_sigma_yaw_rad**-2])
    estimate, normal, number = np.array([*best, 0.0]), prior, 0.0
    for _ in range(c.iterations):
        normal, right, number = prior.copy(), np.zeros(3), 0.0
        for i in range(len(other.center)):
            x, y = other.center[i] - origin
            h = np.array([[1, 0, -y], [0, 1, x]])
            variance = other.sigma[i] ** 2 + ego.sigma**2 + c.min_sigma_m**2
            displacement = ego.center - other.center[i]
            square = ((displacement - h @ estimate) ** 2).sum(1) / variance
            is_pair = (square <= c.max_deviation**2) & (np.linalg.norm(displacement, axis=1) <= 2 * c.max_shift_m)
            density = is_pair * np.sqrt(other.weight[i] * ego.weight) * np.exp(-square / 2) / (2 * np.pi * variance)
            share = density / (density.sum() + c.clutter_per_m2)
            number += share.sum()
            normal += (share / variance).sum() * h.T @ h
            right += h.T @ ((share / variance) @ displacement)
        estimate = np.linalg.solve(normal, right)
    of_pairs = slow_log_likelihood(ego, other, origin, estimate, 0.0)
    of_pairs -= slow_log_likelihood(ego, other, origin, np.zeros(3), 0.0)
    evidence = c.evidence_scale * of_pairs + (np.log(np.linalg.det(prior) / np.linalg.det(normal))) / 2
    return estimate, number, evidence - estimate @ prior @ estimate / 2


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
            assert np.allclose([*fast.shift, fast.yaw], slow[0], atol=1e-9)
            assert (fast.num_pairs, fast.evidence) == pytest.approx(slow[1:], abs=1e-8)
    assert found_any > 15


def test_one_pair_by_hand() -> None:
    """A peak 0.5 m beside the ego's one, at the sender's own place: it has no lever, so the heading is that of the prior.

    variance .3^2 + .3^2 + .1^2 = .19; the share of the pair at the end and the estimate hold each other: shift = .5 a / (a + 1), a
    the precision of the pair.
    """
    peaks = [Peaks(np.array([[x, 0.0]]), np.array([1.0]), np.array([0.3])) for x in (0.5, 0.0)]
    found = estimate_shift(peaks[0], peaks[1], np.zeros(2))
    assert found is not None

    def density(error: float) -> float:
        return float(np.exp(-(error**2) / (2 * 0.19)) / (2 * np.pi * 0.19)) / 0.02

    rest = 0.5 - found.shift[0]
    share = density(rest) / (1 + density(rest))
    assert found.shift == pytest.approx([0.5 * share / (share + 0.19), 0.0], abs=1e-6) and found.yaw == 0.0
    assert found.num_pairs == pytest.approx(share, abs=1e-4)
    want = 1.25 * np.log((1 + density(rest)) / (1 + density(0.5))) - found.shift[0] ** 2 / 2 - np.log(share / 0.19 + 1)
    assert found.evidence == pytest.approx(want, abs=1e-4)
    # No yaw is measured: its variance is that of the prior.
    assert found.covariance[2, 2] == pytest.approx(0.014**2)


def test_probabilities_by_hand() -> None:
    """Even evidence leaves the prior, 1/2 of .9 and of .05; one sender's evidence changes what that of another means."""
    assert find_probabilities_off([]) == []
    assert find_probabilities_off([0.0]) == pytest.approx([0.475])
    # Ratio 9: pairs are .1 + 8.1 = 8.2 times as probable if unreliable, .95 + .45 = 1.4 if reliable.
    unreliable = 8.2 / (8.2 + 1.4)
    want = unreliable * 8.1 / 8.2 + (1 - unreliable) * 0.45 / 1.4
    assert find_probabilities_off([np.log(9)]) == pytest.approx([want])
    alone, among_exact, among_off = (find_probabilities_off([1.0, *[e] * 4])[0] for e in (0.0, -8.0, 20.0))
    assert among_exact < 0.2 < alone < among_off < 1
    assert find_probabilities_off([1e9, -1e9]) == pytest.approx([1, 0], abs=1e-9)


def test_an_expected_correction_is_a_mixture() -> None:
    whole = SenderShift(np.array([1.0, 0.0]), 0.02, np.zeros(2), np.diag([0.04, 0.04, 1e-4]), 5.0, 0.0)
    half = whole.if_off_with(0.5)
    assert half.shift.tolist() == [0.5, 0.0] and half.yaw == 0.01
    # Half of the variance, and a quarter of the square of the distance of the two.
    assert half.covariance[0, 0] == pytest.approx(0.02 + 0.25) and half.covariance[1, 1] == pytest.approx(0.02)
    assert half.covariance[0, 2] == pytest.approx(0.25 * 0.02)


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
