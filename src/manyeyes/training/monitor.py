# SPDX-License-Identifier: Apache-2.0
"""Observation of a training run: the progress of each step, and pictures of validated weights."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from PIL.Image import Image


@dataclass(frozen=True)
class Progress:
    """Progress of one step: one line of the log.

    terms: of the loss, and measures of the batch. validation: measures of the averaged weights, empty at most steps.
    """

    step: int
    steps: int
    loss: float
    terms: dict[str, float]
    learning_rate: float
    seconds: float
    validation: dict[str, float] = field(default_factory=dict)

    def to_record(self) -> dict[str, Any]:
        """Return the line of log.jsonl."""
        terms = {name: round(value, 5) for name, value in self.terms.items()}
        measures = {name: round(value, 5) for name, value in self.validation.items()}
        record = {"step": self.step, "loss": round(self.loss, 5), **terms, "lr": self.learning_rate}
        return record | ({"validation": measures} if measures else {})


class Monitor:
    """An observer of a run, called by its first process; this one does nothing."""

    @property
    def draws(self) -> bool:
        """Whether pictures are wanted."""
        return False

    def record(self, progress: Progress) -> None:
        """Record a step, after its line of the log is written and before its state is saved."""

    def show(self, step: int, pictures: dict[str, Image]) -> None:
        """Show pictures, by name, of the averaged weights that were validated after a step."""
