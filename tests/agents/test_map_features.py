# SPDX-License-Identifier: Apache-2.0
"""Map features as packets: tiles are predicted from received features only."""

import copy
import dataclasses
import math

import numpy as np
import torch

from manyeyes.agents.map_features import decode_map_features, encode_map_features, predict_tile
from manyeyes.datatypes import AgentFrame, Boxes, PointCloud, Transform
from manyeyes.models.maps.head import decode_elements
from manyeyes.models.maps.map_model import MapModel

PLACE = Transform.from_xyz_yaw(1000.0, -200.0, 0.0, 0.4)


def frame(agent, x=0.0, yaw=0.0, points=200):
    cloud = torch.randn(points, 3, generator=torch.Generator().manual_seed(agent)) * torch.tensor([3.0, 3.0, 0.3])
    return AgentFrame.of(PointCloud.of(cloud), PLACE @ Transform.from_xyz_yaw(x, 0, 1.5, yaw), agent, agent * 1000)


def drawn(mapper, frames, **how):
    messages = [decode_map_features(encode_map_features(mapper, f, **how), mapper) for f in frames]
    return predict_tile(mapper, [m for m in messages if m is not None], PLACE)


def test_full_precision_through_bytes_is_the_model_itself(mapper):
    frames = [frame(1), frame(2, x=5.0, yaw=math.pi)]
    there = drawn(mapper, frames, token_encoding="float32", budget_bytes=None)
    features = mapper.extract_features([f.points for f in frames])
    motion = Transform.stack([PLACE.inverse() @ f.world_from_agent for f in frames])
    raw = mapper.predict_elements(mapper.fuse(features.tokens, motion, torch.zeros(2, dtype=torch.int64), 1))[-1]
    here = decode_elements(raw, mapper.config.tile, mapper.config.head)[0]
    np.testing.assert_allclose(there.score, here.score, atol=1e-4)
    np.testing.assert_array_equal(there.kind, here.kind)
    np.testing.assert_allclose(there.points, here.points, atol=1e-2)


def test_packets_and_tiles_are_those_of_the_cpu_wherever_the_weights_are(mapper, device):
    frames, theirs = [frame(1), frame(2, x=5.0, yaw=math.pi)], copy.deepcopy(mapper).to(device)
    features = theirs.extract_features([frames[0].points])
    assert features.tokens.features.device == theirs.device == device
    one, other = (drawn(model, frames, token_encoding="float32") for model in (mapper, theirs))
    assert len(one) > 0
    np.testing.assert_array_equal(other.kind, one.kind)
    np.testing.assert_allclose(other.score, one.score, atol=1e-4)
    np.testing.assert_allclose(other.points, one.points, atol=1e-2)


def test_the_order_of_messages_does_not_count(mapper):
    frames = [frame(1), frame(2, x=5.0, yaw=math.pi), frame(3, x=-4.0)]
    a, b = drawn(mapper, frames), drawn(mapper, frames[::-1])
    np.testing.assert_allclose(a.score, b.score, atol=1e-5)


def test_a_budget_keeps_the_cells_of_highest_score(mapper):
    full = decode_map_features(encode_map_features(mapper, frame(1), "float32", None), mapper)
    packets = encode_map_features(mapper, frame(1), "float32", 700)
    few = decode_map_features(packets, mapper)
    assert sum(map(len, packets)) <= 700 and few is not None and full is not None
    assert few.tokens is not None and full.tokens is not None
    kept, all_of_them = few.tokens.sites.key, full.tokens.sites.key
    worth = mapper.line_classifier(full.tokens.features).sigmoid().amax(1)
    left_out = ~torch.isin(all_of_them, kept)
    assert 0 < len(kept) < len(all_of_them)
    assert float(worth[~left_out].min()) >= float(worth[left_out].max()) - 1e-6


def test_an_empty_cloud_sends_nothing_and_a_tile_without_messages_is_predicted(mapper):
    assert encode_map_features(mapper, frame(1, points=0)) == [] and decode_map_features([], mapper) is None
    nothing = predict_tile(mapper, [], PLACE)
    away = drawn(mapper, [frame(1, x=900.0)])
    np.testing.assert_allclose(nothing.score, away.score, atol=1e-6)


def test_tokens_of_other_weights_are_not_understood(mapper):
    other = MapModel(mapper.config).eval()
    other.fingerprint = b"another!"
    assert decode_map_features(encode_map_features(mapper, frame(1)), other) is None


def test_moved_poses_move_the_features(mapper):
    one = frame(1)
    moved = dataclasses.replace(one, world_from_agent=one.world_from_agent @ Transform.from_xyz_yaw(6.0, 0, 0, 0))
    assert not np.allclose(drawn(mapper, [one]).score, drawn(mapper, [moved]).score, atol=1e-5)


def test_detections_are_sent_with_the_map_features(mapper):
    car = Boxes.of(torch.tensor([[4.0, 1.0, 0.8]]), torch.tensor([[4.5, 1.9, 1.6]]), torch.tensor([0.3]))
    alone, both = (decode_map_features(encode_map_features(mapper, frame(1), objects=o), mapper) for o in (None, car))
    assert alone is not None and alone.objects is None and both is not None and both.objects is not None
    np.testing.assert_allclose(both.objects.center.numpy(), car.center.numpy(), atol=0.05)
    assert np.array_equal(predict_tile(mapper, [alone], PLACE).score, predict_tile(mapper, [both], PLACE).score)
