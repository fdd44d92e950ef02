# SPDX-License-Identifier: Apache-2.0
"""Training of the detector: resumes bit by bit, shares a batch between processes, grows, and runs the paper's preset."""

import dataclasses
import math
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from manyeyes.datatypes import CheckpointError
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_OPV2V, COSTR_TINY
from manyeyes.models.fusion.transform_tokens import AgentTokens, to_ego_frame
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig, _grow, _load_weights, prune_threshold
from manyeyes.training.trainer import Trainer

pytestmark = pytest.mark.training

TINY = DetectorTrainConfig(
    COSTR_TINY, steps=6, batch=2, warmup_steps=2, save_every=2, augment=AugmentConfig(max_agents=2)
)
ROAD = dataclasses.replace(
    TINY,
    augment=AugmentConfig(max_agents=99, early_fusion_prob=0.0),
    degradation=DegradationConfig(
        2,
        sender_history=1,
        delay_prob=0.5,
        max_delay_frames=2,
        pose_noise_prob=0.5,
        packet_loss_prob=0.5,
        budget_prob=1.0,
        min_budget_tokens=4,
    ),
)


def small(toy):
    return toy(agents_n=2, points_per_car=20, ground_points=60)


@pytest.mark.parametrize("config", (TINY, ROAD), ids=("plain", "road"))
def test_an_interrupted_run_ends_with_the_same_result(toy, tmp_path, check_resumption, config):
    check_resumption(lambda: DetectorTask(config, dataclasses.replace(small(toy), frames=4), 3), tmp_path)


def test_the_card_of_the_weights_holds_the_run(toy, tmp_path):
    config = dataclasses.replace(TINY, steps=0, epochs=0.75)
    weights = Trainer(DetectorTask(config, small(toy), 1), tmp_path).run({"command": "x"})
    card = checkpoint.read_card(weights)
    assert card["seed"] == 1 and card["steps"] == 2 and card["command"] == "x"
    assert card["config"]["detector"]["head_channels"] == 32 and checkpoint.load(weights).fingerprint
    assert len(checkpoint.load(weights).token_peaks or ()) == checkpoint.load(weights).token_channels


def test_the_prune_threshold_grows_between_two_fractions_of_the_run():
    config = dataclasses.replace(TINY, prune_warmup_start=0.1, prune_warmup_end=0.3)
    thresholds = [prune_threshold(config, step, 100) for step in (0, 10, 20, 30, 99)]
    assert thresholds == pytest.approx([0, 0, 0.05, 0.1, 0.1])


def test_a_second_stage_begins_where_the_first_ended(toy, tmp_path):
    first = Trainer(DetectorTask(dataclasses.replace(TINY, steps=2), small(toy), 1), tmp_path / "first").run()
    kept = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, prune_threshold=0.01))
    second = Trainer(DetectorTask(kept, small(toy), 2, first), tmp_path / "second")
    for name, value in checkpoint.load(first).state_dict().items():
        assert torch.equal(second.model.state_dict()[name], value), name
    narrower = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, head_channels=24))
    with pytest.raises(CheckpointError, match=r"head\.out\.weight does not fit"):
        Trainer(DetectorTask(narrower, small(toy), 2, first), tmp_path / "third")


def test_a_tensor_grows_at_its_ends_by_zeros_and_a_vector_keeps_its_own():
    old = torch.arange(6.0).view(2, 3) + 1
    grown = _grow(torch.full((3, 4), 9.0), old)
    assert grown is not None and grown.tolist() == [[1, 2, 3, 0], [4, 5, 6, 0], [0, 0, 0, 0]]
    bias = _grow(torch.tensor([7.0, 8.0, 9.0]), torch.tensor([1.0, 2.0]))
    assert bias is not None and bias.tolist() == [1, 2, 9]
    assert _grow(torch.zeros(2, 2), old) is None and _grow(torch.zeros(6), old) is None
    half = _grow(torch.zeros(2, 3), old.half())
    assert half is not None and half.dtype == torch.float32 and torch.equal(half, old)


def test_added_modules_start_without_effect(toy, tmp_path):
    """From one sweep and plain self-attention to two sweeps and a past: the same boxes, before the first step."""
    plain = dataclasses.replace(COSTR_TINY, sweeps=1, fusion="self-attention", prune_threshold=0.0)
    first = Trainer(
        DetectorTask(dataclasses.replace(TINY, detector=plain, steps=2), small(toy), 1), tmp_path / "first"
    ).run()
    grown = dataclasses.replace(plain, sweeps=2, fusion="fast")
    run = Trainer(DetectorTask(dataclasses.replace(TINY, detector=grown), small(toy), 2, first), tmp_path / "second")
    old, new = checkpoint.load(first), run.model.eval()
    now, before = (toy().snapshot("toy_0", i).frames[0].points for i in (1, 0))
    none = now[:0]
    with torch.no_grad():
        mine, theirs = (
            m.make_tokens(s, m.predict(s))
            for m, s in ((old, old.extract_features([now]).tokens), (new, new.extract_features([now], [none]).tokens))
        )
        past = new.extract_features([before], [none]).tokens
        ego_past = to_ego_frame(
            [AgentTokens(0, new.make_tokens(past, new.predict(past)).features, past.sites.xy)], old.token_grid, 1
        )
        tokens = to_ego_frame([AgentTokens(0, mine.features, mine.sites.xy)], old.token_grid, 1)
        fused, boxes = zip(old.fuse(tokens), new.fuse(tokens, ego_past))
    assert torch.equal(mine.sites.key, theirs.sites.key)
    assert torch.allclose(mine.features, theirs.features, atol=1e-5)
    assert len(ego_past.features) > 20 and torch.equal(boxes[0].sites.key, boxes[1].sites.key)
    assert torch.allclose(fused[0].bev.features, fused[1].bev.features, atol=1e-5)
    assert torch.allclose(boxes[0].to_rows(), boxes[1].to_rows(), atol=1e-6)


def fuse_alone(detector, cloud):
    """What a detector finds in a cloud, before decoding: its own boxes, and those after fusion with nothing."""
    with torch.no_grad():
        tokens = detector.extract_features([cloud]).tokens
        own = detector.predict(tokens)
        shared = detector.make_tokens(tokens, own)
        return own, detector.fuse(
            to_ego_frame([AgentTokens(0, shared.features, shared.sites.xy)], detector.token_grid, 1)
        )[1]


def test_an_added_class_leaves_the_heat_of_the_others(toy, tmp_path):
    with torch.random.fork_rng():
        torch.manual_seed(3)
        plain = dataclasses.replace(COSTR_TINY, prune_threshold=0.0)
        old = Detector(plain).eval()
        torch.nn.init.normal_(old.refine.out.weight, std=0.05)
        checkpoint.save(old, tmp_path / "one.safetensors", {})
        two = Detector(dataclasses.replace(plain, classes=("pedestrian", "vehicle"))).eval()
        _load_weights(two, tmp_path / "one.safetensors")
        cloud = toy().snapshot("toy_0", 1).frames[0].points
        begun = fuse_alone(two, cloud)
        torch.nn.init.normal_(two.refine.out.bias[-2:], std=0.5)
        torch.nn.init.normal_(two.head.out.weight[-2:-1], std=0.5)
        checkpoint.save(two, tmp_path / "two.safetensors", {})
        three = Detector(dataclasses.replace(plain, classes=("vehicle", "cyclist", "pedestrian"))).eval()
        _load_weights(three, tmp_path / "two.safetensors")
    for one_raw, begun_raw in zip(fuse_alone(old, cloud), begun):
        assert one_raw.heatmap_logit.numel() > 20
        assert torch.allclose(one_raw.heatmap_logit, begun_raw.class_heat[:, 1], atol=1e-5)
    for two_raw, three_raw in zip(*(fuse_alone(detector, cloud) for detector in (two, three))):
        assert torch.allclose(two_raw.class_heat[:, 0], three_raw.class_heat[:, 2], atol=1e-5)
        assert torch.allclose(two_raw.class_heat[:, 1], three_raw.class_heat[:, 0], atol=1e-5)
    # A class that is new has low heat at first.
    assert three.head.out.bias[-2].item() == -6.0 and three.refine.out.bias[-2].item() == -4.0
    assert not three.head.out.weight[-2].any() and not three.refine.out.weight[-2].any()


MEASURE = """
import torch
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.training.detector.losses import LossConfig
from manyeyes.training.detector.samples import AugmentConfig
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.trainer import Trainer

def measure(toy, out):
    # One frame of one agent without augmentation: all samples of the batch are alike.
    alike = toy(scenarios=("toy_0",), frames=1, agents_n=1, points_per_car=20, ground_points=60)
    # Windows of other samples are negatives of the selector's information: twins among them cost the logarithm of their number.
    loss = LossConfig(information=0.0)
    config = DetectorTrainConfig(COSTR_TINY, steps=6, batch=4, warmup_steps=2, augment=AugmentConfig.none(), loss=loss)
    run = Trainer(DetectorTask(config, alike, 0), out / "alike")
    first = run.advance()
    state = {k: v for k, v in run.model.state_dict().items() if "running" not in k and "tracked" not in k}
    varied = Trainer(DetectorTask(config, toy(frames=4, points_per_car=20, ground_points=60), 0), out / "varied")
    drawn, real = [], varied.task.stream.draw
    object.__setattr__(varied.task.stream, "draw", lambda n: drawn.append(n) or real(n))
    losses = [varied.advance().loss for _ in range(2)]
    return dict(loss=first.loss, state=state, drawn=drawn, losses=losses, varied=varied.model.state_dict())
"""

PROCESS = """
import datetime, pathlib, runpy, sys
import torch.distributed as dist
torch.set_num_threads(1)
here, port, rank, out = sys.argv[1], sys.argv[2], int(sys.argv[3]), pathlib.Path(sys.argv[4])
dist.init_process_group("gloo", f"tcp://127.0.0.1:{port}", datetime.timedelta(seconds=60), world_size=2, rank=rank)
torch.save(measure(runpy.run_path(here)["ToyRecording"], out), out / f"{rank}.pt")
dist.destroy_process_group()
"""


def two_processes(folder: Path) -> list[dict]:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "OMP_NUM_THREADS": "1"}
    arguments = [str(Path(__file__).with_name("conftest.py")), str(port)]
    started = [
        subprocess.Popen([sys.executable, "-c", MEASURE + PROCESS, *arguments, str(rank), str(folder)], env=environment)
        for rank in range(2)
    ]
    assert [p.wait(120) for p in started] == [0, 0]
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(2)]


def test_two_processes_equal_one_with_their_batch(toy, tmp_path):
    """Equal where it can be equal: each process normalises by its own samples (batch statistics, number of boxes, windows to
    tell apart), so one process of four samples and two of two agree to rounding only when those agree, here because all
    samples are alike."""
    first, second = two_processes(tmp_path)
    names: dict[str, Any] = {}
    exec(MEASURE, names)
    one = names["measure"](toy, tmp_path)
    assert first["loss"] == pytest.approx(one["loss"], rel=1e-5) and second["loss"] == pytest.approx(
        one["loss"], rel=1e-5
    )
    # The first step of AdamW is the sign of the gradient: where that is all rounding, weights may differ by two steps.
    differ = [(first["state"][k] - v).abs().flatten() for k, v in one["state"].items()]
    assert float((torch.cat(differ) > 1e-6).float().mean()) < 0.02
    assert all(torch.equal(v, second["state"][k]) for k, v in first["state"].items())
    # Different samples: no sample is drawn twice or left out, losses differ, weights and statistics stay the same.
    assert (one["drawn"], first["drawn"], second["drawn"]) == ([*range(8)], [0, 1, 4, 5], [2, 3, 6, 7])
    assert first["losses"] != second["losses"]
    for name, value in first["varied"].items():
        assert torch.equal(value, second["varied"][name]), name


def test_the_papers_preset_takes_a_step_and_resumes(toy, tmp_path):
    config = DetectorTrainConfig(COSTR_OPV2V, steps=2, batch=1, augment=AugmentConfig(max_agents=2))
    run = Trainer(DetectorTask(config, small(toy), 0), tmp_path)
    first = run.advance()
    run.save()
    assert math.isfinite(first.loss) and run.model.token_grid.stride == 8
    resumed = Trainer(DetectorTask(config, small(toy), 0), tmp_path)
    assert resumed.step == 1 and math.isfinite(resumed.advance().loss)
