# SPDX-License-Identifier: Apache-2.0
"""Numbers about a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.evaluation.detection.accumulator import MethodResult as MethodResult
    from manyeyes.evaluation.detection.average_precision import (
        ApResult as ApResult,
        average_precision as average_precision,
    )
    from manyeyes.evaluation.detection.benchmark import (
        BenchmarkConfig as BenchmarkConfig,
        BenchmarkResult as BenchmarkResult,
        benchmark as benchmark,
        run_benchmark as run_benchmark,
    )
    from manyeyes.evaluation.detection.protocols import (
        DetectionProtocol as DetectionProtocol,
        get_protocol as get_protocol,
    )
    from manyeyes.evaluation.maps.matching import (
        MatchingProtocol as MatchingProtocol,
        get_matching_protocol as get_matching_protocol,
    )
    from manyeyes.evaluation.maps.metrics import MapMetrics as MapMetrics, evaluate_map as evaluate_map
    from manyeyes.evaluation.pose.metrics import (
        PoseEvaluation as PoseEvaluation,
        PoseScore as PoseScore,
        evaluate_pose as evaluate_pose,
        summarize_evaluations as summarize_evaluations,
    )
    from manyeyes.evaluation.statistics.bootstrap import (
        BootstrapSamples as BootstrapSamples,
        Interval as Interval,
        bootstrap as bootstrap,
    )
    from manyeyes.evaluation.statistics.comparison import Comparison as Comparison, compare_methods as compare_methods

__getattr__, __dir__ = attach(__name__)
