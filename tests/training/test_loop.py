# SPDX-License-Identifier: Apache-2.0
"""The training loop: resumes bit by bit, shares a batch between processes, logs, and runs the paper's preset."""

import dataclasses
import itertools
import json
import math
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.detector.presets import COSTR_OPV2V, COSTR_TINY
from manyeyes.models.fusion.transform_tokens import AgentTokens, to_ego_frame
from manyeyes.training.detector.loop import (
    DetectorRun,
    TrainConfig,
    _grow,
    learning_rate,
    prune_threshold,
    train_detector,
)
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig

TINY = TrainConfig(COSTR_TINY, steps=6, batch=2, warmup_steps=2, save_every=2, augment=AugmentConfig(max_agents=2))
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


def same_state(a: torch.nn.Module, b: torch.nn.Module) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


@pytest.mark.parametrize("config", (TINY, ROAD), ids=("plain", "road"))
def test_a_run_that_was_killed_ends_as_if_it_had_not_been(toy, tmp_path, config):
    recording = dataclasses.replace(small(toy), frames=4)
    whole = DetectorRun(config, recording, tmp_path / "whole", seed=3)
    for _ in range(6):
        whole.advance()
    broken = DetectorRun(config, recording, tmp_path / "broken", seed=3)
    for _ in range(4):
        broken.advance()
        if broken.state.step == 2:
            broken.state.save()
    resumed = DetectorRun(config, recording, tmp_path / "broken", seed=3)
    assert resumed.state.step == 2 and not same_state(resumed.state.model, broken.state.model)
    last = [resumed.advance() for _ in range(4)][-1]
    assert last.step == 6
    assert same_state(resumed.state.model, whole.state.model) and same_state(resumed.state.average, whole.state.average)
    for mine, theirs in zip(resumed.state.optimiser.state.values(), whole.state.optimiser.state.values(), strict=True):
        assert torch.equal(mine["exp_avg"], theirs["exp_avg"]) and torch.equal(mine["exp_avg_sq"], theirs["exp_avg_sq"])


def test_train_writes_weights_a_log_and_goes_on_where_it_stopped(toy, tmp_path):
    reports = []
    weights = train_detector(TINY, small(toy), tmp_path, seed=1, card={"command": "x"}, report=reports.append)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2, 3, 4, 5, 6] == [p.step for p in reports]
    assert all(math.isfinite(line["loss"]) for line in lines)
    card = checkpoint.read_card(weights)
    assert card["seed"] == 1 and card["steps"] == 6 and card["command"] == "x"
    assert card["config"]["detector"]["head_channels"] == 32
    # A run that is over trains no more; lines after the last save are dropped and written again.
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write(json.dumps({"step": 7, "loss": 0.0}) + "\n")
    before = weights.read_bytes()
    train_detector(TINY, small(toy), tmp_path, seed=1, card={"command": "x"})
    assert [json.loads(line)["step"] for line in (tmp_path / "log.jsonl").read_text().splitlines()] == [
        1,
        2,
        3,
        4,
        5,
        6,
    ]
    assert checkpoint.load(weights).fingerprint and len(before) == weights.stat().st_size
    assert not list(tmp_path.glob("*.partial"))


def test_a_log_line_cut_by_a_kill_is_dropped(toy, tmp_path):
    train_detector(dataclasses.replace(TINY, steps=2), small(toy), tmp_path, seed=1)
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"step": 3, "lo')
    train_detector(dataclasses.replace(TINY, steps=2), small(toy), tmp_path, seed=1)
    assert [json.loads(line)["step"] for line in (tmp_path / "log.jsonl").read_text().splitlines()] == [1, 2]


def test_a_second_stage_begins_where_the_first_ended(toy, tmp_path):
    first = train_detector(dataclasses.replace(TINY, steps=2), small(toy), tmp_path / "first", seed=1)
    kept = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, prune_threshold=0.01))
    second = DetectorRun(kept, small(toy), tmp_path / "second", 2, first)
    for name, value in checkpoint.load(first).state_dict().items():
        assert torch.equal(second.state.model.state_dict()[name], value), name
    narrower = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, head_channels=24))
    with pytest.raises(CheckpointError, match=r"head\.out\.weight does not fit"):
        DetectorRun(narrower, small(toy), tmp_path / "third", 2, first)


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
    first = train_detector(dataclasses.replace(TINY, detector=plain, steps=2), small(toy), tmp_path / "first", seed=1)
    grown = dataclasses.replace(plain, sweeps=2, fusion="fast")
    run = DetectorRun(dataclasses.replace(TINY, detector=grown), small(toy), tmp_path / "second", 2, first)
    old, new = checkpoint.load(first), run.state.model.eval()
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
        fused = old.fuse_tokens(tokens), new.fuse_tokens(tokens, ego_past)
        boxes = old.fuse(tokens), new.fuse(tokens, ego_past)
    assert torch.equal(mine.sites.key, theirs.sites.key)
    assert torch.allclose(mine.features, theirs.features, atol=1e-5)
    assert len(ego_past.features) > 20 and torch.equal(boxes[0].sites.key, boxes[1].sites.key)
    assert torch.allclose(fused[0].bev.features, fused[1].bev.features, atol=1e-5)
    assert torch.allclose(boxes[0].to_rows(), boxes[1].to_rows(), atol=1e-6)


def test_the_shipped_weights_are_the_average(toy, tmp_path):
    train_detector(dataclasses.replace(TINY, steps=3), small(toy), tmp_path, seed=1)
    state = torch.load(tmp_path / "last.pt", weights_only=True)
    loaded = checkpoint.load(tmp_path / "weights.safetensors").state_dict()
    assert torch.equal(loaded["head.out.weight"], state["average"]["head.out.weight"].half().float())
    assert not torch.equal(loaded["head.out.weight"], state["model"]["head.out.weight"])


def test_a_folder_of_another_run_or_a_cut_state_is_refused(toy, tmp_path):
    run = DetectorRun(TINY, small(toy), tmp_path, seed=3)
    run.state.save()
    for config, seed in ((TINY, 4), (dataclasses.replace(TINY, learning_rate=1.0), 3)):
        with pytest.raises(CheckpointError, match=r"last\.pt: belongs to a run of another configuration or seed"):
            DetectorRun(config, small(toy), tmp_path, seed)
    path = tmp_path / "last.pt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match=r"last\.pt: not a whole training state"):
        DetectorRun(TINY, small(toy), tmp_path, 3)


def test_non_finite_loss_stops_the_run_and_names_the_step(toy, tmp_path):
    run = DetectorRun(TINY, small(toy), tmp_path, seed=3)
    with torch.no_grad():
        run.state.model.head.out.bias.fill_(torch.nan)
    with pytest.raises(ConfigError, match="The loss is nan at step 0"):
        run.advance()


def test_schedules():
    config = dataclasses.replace(TINY, learning_rate=1.0, warmup_steps=10, prune_warmup_start=0.1, prune_warmup_end=0.3)
    rates = [learning_rate(config, step, 100) for step in range(101)]
    assert rates[0] == pytest.approx(0.1) and max(rates) == rates[9] and rates[100] == pytest.approx(0.0, abs=1e-9)
    assert all(a > b for a, b in itertools.pairwise(rates[9:]))
    thresholds = [prune_threshold(config, step, 100) for step in (0, 10, 20, 30, 99)]
    assert thresholds == pytest.approx([0, 0, 0.05, 0.1, 0.1])


def test_the_same_seed_is_the_same_run_and_another_is_not(toy, tmp_path):
    runs = [DetectorRun(TINY, small(toy), tmp_path / str(i), seed) for i, seed in enumerate((5, 5, 6))]
    for run in runs:
        run.advance()
    assert same_state(runs[0].state.model, runs[1].state.model) and not same_state(
        runs[0].state.model, runs[2].state.model
    )


MEASURE = """
import torch
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.training.detector.loop import DetectorRun, TrainConfig
from manyeyes.training.detector.losses import LossConfig
from manyeyes.training.detector.samples import AugmentConfig

def measure(toy, out):
    # One frame of one agent without augmentation: all samples of the batch are alike.
    alike = toy(scenarios=("toy_0",), frames=1, agents_n=1, points_per_car=20, ground_points=60)
    # Windows of other samples are negatives of the selector's information: twins among them cost the logarithm of their number.
    loss = LossConfig(information=0.0)
    config = TrainConfig(COSTR_TINY, steps=6, batch=4, warmup_steps=2, augment=AugmentConfig.none(), loss=loss)
    run = DetectorRun(config, alike, out / "alike", 0)
    first = run.advance()
    state = {k: v for k, v in run.state.model.state_dict().items() if "running" not in k and "tracked" not in k}
    varied = DetectorRun(config, toy(frames=4, points_per_car=20, ground_points=60), out / "varied", 0)
    drawn, real = [], varied.stream.draw
    object.__setattr__(varied.stream, "draw", lambda n: drawn.append(n) or real(n))
    losses = [varied.advance().loss for _ in range(2)]
    return dict(loss=first.loss, state=state, drawn=drawn, losses=losses, varied=varied.state.model.state_dict())
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


def test_a_batch_that_cannot_be_shared_is_refused(toy, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
    monkeypatch.setattr("torch.distributed.get_rank", lambda: 0)
    monkeypatch.setattr("torch.distributed.get_world_size", lambda: 4)
    with pytest.raises(ConfigError, match="batch of 2 samples cannot be shared by 4"):
        DetectorRun(TINY, small(toy), tmp_path, seed=0).advance()


def test_the_papers_preset_takes_a_step_and_resumes(toy, tmp_path):
    config = TrainConfig(COSTR_OPV2V, steps=2, batch=1, augment=AugmentConfig(max_agents=2))
    run = DetectorRun(config, small(toy), tmp_path, seed=0)
    first = run.advance()
    run.state.save()
    assert math.isfinite(first.loss) and run.state.model.token_grid.stride == 8
    resumed = DetectorRun(config, small(toy), tmp_path, seed=0)
    assert resumed.state.step == 1 and math.isfinite(resumed.advance().loss)
