# SPDX-License-Identifier: Apache-2.0
"""Training of the map model: resumes bit by bit, starts from other models, calibrates, and thins as a budget would."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import (
    AgentFrame,
    BevGrid,
    CheckpointError,
    ConfigError,
    PointCloud,
    Sites,
    SparseBev,
    Transform,
)
from manyeyes.datatypes.camera import Camera, CameraImage
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps.metrics import evaluate_map
from manyeyes.evaluation.maps.tiles import place_side_by_side
from manyeyes.models import checkpoint
from manyeyes.models.maps.bev import BevConfig
from manyeyes.models.maps.head import MapHeadConfig, decode_elements
from manyeyes.models.maps.image_encoder import ImageEncoderConfig
from manyeyes.models.maps.map_model import MapModel, MapModelConfig
from manyeyes.models.maps.presets import FORMAT
from manyeyes.ops.keyed_random import keyed_generator, keyed_uniform
from manyeyes.training.maps.losses import MapLossTerms
from manyeyes.training.maps.presets import MAP_TRAINING_PRESETS
from manyeyes.training.maps.samples import MapSample, rasterise_elements
from manyeyes.training.maps.step import extract_features, loss_terms, subsample_tokens, warp_tokens
from manyeyes.training.maps.task import MapTask, MapTrainConfig
from manyeyes.training.trainer import Trainer

pytestmark = pytest.mark.training

TINY = MapModelConfig(
    BevConfig(
        BevGrid(-12.0, -12.0, -2.0, 12.0, 12.0, 4.0, pillar=0.5), channels=24, raster_channels=12, raster_blocks=(1, 1)
    ),
    BevGrid(-16.0, -8.0, -1.0, 16.0, 8.0, 1.0, pillar=1.0),
    token_channels=16,
    neck_blocks=(1, 1),
    head=MapHeadConfig(
        num_queries=8,
        num_points=6,
        num_one_to_many_queries=8,
        num_seeds=40,
        channels=32,
        feedforward_channels=64,
        layers=2,
        heads=4,
    ),
)
CONFIG = MapTrainConfig(TINY, steps=4, batch=2, warmup_steps=2, save_every=2)


class Streets:
    """Short streets: two edges, a divider and a crossing, which two agents see as points in the colours of each."""

    towns = ("Nowhere",)

    def __init__(self, count=50):
        self.count = count

    def draw(self, number):
        rng = keyed_generator("street", number % self.count)
        yaw, y, x = rng.uniform(-0.5, 0.5), rng.uniform(-2, 2), rng.uniform(-6, 6)
        c, s = math.cos(yaw), math.sin(yaw)
        turn = np.array([[c, s], [-s, c]])
        ring = np.array([[x, -3.0], [x + 3, -3], [x + 3, 3], [x, 3]]) @ turn + [0, y]
        lines = [np.array([[-12.0, o], [12.0, o]]) @ turn + [0, y] for o in (-3.0, 0.0, 3.0)]
        truth = MapElements.of([*lines, ring], [BOUNDARY, DIVIDER, BOUNDARY, CROSSING])
        frames, poses, ink = [], [], []
        for k, pose in enumerate((Transform.from_xyz_yaw(-5, 0, 0, 0.2), Transform.from_xyz_yaw(5, 0, 0, 3.0))):
            share = rng.uniform(size=(4, 150, 1))
            along = np.concatenate([line[0] + share[i] * (line[1] - line[0]) for i, line in enumerate(lines)])
            inside = (
                ring[0]
                + rng.uniform(size=(200, 1)) * (ring[1] - ring[0])
                + rng.uniform(size=(200, 1)) * (ring[3] - ring[0])
            )
            xy = np.concatenate((along, inside, rng.uniform([-14, -8], [14, 8], (300, 2))))
            z = np.concatenate((np.repeat([0.15, 0.0, 0.15], 150), np.zeros(500)))
            bright = np.concatenate((np.repeat([0.3, 0.8, 0.3], 150), np.full(200, 0.6), np.full(300, 0.1)))
            world = torch.from_numpy(np.concatenate((xy, z[:, None]), 1))
            cloud = PointCloud.of(pose.inverse().apply(world), torch.from_numpy(bright))
            frame = AgentFrame.of(cloud, pose, k)
            frames.append(frame)
            poses.append(pose)
            x_, y_, _ = pose.inverse().translation.tolist()
            there = truth.transform(x_, y_, -float(pose.yaw))
            ink.append(rasterise_elements(there, TINY.bev.token_grid, TINY.head.kinds))
        return MapSample(tuple(frames), Transform.stack(poses), truth, torch.stack(ink))


def same_state(a, b):
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


def test_an_interrupted_run_ends_with_the_same_result(tmp_path, check_resumption):
    check_resumption(lambda: MapTask(CONFIG, Streets(), 3), tmp_path)


def test_run_state_includes_the_initial_weights(tmp_path):
    one, other = (Trainer(MapTask(CONFIG, Streets(), n), tmp_path / "x").model.state_dict() for n in (1, 2))
    run = Trainer(MapTask(CONFIG, Streets(), 3, [one]), tmp_path / "run")
    run.advance()
    run.save()
    assert Trainer(MapTask(CONFIG, Streets(), 3, [one]), tmp_path / "run").step == 1
    for start in ([other], []):
        with pytest.raises(CheckpointError, match=r"initial weights are \w+ there and \w+ here"):
            Trainer(MapTask(CONFIG, Streets(), 3, start), tmp_path / "run")


def test_a_batch_in_parts_has_the_mean_gradient_of_its_parts(tmp_path):
    config = dataclasses.replace(CONFIG, batch=4, micro_batch=3)
    run = Trainer(MapTask(config, Streets(), 3), tmp_path)
    losses, gradients = [], []
    for part in (range(3), range(3, 4)):
        model = Trainer(MapTask(config, Streets(), 3), tmp_path / "alone").model.train()
        samples = [Streets().draw(number) for number in part]
        num_frames = sum(len(sample.frames) for sample in samples)
        thin = config.max_token_dropout * keyed_uniform((num_frames,), "thin", 3, part.start).float()
        loss = loss_terms(model, samples, config.loss, thin, config.line_field_steps == 0).total(config.loss)
        loss.backward()
        losses.append(float(loss.detach()))
        gradients.append([torch.zeros_like(p) if p.grad is None else p.grad for p in model.parameters()])
    seen = []
    run.optimiser.register_step_pre_hook(
        lambda *_: seen.extend(
            torch.zeros_like(p) if p.grad is None else p.grad.clone() for p in run.model.parameters()
        )
    )
    progress = run.advance()
    assert progress.loss == pytest.approx(0.75 * losses[0] + 0.25 * losses[1], rel=1e-6)
    terms = MapLossTerms(**{name: torch.tensor(value) for name, value in progress.terms.items()})
    assert float(terms.total(config.loss)) == pytest.approx(progress.loss, rel=1e-5)
    expected = [0.75 * a + 0.25 * b for a, b in zip(*gradients)]
    length = float(torch.stack([g.square().sum() for g in expected]).sum().sqrt())
    shrink = min(1.0, config.max_grad_norm / length)
    assert all(torch.allclose(g, shrink * e, atol=1e-5, rtol=1e-4) for g, e in zip(seen, expected, strict=True))


def shrunk_paper():
    """The paper's preset with every layer, block and point of an element that it has, but narrow, with a tenth of its queries,
    coarse cells and a batch of one: as it stands, a step takes minutes and gigabytes."""
    paper = MAP_TRAINING_PRESETS["map-paper"]
    bev, head = paper.map_model.bev, paper.map_model.head
    image = dataclasses.replace(bev.image_encoder, stem_channels=8, channels=16)
    grid, tile = (dataclasses.replace(g, pillar=6.4) for g in (bev.grid, paper.map_model.tile))
    tile = dataclasses.replace(tile, pillar=6.0)
    bev = dataclasses.replace(bev, grid=grid, channels=16, image_encoder=image, image_size=(48, 64))
    head = dataclasses.replace(head, num_queries=10, num_one_to_many_queries=30, channels=32, feedforward_channels=64)
    mapper = dataclasses.replace(paper.map_model, bev=bev, tile=tile, token_channels=16, head=head)
    return dataclasses.replace(paper, map_model=mapper, batch=1, steps=3)


class Photos:
    """A street about an agent with one camera that looks ahead, over and over."""

    towns = ("Nowhere",)

    def __init__(self, map_model):
        self.map_model = map_model

    def draw(self, number):
        ahead = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
        k = torch.tensor([[32.0, 0, 32], [0, 32.0, 24], [0, 0, 1]], dtype=torch.float64)
        camera = Camera(k, Transform(ahead, torch.tensor([0.0, 0.0, 1.5], dtype=torch.float64)), 64, 48)
        rgb = torch.randint(0, 256, (3, 48, 64), generator=torch.Generator().manual_seed(number), dtype=torch.uint8)
        pose = Transform.from_xyz_yaw(0, 0, 0, 0)
        frame = dataclasses.replace(
            AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), pose, 0), images=(CameraImage(camera, rgb),)
        )
        truth = MapElements.of(
            [np.array([[-40.0, y], [40.0, y]]) for y in (-4.0, 0.0, 4.0)], [BOUNDARY, DIVIDER, BOUNDARY]
        )
        bev = self.map_model.bev
        return MapSample(
            (frame,),
            Transform.stack([pose]),
            truth,
            rasterise_elements(truth, bev.token_grid, self.map_model.head.kinds)[None],
        )


def test_the_papers_model_takes_a_step_and_resumes(tmp_path):
    config = shrunk_paper()
    samples = Photos(config.map_model)
    run = Trainer(MapTask(config, samples, 0), tmp_path)
    first = run.advance()
    assert math.isfinite(first.loss) and first.terms["one_to_many"] > 0
    run.save()
    run.advance()
    resumed = Trainer(MapTask(config, samples, 0), tmp_path)
    assert resumed.step == 1
    resumed.advance()
    assert same_state(resumed.model, run.model) and same_state(resumed.average, run.average)


def test_train_writes_weights_with_their_towns_and_a_log(tmp_path):
    reports = []
    weights = Trainer(MapTask(CONFIG, Streets(), 1), tmp_path).run({"command": "x"}, reports.append)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2, 3, 4] == [p.step for p in reports]
    assert all(
        math.isfinite(line[name])
        for line in lines
        for name in ("loss", "classification", "point", "direction", "segmentation", "line_field", "one_to_many")
    )
    card = checkpoint.read_card(weights, FORMAT)
    assert card["towns"] == ["Nowhere"] and card["steps"] == 4 and card["command"] == "x"
    assert len(card["token_peaks"]) == TINY.token_channels and min(card["token_peaks"]) > 0
    again = checkpoint.load_as(weights, FORMAT, MapModelConfig, MapModel)
    assert again.config == TINY and torch.equal(again.logit_scale, torch.ones(3))


def test_a_run_begins_from_what_it_has_in_common_with_models_of_other_sensors(tmp_path):
    seeing = dataclasses.replace(
        TINY, bev=dataclasses.replace(TINY.bev, sensors=("lidar", "camera"), image_size=(24, 32), raster_channels=12)
    )
    lidar, camera = (
        MapModel(TINY),
        MapModel(dataclasses.replace(seeing, bev=dataclasses.replace(seeing.bev, sensors=("camera",)))),
    )
    lidar.logit_scale.add_(1.0)
    config = dataclasses.replace(CONFIG, map_model=seeing)
    random = Trainer(MapTask(config, Streets(), 0), tmp_path / "random").model.state_dict()
    begun = Trainer(MapTask(config, Streets(), 0, [lidar.state_dict(), camera.state_dict()]), tmp_path / "begun")
    state, first, second = (m.state_dict() for m in (begun.model, lidar, camera))
    # The first model with a tensor takes precedence; calibration starts again; the average starts as the model.
    assert all(torch.equal(state[k], v) for k, v in first.items() if k not in ("logit_scale", "logit_shift"))
    assert all(torch.equal(state[k], v) for k, v in second.items() if k.startswith("camera."))
    assert torch.equal(state["logit_scale"], torch.ones(3)) and same_state(begun.average, begun.model)
    assert not torch.equal(random["token_projection.weight"], state["token_projection.weight"])
    with pytest.raises(ConfigError, match="of its size"):
        Trainer(MapTask(config, Streets(), 0, [{"lidar.stem.0.0.weight": torch.zeros(3)}]), tmp_path / "none")


def test_scores_are_calibrated_at_the_end_and_training_is_the_same(tmp_path):
    # Without a threshold even a model that has learnt nothing draws something.
    mapper = dataclasses.replace(TINY, head=dataclasses.replace(TINY.head, score_threshold=0.0))
    plain, calibrated = (
        Trainer(
            MapTask(dataclasses.replace(CONFIG, map_model=mapper, calibration_tiles=count), Streets()),
            tmp_path / str(count),
        ).run()
        for count in (0, 3)
    )
    plain, calibrated = (checkpoint.load_as(file, FORMAT, MapModelConfig, MapModel) for file in (plain, calibrated))
    assert not torch.equal(calibrated.logit_scale, plain.logit_scale) and bool((calibrated.logit_scale > 0).all())
    same = {name for name, value in plain.state_dict().items() if torch.equal(value, calibrated.state_dict()[name])}
    assert set(plain.state_dict()) - same <= {"logit_scale", "logit_shift"}


def test_subsampling_drops_the_lowest_scores_of_each_frame():
    grid = TINY.bev.token_grid
    key = torch.cat((torch.arange(4), grid.shape[0] * grid.shape[1] + torch.arange(6)))
    tokens = SparseBev(torch.arange(10.0)[:, None], Sites(key, grid, 3))
    worth = torch.tensor([0.4, 0.1, 0.3, 0.2, 0.9, 0.5, 0.8, 0.6, 0.7, 0.05])
    kept = subsample_tokens(tokens, worth, torch.tensor([0.5, 0.34, 0.9]))
    assert kept.features[:, 0].tolist() == [0, 2, 4, 6, 7, 8]
    assert torch.equal(subsample_tokens(tokens, worth, torch.zeros(3)).features, tokens.features)


def test_decoder_trains_after_the_line_field(tmp_path):
    run = Trainer(MapTask(dataclasses.replace(CONFIG, line_field_steps=1), Streets(), 0), tmp_path)
    before = {name: p.clone() for name, p in run.model.named_parameters()}
    first, second = run.advance(), run.advance()
    assert first.terms["classification"] == 0 == first.terms["one_to_many"] and first.terms["line_field"] > 0
    assert second.terms["classification"] > 0 and second.terms["one_to_many"] > 0
    only = Trainer(MapTask(dataclasses.replace(CONFIG, line_field_steps=1), Streets(), 0), tmp_path / "only")
    only.advance()
    same = {name for name, p in only.model.named_parameters() if torch.equal(p, before[name])}
    assert any(name.startswith("head.layers") for name in same)
    assert not any(name.startswith("head.line_field_head") for name in same)


def test_two_tiles_can_be_overfitted(tmp_path):
    mapper = dataclasses.replace(TINY, head=dataclasses.replace(TINY.head, num_one_to_many_queries=0))
    config = MapTrainConfig(
        mapper,
        steps=180,
        batch=2,
        learning_rate=6e-3,
        warmup_steps=10,
        ema_decay=0.9,
        max_token_dropout=0.0,
        line_field_steps=20,
    )
    run = Trainer(MapTask(config, Streets(2), 0), tmp_path)
    streets = [Streets(2).draw(k) for k in range(2)]
    truth = place_side_by_side([street.truth for street in streets])
    before = quality(run.average, streets, truth)
    for _ in range(config.steps):
        run.advance()
    after = quality(run.average, streets, truth)
    assert before < 0.1 and after > 0.9, (before, after)


@torch.no_grad()
def quality(model, streets, truth):
    raw = model.predict_elements(
        model.fuse_features(*warp_tokens(model, extract_features(model, streets).tokens, streets))
    )[-1]
    drawn = place_side_by_side(decode_elements(raw, TINY.tile, TINY.head))
    return evaluate_map(drawn, truth, ("exact",), TINY.head.kinds).mean_ap("exact", kinds=TINY.head.kinds)


def test_every_weight_of_the_lidar_path_learns():
    torch.manual_seed(0)
    model = MapModel(TINY)
    # Branches of the head are zero-initialised, and layers before a zero weight learn one step later.
    with torch.no_grad():
        for branch in (*model.head.class_branches, *model.head.point_branches):
            list(branch.parameters())[-2].normal_(std=0.1)
    terms = loss_terms(model, [Streets().draw(0), Streets().draw(1)], CONFIG.loss, torch.full((4,), 0.2))
    terms.total(CONFIG.loss).backward()
    silent = [name for name, p in model.named_parameters() if p.grad is None or not bool((p.grad != 0).any())]
    # Blocks begin as their shortcuts.
    waiting = {name for name in silent if ".inner." in name}
    assert set(silent) - waiting == set()


def make_task(kind: str) -> MapTask:
    if kind == "lidar":
        return MapTask(CONFIG, Streets(), 3)
    image = ImageEncoderConfig((1, 1), 8, channels=16, gradient_checkpointing=True)
    bev = dataclasses.replace(TINY.bev, sensors=("camera",), image_encoder=image, image_size=(48, 64))
    config = dataclasses.replace(CONFIG, map_model=dataclasses.replace(TINY, bev=bev))
    return MapTask(config, Photos(config.map_model), 3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lidar", "camera"])
def test_a_step_on_a_device_has_the_loss_and_the_weights_of_the_cpu(tmp_path, device, is_gpu, kind):
    ours, theirs = (Trainer(make_task(kind), tmp_path / str(i), d) for i, d in enumerate(("cpu", device)))
    begun = [p.detach().clone() for p in ours.model.parameters()]
    one, other = ours.advance(), theirs.advance()
    assert other.loss == pytest.approx(one.loss, rel=1e-5)
    assert other.terms == pytest.approx(one.terms, rel=1e-4, abs=1e-6)
    assert all(p.device == device for p in theirs.model.parameters())
    # AdamW's first moment is then a tenth of the gradient.
    grads = [
        torch.cat([state["exp_avg"].cpu().flatten() for state in trainer.optimiser.state.values()])
        for trainer in (ours, theirs)
    ]
    assert float((grads[0] - grads[1]).norm()) < 1e-3 * float(grads[0].norm())
    pairs = list(zip(begun, ours.model.parameters(), theirs.model.parameters(), strict=True))
    apart, moved = (
        math.sqrt(sum(float((a.detach().cpu() - b.detach().cpu()).square().sum()) for a, b in each))
        for each in ([(mine, its) for _, mine, its in pairs], [(was, mine) for was, mine, _ in pairs])
    )
    # AdamW's first step is the sign of a gradient: rounding turns it where the gradient is nearly zero, which on a GPU is every
    # weight whose exact gradient is zero.
    assert moved > 0 and apart < (0.5 if is_gpu else 0.02) * moved


@pytest.mark.slow
def test_a_run_goes_on_on_another_device_and_ends_with_calibrated_weights(tmp_path, device):
    # Without a threshold even a model that has learnt nothing draws something.
    mapper = dataclasses.replace(TINY, head=dataclasses.replace(TINY.head, score_threshold=0.0))
    task = MapTask(dataclasses.replace(CONFIG, map_model=mapper, steps=3, calibration_tiles=1), Streets(), 3)
    whole = Trainer(task, tmp_path / "whole")
    losses = [whole.advance().loss for _ in range(2)]
    moved = []
    for kind in ("cpu", device):
        run = Trainer(task, tmp_path / "moved", kind)
        assert run.step == len(moved)
        moved.append(run.advance().loss)
        run.save()
    assert moved == pytest.approx(losses, rel=1e-3)
    last = Trainer(task, tmp_path / "moved", "cpu").model.state_dict()
    assert all(value.device.type == "cpu" for value in last.values())
    weights = Trainer(task, tmp_path / "moved", device).run()
    assert not torch.equal(checkpoint.read_state(weights, FORMAT)["logit_scale"].float(), torch.ones(3))
    assert checkpoint.load_as(weights, FORMAT, MapModelConfig, MapModel).config == mapper
