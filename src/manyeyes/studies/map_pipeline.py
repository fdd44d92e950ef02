# SPDX-License-Identifier: Apache-2.0
"""From sensors to a map: every agent of a recording surveys, a cartographer hears, the fused map is judged and drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.map_features import share_look
from manyeyes.agents.map_perception import Survey, Surveyor, survey_config
from manyeyes.agents.map_replay import MapTeam, Said
from manyeyes.agents.map_server import Cartographer
from manyeyes.datasets.base import Recording
from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, ConfigError, Message, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.datatypes.message import SeenMap
from manyeyes.evaluation.maps.map_cells import ApRow, KindRow, judge_maps
from manyeyes.evaluation.maps.registry import tuned
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.incremental import StreamConfig, drift
from manyeyes.studies.map_folder import MapFolder, write_vector_map
from manyeyes.studies.town_maps import Ground
from manyeyes.viz.map_figures import Panel, save_figure
from manyeyes.viz.map_page import page_of, save_map_page

if TYPE_CHECKING:
    from manyeyes.models.maps.map_model import Mapper

Floats = NDArray[np.float64]
MARGIN_M = 20.0


@dataclass(frozen=True)
class Building:
    """How a recording becomes a map. mapper: draws; None: the true map does, seen with the errors of a simulated crowd.

    survey: local or semi-global. every: agents look at every n-th frame. channel: a preset's name. pose_sigma_m: of errors added to
    claimed positions, anew at each look; headings err in proportion, 1 degree a metre.
    """

    mapper: Mapper | None
    survey: str = "local"
    every: int = 5
    channel: str = "ideal"
    pose_sigma_m: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        survey_config(self.survey)
        if self.every < 1:
            raise ConfigError(f"Agents look at every n-th frame, n of 1 or more; got {self.every}.")


@dataclass(frozen=True)
class Quality:
    """What a map is worth against the truth in view."""

    true_elements: int
    ap: tuple[ApRow, ...]
    kinds: tuple[KindRow, ...]

    def mean_ap(self, way: str = "maptr", thresholds: str = "narrow") -> float:
        """mAP over crossings and dividers."""
        return next(row.mean for row in self.ap if (row.way, row.thresholds) == (way, thresholds))

    def f(self, kind: str) -> float:
        """F by length of one kind at 0.5 m."""
        return next(row.f[1] for row in self.kinds if row.kind == kind)


@dataclass(frozen=True)
class Numbers:
    """What came of one ground. messages: with a map; bytes of them, and of looks, a message. lost: sent and never whole there.

    drift: F of published lines at 0.5 m between the map as it grew, observation by observation, and the fold over all.
    quality, union: of the map, and of all observations as they are; None where the true map is not known. missing: files of
    the recording.
    """

    name: str
    scenarios: int
    messages: int
    bytes_per_message: float
    bytes_per_look: float
    lost: int
    refused: int
    observations: int
    observed_elements: int
    elements: int
    published: int
    drift: float
    quality: Quality | None
    union: Quality | None
    missing: MissingFiles = NONE_MISSING


@dataclass(frozen=True, eq=False)
class Built:
    """A map and what it was made of; truth: in view and cut, shown: what of the map the truth can speak about."""

    ground: Ground
    cartographer: Cartographer
    made: VectorMap
    truth: MapElements | None
    shown: MapElements
    observed: MapElements
    numbers: Numbers


@dataclass
class _Log:
    """What was sent, and where everybody truly was: by agent's pseudonym and time, poses (3,) in the map's frame."""

    said: list[Said] = field(default_factory=list)
    true: dict[tuple[str, int], Floats] = field(default_factory=dict)


def build_map(
    recording: Recording, ground: Ground, building: Building, looked: Callable[[], None] = lambda: None
) -> Built:
    """The map of one ground; looked is called after each instant."""
    cartographer = Cartographer(ground.frame, ground.origin_xy, config=StreamConfig(fuse=tuned().ours))
    log = _Log()
    for scenario in ground.scenarios:
        team = _team(building, ground, scenario, cartographer, log.true)
        frames: tuple[AgentFrame, ...] = ()
        for frames, true in _instants(recording, scenario, building):
            for frame, pose in zip(frames, true):
                log.true[f"{scenario}/{frame.agent_id}", frame.timestamp_ns] = pose - [*ground.origin_xy, 0.0]
            log.said += team.step(frames)
            looked()
        team.finish(frames)
    return _judged(ground, cartographer, log)


def instants(recording: Recording, ground: Ground, every: int) -> int:
    """How many instants are looked at."""
    return sum(len(range(0, recording.length(s), every)) for s in ground.scenarios)


def _instants(
    recording: Recording, scenario: str, building: Building
) -> Iterator[tuple[tuple[AgentFrame, ...], Floats]]:
    """Frames with the poses that are claimed, and where they truly are: (N, 3) world, as far as the recording knows."""
    sigma = building.pose_sigma_m
    noise = PoseNoise("all_agents_iid", sigma, float(np.radians(sigma)), building.seed)
    for index in range(0, recording.length(scenario), building.every):
        snapshot = recording.snapshot(scenario, index)
        claimed = Transform.stack([frame.world_from_agent for frame in snapshot.frames])
        poses = claimed if snapshot.truth is None else snapshot.truth.world_from_agent
        yaw = poses.yaw.double().numpy()
        true = np.concatenate((poses.translation[:, :2].double().numpy(), yaw[:, None]), 1)
        yield (noise.apply(snapshot, 0) if sigma else snapshot).frames, true


def _team(
    building: Building,
    ground: Ground,
    scenario: str,
    cartographer: Cartographer,
    true: Mapping[tuple[str, int], Floats],
) -> MapTeam:
    config, mapper = survey_config(building.survey), building.mapper
    if mapper is None:
        survey = _oracle(ground, scenario, building, true)
        return MapTeam(survey, cartographer, scenario, channel=building.channel, seed=building.seed)
    tell = partial(share_look, mapper) if config.together else None
    survey = Surveyor(mapper, config)
    return MapTeam(survey, cartographer, scenario, tell, mapper.fingerprint, building.channel, building.seed)


def _oracle(ground: Ground, scenario: str, building: Building, true: Mapping[tuple[str, int], Floats]) -> Survey:
    """Agents that draw the true map with a crowd's errors."""
    from manyeyes.simulator.fleet.config import crowd_config
    from manyeyes.simulator.fleet.map_predictor import Eyewitness

    if ground.place is None:
        raise ConfigError(f"{ground.name}: no true map is known by its name, so none can be seen; use a map model.")
    config = survey_config(building.survey)
    witness = Eyewitness(ground.place.truth, crowd_config(building.survey), building.seed)

    def survey(frame: AgentFrame, heard: Sequence[Message]) -> SeenMap:
        who = f"{scenario}/{frame.agent_id}"
        return witness.see(true[who, frame.timestamp_ns], config.window(frame), who, frame.timestamp_ns)

    return survey


def _judged(ground: Ground, cartographer: Cartographer, log: _Log) -> Built:
    seen, made = cartographer.observations, cartographer.fold()
    observed = MapElements.cat([o.in_map() for o in seen])
    published = made.published().elements
    truth = ground.truth(seen, np.array([log.true[o.agent, o.time_ns] for o in seen])) if seen else None
    cut = ground.cut
    shown = published if cut is None else cut(published)
    sent = [one for one in log.said if one.map_packets]
    looks = [one.look_bytes for one in log.said if one.look_bytes]
    numbers = Numbers(
        name=ground.name,
        scenarios=len(ground.scenarios),
        messages=len(sent),
        bytes_per_message=float(np.mean([one.map_bytes for one in sent])) if sent else 0.0,
        bytes_per_look=float(np.mean(looks)) if looks else 0.0,
        lost=len(sent) - len(seen) - len(cartographer.refused),
        refused=len(cartographer.refused),
        observations=len(seen),
        observed_elements=len(observed),
        elements=len(made),
        published=len(published),
        drift=drift(cartographer.map(), made),
        quality=None if truth is None else _quality(shown, truth),
        union=None if truth is None or cut is None else _quality(cut(observed), truth),
    )
    return Built(ground, cartographer, made, truth, shown, observed, numbers)


def _quality(elements: MapElements, truth: MapElements) -> Quality:
    return Quality(len(truth), *judge_maps(elements, truth))


def write_built(built: Built, out: Path, title: str) -> None:
    """The map's folder, as 'map simulate' and 'map fuse' leave one, its page and its picture."""
    ground, seen = built.ground, built.cartographer.observations
    folder = MapFolder(out)
    folder.write_observations(seen, ground.frame)
    if built.truth is not None and ground.cut is not None:
        folder.write_truth(built.truth, ground.frame, ground.cut)
    write_vector_map(built.made, out / "map")
    page = page_of(title, built.made, built.truth, built.observed, len(seen), built.shown)
    save_map_page(page, out / "map.html")
    area = _around(built.observed, built.truth)
    panels = [
        Panel(f"What {len(seen)} observations say", built.observed, built.truth, area=area),
        Panel("Fused map" + (", truth behind it" if built.truth else ""), built.shown, built.truth, area=area),
    ]
    save_figure(panels, out / "map.png")


def _around(observed: MapElements, truth: MapElements | None) -> tuple[float, float, float, float] | None:
    points = np.concatenate([e.points for e in (observed, truth) if e is not None])
    if not len(points):
        return None
    (x0, y0), (x1, y1) = points.min(0) - MARGIN_M, points.max(0) + MARGIN_M
    return float(x0), float(y0), float(x1), float(y1)
