# SPDX-License-Identifier: Apache-2.0
"""What studies of the map model draw, by way of bytes, and the files that they go on from; with a model that knows nothing."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.comms import wire
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, PointCloud, Snapshot, Transform
from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.evaluation.maps import tile_prediction as tile_drawing
from manyeyes.evaluation.maps.tile_prediction import (
    CLEAN,
    CLEAN_CORRECTED,
    CORRECTED,
    NOISY,
    ROADSIDE,
    SINGLE_VEHICLE,
    VEHICLE,
    LocalPredictor,
    PoseNoisePredictor,
    SemiGlobalPredictor,
    TilePrediction,
)
from manyeyes.evaluation.maps.tile_sampling import TileSource, collect_observer_poses
from manyeyes.models import checkpoint
from manyeyes.models.maps.bev import BevConfig
from manyeyes.models.maps.head import MapHeadConfig
from manyeyes.models.maps.map_model import MapModel, MapModelConfig
from manyeyes.models.maps.presets import FORMAT
from manyeyes.studies.engine.cells import CellStore
from manyeyes.studies.maps import tile_cells
from manyeyes.studies.maps.tile_cells import RecordingSource, make_tile_jobs

CONFIG = MapModelConfig(
    BevConfig(
        BevGrid(-8.0, -8.0, -2.0, 8.0, 8.0, 4.0, pillar=0.5), channels=16, raster_channels=8, raster_blocks=(1, 1)
    ),
    BevGrid(-10.0, -5.0, -1.0, 10.0, 5.0, 1.0, pillar=1.0),
    token_channels=8,
    neck_blocks=(1, 1),
    head=MapHeadConfig(
        num_queries=9,
        num_points=5,
        min_trace_score=0.0,
        channels=16,
        feedforward_channels=32,
        layers=1,
        heads=4,
        score_threshold=0.0,
    ),
)
LINE = MapElements.of([[[98.0, 0.0], [98.0, 100.0]]], DIVIDER)


@dataclass(frozen=True)
class Drive:
    """Two cars and a pole, three frames, the first of them history; car 7 stands at (100, 50) and looks north."""

    scenarios: tuple[str, ...] = ("town1_0000", "town1_0001")

    def length(self, scenario: str) -> int:
        return 3

    def eval_indices(self, scenario: str) -> range:
        return range(1, 3)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (7, 8, -1)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        poses = [Transform.from_xyz_yaw(100 + 4 * k, 50 + 5 * k, 2, math.pi / 2 - k) for k in range(3)]
        clouds = [torch.randn(80, 3, generator=torch.Generator().manual_seed(index + 5 * k)) * 2 for k in range(3)]
        frames = [AgentFrame.of(PointCloud.of(c), p, a, index * 10**8) for c, p, a in zip(clouds, poses, (7, 8, -1))]
        return Snapshot(scenario, index, (*frames[:2], replace(frames[2], is_infrastructure=True)))


def load_truth(recording) -> dict[str, MapElements]:
    return {"Town1": LINE}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    checkpoint.save(MapModel(CONFIG), path, {"towns": []}, format=FORMAT)
    return str(path)


@pytest.fixture(scope="module")
def map_model(weights):
    return tile_cells.load_map_model(weights)


@pytest.fixture
def source():
    return TileSource(Drive(), load_truth(Drive()), collect_observer_poses(Drive()))


@pytest.fixture
def sent(monkeypatch):
    packets = []
    monkeypatch.setattr(wire, "decode_packet", lambda p, read=wire.decode_packet: packets.append(p) or read(p))
    return packets


def test_more_frames_change_the_prediction_and_every_frame_is_bytes(map_model, source, sent):
    one, two, many = SemiGlobalPredictor((1, 2, 9))(map_model, source, "town1_0000", 0)
    assert [len(d.frame_bytes) for d in (one, two, many)] == [1, 2, 6], "three agents here, three in the other scenario"
    assert (
        many.frame_bytes[:2] == two.frame_bytes
        and two.frame_bytes[:1] == one.frame_bytes
        and sum(many.frame_bytes) == sum(map(len, sent))
    )
    assert [d.row_name for d in (one, two, many)] == ["1", "2", "9"] and len(one.predicted) and len(one.truth) == 1
    assert not np.allclose(one.predicted.score, many.predicted.score, atol=1e-5)
    np.testing.assert_array_equal(one.truth.points, many.truth.points)


def test_local_maps_are_clipped_to_the_window_ahead(map_model, source):
    drawings = LocalPredictor()(map_model, source, "town1_0000", 0)
    assert [d.row_name for d in drawings] == [VEHICLE, VEHICLE, ROADSIDE] and all(
        len(d.frame_bytes) == 1 for d in drawings
    )
    assert all((d.predicted.points[:, 0] >= 0).all() and len(d.predicted) for d in drawings)
    np.testing.assert_allclose(np.sort(drawings[0].truth.points, 0), [[0, 2], [30, 2]], atol=1e-4)


def test_local_maps_of_one_kind_of_agent(map_model, source):
    every = LocalPredictor()(map_model, source, "town1_0000", 0)
    vehicles, roadside = (LocalPredictor((kind,))(map_model, source, "town1_0000", 0) for kind in (VEHICLE, ROADSIDE))
    assert [d.row_name for d in (*vehicles, *roadside)] == [d.row_name for d in every]
    np.testing.assert_array_equal(roadside[0].predicted.points, every[2].predicted.points)


def test_pose_noise_moves_others_features_and_the_corrector_gets_boxes(map_model, source, monkeypatch):
    """The corrector is asked with the noisy looks and their boxes, and what it returns is drawn from."""
    received, car = [], Boxes.of(torch.tensor([[4.0, 1.0, 0.8]]), torch.tensor([[4.5, 1.9, 1.6]]), torch.tensor([0.3]))

    class PerfectCorrection:
        """Puts everybody back to the true pose, as a perfect corrector would."""

        def correct(self, frame, cache, messages, states):
            received.append(messages)
            true = {f.agent_id: f.world_from_agent for f in source.recording.snapshot("town1_0000", 1).frames}
            back = tuple(replace(m, world_from_agent=true[m.agent_id]) for m in messages)
            return type("Aligned", (), {"messages": back})

    class FixedBoxesFusion:
        def compose_message(self, cache, frame):
            return type("Content", (), {"objects": car})

    monkeypatch.setattr(tile_drawing, "_make_cache", lambda *_: object())
    monkeypatch.setattr(tile_drawing, "LateFusion", FixedBoxesFusion)
    predictions = {
        d.row_name: d
        for d in PoseNoisePredictor(sigma_m=2.0, pose_correction=PerfectCorrection())(
            map_model, source, "town1_0000", 0
        )
    }
    assert list(predictions) == [SINGLE_VEHICLE, CLEAN, NOISY, CORRECTED, CLEAN_CORRECTED]
    assert [len(predictions[row].frame_bytes) for row in predictions] == [1, 3, 3, 3, 3] and len(received) == 2
    assert [m.agent_id for m in received[0]] == [8, -1] and all(len(m.objects) == 1 for m in received[0])
    assert float(received[0][0].pose_covariance[0, 0]) == pytest.approx(4.0, rel=0.05)
    assert not np.allclose(predictions[CLEAN].predicted.score, predictions[NOISY].predicted.score, atol=1e-5)
    for row in (CORRECTED, CLEAN_CORRECTED):
        np.testing.assert_allclose(predictions[CLEAN].predicted.score, predictions[row].predicted.score, atol=1e-4)


@dataclass
class CountingPredictor:
    """Draws the truth at both rows, and counts how often it was asked."""

    num_calls: int = 0
    cache_key: str = "counting"

    def __call__(self, map_model, source, scenario, seed):
        self.num_calls += 1
        truth = source.crop_truth(scenario, Transform.from_xyz_yaw(100, 50, 0, seed), CONFIG.tile)
        return [
            TilePrediction("one", truth, truth, (100 + seed,)),
            TilePrediction("none", MapElements.empty(), truth, ()),
        ]


def run_jobs(weights, predictor, seeds, folder, **options):
    source = RecordingSource(Drive, load_truth)
    return [job() for job in make_tile_jobs(source, weights, predictor, seeds, CellStore(folder), **options)]


@pytest.mark.slow
def test_an_interrupted_study_resumes(weights, tmp_path):
    draw = CountingPredictor()
    first = run_jobs(weights, draw, (0, 1), tmp_path)
    assert draw.num_calls == 4
    assert [(c.scenario, c.seed) for c in first] == [(s, k) for s in Drive().scenarios for k in (0, 1)]
    sorted(tmp_path.glob("town1_0001-1-*"))[0].write_bytes(b"spoilt")
    again = run_jobs(weights, draw, (0, 1), tmp_path)
    assert draw.num_calls == 5, "kept ones are read, a spoilt one is made again"
    for one, other in zip(first, again):
        for a, b in zip(one.predictions, other.predictions, strict=True):
            assert (a.row_name, a.frame_bytes) == (b.row_name, b.frame_bytes) and len(a.predicted) == len(b.predicted)
            np.testing.assert_array_equal(a.truth.points, b.truth.points)
    run_jobs(weights, draw, (0, 2), tmp_path, scenario_stride=2)
    assert draw.num_calls == 6, "another seed of the first scenario alone"


def test_other_weights_are_other_results(weights, tmp_path):
    torch.manual_seed(1)
    other = tmp_path / "other.safetensors"
    checkpoint.save(MapModel(CONFIG), other, {"towns": []}, format=FORMAT)
    draw = CountingPredictor()
    for name in (weights, str(other)):
        run_jobs(name, draw, (0,), tmp_path / "cells", scenario_stride=2)
    assert draw.num_calls == 2
