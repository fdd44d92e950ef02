# SPDX-License-Identifier: Apache-2.0
"""Two real sweeps (Argoverse 2): landmarks are the annotated boxes with errors drawn, the start is anywhere."""

from pathlib import Path

import numpy as np
import pytest

from manyeyes.datasets.argoverse2 import Argoverse2Recording
from manyeyes.datatypes import Transform
from manyeyes.ops.keyed_random import keyed_normal, keyed_uniform
from manyeyes.pose.corrector import correct_by_voting
from manyeyes.pose.landmarks import DetectorUncertainty, Landmarks
from manyeyes.pose.types import PosePrior, lift_to_se3, pose_difference, project_to_se2

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
LOG = SHARED / "av2" / "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
ERROR = DetectorUncertainty(0.25, 0.044, 0.01)
pytestmark = pytest.mark.skipif(not LOG.is_dir(), reason=f"{LOG} is absent: the real sweeps are not in this project")


def views():
    """What both sweeps' vehicles are, and ego_from_other between the sweeps' own frames."""
    recording = Argoverse2Recording(LOG, gap=1)
    scenario = recording.scenarios[0]
    sweeps = recording.sweeps(scenario)[:2]
    marks = []
    for time in sweeps:
        annotations = recording.annotations(scenario, time)
        marks.append(
            Landmarks.of_boxes(annotations.boxes[annotations.is_vehicle & (annotations.interior_points > 0)], ERROR)
        )
    poses = [f.world_from_agent for f in recording.snapshot(scenario, 0).frames]
    return marks[0], marks[1], poses[0].inverse() @ poses[1]


def disturbed(marks, *key):
    unit = keyed_normal((len(marks), 3), *key).numpy()
    shift = Landmarks(
        marks.xy + 0.25 * unit[:, :2], marks.yaw + 0.044 * unit[:, 2], marks.size, marks.score, marks.sigma_xy,
        marks.sigma_yaw, marks.p_flip, marks.instant,
    )  # fmt: skip
    return shift


@pytest.mark.slow
def test_a_hundred_starts_of_any_yaw_and_up_to_twenty_metres():
    ego, other, ego_from_other = views()
    assert len(ego) > 15
    right = wrong = 0
    for start in range(100):
        u = keyed_uniform((3,), 0, "start", start).tolist()
        turned = Transform.from_xyz_yaw(0.0, 0.0, 0.0, 2 * np.pi * u[0])
        # The other agent's frame is turned anywhere, and its claim is up to 20 m and any yaw off.
        truth = project_to_se2(ego_from_other @ turned.inverse())
        seen = disturbed(other, 0, "other", start).transform(project_to_se2(turned))
        far = np.array([20 * np.cos(2 * np.pi * u[1]), 20 * np.sin(2 * np.pi * u[1]), 2 * np.pi * u[2]])
        prior = PosePrior(lift_to_se3(truth + far, None), np.diag([100.0, 100.0, 3.0]))
        found = correct_by_voting(disturbed(ego, 0, "ego", start), seen, prior)
        if found.status.has_estimate:
            error = pose_difference(found.pose, truth)
            good = np.hypot(error[0], error[1]) < 1.0 and abs(error[2]) < np.radians(1.0)
            right, wrong = right + good, wrong + (not good)
    assert right >= 95 and wrong == 0, (right, wrong)
