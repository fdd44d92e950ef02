# SPDX-License-Identifier: Apache-2.0
"""The loss of a training run and its terms over steps, from the run's own log."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from manyeyes._io import atomic_replace
from manyeyes.datatypes import MissingExtraError, RecordingError

_NOT_TERMS = ("step", "lr", "validation")
_SMOOTH_SHARE = 0.02


def save_loss_curve(log: Path, path: Path) -> None:
    """A PNG of every term of log.jsonl, on a logarithmic axis, each with its running mean."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("view", "Drawing the loss") from error
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines() if line]
    if not lines:
        raise RecordingError(f"{log}: no step in it; train for at least one step before drawing the loss.")
    steps = np.array([line["step"] for line in lines])
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for name in (key for key in lines[0] if key not in _NOT_TERMS):
        values = np.array([line[name] for line in lines], float)
        width = max(1, round(_SMOOTH_SHARE * len(values)))
        smooth = np.convolve(values, np.ones(width) / width, "valid")
        main = name == "loss"
        (line,) = axes.plot(steps[width - 1 :], smooth, lw=2 if main else 1, label=name, zorder=3 if main else 2)
        if main:
            axes.plot(steps, values, lw=0.5, alpha=0.25, color=line.get_color(), zorder=1)
    # Terms that are negative log-likelihoods may fall below zero.
    positive = all(line[key] > 0 for line in lines for key in line if key not in _NOT_TERMS)
    axes.set(xlabel="step", ylabel="loss")
    axes.set_yscale("log" if positive else "symlog", **({} if positive else {"linthresh": 0.1}))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, fontsize=9, loc="outside right center")
    with atomic_replace(path, durable=False) as temporary:
        figure.savefig(temporary, format="png", dpi=140)
