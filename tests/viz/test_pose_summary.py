# SPDX-License-Identifier: Apache-2.0
"""The pose summary in a drive's report."""

import numpy as np

from manyeyes.agents.pose_correction import CorrectionOutcome, MessageUse
from manyeyes.pose.pose_monitor import PoseHealth, PoseReport
from manyeyes.pose.types import no_estimate
from manyeyes.viz import report
from manyeyes.viz.pose_summary import HEADINGS, PoseCorrectionSummary


def make_outcome(agent: int, use: MessageUse, health: PoseHealth, drift: float = 0.0) -> CorrectionOutcome:
    pose_report = PoseReport(health, 1.0, np.array([drift, 0.0, 0.0]), 5.0, 9)
    return CorrectionOutcome(agent, agent < 0, use, no_estimate(None), 0.1, pose_report)


def test_the_worst_lasting_health_is_reported_with_its_first_frame() -> None:
    summary = PoseCorrectionSummary()
    summary.add(
        6,
        [
            make_outcome(-1, MessageUse.CORRECTED, PoseHealth.SOUND),
            make_outcome(7, MessageUse.PRIOR, PoseHealth.UNKNOWN),
        ],
    )
    summary.add(
        7,
        [
            make_outcome(-1, MessageUse.CORRECTED, PoseHealth.DRIFTING, 0.12),
            make_outcome(7, MessageUse.CORRECTED, PoseHealth.SUSPECT),
        ],
    )
    summary.add(
        8,
        [
            make_outcome(-1, MessageUse.UNCERTAIN, PoseHealth.DRIFTING, 0.1),
            make_outcome(7, MessageUse.CORRECTED, PoseHealth.SOUND),
        ],
    )
    roadside, vehicle = summary.make_rows()
    assert dict(zip(HEADINGS, roadside)) == {
        "agent": "-1 (roadside unit)", "prior pose": "drifting", "first frame": "7", "corrected": "2",
        "at prior pose": "0", "excluded": "1", "drift [m/s]": "0.10",
    }  # fmt: skip
    assert vehicle == ("7", "sound", "", "2", "1", "0", "")
    assert summary.make_warnings() == ("agent -1 (roadside unit): its prior pose is drifting, first in frame 7",)


def test_an_agent_never_corrected_is_not_reported() -> None:
    summary = PoseCorrectionSummary()
    summary.add(0, ())
    assert summary.make_rows() == () and summary.make_warnings() == ()


def test_the_report_shows_the_table() -> None:
    summary = PoseCorrectionSummary()
    summary.add(3, [make_outcome(-1, MessageUse.CORRECTED, PoseHealth.OFFSET)])
    chapter = report.Chapter("Who is where", "Text.", table=(HEADINGS, *summary.make_rows()))
    page = report.render(report.HtmlReport("A drive", "Lead.", chapters=(chapter,)))
    assert "<th>prior pose<small>" in page and "<td>offset</td>" in page and "-1 (roadside unit)" in page
