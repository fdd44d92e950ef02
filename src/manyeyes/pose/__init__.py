# SPDX-License-Identifier: Apache-2.0
"""Relative pose estimation between agents, from landmarks or clouds, with tests of the prior pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.pose.corrector import CorrectorConfig as CorrectorConfig
    from manyeyes.pose.landmarks import Landmarks as Landmarks
    from manyeyes.pose.pose_graph import (
        PoseGraphResult as PoseGraphResult,
        RelativePoseEdge as RelativePoseEdge,
        optimize_poses as optimize_poses,
    )
    from manyeyes.pose.pose_monitor import (
        PoseHealth as PoseHealth,
        PoseMonitorConfig as PoseMonitorConfig,
        PoseReport as PoseReport,
        update_monitor as update_monitor,
    )
    from manyeyes.pose.registration import RegistrationConfig as RegistrationConfig, register_clouds as register_clouds
    from manyeyes.pose.registry import (
        correct_pose as correct_pose,
        list_correctors as list_correctors,
        load_corrector as load_corrector,
        register_pose_corrector as register_pose_corrector,
    )
    from manyeyes.pose.types import (
        PoseCorrector as PoseCorrector,
        PoseEstimate as PoseEstimate,
        PosePrior as PosePrior,
        PoseStatus as PoseStatus,
    )

__getattr__, __dir__ = attach(__name__)
