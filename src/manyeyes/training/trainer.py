# SPDX-License-Identifier: Apache-2.0
"""Training of any task: keyed randomness, resumable, one or more processes, averaged weights."""

from __future__ import annotations

import copy
import io
import json
import math
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from manyeyes._io import atomic_write, atomic_write_text, flush_files, name_errors
from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models import checkpoint
from manyeyes.training.mixed_precision import Precision, multiply_in_bfloat16
from manyeyes.training.monitor import Monitor, Progress
from manyeyes.training.optimiser import AveragedWeights, clip_gradients, load_optimiser, make_optimiser, to_cpu
from manyeyes.training.prefetch import prefetch
from manyeyes.training.run_identity import RunIdentity

if TYPE_CHECKING:
    from PIL.Image import Image

STEPS_BETWEEN_READS = 10
"""Off the CPU, losses are read, checked and logged every so many steps, and before a save: reading waits for the device."""

Config = TypeVar("Config", bound="TrainConfig")
Model = TypeVar("Model", bound=nn.Module)
Sample = TypeVar("Sample")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Settings that all tasks share.

    Attributes:
        steps: number of optimiser steps.
        batch: samples per step over all processes.
        learning_rate: its peak.
        beta2: decay of Adam's second moment.
        warmup_steps: steps of linear growth of the learning rate, before a cosine to zero.
        max_grad_norm: at which gradients are clipped.
        ema_decay: decay of the averaged weights, which are saved.
        micro_batch: samples that a process holds in memory together, None for all of its batch; batch norms see one part at a time.
        save_every: steps between two saves of the training state.
        validate_every: steps between two measurements on a recording of validation, whose best weights are the result; 0 for none.
        validate_frames: maximum number of frames of a measurement, the same ones each time, spread evenly.
        precision: of products of convolutions and attention; see training/mixed_precision.py.
    """

    steps: int
    batch: int = 4
    learning_rate: float = 2e-4
    weight_decay: float = 1e-2
    beta2: float = 0.999
    warmup_steps: int = 100
    max_grad_norm: float = 10.0
    ema_decay: float = 0.999
    micro_batch: int | None = None
    save_every: int = 200
    validate_every: int = 0
    validate_frames: int = 40
    precision: Precision = "float32"


class Task(ABC, Generic[Config, Model, Sample]):
    """What is trained: a model, an endless keyed stream of samples, and a loss.

    Attributes:
        format: format name in the metadata of the weights file.
        shown_terms: names of the loss terms that a progress bar shows.
        config: settings, which identify the run together with the seed.
    """

    format: ClassVar[str]
    shown_terms: ClassVar[tuple[str, ...]] = ()
    config: Config
    seed: int

    @property
    def is_initialised(self) -> bool:
        """Whether make_model starts from given weights."""
        return False

    @property
    def steps(self) -> int:
        """Number of optimiser steps."""
        return self.config.steps

    @abstractmethod
    def make_model(self) -> Model:
        """Make the model before the first step; torch's random state is seeded."""

    @abstractmethod
    def draw(self, number: int) -> Sample:
        """Draw the sample of this number, deterministically."""

    @abstractmethod
    def loss(self, model: Model, samples: list[Sample], numbers: range, step: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the loss of samples with these numbers, and the terms for the log, as scalars."""

    def validate(self, weights: Path) -> dict[str, float]:
        """Measure a file of averaged weights; the first measure, where more is better, decides which are the best.

        Raises:
            ConfigError: the task has nothing to validate on.
        """
        raise ConfigError("This training has no recording of validation; give one, or set validate_every to 0.")

    def draw_pictures(self, weights: Path) -> dict[str, Image]:
        """Draw what a file of averaged weights finds, by name; nothing by default."""
        return {}

    def finish(self, model: Model) -> dict[str, Any]:
        """Adjust the averaged model after the last step; returns additions to its card."""
        return {}


@dataclass(frozen=True, eq=False)
class _StepResult:
    """What a step measured, still on the device: values (1 + terms,), the loss and the terms of these names."""

    step: int
    values: Tensor
    names: tuple[str, ...]
    rate: float
    seconds: float


class Trainer(Generic[Model, Sample]):
    """A resumable training run in a folder, of one process or of one of several that share every batch.

    The folder holds last.pt (training state), log.jsonl (one object per step) and weights.safetensors (float16). Two runs must not
    write to one folder at once: hold its lock (:func:`manyeyes._lock.hold_folder`), as ``manyeyes train`` does.

    device: of the model; samples are drawn on the CPU. The state of a run can be resumed on any device.
    workers: processes that draw the samples of run ahead of its steps; 0 draws them in this one. The result is the same.
    tensorboard: whether run writes scalars and pictures to the folder tensorboard.

    Raises:
        CheckpointError: the folder holds a run of another configuration, seed or initial weights, or a damaged state.
    """

    def __init__(
        self,
        task: Task[Any, Model, Sample],
        folder: Path,
        device: torch.device | str = "cpu",
        workers: int = 0,
        tensorboard: bool = False,
    ) -> None:
        self.task, self.folder, self.device, self.workers = task, folder, torch.device(device), workers
        self._tensorboard, self._monitor = tensorboard, Monitor()
        self._draw = task.draw
        self.rank, self.world_size = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        with torch.random.fork_rng():
            torch.manual_seed(task.seed)
            self.model = task.make_model()
        begun = checkpoint.fingerprint(self.model).hex() if task.is_initialised else ""
        self.model.to(self.device)
        self.average = copy.deepcopy(self.model).requires_grad_(False)
        if task.config.precision == "bfloat16":
            multiply_in_bfloat16(self.model)
        self._averaged_weights = AveragedWeights(self.average, self.model)
        self.optimiser = make_optimiser(self.model, task.config.weight_decay, task.config.beta2)
        self.step, self.seconds = 0, 0.0
        self.loss: float | None = None  # of the last step
        self.best: dict[str, float] | None = None  # step and measures of the best validation
        self._identity = RunIdentity(task.config, task.seed, begun)
        if self.path.exists():
            self._resume()
        if not self.rank:
            _trim_log(self.log_path, self.step)

    @property
    def log_path(self) -> Path:
        """The file of the log, one line per step."""
        return self.folder / "log.jsonl"

    @property
    def best_path(self) -> Path:
        """The file of the averaged weights with the best validation."""
        return self.folder / "best.safetensors"

    @property
    def path(self) -> Path:
        """The file of the saved training state."""
        return self.folder / "last.pt"

    def run(
        self, card: dict[str, Any] | None = None, report: Callable[[Progress], None] = lambda progress: None
    ) -> Path:
        """Train to the last step; returns the file of averaged weights, with this card.

        The first process writes the log and calls report at every step. SIGINT and SIGTERM end the run after its current step,
        which is saved.
        """
        numbers = (n for step in range(self.step, self.task.steps) for n in self._sample_numbers(step))
        with (
            prefetch(self.task.draw, numbers, self.workers) as self._draw,
            self._open_monitor() as self._monitor,
            _defer_interrupts() as interrupted,
        ):
            self._run_steps(report, interrupted)
        self._draw = self.task.draw
        weights = self.folder / "weights.safetensors"
        if not self.rank:
            self._write_result(weights, card or {})
        return weights

    def _open_monitor(self) -> AbstractContextManager[Monitor]:
        if self.rank or not self._tensorboard:
            return nullcontext(Monitor())
        from manyeyes.training.tensorboard import open_tensorboard

        return open_tensorboard(self.folder, self.step)

    def _run_steps(self, report: Callable[[Progress], None], interrupted: threading.Event) -> None:
        unread: list[_StepResult] = []
        while self.step < self.task.steps:
            unread.append(self._advance())
            is_measured = self._is_measured()
            is_due = is_measured or not self.step % self.task.config.save_every or self.step == self.task.steps
            if is_due or interrupted.is_set() or len(unread) >= self._steps_between_reads:
                for progress in self._read(unread):
                    if not self.rank:
                        self._record(progress, is_measured and progress.step == self.step, report)
                unread = []
            if is_due or interrupted.is_set():
                self.save()
            if interrupted.is_set():
                raise KeyboardInterrupt

    def _record(self, progress: Progress, is_measured: bool, report: Callable[[Progress], None]) -> None:
        """Record a step in the log and with observers; is_measured: after a validation."""
        if is_measured:
            progress = replace(progress, validation=self._validate())
        self._log(progress)
        self._monitor.record(progress)
        report(progress)

    def _write_result(self, weights: Path, card: dict[str, Any]) -> None:
        """Write the averaged weights, those of the best validation where there were any, with their card."""
        result: Model = self.average
        about: dict[str, Any] = {"seed": self.task.seed, "steps": self.task.steps}
        if self.best is not None:
            result = copy.deepcopy(self.average)
            result.load_state_dict(checkpoint.read_state(self.best_path, self.task.format), strict=False)
            about["best_validation"] = self.best
        about |= self.task.finish(result)
        about |= {"train_seconds": round(self.seconds), "config": asdict(self.task.config)}
        checkpoint.save(result, weights, about | card, half=True, format=self.task.format)

    def _is_measured(self) -> bool:
        """Return whether averaged weights are validated after the current step, the last one always."""
        every = self.task.config.validate_every
        return bool(every) and (not self.step % every or self.step == self.task.steps)

    def _validate(self) -> dict[str, float]:
        """Measure the averaged weights, and keep them where they are the best so far; of equal ones the first."""
        candidate = self.folder / "candidate.safetensors"
        checkpoint.save(self.average, candidate, {"step": self.step}, half=True, format=self.task.format)
        measures = self.task.validate(candidate)
        if self._monitor.draws:
            self._monitor.show(self.step, self.task.draw_pictures(candidate))
        first = next(iter(measures))
        if self.best is None or measures[first] > self.best[first]:
            self.best = {"step": self.step, **measures}
            candidate.replace(self.best_path)
        candidate.unlink(missing_ok=True)
        return measures

    def advance(self) -> Progress:
        """Run one optimiser step."""
        return self._read([self._advance()])[0]

    def _advance(self) -> _StepResult:
        """Run one optimiser step without waiting for what it measures."""
        config, began = self.task.config, time.monotonic()
        numbers = self._sample_numbers(self.step)
        self.model.train()
        total: Tensor | None = None
        names: tuple[str, ...] = ()
        for part in _split(numbers, config.micro_batch or len(numbers)):
            samples = [self._draw(number) for number in part]
            loss, terms = self.task.loss(self.model, samples, part, self.step)
            fraction = len(part) / len(numbers)
            names = tuple(terms)
            values = torch.stack([value.detach().to(self.device) for value in (loss, *terms.values())]) * fraction
            total = values if total is None else total + values
            if self.device.type == "cpu":
                _check_loss(float(loss.detach()), self.step)
            (loss * fraction).backward()
        assert total is not None
        rate = config.learning_rate * warmup_cosine(config.warmup_steps, self.step, self.task.steps)
        self._optimiser_step(rate)
        self.seconds += time.monotonic() - began
        return _StepResult(self.step, total, names, rate, self.seconds)

    @property
    def _steps_between_reads(self) -> int:
        return 1 if self.device.type == "cpu" else STEPS_BETWEEN_READS

    def _read(self, results: Sequence[_StepResult]) -> list[Progress]:
        """Read the loss and terms of steps, in one copy from the device.

        Raises:
            ConfigError: a loss is not finite.
        """
        found = []
        for result, values in zip(results, torch.stack([result.values for result in results]).tolist()):
            self.loss = _check_loss(values[0], result.step - 1)
            terms = dict(zip(result.names, values[1:]))
            found.append(Progress(result.step, self.task.steps, self.loss, terms, result.rate, result.seconds))
        return found

    def save(self) -> None:
        """Save everything that is needed to resume as if uninterrupted, atomically."""
        if self.rank:
            return
        parts = {name: to_cpu(getattr(self, name).state_dict()) for name in ("model", "average", "optimiser")}
        # In memory first: torch reports a full disk as a RuntimeError without the file's name.
        content = io.BytesIO()
        torch.save(
            {
                **self._identity.to_record(),
                **parts,
                "step": self.step,
                "seconds": self.seconds,
                "loss": self.loss,
                "best": self.best,
            },
            content,
        )
        if self.log_path.exists():
            flush_files([self.log_path])  # a resumed run keeps the lines up to this state
        atomic_write(self.path, content.getbuffer())

    def _log(self, progress: Progress) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        with name_errors(self.log_path), self.log_path.open("a", encoding="utf-8") as log:
            log.write(json.dumps(progress.to_record()) + "\n")

    def _sample_numbers(self, step: int) -> range:
        """Return the sample numbers of this process for a step."""
        batch = self.task.config.batch
        if batch % self.world_size:
            raise ConfigError(f"A batch of {batch} samples cannot be shared by {self.world_size} processes evenly.")
        count = batch // self.world_size
        first = step * batch + self.rank * count
        return range(first, first + count)

    def _optimiser_step(self, rate: float) -> None:
        """Step down the mean loss of all processes and update the averaged weights, faster at the start."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self._average_gradients()
        clip_gradients(self.model.parameters(), self.task.config.max_grad_norm)
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        self._averaged_weights.update(min(self.task.config.ema_decay, (1 + self.step) / (10 + self.step)))
        self.step += 1

    def _average_gradients(self) -> None:
        """Average gradients and running statistics over processes, in one flat all-reduce each."""
        if self.world_size == 1:
            return
        for p in self.model.parameters():
            p.grad = torch.zeros_like(p) if p.grad is None else p.grad
        _mean_in_place([p.grad for p in self.model.parameters() if p.grad is not None], self.world_size)
        _mean_in_place([b for b in self.model.buffers() if b.is_floating_point()], self.world_size)

    def _resume(self) -> None:
        try:
            state = torch.load(self.path, weights_only=True, map_location="cpu")
        except Exception as error:
            raise CheckpointError(
                f"{self.path}: not a whole training state ({type(error).__name__}); delete it to start again."
            ) from error
        differences = self._identity.list_differences(state)
        if differences:
            raise CheckpointError(
                f"{self.path}: belongs to another run: {'; '.join(differences)}. Give another --out, or delete it."
            )
        self.model.load_state_dict(state["model"])
        self.average.load_state_dict(state["average"])
        load_optimiser(self.optimiser, state["optimiser"])
        self.step, self.seconds, self.loss = state["step"], state["seconds"], state.get("loss")
        self.best = state.get("best")


def warmup_cosine(warmup_steps: int, step: int, steps: int) -> float:
    """Return the learning rate as a fraction of its peak: linear warm-up over warmup_steps, times a cosine to zero."""
    return min(1.0, (step + 1) / max(1, warmup_steps)) * 0.5 * (1 + math.cos(math.pi * step / steps))


def _check_loss(loss: float, step: int) -> float:
    """Return a loss that is finite; ConfigError for any other."""
    if not math.isfinite(loss):
        raise ConfigError(f"The loss is {loss} at step {step}; lower the learning rate, or resume from an older save.")
    return loss


def _split(numbers: range, size: int) -> Iterator[range]:
    return (numbers[first : first + size] for first in range(0, len(numbers), size))


@contextmanager
def _defer_interrupts() -> Iterator[threading.Event]:
    """Yield an event that the first SIGINT or SIGTERM sets; a second one acts as before. Only the main thread can."""
    interrupted, numbers = threading.Event(), (signal.SIGINT, signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return

    def restore() -> None:
        for number, handler in handlers.items():
            signal.signal(number, handler)

    def defer(number: int, frame: object) -> None:
        interrupted.set()
        restore()

    handlers = {number: signal.signal(number, defer) for number in numbers}
    try:
        yield interrupted
    finally:
        restore()


def _mean_in_place(tensors: Sequence[Tensor], world: int) -> None:
    """Replace each tensor by its mean over world processes, in one flat all-reduce."""
    if not tensors:
        return
    flat = torch.cat([t.flatten() for t in tensors])
    dist.all_reduce(flat)
    flat /= world
    for tensor, part in zip(tensors, flat.split([t.numel() for t in tensors])):
        tensor.copy_(part.view_as(tensor))


def _trim_log(path: Path, step: int) -> None:
    """Drop log lines written after the last save, which may be truncated; they will be written again."""
    if path.exists():
        kept = [line for line in path.read_text(encoding="utf-8").splitlines() if 0 < _step_of(line) <= step]
        atomic_write_text(path, "".join(line + "\n" for line in kept))


def _step_of(line: str) -> int:
    try:
        return int(json.loads(line)["step"])
    except (json.JSONDecodeError, KeyError, TypeError):
        return 0
