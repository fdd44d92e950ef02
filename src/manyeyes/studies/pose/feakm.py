# SPDX-License-Identifier: Apache-2.0
"""FeaKM's ablation, its Table 3: with and without a confidence map, with one scale of fusion and with several.

What a row is stands in evaluation/pose/feakm_ablation.py. A branch is a detector and a net taught on its views, with ``@8``
behind it for the paper's eight pairs; its rows are kept under --out.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from manyeyes._io import atomic_write
from manyeyes._source import source_digest
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.accumulator import IOUS
from manyeyes.evaluation.detection.benchmark import judging_protocol, loaded
from manyeyes.evaluation.pose.feakm_ablation import SIGMAS, Branch, BranchRow, ablation
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.study import COMPUTED_BY, recording_digest
from manyeyes.models.checkpoint import fingerprint
from manyeyes.pose.feakm import Feakm
from manyeyes.pose.registry import corrector
from manyeyes.studies.detection.ablation import branches_of
from manyeyes.studies.running import Start, publish, start
from manyeyes.viz.curves import Curve, Panel
from manyeyes.viz.progress import bars
from manyeyes.viz.study_table import Sheet, number

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

PAPER = "The last table is FeaKM's own: DAIR-V2X, AP@0.5, CoAlign's protocol; it is no bar and no rival."
PAPER_TABLE = (
    ("neither", 0.741, 0.704, 0.682, 0.678),
    ("several scales", 0.780, 0.716, 0.682, 0.666),
    ("confidence map", 0.778, 0.716, 0.674, 0.660),
    ("both", 0.768, 0.716, 0.690, 0.678),
)


def run(options: Options, console: Console) -> None:
    """The study."""
    named = branches_of(options.branches, "feakm", "detector.safetensors,net.safetensors[@8]")
    branches = [(_branch(name, files), files.partition("@")[2]) for name, files in named.items()]
    begun = start(options, console)
    table = rows(begun, branches)
    payload: dict[str, object] = {"rows": table, "paper": {"note": PAPER, "rows": PAPER_TABLE}}
    sheets = [*(_sheet(table, k) for k in range(len(IOUS))), _answers(table), _paper()]
    publish(begun, payload, sheets, panels(table), [], (PAPER,))


def _branch(name: str, files: str) -> Branch:
    detector, _, net = files.partition(",")
    if not net.partition("@")[0].endswith(".safetensors"):
        raise ConfigError(f"Branch {name!r} needs two files, detector.safetensors,net.safetensors[@8]; got {files!r}.")
    found = corrector(net)
    assert isinstance(found, Feakm)
    return Branch(name, loaded(detector), found)


def rows(begun: Start, branches: Sequence[tuple[Branch, str]]) -> list[BranchRow]:
    """Rows of every branch and its least number of pairs, as it was written; those that are kept are not made again."""
    recording, seed = begun.base.view(begun.opener()), begun.options.seed
    code = source_digest(COMPUTED_BY, "manyeyes.evaluation.pose.feakm_ablation")
    protocol, data = judging_protocol(begun.base), (recording_digest(recording), code, SIGMAS, seed)
    out = list[BranchRow]()
    with bars(begun.console) as progress:
        task = progress.add_task("Judging", total=len(branches) * len(recording.scenarios))
        for n, (branch, pairs) in enumerate(branches):
            done = {s: n * len(recording.scenarios) + k for k, s in enumerate(recording.scenarios)}
            who = branch.detector.fingerprint, fingerprint(branch.corrector.net), pairs
            key = hashlib.blake2b(repr((who, data)).encode(), digest_size=8).hexdigest()
            path = begun.cells / f"feakm-{key}.json"
            if not path.is_file():

                def report(scenario: str, index: int, done: dict[str, int] = done) -> None:
                    progress.update(task, completed=done[scenario])

                found = ablation(recording, [branch], SIGMAS, protocol=protocol, seed=seed, report=report)
                atomic_write(path, json.dumps([asdict(row) for row in found]).encode())
            held = json.loads(path.read_text(encoding="utf-8"))
            out += [BranchRow(**(row | {"branch": branch.name, "ap": tuple(row["ap"])})) for row in held]
    return out


def _lines(table: Sequence[BranchRow], cell: str, digits: int, iou: int = 0) -> tuple[tuple[str, ...], ...]:
    def shown(row: BranchRow) -> str:
        return number(row.ap[iou] if cell == "ap" else row.answered, digits)

    names = dict.fromkeys(row.branch for row in table)
    return tuple((name, *(shown(row) for row in table if row.branch == name)) for name in names)


def _headings() -> tuple[str, ...]:
    return ("branch", *(f"{s:g} m, {s:g}°" for s in SIGMAS))


def _sheet(table: Sequence[BranchRow], iou: int) -> Sheet:
    return Sheet(f"AP@{IOUS[iou]:g}", _headings(), _lines(table, "ap", 3, iou))


def _answers(table: Sequence[BranchRow]) -> Sheet:
    return Sheet("Share of collaborators whose pose was found", _headings(), _lines(table, "answered", 2))


def _paper() -> Sheet:
    lines = tuple((name, *(f"{v:.3f}" for v in ap)) for name, *ap in PAPER_TABLE)
    return Sheet("FeaKM's Table 3, AP@0.5: another data set", _headings(), lines)


def panels(table: Sequence[BranchRow]) -> list[Panel]:
    """AP against sigma, a line a branch."""
    names = dict.fromkeys(row.branch for row in table)
    return [
        Panel(
            "FeaKM's parts", "sigma, metres and degrees", f"AP@{threshold:g}",
            tuple(Curve(n, tuple(_plain(r.ap[k]) for r in table if r.branch == n), SIGMAS) for n in names),
        )
        for k, threshold in enumerate(IOUS)
    ]  # fmt: skip


def _plain(value: float) -> Interval:
    return Interval(value, value, value, 0.95, 1)
