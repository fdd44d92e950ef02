# SPDX-License-Identifier: Apache-2.0
"""Branches of a training side by side, perfect, late and displaced: CoSTr, Table III. Each part is to earn its place.

The order is that of the command line; a branch is held against the one before it. What was trained, how long and from which
seed stands in the model card of each file and is shown beside. ``@BYTES`` behind a file: a message has so many bytes at most,
of those tokens that the trained mask takes (MI, Eq. 10-13); without it a message holds all tokens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.study import Condition, Sweep
from manyeyes.models import checkpoint
from manyeyes.studies.detection.perturbations import PERFECT, Disturbance
from manyeyes.studies.running import OURS, PAPER, carry_out, publish, start, with_replay
from manyeyes.viz.curves import Curve, Panel
from manyeyes.viz.study_table import Sheet, change, log2, number, value

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
    from manyeyes.studies.options import Options

MASKED = "learned"
UNDER = (PERFECT, Disturbance(delay_s=0.2), Disturbance(position_m=0.4))
PAPER_TABLE = (
    ("none", 0.875, 0.831, 0.762, 16.43),
    ("SE", 0.897, 0.842, 0.790, 16.94),
    ("SE, DAST", 0.919, 0.849, 0.883, 16.94),
    ("SE, DAST, DAST in FAST's place", 0.933, 0.878, 0.911, 16.94),
    ("SE, DAST, FAST", 0.946, 0.928, 0.926, 16.94),
    ("SE, DAST, FAST, MI", 0.941, 0.924, 0.925, 14.71),
)


@dataclass(frozen=True)
class Row:
    """A branch. ap: at IoU 0.5 and 0.7 under each of UNDER; over_last: AP@0.5 over the branch before. card: of its weights."""

    branch: str
    ap: tuple[tuple[Interval, Interval], ...]
    over_last: tuple[Interval, ...]
    bytes_per_message: float
    card: dict[str, Any]


@dataclass(frozen=True)
class _Branch:
    """A detector, and the most bytes of a message if the trained mask is to choose its tokens."""

    name: str
    weights: Path
    budget_bytes: int | None

    @property
    def method(self) -> str:
        return OURS if self.budget_bytes is None else MASKED

    def on(self, base: BenchmarkConfig) -> BenchmarkConfig:
        """The configuration of a benchmark of this branch."""
        config = replace(base, methods=(self.method,), weights=str(self.weights))
        return config if self.budget_bytes is None else with_replay(config, budget_bytes=self.budget_bytes)


def _branch(name: str, weights: str, most: str) -> _Branch:
    if most and not (most.isdigit() and int(most)):
        raise ConfigError(f"Branch {name!r}: behind @ stands a number of bytes, one or more; got {most!r}.")
    return _Branch(name, Path(weights), int(most) if most else None)


def run(options: Options, console: Console) -> None:
    """The study."""
    branches = [
        _branch(name, *words.partition("@")[::2])
        for name, words in branches_of(options.branches, files="weights.safetensors[@BYTES]").items()
    ]
    begun = start(options, console)
    conditions = [
        Condition(_name(branch.name, under), under.on(branch.on(begun.base))) for branch in branches for under in UNDER
    ]
    cards = [checkpoint.read_card(branch.weights) for branch in branches]
    table = rows(carry_out(begun, conditions), branches, cards)
    sheets = [_sheet(table), _cards(table), _paper()]
    payload: dict[str, object] = {"rows": table, "paper": {"note": PAPER, "rows": PAPER_TABLE}}
    publish(begun, payload, sheets, panels(table), conditions, (PAPER.replace('column "paper"', "last table"),))


def branches_of(words: Sequence[str], study: str = "ablation", files: str = "weights.safetensors") -> dict[str, str]:
    """Names and files of ``name=weights.safetensors``, or whatever files the study takes."""
    pairs = [word.partition("=") for word in words]
    odd = [word for word, (name, _, path) in zip(words, pairs) if not name or not path]
    names = [name for name, _, _ in pairs]
    if odd or not words or len(set(names)) < len(names):
        raise ConfigError(
            f"The study '{study}' takes --branches name={files} ..., each name once; got {' '.join(words) or 'none'}."
        )
    return {name: path for name, _, path in pairs}


def _name(branch: str, under: Disturbance) -> str:
    return f"{branch}: {under.name}"


def rows(done: Sweep, branches: Sequence[_Branch], cards: Sequence[dict[str, Any]]) -> tuple[Row, ...]:
    """The table, in the order of the branches."""
    out, before = [], []
    for branch, card in zip(branches, cards):
        places = [(_name(branch.name, under), branch.method) for under in UNDER]
        out.append(
            Row(
                branch.name,
                tuple((done.ap(place, 0), done.ap(place, 1)) for place in places),
                tuple(done.less(place, other, 0) for place, other in zip(places, before)),
                done.cells[places[0]].bytes_per_message,
                card,
            )
        )
        before = places
    return tuple(out)


def _sheet(table: Sequence[Row]) -> Sheet:
    names = [under.name for under in UNDER]
    headings = (
        "branch", *(f"AP@0.5 {n}" for n in names), *(f"AP@0.7 {n}" for n in names),
        *(f"over the one before {n}" for n in names), "bytes/message", "AB log2",
    )  # fmt: skip
    lines = tuple(
        (
            row.branch,
            *(value(half) for half, _ in row.ap),
            *(value(seven) for _, seven in row.ap),
            *(tuple(map(change, row.over_last)) or ("",) * len(UNDER)),
            number(row.bytes_per_message),
            log2(row.bytes_per_message),
        )
        for row in table
    )
    return Sheet("Branches", headings, lines)


def _cards(table: Sequence[Row]) -> Sheet:
    lines = tuple((row.branch, *(str(row.card.get(key, "")) for key in ("steps", "seed", "command"))) for row in table)
    return Sheet("How they were trained", ("branch", "steps", "seed", "command"), lines)


def _paper() -> Sheet:
    lines = tuple((name, *(f"{v:.3f}" for v in ap), f"{ab:.2f}") for name, *ap, ab in PAPER_TABLE)
    headings = ("parts", *(under.name for under in UNDER), "AB log2")
    return Sheet("The paper's own table, AP@0.5: another data set, unknown protocol", headings, lines)


def panels(table: Sequence[Row]) -> list[Panel]:
    """AP@0.5 and AP@0.7 of the branches, a line a disturbance."""
    x, ticks = tuple(map(float, range(len(table)))), tuple(row.branch for row in table)
    return [
        Panel(
            f"AP@{iou}", "", f"AP@{iou}",
            tuple(Curve(u.name, tuple(row.ap[k][which] for row in table), x) for k, u in enumerate(UNDER)),
            ticks=ticks,
        )
        for which, iou in enumerate(("0.5", "0.7"))
    ]  # fmt: skip
