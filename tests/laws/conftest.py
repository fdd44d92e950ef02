# SPDX-License-Identifier: Apache-2.0
"""Examples of every data type, by which ``@given(boxes=...)`` draws an argument of a law from its annotation."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from manyeyes.datatypes import (
    KINDS,
    LABELS,
    STYLES,
    AgentBody,
    AgentFrame,
    BevGrid,
    Boxes,
    Camera,
    CameraImage,
    GroundTruth,
    MapElements,
    Message,
    PointCloud,
    Polygons,
    Sites,
    Snapshot,
    SparseBev,
    Transform,
)
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.datatypes.message import DESCRIPTOR_DIM, LocalMap, RequestMap
from manyeyes.datatypes.sight import NUM_SECTORS, Sight

GRID = BevGrid(-12.8, -6.4, -3.0, 12.8, 6.4, 1.0, 0.4, 4)
SEEDS = st.integers(0, 2**32 - 1)
COUNTS = st.integers(0, 12)
ANGLES = st.floats(-math.pi, math.pi)
OFFSETS = st.floats(-300, 300)


def make_transform(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> Transform:
    angles = torch.tensor([roll, pitch, yaw], dtype=torch.float64)
    return Transform.from_rpy(torch.tensor([x, y, z], dtype=torch.float64), *angles)


def make_boxes(seed: int, count: int, dtype: torch.dtype = torch.float32) -> Boxes:
    draw = np.random.default_rng(seed)
    center = np.stack((draw.uniform(-60, 60, count), draw.uniform(-60, 60, count), draw.uniform(0, 2, count)), 1)
    size = np.stack((draw.uniform(1, 20, count), draw.uniform(0.5, 3, count), draw.uniform(1, 4, count)), 1)
    columns = (center, size, draw.uniform(-3.1, 3.1, count), draw.permutation(count) / max(count, 1))
    sigmas = (draw.uniform(0.02, 19, count), draw.uniform(0.01, 3, count), draw.uniform(0, 1, count))
    return Boxes(
        *(torch.from_numpy(column).to(dtype) for column in columns),
        torch.from_numpy(draw.integers(0, len(LABELS), count)),
        torch.from_numpy(draw.integers(-1, 250, count)),
        *(torch.from_numpy(column).to(dtype) for column in sigmas),
        torch.from_numpy(draw.uniform(-30, 30, (count, 2))).to(dtype),
    )


def make_cloud(seed: int, count: int) -> PointCloud:
    draw = np.random.default_rng(seed)
    return PointCloud.of(draw.uniform(-90, 90, (count, 3)), draw.uniform(0, 1, count))


def make_tokens(seed: int, count: int, channels: int) -> SparseBev:
    draw = np.random.default_rng(seed)
    key = np.sort(draw.permutation(math.prod(GRID.shape))[:count])
    features = draw.normal(0, 1, (len(key), channels)).astype(np.float32)
    return SparseBev(torch.from_numpy(features), Sites(torch.from_numpy(key), GRID))


def make_elements(seed: int, count: int) -> MapElements:
    draw = np.random.default_rng(seed)
    lines = [np.cumsum(draw.uniform(0.5, 3, (draw.integers(2, 7), 2)), 0) for _ in range(count)]
    kind = draw.integers(0, KINDS.index("crossing"), count)
    return MapElements.of(lines, kind, draw.uniform(0, 1, count), style=draw.integers(0, len(STYLES), count))


def make_message(
    seed: int, pose: Transform, tokens: SparseBev | None, objects: Boxes | None, points: PointCloud | None
) -> Message:
    draw = np.random.default_rng(seed)
    sigma = torch.from_numpy(draw.uniform(0.01, 1, 3))
    view = np.array([(0, -15), (30, -15), (30, 15), (0, 15)], float)
    return Message(
        int(draw.integers(-(2**31), 2**31)),
        int(draw.integers(0, 2**62)),
        pose,
        torch.diag(sigma**2),
        draw.bytes(8),
        bool(seed % 2),
        tokens,
        None if tokens is None else torch.from_numpy(draw.permutation(len(tokens.sites)).astype(np.float32)),
        objects,
        points,
        None if objects is None else torch.nn.functional.normalize(torch.ones(len(objects), DESCRIPTOR_DIM)),
        RequestMap(GRID, torch.from_numpy(draw.integers(0, 256, GRID.shape) / 255).float()),
        LocalMap(make_elements(seed, 2), view),
        sight=None if seed % 3 else Sight(draw.integers(0, 256, NUM_SECTORS)),
    )


def make_frame(agent_id: int, points: PointCloud, pose: Transform, images: tuple[CameraImage, ...]) -> AgentFrame:
    return AgentFrame(agent_id, 0, points, pose, torch.eye(3, dtype=torch.float64), odometry=pose, images=images)


def make_snapshot(boxes: Boxes, first: AgentFrame, second: AgentFrame) -> Snapshot:
    poses = Transform.stack([first.world_from_agent, second.world_from_agent])
    truth = GroundTruth(boxes, torch.ones(2, len(boxes), dtype=torch.bool), poses)
    return Snapshot("street", 0, (first, second), truth)


st.register_type_strategy(BevGrid, st.just(GRID))
BODY_CENTER, BODY_SIZE = st.floats(-20, 20, width=32), st.floats(0.125, 25, width=32)
st.register_type_strategy(
    AgentBody, st.builds(AgentBody, st.tuples(*[BODY_CENTER] * 3), st.tuples(*[BODY_SIZE] * 3), ANGLES)
)
st.register_type_strategy(Transform, st.builds(make_transform, OFFSETS, OFFSETS, OFFSETS, ANGLES, ANGLES, ANGLES))
st.register_type_strategy(Boxes, st.builds(make_boxes, SEEDS, COUNTS, st.sampled_from((torch.float32, torch.float64))))
st.register_type_strategy(PointCloud, st.builds(make_cloud, SEEDS, COUNTS))
st.register_type_strategy(SparseBev, st.builds(make_tokens, SEEDS, COUNTS, st.integers(1, 4)))
st.register_type_strategy(Sites, st.from_type(SparseBev).map(lambda tokens: tokens.sites))
st.register_type_strategy(MapElements, st.builds(make_elements, SEEDS, COUNTS))
st.register_type_strategy(Polygons, st.from_type(MapElements).map(lambda all: Polygons(all.points, all.offsets)))
st.register_type_strategy(
    Camera,
    st.builds(Camera, st.just(torch.eye(3, dtype=torch.float64)), st.from_type(Transform), st.just(3), st.just(2)),
)
st.register_type_strategy(
    CameraImage, st.builds(lambda camera: CameraImage(camera, torch.zeros(3, 2, 3).byte()), st.from_type(Camera))
)
st.register_type_strategy(
    Keypoints, st.from_type(Boxes).map(lambda boxes: Keypoints(boxes, torch.ones(len(boxes), DESCRIPTOR_DIM)))
)
st.register_type_strategy(
    Message,
    st.builds(
        make_message,
        SEEDS,
        st.from_type(Transform),
        st.none() | st.from_type(SparseBev),
        st.none() | st.builds(make_boxes, SEEDS, COUNTS),
        st.none() | st.from_type(PointCloud),
    ),
)
st.register_type_strategy(RequestMap, st.from_type(Message).map(lambda message: message.request))
st.register_type_strategy(
    Sight, st.builds(lambda seed: Sight(np.random.default_rng(seed).integers(0, 256, NUM_SECTORS)), SEEDS)
)
st.register_type_strategy(LocalMap, st.from_type(Message).map(lambda message: message.local_map))
st.register_type_strategy(
    AgentFrame,
    st.builds(
        make_frame,
        st.integers(-1, 9),
        st.from_type(PointCloud),
        st.from_type(Transform),
        st.tuples() | st.tuples(st.from_type(CameraImage)),
    ),
)
st.register_type_strategy(
    Snapshot, st.builds(make_snapshot, st.from_type(Boxes), st.from_type(AgentFrame), st.from_type(AgentFrame))
)
st.register_type_strategy(GroundTruth, st.from_type(Snapshot).map(lambda snapshot: snapshot.truth))


def is_same(a: Any, b: Any, tolerance: float) -> bool:
    """Whether two values are equal field by field, numbers within a tolerance."""
    if isinstance(a, (torch.Tensor, np.ndarray)):
        a, b = (np.asarray(x) for x in (a, b))
        return a.dtype == b.dtype and a.shape == b.shape and np.allclose(a, b, rtol=0, atol=tolerance, equal_nan=True)
    if dataclasses.is_dataclass(a):
        names = [f.name for f in dataclasses.fields(a) if f.name != "cache"]
        return type(a) is type(b) and all(is_same(getattr(a, n), getattr(b, n), tolerance) for n in names)
    if isinstance(a, float):
        return a == b or abs(a - b) <= tolerance or (a != a and b != b)
    if isinstance(a, (tuple, list)):
        return len(a) == len(b) and all(is_same(x, y, tolerance) for x, y in zip(a, b))
    return a == b


@pytest.fixture(scope="session")
def assert_same() -> Callable[..., None]:
    """A function that fails unless two values are equal field by field."""

    def check(a: Any, b: Any, tolerance: float = 0.0) -> None:
        assert is_same(a, b, tolerance), f"{a}\nis not\n{b}"

    return check
