# SPDX-License-Identifier: Apache-2.0
"""Token codes: error of boxes and features after a round trip, and decoding of arbitrary bytes."""

import math

import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.datatypes import VEHICLE_LABELS, BevGrid, ConfigError, ShapeError, Sites
from manyeyes.models.detector.box_head import BOX_LAYOUT, DecodeConfig, RawBoxes, axis_yaw, decode, heading_logit
from manyeyes.models.detector.codebook import FREQUENCY_TOTAL, Codebook, CodebookConfig, nearest_centre, residual_codes
from manyeyes.models.detector.proposal import PROPOSAL_DIM, make_proposals, move_proposal
from manyeyes.models.detector.proposal_codes import PROPOSAL_CODES, proposal_from_codes, proposal_to_codes

torch.set_num_threads(1)
GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0, 0.4, 4)


def proposals(seed: int, count: int = 200) -> torch.Tensor:
    """Proposals of a confident head over the whole range of each quantity."""
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, width: int = 1) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, width, generator=g)

    yaw = uniform(-math.pi, math.pi)[:, 0]
    rows = torch.zeros(count, PROPOSAL_DIM)
    rows[:, BOX_LAYOUT.heatmap_logit], rows[:, BOX_LAYOUT.offset], rows[:, BOX_LAYOUT.z] = (
        uniform(-7, 7),
        uniform(-2, 2, 2),
        uniform(-4, 4),
    )
    rows[:, BOX_LAYOUT.log_size] = uniform(-1, 1, 3)
    rows[:, BOX_LAYOUT.axis] = torch.stack(((2 * yaw).cos(), (2 * yaw).sin()), 1)
    rows[:, BOX_LAYOUT.direction] = uniform(0.2, 10) * torch.stack((yaw.cos(), yaw.sin()), 1)
    rows[:, BOX_LAYOUT.class_logits] = uniform(-6, 6, len(VEHICLE_LABELS))
    rows[:, BOX_LAYOUT.log_sigma_xy], rows[:, BOX_LAYOUT.log_sigma_yaw] = uniform(-3.9, 1.9), uniform(-3.9, 1.9)
    rows[:, BOX_LAYOUT.iou_logit], rows[:, BOX_LAYOUT.velocity] = uniform(-5, 5), uniform(-3, 3, 2)
    return rows


@given(st.integers(0, 10**6))
def test_box_round_trip_error_is_below_3_cm_and_half_a_degree(seed):
    """Centre in three dimensions, on the shipped models' lattice; sizes within 1 %; velocity within 0.125 m/s an axis."""
    original = proposals(seed)
    codes = proposal_to_codes(original)
    assert codes.dtype == torch.uint8 and codes.shape == (200, PROPOSAL_CODES)
    back = proposal_from_codes(codes)
    away = torch.cat(
        ((back - original)[:, BOX_LAYOUT.offset] * GRID.cell_size_m, (back - original)[:, BOX_LAYOUT.z]), 1
    )
    assert away.norm(dim=1).max() < 0.03
    turn = (
        torch.remainder(
            axis_yaw(back[:, BOX_LAYOUT.axis]) - axis_yaw(original[:, BOX_LAYOUT.axis]) + math.pi / 2, math.pi
        )
        - math.pi / 2
    )
    assert turn.abs().max() <= math.radians(0.36)
    assert ((back - original)[:, BOX_LAYOUT.log_size].exp() - 1).abs().max() < 0.01
    assert (back - original)[:, BOX_LAYOUT.velocity].abs().max() * 10 <= 0.1251
    for column in (BOX_LAYOUT.heatmap_logit, BOX_LAYOUT.iou_logit):
        assert (back - original)[:, column].abs().max() <= 1 / 32 + 1e-5
    for column in (BOX_LAYOUT.log_sigma_xy, BOX_LAYOUT.log_sigma_yaw):
        assert (back - original)[:, column].abs().max() <= 0.2001
    assert torch.equal(back[:, BOX_LAYOUT.class_logits].argmax(1), original[:, BOX_LAYOUT.class_logits].argmax(1))


@given(st.integers(0, 10**6), st.floats(-3, 3))
def test_decoded_box_and_heading_are_equal_in_any_frame(seed, yaw):
    """Also after the receiver has turned it: the seams of axis and direction are nowhere."""
    original = proposals(seed)
    back = proposal_from_codes(proposal_to_codes(original))
    turn, height = torch.tensor(yaw), torch.zeros(200)
    sites = Sites(torch.arange(200), GRID)
    a, b = (RawBoxes.of(move_proposal(rows, turn, height), sites) for rows in (original, back))
    ahead = [
        torch.sign(heading_logit(raw))[:, None] * torch.stack((axis_yaw(raw.axis).cos(), axis_yaw(raw.axis).sin()), 1)
        for raw in (a, b)
    ]
    assert ((ahead[0] * ahead[1]).sum(1) > 0.99).all()
    config = DecodeConfig(nms_iou=1.1)
    one, two = decode(a, config)[0], decode(b, config)[0]
    assert abs(len(one) - len(two)) <= 3


def test_zero_velocity_is_exact_and_high_velocity_saturates():
    rows = torch.zeros(2, PROPOSAL_DIM)
    rows[:, BOX_LAYOUT.axis] = torch.tensor([1.0, 0.0])
    rows[1, BOX_LAYOUT.velocity] = torch.tensor([9.0, -9.0])
    rows[1, BOX_LAYOUT.offset] = torch.tensor([7.0, -7.0])
    back = proposal_from_codes(proposal_to_codes(rows))
    assert back[0, BOX_LAYOUT.velocity].tolist() == [0, 0] and back[0, BOX_LAYOUT.offset].tolist() == [0, 0]
    assert (back[1, BOX_LAYOUT.velocity] * 10).tolist() == pytest.approx([31.75, -31.75])
    # Beyond the reach of a vote before and after (fusion.settle.REACH_CELLS = 2).
    assert back[1, BOX_LAYOUT.offset].tolist() == pytest.approx([2.25, -2.25])


def test_any_bytes_decode_and_reencode_unchanged():
    codes = torch.randint(0, 256, (500, PROPOSAL_CODES), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    back = proposal_from_codes(codes)
    assert torch.isfinite(back).all()
    again = proposal_from_codes(proposal_to_codes(back))
    kept = (codes[:, :-4] > 0).all(1) & (codes[:, -3] > 0)
    assert torch.allclose(again[kept], back[kept], atol=1e-4)


def filled(stages: int, size: int = 256, channels: int = 8) -> Codebook:
    book = Codebook(channels, CodebookConfig(stages, size))
    g = torch.Generator().manual_seed(0)
    book.centres.copy_(torch.randn(book.centres.shape, generator=g) / 2.0 ** torch.arange(stages)[:, None, None])
    return book


def test_residuals_by_hand():
    """Centres 0 and 10, then -1 and 1: 9.2 is 10 - 1, 0.7 is 0 + 1; a tie goes to the first."""
    centres = torch.tensor([[[0.0], [10.0]], [[-1.0], [1.0]]])
    assert residual_codes(torch.tensor([[9.2], [0.7], [5.0], [10.0]]), centres).tolist() == [
        [1, 0],
        [0, 1],
        [0, 1],
        [1, 0],
    ]


def test_nearest_is_the_nearest():
    g = torch.Generator().manual_seed(1)
    x, centres = torch.randn(300, 5, generator=g), torch.randn(40, 5, generator=g)
    slow = torch.stack([((row - centres) ** 2).sum(1).argmin() for row in x])
    assert torch.equal(nearest_centre(x, centres), slow)


def test_each_stage_reduces_the_residual_and_sums_of_centres_are_exact():
    g = torch.Generator().manual_seed(2)
    x = torch.cat((torch.randn(400, 8, generator=g), proposals(0, 400)), 1)
    errors = [(filled(k).decode(filled(k).encode(x)) - x)[:, :8].square().mean() for k in (1, 2, 3, 4)]
    assert errors == sorted(errors, reverse=True)
    book = filled(1)
    exact = torch.cat((book.centres[0], proposals(0, 256)), 1)
    assert torch.equal(book.decode(book.encode(exact))[:, :8], book.centres[0])


def test_any_bytes_decode_with_few_centres():
    book = filled(2, size=3)
    rows = torch.randint(0, 256, (100, book.width), generator=torch.Generator().manual_seed(3)).to(torch.uint8)
    assert torch.isfinite(book.decode(rows)).all()
    assert book.decode(rows[:0]).shape == (0, 8 + PROPOSAL_DIM) and book.encode(book.decode(rows[:0])).shape == (
        0,
        book.width,
    )
    assert int(book.frequencies.sum()) == FREQUENCY_TOTAL * book.width


def test_rows_of_another_width_are_refused():
    book = filled(2)
    with pytest.raises(ShapeError, match="8 features; got 9"):
        book.encode(torch.zeros(1, 9 + PROPOSAL_DIM))
    with pytest.raises(ShapeError, match="rows of"):
        book.decode(torch.zeros(1, 3, dtype=torch.uint8))
    for config in ((0, 256), (4, 257), (4, 0)):
        with pytest.raises(ConfigError, match="256 centres"):
            CodebookConfig(*config)


def test_detector_proposals_fit_their_codes():
    sites = Sites(torch.arange(50), GRID)
    raw = RawBoxes.of(proposals(4, 50), sites)
    assert proposal_to_codes(make_proposals(raw)).shape == (50, PROPOSAL_CODES)


@pytest.mark.parametrize("size", [256, 40])
def test_compiled_decoding_equals_decoding_by_tensors(size: int) -> None:
    """Any bytes, those of no centre and of no class among them."""
    rng = torch.Generator().manual_seed(size)
    codebook = Codebook(12, CodebookConfig(stages=3, size=size))
    codebook.centres.copy_(torch.randn(codebook.centres.shape, generator=rng))
    codes = torch.randint(0, 256, (600, codebook.width), generator=rng).to(torch.uint8)
    got, want = codebook.decode(codes), codebook.decode_by_tensors(codes)
    assert torch.equal(got[:, 12:], want[:, 12:]) and torch.allclose(got[:, :12], want[:, :12], atol=1e-6)
    assert codebook.decode(codes[:0]).shape == (0, 12 + PROPOSAL_DIM)


@pytest.mark.parametrize("seed", range(3))
def test_the_loops_of_a_folded_codebook_give_the_codes_of_the_tensors(seed: int) -> None:
    torch.manual_seed(seed)
    book = Codebook(24, CodebookConfig(stages=3, size=64))
    book.centres.normal_()
    # Values beyond the codes too, and equal class logits.
    rows = proposals(seed) * torch.rand(200, 1) * 4
    rows[:20, BOX_LAYOUT.class_logits] = 1.5
    tokens = torch.cat((torch.randn(200, 24) * 2, rows), 1)
    wanted = book.encode(tokens)
    book.fold()
    assert book.folded is not None
    found = book.encode(tokens)
    assert torch.equal(found[:, :3], wanted[:, :3])
    assert torch.equal(found[20:, 3:], wanted[20:, 3:])
    # Which of equal classes comes first is free; that neither leads is not.
    assert torch.equal(book.decode(found)[:20, 24:].abs(), book.decode(wanted)[:20, 24:].abs())
    assert book.encode(tokens[:0]).shape == (0, book.width)


def test_the_first_of_equal_centres_is_taken() -> None:
    book = Codebook(8, CodebookConfig(stages=1, size=16))
    book.centres[0, [3, 7]] = 1.0
    book.fold()
    codes = book.encode(torch.cat((torch.ones(1, 8), proposals(0, 1)), 1))
    assert int(codes[0, 0]) == 3
