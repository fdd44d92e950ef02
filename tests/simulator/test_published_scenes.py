# SPDX-License-Identifier: Apache-2.0
"""Scenes of carla-towns-small, on which tables are published: the points of today are those of commit f80ac70."""

import os

import pytest
import torch

pytest.importorskip("libsumo", reason="scenarios need the sim extra")

from manyeyes.simulator.presets import make_jobs, simulation_preset
from manyeyes.simulator.record import make_first_scenario

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif("MANYEYES_TOWNS" not in os.environ, reason="CARLA's towns are in no folder (MANYEYES_TOWNS)"),
]

# Of frame 7, by agent: number of points, and sums of x, y, z, intensity and time.
GOLDEN = {
    "train": {
        68: (13358, (-5964.893535, -3599.750260, 8107.554539, 2906.781651, -668.269980)),
        180: (13270, (-1465.132437, 10154.302249, 6919.526866, 2974.919231, -667.955020)),
        394: (13343, (-9257.838777, -3489.759471, 8063.563065, 3620.553738, -667.844636)),
    },
    "validate": {
        81: (12893, (7610.051552, 3962.642811, 7213.322891, 2411.871948, -645.952116)),
        152: (13152, (14367.464150, 17514.972630, 7574.605422, 3297.850341, -667.924998)),
        217: (13142, (1927.547199, 18510.041471, 8922.631421, 3629.199147, -661.491437)),
        -1: (13220, (62338.115113, 7777.238474, 27428.440166, 3199.940115, -661.609547)),
    },
}


@pytest.mark.parametrize("split", GOLDEN)
def test_a_scene_has_the_points_that_tables_were_measured_on(split: str) -> None:
    job = next(job for job in make_jobs(simulation_preset("carla-towns-small"), 0) if job.split == split)
    frames = make_first_scenario(job.spec, job.towns).snapshot(7).frames
    assert [frame.agent_id for frame in frames] == list(GOLDEN[split])
    for frame in frames:
        count, sums = GOLDEN[split][frame.agent_id]
        points = frame.points
        assert points.time_s is not None
        assert len(points) == count
        columns = torch.cat([points.xyz, points.intensity[:, None], points.time_s[:, None]], 1)
        assert columns.double().sum(0).tolist() == pytest.approx(sums, rel=1e-6, abs=1e-2)
