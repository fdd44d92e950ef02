# SPDX-License-Identifier: Apache-2.0
"""The map part of the demo: of the drive itself where a map model ships; else of a crowd that crosses one junction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes.datasets.base import Recording
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.experiment import Scene, Trial, carry_out
from manyeyes.evaluation.maps.metrics import MapQuality, judge
from manyeyes.evaluation.maps.registry import OURS, make_map, map_of, tuned
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion.pose_optimization import Alignment, solve_poses
from manyeyes.models.maps.map_model import Mapper
from manyeyes.simulator.fleet.config import crowd_config
from manyeyes.studies.map_folder import MapFolder, write_vector_map
from manyeyes.studies.map_pipeline import Building, Numbers, build_map, write_built
from manyeyes.studies.town_maps import grounds_of
from manyeyes.viz.map_figures import Panel, misalignment, save_figure
from manyeyes.viz.map_page import page_of, save_map_page
from manyeyes.viz.report import Chapter, Picture

Floats = NDArray[np.float64]
PLACE, OBSERVATIONS, SIZE_M, NEAR_M = "cross", 60, 160.0, 15.0
EVERY = 10
"""Agents of the demo's drive draw a map once a second."""


def drive_map(recording: Recording, mapper: Mapper, out: Path, seed: int = 0) -> tuple[str, Chapter]:
    """The map of a drive of one scenario, from its agents' sensors by a map model, under out: in one line, and as a chapter."""
    (ground,) = grounds_of(recording, recording.scenarios[:1], "drive")
    built = build_map(recording, ground, Building(mapper, "semi-global", EVERY, seed=seed))
    write_built(built, out, "One drive, one map")
    said = drive_sentence(built.numbers)
    text = (
        f"{said} Each agent draws a tile of 120 m by 60 m about itself from its own sensors and from the tokens that the others "
        "send, and sends its lines; they are fused where several agree. The truth is pale. map/map.html beside this file has it as "
        "a web page with layers."
    )
    picture = Picture(out / "map.png", "What all agents drew, and what is fused of it", wide=True)
    return said, Chapter("One drive, one map", text, (picture,))


def drive_sentence(n: Numbers) -> str:
    """The map of a drive in one line."""
    judged = (
        ""
        if n.quality is None or n.union is None
        else (
            f" mAP {n.quality.mean_ap():.2f}, F of dividers at 0.5 m {n.quality.f('divider'):.2f}; "
            f"all that was drawn, unfused, has {n.union.mean_ap():.2f} and {n.union.f('divider'):.2f}."
        )
    )
    return f"One map from {n.messages} messages of {n.bytes_per_message:,.0f} bytes, drawn from sensors:{judged or ' not judged.'}"


@dataclass(frozen=True)
class SmallMap:
    """What the demo's map is worth: judged against the truth, beside the union of all observations."""

    observations: int
    elements: int
    fused: MapQuality
    union: MapQuality


def small_map(out: Path, seed: int = 0) -> tuple[SmallMap, Chapter]:
    """Simulates, fuses, judges and draws under out; the numbers, and a chapter for the report."""
    scene = carry_out(Trial(PLACE, OBSERVATIONS, seed, SIZE_M, crowd=crowd_config("local")))
    settings = tuned()
    made = map_of(OURS, scene.observations, settings, scene.place.frame)
    shown, union = scene.cut(made.published().elements), scene.cut(make_map("union", scene, settings))
    numbers = SmallMap(len(scene.observations), len(shown), judge(shown, scene.truth), judge(union, scene.truth))
    MapFolder(out).write(scene)
    write_vector_map(made, out / "map")
    observed = MapElements.cat([o.in_map() for o in scene.observations])
    page = page_of("One map from many drives", made, scene.truth, observed, len(scene.observations), shown)
    save_map_page(page, out / "map.html")
    save_figure(
        _two_observations(scene, solve_poses(scene.observations, settings.ours.align)), out / "misalignment.png"
    )
    area = scene.place.area
    panels = [
        Panel(f"What {len(scene.observations)} observations say", observed, scene.truth, area=area),
        Panel("Fused map, truth behind it", shown, scene.truth, area=area),
    ]
    save_figure(panels, out / "map.png")
    return numbers, _chapter(numbers, out)


def sentence(numbers: SmallMap) -> str:
    """The map in one line."""
    ours, union = numbers.fused, numbers.union
    return (
        f"One map from {numbers.observations} local maps of a crossroads: mAP {ours.mean_ap():.2f}, "
        f"F of dividers at 0.5 m {ours.length('divider').f:.2f}; "
        f"their union has {union.mean_ap():.2f} and {union.length('divider').f:.2f}."
    )


def _chapter(numbers: SmallMap, out: Path) -> Chapter:
    return Chapter(
        "One map from many drives",
        f"{sentence(numbers)} Every local map is displaced, bent, cut, incomplete and partly invented, as those of real models "
        "are; each one's pose is corrected once, then lines are fused where several agree. The truth is pale. map/map.html "
        "beside this file has it as a web page with layers.",
        (
            Picture(out / "map.png", "All observations, and what is fused of them", wide=True),
            Picture(
                out / "misalignment.png",
                "Two observations as claimed, and after correction; arrows: misalignment",
                wide=True,
            ),
        ),
    )


def _two_observations(scene: Scene, alignment: Alignment) -> list[Panel]:
    """The two neighbouring observations that disagree most, before and after."""
    before, after = _most_misaligned(scene.observations)
    rows = alignment.rows([before.id, after.id])
    panels = []
    for title, poses in (
        ("As claimed", (before.pose, after.pose)),
        ("After one correction an observation", alignment.pose[rows]),
    ):
        one, two = before.in_map(poses[0]), after.in_map(poses[1])
        arrows = misalignment(two, one)
        mean = float(np.hypot(arrows[:, 2], arrows[:, 3]).mean()) if len(arrows) else 0.0
        panels.append(Panel(f"{title}: {mean:.2f} m apart on average", two, one, arrows))
    return panels


def _most_misaligned(observations: tuple[Observation, ...]) -> tuple[Observation, Observation]:
    """Of different agents, at most 15 m apart: the pair with the longest arrows in sum."""
    best, found = -1.0, (observations[0], observations[-1])
    for i, one in enumerate(observations):
        for two in observations[i + 1 :]:
            if one.agent != two.agent and np.hypot(*(one.pose - two.pose)[:2]) <= NEAR_M:
                arrows = misalignment(two.in_map(), one.in_map())
                total = float(np.hypot(arrows[:, 2], arrows[:, 3]).sum())
                if total > best:
                    best, found = total, (one, two)
    return found
