# SPDX-License-Identifier: Apache-2.0
"""From sensors to a map: agents of a recording predict and send map elements, a map server fuses them, the map is evaluated."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.map_features import encode_map_features
from manyeyes.agents.map_perception import MapModelPredictor, MapPredictor, get_map_share_config
from manyeyes.agents.map_replay import MapReplay, SentRecord
from manyeyes.agents.map_server import MapServer
from manyeyes.datasets.base import Recording
from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, ConfigError, Message, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.datatypes.message import LocalMap
from manyeyes.evaluation.maps.metrics import MapMetrics, evaluate_map
from manyeyes.evaluation.maps.registry import make_tuned_settings
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.incremental import IncrementalConfig, compute_map_fscore
from manyeyes.maps.registry import MAP_MODEL, OURS
from manyeyes.studies.map_folder import MapFolder, write_vector_map
from manyeyes.studies.town_maps import TownMap
from manyeyes.viz.map_figures import MapPanel, save_figure
from manyeyes.viz.map_page import make_page, save_map_page

if TYPE_CHECKING:
    from manyeyes.models.maps.map_model import MapModel

Floats = NDArray[np.float64]
MARGIN_M = 20.0


@dataclass(frozen=True)
class MapBuildConfig:
    """Configuration of a map build. map_model: predicts elements; None: the true map with the errors of a simulated fleet does.

    map_mode: local or semi-global. frame_stride: every n-th frame is used. channel: a preset's name. pose_sigma_m: of errors
    added to prior positions, independently in each frame; headings err in proportion, 1 degree a metre.
    """

    map_model: MapModel | None
    map_mode: str = "local"
    frame_stride: int = 5
    channel: str = "ideal"
    pose_sigma_m: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        get_map_share_config(self.map_mode)
        if self.frame_stride < 1:
            raise ConfigError(f"frame_stride is 1 or more; got {self.frame_stride}.")


@dataclass(frozen=True)
class MapBuildStats:
    """Statistics of one town map. num_messages: with a map; bytes_per_message, bytes_per_frame: of these, and of feature messages.
    num_lost: sent and not completely received.

    incremental_fscore: F of published lines at 0.5 m between the map as it grew, observation by observation, and the fold over all.
    scores, union_scores: of the map, and of all observations as they are; None where the true map is not known. missing: files of
    the recording.
    """

    name: str
    num_scenarios: int
    num_messages: int
    bytes_per_message: float
    bytes_per_frame: float
    num_lost: int
    num_rejected: int
    num_observations: int
    num_observed_elements: int
    num_elements: int
    num_published: int
    incremental_fscore: float
    scores: MapMetrics | None
    union_scores: MapMetrics | None
    missing: MissingFiles = NONE_MISSING


@dataclass(frozen=True, eq=False)
class BuiltMap:
    """A map and what it was made of; truth: in view and cut, shown: what of the map the truth can speak about."""

    town_map: TownMap
    map_server: MapServer
    fused: VectorMap
    truth: MapElements | None
    evaluated: MapElements
    observed: MapElements
    stats: MapBuildStats


@dataclass
class _BuildLog:
    """What was sent, and where everybody truly was: by agent's pseudonym and time, poses (3,) in the map's frame."""

    sent_records: list[SentRecord] = field(default_factory=list)
    true_poses: dict[tuple[str, int], Floats] = field(default_factory=dict)


def build_map(
    recording: Recording, town_map: TownMap, config: MapBuildConfig, on_snapshot: Callable[[], None] = lambda: None
) -> BuiltMap:
    """Build the map of one town; on_snapshot is called after each snapshot."""
    method = OURS if config.map_model is None else MAP_MODEL
    map_server = MapServer(
        town_map.frame, town_map.origin_xy, config=IncrementalConfig(fusion=make_tuned_settings().config_of(method))
    )
    log = _BuildLog()
    for scenario in town_map.scenarios:
        player = _make_replay(config, town_map, scenario, map_server, log.true_poses)
        frames: tuple[AgentFrame, ...] = ()
        for frames, true_poses in _iterate_snapshots(recording, scenario, config):
            for frame, pose in zip(frames, true_poses):
                log.true_poses[f"{scenario}/{frame.agent_id}", frame.timestamp_ns] = pose - [*town_map.origin_xy, 0.0]
            log.sent_records += player.step(frames)
            on_snapshot()
        player.finish(frames)
    return _evaluate(town_map, map_server, log)


def count_snapshots(recording: Recording, town_map: TownMap, frame_stride: int) -> int:
    """Count the snapshots that are used."""
    return sum(len(range(0, recording.length(s), frame_stride)) for s in town_map.scenarios)


def _iterate_snapshots(
    recording: Recording, scenario: str, config: MapBuildConfig
) -> Iterator[tuple[tuple[AgentFrame, ...], Floats]]:
    """Yield frames with their prior poses, and the true poses: (N, 3) world, as far as the recording knows."""
    sigma = config.pose_sigma_m
    noise = PoseNoise("all_agents", sigma, float(np.radians(sigma)), config.seed, "independent", "true")
    for index in range(0, recording.length(scenario), config.frame_stride):
        snapshot = recording.snapshot(scenario, index)
        reported = Transform.stack([frame.world_from_agent for frame in snapshot.frames])
        poses = reported if snapshot.truth is None else snapshot.truth.world_from_agent
        yaw = poses.yaw.double().numpy()
        true_poses = np.concatenate((poses.translation[:, :2].double().numpy(), yaw[:, None]), 1)
        yield (noise.apply(snapshot, 0) if sigma else snapshot).frames, true_poses


def _make_replay(
    config: MapBuildConfig,
    town_map: TownMap,
    scenario: str,
    map_server: MapServer,
    true_poses: Mapping[tuple[str, int], Floats],
) -> MapReplay:
    share_config, map_model = get_map_share_config(config.map_mode), config.map_model
    if map_model is None:
        map_predictor = _make_simulated_predictor(town_map, scenario, config, true_poses)
        return MapReplay(map_predictor, map_server, scenario, channel=config.channel, seed=config.seed)
    encode_features = partial(encode_map_features, map_model) if share_config.use_neighbours else None
    map_predictor = MapModelPredictor(map_model, share_config)
    return MapReplay(
        map_predictor, map_server, scenario, encode_features, map_model.fingerprint, config.channel, config.seed
    )


def _make_simulated_predictor(
    town_map: TownMap, scenario: str, config: MapBuildConfig, true_poses: Mapping[tuple[str, int], Floats]
) -> MapPredictor:
    """Agents that draw the true map with a crowd's errors."""
    from manyeyes.simulator.fleet.config import crowd_config
    from manyeyes.simulator.fleet.map_predictor import SimulatedMapPredictor

    if town_map.place is None:
        raise ConfigError(f"{town_map.name}: no true map is known by its name, so none can be seen; use a map model.")
    share_config = get_map_share_config(config.map_mode)
    simulated = SimulatedMapPredictor(town_map.place.truth, crowd_config(config.map_mode), config.seed)

    def predict(frame: AgentFrame, received: Sequence[Message]) -> LocalMap:
        agent_key = f"{scenario}/{frame.agent_id}"
        return simulated.predict(
            true_poses[agent_key, frame.timestamp_ns], share_config.window(frame), agent_key, frame.timestamp_ns
        )

    return predict


def _evaluate(town_map: TownMap, map_server: MapServer, log: _BuildLog) -> BuiltMap:
    observations, fused = map_server.observations, map_server.rebuild()
    observed = MapElements.cat([o.elements_in_map() for o in observations])
    published = fused.select_published().elements
    truth = (
        town_map.observed_truth(observations, np.array([log.true_poses[o.agent, o.time_ns] for o in observations]))
        if observations
        else None
    )
    cut_policy = town_map.cut_policy
    evaluated = published if cut_policy is None else cut_policy(published)
    map_records = [record for record in log.sent_records if record.map_packets]
    feature_bytes = [record.feature_bytes for record in log.sent_records if record.feature_bytes]
    stats = MapBuildStats(
        name=town_map.name,
        num_scenarios=len(town_map.scenarios),
        num_messages=len(map_records),
        bytes_per_message=float(np.mean([record.map_bytes for record in map_records])) if map_records else 0.0,
        bytes_per_frame=float(np.mean(feature_bytes)) if feature_bytes else 0.0,
        num_lost=len(map_records) - len(observations) - len(map_server.rejected),
        num_rejected=len(map_server.rejected),
        num_observations=len(observations),
        num_observed_elements=len(observed),
        num_elements=len(fused),
        num_published=len(published),
        incremental_fscore=compute_map_fscore(map_server.map(), fused),
        scores=None if truth is None else evaluate_map(evaluated, truth),
        union_scores=None if truth is None or cut_policy is None else evaluate_map(cut_policy(observed), truth),
    )
    return BuiltMap(town_map, map_server, fused, truth, evaluated, observed, stats)


def write_built_map(built: BuiltMap, out: Path, title: str) -> None:
    """The map's folder, as 'map simulate' and 'map fuse' leave one, its page and its picture."""
    town_map, observations = built.town_map, built.map_server.observations
    folder = MapFolder(out)
    folder.write_observations(observations, town_map.frame)
    if built.truth is not None and town_map.cut_policy is not None:
        folder.write_truth(built.truth, town_map.frame, town_map.cut_policy)
    write_vector_map(built.fused, out / "map")
    page = make_page(title, built.fused, built.truth, observations, built.evaluated)
    save_map_page(page, out / "map.html")
    area = _bounding_area(built.observed, built.truth)
    panels = [
        MapPanel(f"{len(observations)} observations", built.observed, built.truth, area=area),
        MapPanel("Fused map" + (", truth behind it" if built.truth else ""), built.evaluated, built.truth, area=area),
    ]
    save_figure(panels, out / "map.png")


def _bounding_area(observed: MapElements, truth: MapElements | None) -> tuple[float, float, float, float] | None:
    points = np.concatenate([e.points for e in (observed, truth) if e is not None])
    if not len(points):
        return None
    (x0, y0), (x1, y1) = points.min(0) - MARGIN_M, points.max(0) + MARGIN_M
    return float(x0), float(y0), float(x1), float(y1)
