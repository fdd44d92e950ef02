# SPDX-License-Identifier: Apache-2.0
"""Sends a crowd through a place: observations with the errors that map models make, and the truth that was in view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from manyeyes._bounds import ExtentM, LengthM, OutputFolder, Seed, TrialCount


@dataclass(frozen=True)
class Options:
    """Which place, which crowd."""

    place: tyro.conf.Positional[str] = "cross"
    """A CARLA town, av2-miami, av2-pittsburgh, lanelet2, cross, grid, grid-N with N crossroads a side, roundabout or merge."""
    observations: TrialCount = 60
    """How many; the first of a larger crowd are those of a smaller one."""
    crowd: str = "local"
    """Observation noise and fleet: local, semi-global, perfect, independent-malicious, colluding-malicious, outdated,
    with-infrastructure."""
    pose_sigma: LengthM | None = None
    """Another standard deviation of prior positions, metres; headings err in proportion, 1 degree a metre."""
    size: ExtentM = 300.0
    """Side of the area, metres; generated places and logs are never larger than they are."""
    seed: Seed = 0
    """Another seed, other drives."""
    out: OutputFolder | None = None
    """Folder for observations and truth, out/map/PLACE by default."""


def main(options: Options) -> None:
    """Simulate a fleet and write observations and ground truth."""
    from dataclasses import replace

    from rich.console import Console

    from manyeyes.evaluation.maps.experiment import FleetExperiment, FleetTrial
    from manyeyes.simulator.fleet.config import crowd_config
    from manyeyes.simulator.fleet.place import load_place
    from manyeyes.simulator.fleet.simulate import simulate_crowd
    from manyeyes.studies import provenance
    from manyeyes.studies.map_folder import MapFolder
    from manyeyes.viz.progress import make_progress_bars

    trial = FleetTrial(
        options.place, options.observations, options.seed, options.size, options.crowd, crowd_config(options.crowd)
    )
    trial = trial if options.pose_sigma is None else trial.with_pose_noise(options.pose_sigma)
    out = options.out or Path("out/map") / options.place
    console = Console()
    with make_progress_bars(console) as progress:
        task = progress.add_task("Driving", total=trial.num_observations)
        map_place = load_place(trial.place, trial.size_m)
        fleet = simulate_crowd(
            map_place,
            trial.num_observations,
            trial.fleet_config,
            trial.seed,
            (),
            lambda done, _: progress.update(task, completed=done),
        )
    experiment = FleetExperiment(trial, fleet)
    MapFolder(out).write(experiment)
    elements = sum(len(o.elements) for o in experiment.observations)
    payload = {
        "observations": len(experiment.observations),
        "elements": elements,
        "true_elements": len(experiment.truth),
    }
    provenance.write_json(
        out / "simulate.json", payload, {"options": replace(options, out=out), "trial": trial}, options.seed
    )
    console.print(
        f"{len(experiment.observations)} observations of {elements} elements, and {len(experiment.truth)} true "
        f"ones in view, in {out}",
        highlight=False,
        soft_wrap=True,
    )
