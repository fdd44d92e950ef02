# SPDX-License-Identifier: Apache-2.0
"""Estimate the pose of another agent from its boxes and yours, and draw both.

python examples/12_correct_pose.py out/pose.png
"""

import sys
from pathlib import Path

import numpy as np

from manyeyes import PosePrior, correct_pose
from manyeyes.pose.landmarks import Landmarks
from manyeyes.viz.birds_eye import save_png
from manyeyes.viz.pose_pair import draw_pose_pair

picture = Path(sys.argv[1] if len(sys.argv) > 1 else "out/pose.png")
picture.parent.mkdir(parents=True, exist_ok=True)

# Boxes of two agents, each in its own frame: x, y (m), yaw (rad), length, width (m), score. Yours come from your detector.
rng = np.random.default_rng(3)
cars = np.column_stack((rng.uniform(-40, 40, (14, 2)), rng.uniform(-3, 3, 14)))
sizes = np.column_stack((rng.normal(4.5, 0.4, 14), rng.normal(1.85, 0.1, 14)))
x, y, yaw = true_pose = np.array([18.0, -7.0, 0.8])
turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def detect(poses: np.ndarray, rows: slice) -> np.ndarray:
    """Return boxes (N, 6) of cars at poses (N, 3), with errors as real boxes have them."""
    noisy = poses[rows] + rng.normal(0, [0.25, 0.25, 0.06], poses[rows].shape)
    return np.column_stack(
        (noisy, sizes[rows] + rng.normal(0, 0.1, sizes[rows].shape), rng.uniform(0.3, 1, len(noisy)))
    )


own = detect(cars, slice(0, 11))
theirs = detect(np.column_stack(((cars[:, :2] - [x, y]) @ turn, cars[:, 2] - yaw)), slice(2, 14))

# What you know before: the pose with its covariance of x, y (m) and yaw (rad). None where nothing is known.
prior = PosePrior.from_pose(true_pose + [2.0, -1.5, 0.05], covariance=np.diag([2.0**2, 2.0**2, 0.05**2]))
estimate = correct_pose(own, theirs, prior)

print(f"{estimate.status.value}: {estimate.inliers} common objects")
if estimate.pose is not None:
    error = estimate.pose - true_pose
    sigma = np.sqrt(np.diag(estimate.covariance))
    print(f"position within {np.hypot(*error[:2]):.2f} m, stated sigma {np.hypot(*sigma[:2]):.2f} m")
    print(f"yaw within {abs(np.degrees(error[2])):.2f} deg, stated sigma {np.degrees(sigma[2]):.2f} deg")
save_png(draw_pose_pair(Landmarks.of(own), Landmarks.of(theirs), prior, estimate), picture)
print(f"wrote {picture}")
