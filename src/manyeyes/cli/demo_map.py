# SPDX-License-Identifier: Apache-2.0
"""The map part of the demo: one map of a junction from the local maps of a crowd that crosses it.

One drive of four agents shows little of what fusion does: each line is observed by few agents with the errors of one model.
``manyeyes map build`` makes such a map of a recording.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.experiment import FleetExperiment, FleetTrial, run_trial
from manyeyes.evaluation.maps.metrics import MapMetrics, evaluate_map
from manyeyes.evaluation.maps.registry import fuse_experiment, fuse_observations, make_tuned_settings
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion.pose_optimization import solve_poses
from manyeyes.maps.fusion.pose_solution import PoseSolution
from manyeyes.maps.registry import OURS
from manyeyes.simulator.fleet.config import crowd_config
from manyeyes.studies.map_folder import MapFolder, write_vector_map
from manyeyes.viz.map_figures import MapPanel, compute_misalignment, save_figure
from manyeyes.viz.map_page import make_page, save_map_page
from manyeyes.viz.report import Chapter, ReportImage

Floats = NDArray[np.float64]
PLACE, NUM_OBSERVATIONS, SIZE_M, MAX_PAIR_DISTANCE_M = "cross", 60, 160.0, 15.0
MAX_PAIRED = 30
HEADINGS = ("map", "mAP", "precision", "F1", "duplication")


@dataclass(frozen=True)
class DemoMapStats:
    """What the demo's map is worth: evaluated against the truth, beside the union of all observations."""

    num_observations: int
    num_elements: int
    fused: MapMetrics
    union: MapMetrics


def map_crossing(out: Path, seed: int = 0) -> tuple[DemoMapStats, Chapter]:
    """Simulates, fuses, judges and draws under out; the numbers, and a chapter for the report."""
    experiment = run_trial(FleetTrial(PLACE, NUM_OBSERVATIONS, seed, SIZE_M, fleet_config=crowd_config("local")))
    settings = make_tuned_settings()
    fused = fuse_observations(OURS, experiment.observations, settings, experiment.place.frame)
    evaluated, union = (
        experiment.cut_policy(fused.select_published().elements),
        experiment.cut_policy(fuse_experiment("union", experiment, settings)),
    )
    stats = DemoMapStats(
        len(experiment.observations),
        len(evaluated),
        evaluate_map(evaluated, experiment.truth),
        evaluate_map(union, experiment.truth),
    )
    MapFolder(out).write(experiment)
    write_vector_map(fused, out / "map")
    page = make_page("One map from many drives", fused, experiment.truth, experiment.observations, evaluated)
    save_map_page(page, out / "map.html")
    save_figure(
        _make_pair_panels(experiment, solve_poses(experiment.observations, settings.config_of(OURS).pose_solver)),
        out / "misalignment.png",
    )
    area = experiment.place.area
    observed = MapElements.cat([o.elements_in_map() for o in experiment.observations])
    panels = [
        MapPanel(f"{len(experiment.observations)} observations", observed, experiment.truth, area=area),
        MapPanel("Fused map, truth behind it", evaluated, experiment.truth, area=area),
    ]
    save_figure(panels, out / "map.png")
    return stats, _make_chapter(stats, out)


def describe_crossing_map(stats: DemoMapStats) -> str:
    """Return the map in one line."""
    ours, union = stats.fused, stats.union
    return (
        f"One map from {stats.num_observations} local maps of a crossroads: mAP {ours.mean_ap():.2f}, "
        f"F1@0.5 m of dividers {ours.get_length_score('divider').f1:.2f}; unfused, "
        f"{union.mean_ap():.2f} and {union.get_length_score('divider').f1:.2f}."
    )


def _make_chapter(stats: DemoMapStats, out: Path) -> Chapter:
    rows = [_make_row("fused map", stats.fused), _make_row("all local maps together", stats.union)]
    return Chapter(
        "One map from many drives",
        f"{stats.num_observations} local maps of one junction, by a simulated fleet: displaced, bent, cut, incomplete and partly "
        "false, as those of real models are. The pose of each is corrected once; then lines are fused where several agents agree. "
        "Dividers are matched within 0.5 m. The truth is pale. map/map.html beside this file has it as a web page with layers.",
        (
            ReportImage(out / "map.png", "All observations, and what is fused of them", wide=True),
            ReportImage(
                out / "misalignment.png",
                "Two observations at the prior pose, and after correction; arrows: misalignment",
                wide=True,
            ),
        ),
        (HEADINGS, *rows),
    )


def _make_row(name: str, metrics: MapMetrics) -> tuple[str, ...]:
    divider = metrics.get_length_score("divider")
    duplication = metrics.get_kind("divider").duplication
    return name, f"{metrics.mean_ap():.2f}", f"{divider.precision:.2f}", f"{divider.f1:.2f}", f"{duplication:.1f}"


def _make_pair_panels(experiment: FleetExperiment, solution: PoseSolution) -> list[MapPanel]:
    """Return the two neighbouring observations that disagree most, before and after."""
    before, after = _find_largest_difference(experiment.observations)
    rows = solution.row_indices([before.id, after.id])
    panels = []
    for title, poses in (
        ("At prior poses", (before.pose, after.pose)),
        ("After one correction an observation", solution.pose[rows]),
    ):
        one, two = before.elements_in_map(poses[0]), after.elements_in_map(poses[1])
        arrows = compute_misalignment(two, one)
        mean = float(np.hypot(arrows[:, 2], arrows[:, 3]).mean()) if len(arrows) else 0.0
        panels.append(MapPanel(f"{title}: {mean:.2f} m apart on average", two, one, arrows))
    return panels


def _find_largest_difference(observations: tuple[Observation, ...]) -> tuple[Observation, Observation]:
    """Of the first MAX_PAIRED observations, of different agents, at most 15 m apart: the pair with the longest arrows in sum."""
    best, pair = -1.0, (observations[0], observations[-1])
    candidates = observations[:MAX_PAIRED]
    for i, one in enumerate(candidates):
        for two in candidates[i + 1 :]:
            if one.agent != two.agent and np.hypot(*(one.pose - two.pose)[:2]) <= MAX_PAIR_DISTANCE_M:
                arrows = compute_misalignment(two.elements_in_map(), one.elements_in_map())
                total = float(np.hypot(arrows[:, 2], arrows[:, 3]).sum())
                if total > best:
                    best, pair = total, (one, two)
    return pair
