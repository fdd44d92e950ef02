# SPDX-License-Identifier: Apache-2.0
"""What arrives of a message in training, and which gradients flow through it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.datatypes import LABELS, VEHICLES, BevGrid
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.training.detector.losses import LossConfig
from manyeyes.training.detector.samples import AgentView, AugmentConfig, DegradationConfig, Sample, make_sample
from manyeyes.training.detector.step import (
    TOKENS_PER_PACKET,
    _history_tokens,
    _select_delivered,
    forward,
    loss_terms,
    pair_agent_tokens,
)
from manyeyes.training.detector.targets import TargetConfig

GRID: BevGrid = COSTR_TINY.grid


@pytest.fixture(scope="module")
def detector() -> Detector:
    torch.manual_seed(0)
    return Detector(COSTR_TINY)


@pytest.fixture
def sample(toy) -> Sample:
    recording = toy(agents_n=2, points_per_car=20, ground_points=60)
    moments = [recording.snapshot("toy_0", i) for i in range(4)]
    return make_sample(
        moments, 0, GRID, AugmentConfig.none(), ("step",), DegradationConfig(ego_history=2, sender_history=1)
    )


def limited(sample: Sample, keep: int | None = None, lost: float = 0.0) -> Sample:
    """The sample whose collaborator has that budget and those losses."""
    return replace(sample, views=(sample.views[0], replace(sample.views[1], max_tokens=keep, loss_fraction=lost)))


def arriving(view: AgentView, score: Tensor, number: int = 0) -> list[int]:
    """Rows that arrive of a view whose tokens are the rows from 100 on."""
    rows = torch.arange(100, 100 + len(score))
    return _select_delivered(rows, torch.cat((torch.full((100,), 99.0), score)), view, ("test", number)).tolist()


def test_budget_selects_the_best_and_near_ties_at_random(sample):
    view = replace(sample.views[1], max_tokens=10)
    score = torch.linspace(-10, 10, 40)[torch.randperm(40, generator=torch.Generator().manual_seed(0))]
    best = set((100 + score.sort(descending=True).indices[:10]).tolist())
    drawn = [arriving(view, score, number) for number in range(50)]
    assert all(len(rows) == 10 and rows == sorted(rows) for rows in drawn)
    # Scores that lie half a unit apart are rarely exchanged.
    assert sum(len(best & set(rows)) for rows in drawn) / 50 > 8 and len({tuple(rows) for rows in drawn}) > 5
    ties = [arriving(view, torch.zeros(40), number) for number in range(200)]
    counts = torch.bincount(torch.tensor(ties).flatten() - 100, minlength=40)
    assert int(counts.min()) > 20 and int(counts.max()) < 90


def test_large_or_absent_budget_selects_everything(sample):
    view, score = sample.views[1], torch.randn(30)
    for keep in (None, 30, 1000):
        assert arriving(replace(view, max_tokens=keep), score) == [*range(100, 130)]
    assert arriving(replace(view, max_tokens=5, loss_fraction=0.5), score[:0]) == []


def test_loss_is_per_packet(sample):
    view, score = replace(sample.views[1], loss_fraction=0.4), torch.arange(400.0)
    left = 0
    for number in range(20):
        rows = torch.tensor(arriving(view, score, number)) - 100
        packets, counts = torch.unique(rows.div(TOKENS_PER_PACKET, rounding_mode="floor"), return_counts=True)
        assert bool((counts == TOKENS_PER_PACKET).all())
        left += len(packets)
    assert left / (20 * 50) == pytest.approx(0.6, abs=0.05)


def test_budget_fills_packets_by_descending_score(sample):
    # Scores so far apart that chance moves nothing: the order is falling, so is that of the packets.
    score = -100.0 * torch.arange(64)
    rows = arriving(replace(sample.views[1], max_tokens=20, loss_fraction=0.5), score, 3)
    packets = {(row - 100) // TOKENS_PER_PACKET for row in rows}
    assert 0 < len(rows) < 20 and all(row < 120 for row in rows)
    assert {row - 100 for row in rows} == {t for p in packets for t in range(8 * p, min(8 * p + 8, 20))}


def test_packet_loss_is_keyed(sample):
    view, score = (
        replace(sample.views[1], max_tokens=20, loss_fraction=0.5),
        torch.randn(100, generator=torch.Generator().manual_seed(1)),
    )
    assert arriving(view, score, 1) == arriving(view, score, 1) != arriving(view, score, 2)


def test_selection_passes_its_gradient_straight_through_and_changes_no_value(detector, sample):
    """Under a budget the selector's weights receive gradients from the fused boxes; values equal those of plain
    tokens.
    """
    model = detector.eval()
    n = int((forward(model, [sample]).shared_tokens.sites.batch == 1).sum())
    assert n > 40
    few, all_of_it, free = (forward(model, [limited(sample, keep)]) for keep in (n // 2, n, None))
    assert torch.equal(all_of_it.fused_boxes.to_rows(), free.fused_boxes.to_rows())
    assert len(few.fused_boxes.sites) < len(free.fused_boxes.sites)
    for outcome, flows in ((few, True), (free, False)):
        model.zero_grad()
        outcome.fused_boxes.to_rows().sum().backward()
        grads = [p.grad for p in model.selector.parameters() if p.grad is not None]
        assert any(bool(g.any()) for g in grads) == flows
    model.zero_grad()
    detector.train()


def test_ego_history_is_used_without_gradient(detector, sample):
    model = detector.eval()
    ego_history, sender_history = (
        _history_tokens(model, [sample], which, 0.0) for which in ("ego_history", "sender_history")
    )
    assert [round(part.age_s, 6) for part in ego_history] == [0.1, 0.2] and [
        round(part.age_s, 6) for part in sender_history
    ] == [0.1]
    assert all(len(part.tokens) > 20 and not part.tokens.requires_grad and not part.sigma_xy_m for part in ego_history)
    with torch.no_grad():
        for weight in (model.fusion.past_attention.out.weight, model.refine.out.weight):
            torch.nn.init.normal_(weight)
        with_past, without, no_sender_history = (
            forward(model, [s]) for s in (sample, replace(sample, ego_history=()), replace(sample, sender_history=()))
        )
        for weight in (model.fusion.past_attention.out.weight, model.refine.out.weight):
            torch.nn.init.zeros_(weight)
    assert torch.equal(with_past.single_agent_boxes.to_rows(), without.single_agent_boxes.to_rows())
    for less in (without, no_sender_history):
        assert less.fused_boxes.to_rows().shape != with_past.fused_boxes.to_rows().shape or not torch.allclose(
            with_past.fused_boxes.to_rows(), less.fused_boxes.to_rows(), atol=1e-3
        )
    detector.train()


def test_budget_and_packet_loss_also_apply_to_sender_history(detector, sample):
    model = detector.eval()
    whole = _history_tokens(model, [sample], "sender_history", 0.0)[0]
    cut = replace(sample, sender_history=tuple(replace(view, max_tokens=5) for view in sample.sender_history))
    few = _history_tokens(model, [cut], "sender_history", 0.0)[0]
    assert len(few.tokens) == 5 < len(whole.tokens)
    detector.train()


def test_every_parameter_has_a_gradient_under_degradation(detector, sample):
    detector.train().zero_grad()
    past = detector.fusion.past_attention
    torch.nn.init.normal_(past.out.weight, std=0.1)
    torch.nn.init.normal_(past.ffn[2].weight, std=0.1)
    torch.nn.init.normal_(detector.fusion.encoding.outer.weight, std=0.1)
    torch.nn.init.normal_(detector.refine.out.weight, std=0.1)
    torch.nn.init.normal_(detector.selector.outer.weight, std=0.1)
    late = replace(limited(sample, 60, 0.2), key=("late",))
    terms = loss_terms(detector, [late], TargetConfig(), 0.0)
    total = terms.total(LossConfig(iou=0.5))
    total.backward()
    assert bool(torch.isfinite(total))
    silent = [name for name, p in detector.named_parameters() if p.grad is None or not bool(p.grad.any())]
    # A bias that a norm takes away, or that all keys of a softmax share, has no effect; in a fresh model no token repeats another.
    assert all("norm" in name or name.endswith(("key.bias", "selector.redundancy_weight")) for name in silent), silent
    assert all(bool(torch.isfinite(p.grad).all()) for p in detector.parameters() if p.grad is not None)


def test_study_targets_use_the_egos_windows_and_train_only_the_selector(detector, sample):
    model = detector.eval()
    model.zero_grad()
    torch.nn.init.normal_(model.selector.outer.weight, std=0.1)
    out = forward(model, [sample], 0.0)
    met, batch = pair_agent_tokens(out, [sample]), out.shared_tokens.sites.batch
    xy = out.shared_tokens.sites.xy[batch == 1]
    moved = sample.views[1].ego_from_view.apply(functional.pad(xy, (0, 1)).double())[:, :2]
    near = GRID.contains(moved)
    assert len(met.own) == int((batch == 0).sum()) and 0 < int((~near).sum()) < 9
    assert torch.allclose(met.sent_mask, out.mask[batch == 1][near])
    assert torch.allclose(met.sent.norm(dim=1), torch.ones(len(met.sent)), atol=1e-5)
    # Windows of 12.8 m of the ego's frame.
    columns = ((moved[near] - GRID.x_min) / 12.8).floor()
    same = (columns[:, None] == columns[None]).all(2)
    assert torch.equal(same, met.sent_row[:, None] == met.sent_row[None])
    terms = {t: loss_terms(model, [sample], TargetConfig(), 0.0, target=t) for t in ("own_task", "receiver", "literal")}
    values = [float(t.information.detach()) for t in terms.values()]
    assert len({round(v, 4) for v in values}) == 3
    for name in ("receiver", "literal"):
        model.zero_grad()
        terms[name].information.backward()
        taught = {n.split(".")[0] for n, p in model.named_parameters() if p.grad is not None and bool(p.grad.any())}
        assert taught == {"selector"}
    model.zero_grad()
    detector.train()


def test_a_step_of_a_detector_of_several_classes_trains_every_heat_map(toy):
    """The toy's cars are made pedestrians and cyclists in turn."""
    classes = ("vehicle", "pedestrian", "cyclist")
    recording = toy(agents_n=2, points_per_car=20, ground_points=60)
    snapshot = recording.snapshot("toy_0", 0)
    kinds = torch.tensor([LABELS.index(name) for name in ("car", "pedestrian", "motorcyclist")])
    boxes = replace(snapshot.truth.boxes, label=kinds[torch.arange(len(snapshot.truth.boxes)) % 3])
    mixed = replace(snapshot, truth=replace(snapshot.truth, boxes=boxes))
    some, cars = (
        make_sample([mixed], 0, GRID, AugmentConfig.none(), ("step",), classes=c) for c in (classes, VEHICLES)
    )
    assert set(some.merged_gt_boxes.class_rows(classes).tolist()) == {0, 1, 2}
    assert set(cars.merged_gt_boxes.label.tolist()) == {0}
    model = Detector(replace(COSTR_TINY, classes=classes))
    loss_terms(model, [some], TargetConfig()).total(LossConfig()).backward()
    for head in (model.head, model.refine):
        gradient = head.out.bias.grad
        assert gradient is not None and bool((gradient[BOX_LAYOUT.total :] != 0).all())


def test_collaborators_compress_what_the_ego_receives_and_its_own_tokens_stay(sample) -> None:
    """Weights of ERMVP: the fused features train the sampling score, and the ego's features are those of its encoder."""
    torch.manual_seed(0)
    model = Detector(replace(COSTR_TINY, fusion="ermvp")).train()
    fused, made = [], []
    model.fusion.register_forward_hook(lambda _, given, result: (fused.append(given[0]), made.append(result))[0])
    out = forward(model, [sample])
    own, shared = fused[0].sender == 0, out.shared_tokens
    is_ego = shared.sites.batch == 0
    channels = model.encoder.out_channels
    assert torch.equal(fused[0].features[own], shared.features[is_ego, :channels])
    received = fused[0].sender == 1
    assert len(fused[0].features[received].detach().unique(dim=0)) <= 0.3 * int(received.sum()) + 1
    (made[0].bev.features ** 3).sum().backward()
    assert bool(model.fusion.compression.scoring.weight.grad.abs().sum() > 0)
