# SPDX-License-Identifier: Apache-2.0
"""Predictions for the studies of the map model: local maps, tiles from one or more frames, and tiles under pose noise.

Features of every frame are encoded as packets, those of the first agent too (agents.map_features). Sources: CrowdMap, Tables 1
and 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from manyeyes.agents.map_features import decode_map_features, encode_map_features, predict_tile
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.strategies.late import LateFusion
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, Message, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.tile_sampling import (
    TileSource,
    make_local_tile,
    make_world_from_tile,
    sample_fleet_tile,
    sample_meeting,
)
from manyeyes.evaluation.maps.tiles import crop_to_tile
from manyeyes.models import pretrained
from manyeyes.models.checkpoint import fingerprint
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.models.maps.map_model import MapModel

VEHICLE, ROADSIDE = "vehicle", "roadside unit"
CLEAN, NOISY, CORRECTED, CLEAN_CORRECTED = "clean", "noisy", "noisy, corrected", "clean, corrected"
SINGLE_VEHICLE = "one vehicle"


@dataclass(frozen=True, eq=False)
class TilePrediction:
    """The prediction of one tile for one row of a table. predicted, truth: in the tile's frame; frame_bytes: bytes of each frame
    that the tile was predicted from.
    """

    row_name: str
    predicted: MapElements
    truth: MapElements
    frame_bytes: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class ScenarioPredictions:
    """The predicted tiles of one scenario at one seed."""

    scenario: str
    seed: int
    predictions: tuple[TilePrediction, ...]


@dataclass(frozen=True)
class LocalPredictor:
    """Predict the local map ahead of each agent of a scenario; one row for vehicles and one for roadside units.

    The model predicts its whole tile around the agent; the window is cut out of it, as in the map mode local.
    rows: the kinds of agents to predict for.
    """

    rows: tuple[str, ...] = (VEHICLE, ROADSIDE)

    @property
    def cache_key(self) -> str:
        """The configuration, which names stored results."""
        return repr(self)

    def __call__(self, map_model: MapModel, source: TileSource, scenario: str, seed: int) -> Sequence[TilePrediction]:
        """Return one drawing an agent."""
        snapshot, out = sample_meeting(source, scenario, seed), []
        for row, frame in enumerate(snapshot.frames):
            name = ROADSIDE if frame.is_infrastructure else VEHICLE
            if name not in self.rows:
                continue
            tile, window = make_local_tile(source, snapshot, row)
            received = _ReceivedFeatures.of(map_model, frame)
            predicted = crop_to_tile(
                predict_tile(map_model, received.messages, tile.world_from_tile), Transform.identity(), window
            )
            out.append(TilePrediction(name, predicted, tile.truth, received.num_bytes))
        return out


@dataclass(frozen=True)
class SemiGlobalPredictor:
    """Predict the tile around a scenario's first agent from one frame and from more; one row for each number of frames."""

    frame_counts: tuple[int, ...] = (1, 2, 5, 10)

    @property
    def cache_key(self) -> str:
        """The configuration, which names stored results."""
        return repr(self)

    def __call__(self, map_model: MapModel, source: TileSource, scenario: str, seed: int) -> Sequence[TilePrediction]:
        """Return one prediction for each number of frames; all share the frames of the tile."""
        config = map_model.config
        tile = sample_fleet_tile(source, scenario, seed, max(self.frame_counts), config.tile, config.bev.grid)
        received = [_ReceivedFeatures.of(map_model, frame) for frame in tile.frames]
        return [
            _predict(str(count), map_model, received[:count], tile.world_from_tile, tile.truth)
            for count in self.frame_counts
        ]


@dataclass(frozen=True)
class PoseNoisePredictor:
    """The tile about a scenario's first agent from all agents that meet there at one instant, others' prior poses in error.

    sigma_m: of each axis; headings err by as many degrees times deg_per_m. The first agent knows its own pose, in whose frame the
    tile lies. pose_correction: corrects others' poses by objects that both detect; what it leaves out is not drawn from.
    detector_weights: the weights that detect; in every row boxes are sent with the features and count in the bytes.
    """

    sigma_m: float = 0.5
    deg_per_m: float = 2.0
    pose_correction: PoseCorrection = PoseCorrection()
    detector_weights: str = pretrained.DEFAULT_DETECTOR

    @property
    def cache_key(self) -> str:
        """The errors, the corrector and its weights, and the detector's."""
        net = self.pose_correction.net
        return repr(
            (self, _load_detector(self.detector_weights).fingerprint, None if net is None else fingerprint(net))
        )

    def __call__(self, map_model: MapModel, source: TileSource, scenario: str, seed: int) -> Sequence[TilePrediction]:
        """Return rows: one vehicle; clean; noisy; noisy, corrected; clean, corrected."""
        snapshot = sample_meeting(source, scenario, seed)
        ego_frame = snapshot.frames[0]
        world_from_tile = make_world_from_tile(ego_frame)
        truth = source.crop_truth(scenario, world_from_tile, map_model.config.tile)
        sigma_yaw_rad = float(np.radians(self.deg_per_m * self.sigma_m))
        noise = PoseNoise("collaborators", self.sigma_m, sigma_yaw_rad, seed, "independent", "true")
        previous_frames = source.recording.snapshot(scenario, snapshot.index - 1).frames if snapshot.index else ()
        caches = [_make_cache(self.detector_weights, frame, previous_frames) for frame in snapshot.frames]
        clean, noisy = (
            [_ReceivedFeatures.of(map_model, frame, cache) for frame, cache in zip(frames, caches)]
            for frames in (snapshot.frames, noise.apply(snapshot, 0).frames)
        )
        out = [
            _predict(row, map_model, received, world_from_tile, truth)
            for row, received in ((SINGLE_VEHICLE, clean[:1]), (CLEAN, clean), (NOISY, noisy))
        ]
        for row, received in ((CORRECTED, noisy), (CLEAN_CORRECTED, clean)):
            messages = [message for item in received[1:] for message in item.messages]
            corrected = self.pose_correction.correct(ego_frame, caches[0], messages, {}).messages
            predicted = predict_tile(map_model, [*received[0].messages, *corrected], world_from_tile)
            out.append(
                TilePrediction(row, predicted, truth, tuple(size for item in received for size in item.num_bytes))
            )
        return out


@dataclass(frozen=True)
class _ReceivedFeatures:
    """The received features of a frame. messages: its message, none without features; num_bytes: the bytes of that message."""

    messages: tuple[Message, ...]
    num_bytes: tuple[int, ...]

    @classmethod
    def of(cls, map_model: MapModel, frame: AgentFrame, cache: PerceptionCache | None = None) -> _ReceivedFeatures:
        own_message = None if cache is None else LateFusion().compose_message(cache, frame)
        packets = encode_map_features(map_model, frame, objects=None if own_message is None else own_message.objects)
        message = decode_map_features(packets, map_model)
        return cls(() if message is None else (message,), (sum(map(len, packets)),) if packets else ())


def _predict(
    row: str, map_model: MapModel, received: Sequence[_ReceivedFeatures], world_from_tile: Transform, truth: MapElements
) -> TilePrediction:
    messages = [message for item in received for message in item.messages]
    frame_bytes = tuple(size for item in received for size in item.num_bytes)
    return TilePrediction(row, predict_tile(map_model, messages, world_from_tile), truth, frame_bytes)


def _make_cache(detector: str, frame: AgentFrame, previous_frames: Sequence[AgentFrame]) -> PerceptionCache:
    """Return a perception cache that has processed the agent's previous sweeps."""
    cache = PerceptionCache(_load_detector(detector))
    for earlier in previous_frames:
        if earlier.agent_id == frame.agent_id:
            cache.process(earlier)
    return cache


@lru_cache(maxsize=2)
def _load_detector(name: str) -> BoxDetector:
    return pretrained.load(name)
