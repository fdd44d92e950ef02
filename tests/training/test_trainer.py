# SPDX-License-Identifier: Apache-2.0
"""The trainer on a task of one linear layer: log, saves, interrupts, averages, schedule."""

import itertools
import json
import os
import resource
import signal
from dataclasses import dataclass, replace

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.training.optimiser import parameter_groups
from manyeyes.training.presets import TRAINING_PRESETS
from manyeyes.training.trainer import Task, TrainConfig, Trainer, warmup_cosine

pytestmark = pytest.mark.training

CONFIG = TrainConfig(steps=6, batch=4, learning_rate=0.1, warmup_steps=2, save_every=2)


@dataclass(frozen=True)
class LineConfig:
    width: int = 3


class Line(nn.Linear):
    def __init__(self) -> None:
        super().__init__(3, 1)
        self.config = LineConfig()


@dataclass
class LineTask(Task[TrainConfig, Line, Tensor]):
    """Samples are rows of numbers, the loss is the mean square of an error."""

    format = "line"
    config: TrainConfig
    seed: int = 0
    is_given: bool = False

    @property
    def is_initialised(self) -> bool:
        return self.is_given

    def make_model(self) -> Line:
        return Line()

    def draw(self, number: int) -> Tensor:
        return torch.tensor([number % 3, number % 5, 1.0])

    def loss(self, model: Line, samples: list[Tensor], numbers: range, step: int) -> tuple[Tensor, dict[str, Tensor]]:
        rows = torch.stack(samples)
        error = (model(rows)[:, 0] - rows[:, 0] + 2 * rows[:, 1]).square().mean()
        return error, {"error": error, "samples": torch.tensor(float(len(numbers)))}

    def finish(self, model: Line) -> dict[str, str]:
        return {"finished": "yes"}


def steps_of(folder) -> list[int]:
    return [json.loads(line)["step"] for line in (folder / "log.jsonl").read_text().splitlines()]


def test_an_interrupted_run_ends_with_the_same_result(tmp_path, check_resumption):
    check_resumption(lambda: LineTask(CONFIG, 3), tmp_path)


def test_a_run_writes_averaged_weights_a_card_and_a_log(tmp_path):
    reports = []
    weights = Trainer(LineTask(CONFIG, 1), tmp_path).run({"command": "x"}, reports.append)
    assert steps_of(tmp_path) == [1, 2, 3, 4, 5, 6] == [p.step for p in reports]
    assert reports[-1].loss < reports[0].loss and reports[0].terms["error"] == pytest.approx(reports[0].loss)
    assert {p.name for p in tmp_path.iterdir()} == {"last.pt", "log.jsonl", "weights.safetensors"}
    state, saved = torch.load(tmp_path / "last.pt", weights_only=True), load_file(weights)
    assert torch.equal(saved["weight"], state["average"]["weight"].half())
    assert not torch.equal(state["average"]["weight"], state["model"]["weight"])


def test_a_finished_run_trains_no_more_and_lines_after_the_last_save_are_dropped(tmp_path):
    weights = Trainer(LineTask(CONFIG), tmp_path).run()
    before = load_file(weights)
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"step": 7, "loss": 0.0}\n{"step": 8, "lo')
    again = Trainer(LineTask(CONFIG), tmp_path)
    again.run()
    assert steps_of(tmp_path) == [1, 2, 3, 4, 5, 6]
    assert again.loss == pytest.approx(
        json.loads((tmp_path / "log.jsonl").read_text().splitlines()[-1])["loss"], abs=1e-5
    )
    assert all(torch.equal(value, before[name]) for name, value in load_file(weights).items())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_saves_its_step_and_goes_on(tmp_path, number):
    whole = Trainer(LineTask(CONFIG), tmp_path / "whole")
    whole.run()
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]

    def interrupt(progress):
        if progress.step == 3:
            os.kill(os.getpid(), number)

    run = Trainer(LineTask(CONFIG), tmp_path / "broken")
    with pytest.raises(KeyboardInterrupt):
        run.run(report=interrupt)
    assert handlers == [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    resumed = Trainer(LineTask(CONFIG), tmp_path / "broken")
    assert resumed.step == 3
    resumed.run()
    assert steps_of(tmp_path / "broken") == [1, 2, 3, 4, 5, 6]
    assert torch.equal(resumed.model.weight, whole.model.weight)


def test_a_batch_in_parts_has_the_gradient_and_the_loss_of_the_whole(tmp_path):
    whole = Trainer(LineTask(CONFIG), tmp_path / "whole")
    parts = Trainer(LineTask(replace(CONFIG, micro_batch=3)), tmp_path / "parts")
    one, other = whole.advance(), parts.advance()
    assert other.loss == pytest.approx(one.loss) and other.terms["error"] == pytest.approx(one.loss)
    assert other.terms["samples"] == 0.75 * 3 + 0.25 * 1
    assert torch.allclose(whole.model.weight, parts.model.weight)


def test_the_same_seed_is_the_same_run_and_another_is_not(tmp_path):
    runs = [Trainer(LineTask(CONFIG, seed), tmp_path / str(i)) for i, seed in enumerate((5, 5, 6))]
    for run in runs:
        run.advance()
    assert torch.equal(runs[0].model.weight, runs[1].model.weight)
    assert not torch.equal(runs[0].model.weight, runs[2].model.weight)


def test_a_folder_of_another_run_or_a_damaged_state_is_refused(tmp_path):
    Trainer(LineTask(CONFIG, 3), tmp_path).save()
    for task, difference in (
        (LineTask(CONFIG, 4), "the seed is 3 there and 4 here"),
        (LineTask(replace(CONFIG, learning_rate=1.0), 3), "learning_rate is 0.1 there and 1.0 here"),
        (LineTask(CONFIG, 3, True), r"initial weights are random there and \w{16} here"),
    ):
        with pytest.raises(CheckpointError, match=rf"last\.pt: belongs to another run: {difference}\. Give"):
            Trainer(task, tmp_path)
    path = tmp_path / "last.pt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match=r"last\.pt: not a whole training state"):
        Trainer(LineTask(CONFIG, 3), tmp_path)


def test_a_loss_that_is_not_finite_stops_the_run_and_names_the_step(tmp_path):
    run = Trainer(LineTask(CONFIG), tmp_path)
    with torch.no_grad():
        run.model.bias.fill_(torch.nan)
    with pytest.raises(ConfigError, match="The loss is nan at step 0"):
        run.advance()


def test_a_batch_that_cannot_be_shared_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
    monkeypatch.setattr("torch.distributed.get_rank", lambda: 0)
    monkeypatch.setattr("torch.distributed.get_world_size", lambda: 3)
    with pytest.raises(ConfigError, match="batch of 4 samples cannot be shared by 3"):
        Trainer(LineTask(CONFIG), tmp_path).advance()


def test_the_learning_rate_grows_linearly_and_falls_as_a_cosine():
    rates = [warmup_cosine(10, step, 100) for step in range(101)]
    assert rates[0] == pytest.approx(0.1) and max(rates) == rates[9] and rates[100] == pytest.approx(0.0, abs=1e-9)
    assert all(a > b for a, b in itertools.pairwise(rates[9:]))


def test_only_matrices_have_weight_decay():
    decayed, rest = parameter_groups(Line(), 0.5)
    assert ([p.dim() for p in decayed["params"]], [p.dim() for p in rest["params"]]) == ([2], [1])
    assert (decayed["weight_decay"], rest["weight_decay"]) == (0.5, 0.0)


def test_presets_of_all_tasks_have_names_of_their_own():
    assert {"costr-small/stage1", "feakm-small", "map-small-lidar"} <= set(TRAINING_PRESETS)
    assert all(config.batch >= 1 and config.learning_rate > 0 for config in TRAINING_PRESETS.values())


def test_a_full_disk_keeps_the_last_state_and_the_run_goes_on_from_it(tmp_path):
    whole = Trainer(LineTask(CONFIG), tmp_path / "whole")
    whole.run()

    def fill(progress):
        if progress.step == 3:
            used = (tmp_path / "full" / "log.jsonl").stat().st_size
            resource.setrlimit(resource.RLIMIT_FSIZE, (used + 20, limit[1]))

    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with pytest.raises(OSError, match="free some space and run again") as error:
            Trainer(LineTask(CONFIG), tmp_path / "full").run(report=fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert error.value.filename == str(tmp_path / "full" / "log.jsonl")
    resumed = Trainer(LineTask(CONFIG), tmp_path / "full")
    assert resumed.step == 2
    resumed.run()
    assert (tmp_path / "full" / "log.jsonl").read_bytes() == (tmp_path / "whole" / "log.jsonl").read_bytes()
    assert torch.equal(resumed.model.weight, whole.model.weight)


def test_a_full_disk_at_a_save_names_the_state_and_keeps_the_last_one(tmp_path):
    run = Trainer(LineTask(CONFIG), tmp_path)
    run.save()
    before, limit = run.path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    run.advance()
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))
    try:
        with pytest.raises(OSError, match="free some space") as error:
            run.save()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert error.value.filename == str(run.path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"last.pt": before}


def test_a_state_that_is_older_than_a_field_of_the_configuration_goes_on(tmp_path):
    run = Trainer(LineTask(CONFIG), tmp_path)
    run.advance()
    run.save()
    state = torch.load(run.path, weights_only=True)
    stored = json.loads(state["config"])
    del stored["micro_batch"]
    torch.save({**state, "config": json.dumps(stored)}, run.path)
    assert Trainer(LineTask(CONFIG), tmp_path).step == 1
    with pytest.raises(CheckpointError, match="micro_batch is None there and 2 here"):
        Trainer(LineTask(replace(CONFIG, micro_batch=2)), tmp_path)
