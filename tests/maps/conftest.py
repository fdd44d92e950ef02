# SPDX-License-Identifier: Apache-2.0
"""A small map with everything that a map can hold, and a local S3 server, for the tests of stores and formats."""

import hashlib
import socket
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, NO_STYLE, SOLID, STOP_LINE, MapElements
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import PointEvidence, Topology, VectorMap

FRAME = MapFrame(48.137, 11.575)


@pytest.fixture(scope="session")
def s3_options():
    """A local S3 server, as options of the file system."""
    pytest.importorskip("s3fs", reason="the cloud extra is not installed")
    pytest.importorskip("moto.server", reason="moto[server] is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(300):
            try:
                urllib.request.urlopen(f"{address}/moto-api/", timeout=1).close()
                break
            except OSError:
                time.sleep(0.2)
        else:
            pytest.fail("the local S3 server does not answer")
        yield (("endpoint_url", address), ("key", "test"), ("secret", "test"))
    finally:
        server.terminate()
        server.wait(10)


@pytest.fixture
def two_lanes():
    """A function (x, y, frame) -> map of one road."""
    return make_two_lanes


def make_two_lanes(x: float = 0.0, y: float = 0.0, frame: MapFrame = FRAME) -> VectorMap:
    """A road of two 3.5 m lanes, 60 m eastwards from (x, y): two solid edges, a dashed divider, a crossing, a stop line."""
    along = np.arange(0.0, 61.0)
    lines = [np.stack((along, side + 0.3 * np.sin(along / 20)), 1) for side in (3.5, 0.0, -3.5)]
    crossing = np.array([[20.0, 4.0], [24.0, 4.0], [24.0, -4.0], [20.0, -4.0]])
    stop = np.array([[18.0, 0.0], [18.0, 1.5], [18.0, 3.5]])
    elements = MapElements.of(
        [line + (x, y) for line in (*lines, crossing, stop)],
        [BOUNDARY, DIVIDER, BOUNDARY, CROSSING, STOP_LINE],
        [0.9, 0.8, 0.85, 0.7, 0.6],
        style=[SOLID, DASHED, SOLID, NO_STYLE, SOLID],
    )
    seen = [[hashlib.blake2b(bytes([k]), digest_size=16).hexdigest() for k in range(n + 1)] for n in range(5)]
    plain = VectorMap.of(elements, frame, seen, agents=2, times_ns=(10, 20), log_odds=np.linspace(2.5, 5.0, 5))
    rng = np.random.default_rng(3)
    p = len(elements.points)
    stations = PointEvidence(
        support=rng.integers(1, 9, p),
        agents=rng.integers(1, 5, p),
        log_odds=rng.normal(3, 1, p),
        sigma=rng.uniform(0.05, 0.2, p),
        t_first=rng.integers(0, 10, p),
        t_last=rng.integers(10, 20, p),
    )
    topology = Topology(
        successor=np.array([[4, 1]]),
        left=np.array([[1, 0], [2, 1]]),
        right=np.array([[0, 1], [1, 2]]),
        branch=np.array([[0, 0], [0, 1], [1, 2]]),
        branch_xy=np.array([[x, y], [x + 60.0, y - 3.5]]),
    )
    return replace(plain, state=np.array([1, 1, 1, 1, 0]), point_evidence=stations, topology=topology)
