# SPDX-License-Identifier: Apache-2.0
"""Options of map evaluations and of studies of maps."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from manyeyes._bounds import PositiveInt
from manyeyes.studies.replay_options import FileChecks


@dataclass(frozen=True)
class Options:
    """The map to evaluate, or the study to run."""

    folder: tyro.conf.Positional[Path | None] = None
    """The map's folder, of 'map fuse'; or nothing, with --study."""
    truth: Path | None = None
    """A map's folder with the truth; 'truth' beside the map is found by itself."""
    study: str | None = None
    """fusion, fleet-pose-noise, crowdmap-table3, adversarial or tuning; of the map model local, semi-global, full-map or
    map-pose-noise."""
    places: tuple[str, ...] = ()
    """Only these places of a study."""
    observation_counts: tuple[PositiveInt, ...] = ()
    """Only these counts of observations of the study 'fusion'."""
    seeds: PositiveInt = 3
    """How many seeds of a study."""
    methods: tuple[str, ...] = ()
    """Only these methods of a study."""
    oracles: bool = False
    """Add the oracle rows to a study: truth cut again, true poses, known association."""
    workers: PositiveInt = 2
    """Processes that share a study; results do not depend on it."""
    data: Path | None = None
    """Of the map model's studies: a dataset of towns, as 'manyeyes simulate' leaves one."""
    split: str = "test"
    """Which split of it: towns that did not teach."""
    weights: tuple[str, ...] = ()
    """Map models, one a set of sensors: shipped names or .safetensors files; by default all that ship."""
    scenario_stride: PositiveInt = 1
    """Only every n-th scenario of it."""
    pose_correction: str = "voting"
    """Pose corrector of the study 'map-pose-noise', by name."""
    out: Path = Path("out/map-study")
    """Folder for a study: cells are kept there, and a study that was stopped goes on."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files of --data."""
