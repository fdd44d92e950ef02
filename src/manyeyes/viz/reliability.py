# SPDX-License-Identifier: Apache-2.0
"""Reliability diagrams: the fraction of correct boxes over the score, for each method."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.reliability import CONFIDENCE_LEVEL, Reliability
from manyeyes.viz.curves import Curve, CurvePanel, save_curves
from manyeyes.viz.report import Chapter, ReportImage

HEADINGS = ("method", "boxes", "expected calibration error")
TEXT = (
    "Of boxes with a score in an interval, the fraction that overlaps a vehicle (IoU 0.5), with 95 % intervals. On the diagonal a "
    "score is the probability that the box is correct. The expected calibration error is the mean distance from it over boxes."
)


def make_reliability_chapter(reliability: Mapping[str, Reliability], path: Path) -> Chapter:
    """Draw the diagram to a PNG file, and return it with its table as a chapter of a report."""
    diagonal = Curve("calibrated", tuple(Interval(v, v, v, CONFIDENCE_LEVEL, 1) for v in (0.0, 1.0)), (0.0, 1.0))
    curves = tuple(
        Curve(name, tuple(b.correct for b in found.bins), tuple(b.mean_score for b in found.bins))
        for name, found in reliability.items()
        if found.bins
    )
    panel = CurvePanel("Reliability of scores", "score", "fraction of correct boxes", (diagonal, *curves))
    save_curves([panel], path)
    rows = (
        (name, f"{sum(b.count for b in found.bins):,}", f"{found.expected_error:.3f}" if found.bins else "-")
        for name, found in reliability.items()
    )
    return Chapter("Reliability of scores", TEXT, (ReportImage(path, "Reliability diagram"),), (HEADINGS, *rows))
