# SPDX-License-Identifier: Apache-2.0
"""Judges a map against the truth, or runs a study: methods side by side over places, counts and seeds, against bars.

Studies: fusion (four places that nothing was tuned on), noise (pose errors of 0 to 1.5 m), table3 (the CrowdMap paper's Table 3
as a study), malicious (do liars move what honest agents saw), tuning (all methods with the same budget, on other places).
Of the map model, on a recording of towns that it was not taught by: local, semi-global and whole (that paper's Tables 1 to 3, from
sensors), pose (tiles under errors of claimed poses, and behind their corrector).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from manyeyes.apps.map_model import MODEL_STUDIES
from manyeyes.apps.playing import FileChecks
from manyeyes.datatypes import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

STUDIES = ("fusion", "noise", "table3", "malicious", "tuning", *MODEL_STUDIES)


@dataclass(frozen=True)
class Options:
    """What is judged."""

    folder: tyro.conf.Positional[Path | None] = None
    """The map's folder, of 'map fuse'; or nothing, with --study."""
    truth: Path | None = None
    """A map's folder with the truth; 'truth' beside the map is found by itself."""
    study: str | None = None
    """fusion, noise, table3, malicious or tuning; of the map model local, semi-global, whole or pose."""
    places: tuple[str, ...] = ()
    """Only these places of a study."""
    counts: tuple[int, ...] = ()
    """Only these counts of observations of the study 'fusion'."""
    seeds: int = 3
    """How many seeds of a study."""
    methods: tuple[str, ...] = ()
    """Only these methods of a study."""
    oracles: bool = False
    """Add the oracle rows to a study: truth cut again, true poses, known association."""
    workers: int = 2
    """Processes that share a study; results do not depend on it."""
    data: Path | None = None
    """Of the map model's studies: a dataset of towns, as 'manyeyes simulate' leaves one."""
    split: str = "test"
    """Which split of it: towns that did not teach."""
    weights: tuple[str, ...] = ()
    """Map models, one a set of sensors: shipped names or .safetensors files; by default all that ship."""
    every: int = 1
    """Only every n-th scenario of it."""
    align: str = "vote"
    """Who corrects claimed poses in the study 'pose', by name."""
    out: Path = Path("out/map-study")
    """Folder for a study: cells are kept there, and a study that was stopped goes on."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files of --data."""


def main(options: Options) -> None:
    """The verb."""
    from rich.console import Console

    if options.study is not None and options.study not in STUDIES:
        raise ConfigError(f"No study is called {options.study!r}; known: {', '.join(STUDIES)}.")
    if (options.study is None) == (options.folder is None):
        raise ConfigError(f"Give a map's folder, or --study with one of {', '.join(STUDIES)}.")
    console = Console()
    if options.folder is not None:
        _judge_one(options, options.folder, console)
        return
    if options.study in MODEL_STUDIES:
        from manyeyes.apps.map_model import model_study

        model_study(options, console)
        return
    from manyeyes.apps.map_studies import study

    study(options, console)


def _judge_one(options: Options, path: Path, console: Console) -> None:
    from manyeyes.apps import provenance
    from manyeyes.apps.map_folder import MapFolder, read_vector_map
    from manyeyes.apps.viewer.map_table import kinds_terminal
    from manyeyes.evaluation.map_cells import judge_maps
    from manyeyes.evaluation.map_interval import Sureness, ap_interval, f_interval

    truth_folder = options.truth or path.parent / "truth"
    if not truth_folder.is_dir():
        raise ConfigError(f"{truth_folder}: no truth there; name one with --truth.")
    made, truth = read_vector_map(path).published().elements, read_vector_map(truth_folder).elements
    cut = MapFolder(truth_folder.parent).cut()
    judged = cut(made) if cut else made
    ap, kinds = judge_maps(judged, truth)
    console.print(kinds_terminal(ap, kinds, f"{path} against {truth_folder}"))
    sure = tuple(
        Sureness(row.kind, ap_interval(judged, truth, row.kind), f_interval(judged, truth, row.kind))
        for row in kinds
        if row.n_truth
    )
    for s in sure:
        console.print(
            f"{s.kind}: AP exact {s.ap.value:.3f} [{s.ap.low:.3f}, {s.ap.high:.3f}], "
            f"F@0.5 m {s.f.value:.3f} [{s.f.low:.3f}, {s.f.high:.3f}] over {s.ap.scenarios} squares of 64 m",
            highlight=False,
            soft_wrap=True,
        )
    out = path / "quality.json"
    provenance.write_json(out, {"ap": ap, "kinds": kinds, "intervals": sure}, options, None)
    console.print(f"All numbers are in {out}", highlight=False, soft_wrap=True)
