# SPDX-License-Identifier: Apache-2.0
"""What a drive's report says of senders' claimed poses."""

import numpy as np

from manyeyes.agents.pose_correction import Use, Verdict
from manyeyes.pose.pose_monitor import Health, Report
from manyeyes.pose.types import unanswered
from manyeyes.viz import report
from manyeyes.viz.pose_summary import HEADINGS, Whereabouts


def verdict(agent: int, use: Use, health: Health, drift: float = 0.0) -> Verdict:
    said = Report(health, 1.0, np.array([drift, 0.0, 0.0]), 5.0, 9)
    return Verdict(agent, agent < 0, use, unanswered(None), 0.1, said)


def test_the_worst_that_lasted_is_told_with_its_first_frame() -> None:
    found = Whereabouts()
    found.add(6, [verdict(-1, Use.CORRECTED, Health.SOUND), verdict(7, Use.CLAIMED, Health.UNKNOWN)])
    found.add(7, [verdict(-1, Use.CORRECTED, Health.DRIFTING, 0.12), verdict(7, Use.CORRECTED, Health.DOUBTFUL)])
    found.add(8, [verdict(-1, Use.UNSURE, Health.DRIFTING, 0.1), verdict(7, Use.CORRECTED, Health.SOUND)])
    roadside, vehicle = found.lines()
    assert dict(zip(HEADINGS, roadside)) == {
        "agent": "-1 (roadside unit)", "claimed pose": "drifting", "first seen so at": "7", "corrected": "2",
        "as claimed": "0", "left out": "1", "drift m/s": "0.10",
    }  # fmt: skip
    assert vehicle == ("7", "sound", "", "2", "1", "0", "")
    assert found.warnings() == ("agent -1 (roadside unit): its claimed pose is drifting, first in frame 7",)


def test_who_was_never_aligned_is_not_told() -> None:
    found = Whereabouts()
    found.add(0, ())
    assert found.lines() == () and found.warnings() == ()


def test_the_report_shows_the_table() -> None:
    found = Whereabouts()
    found.add(3, [verdict(-1, Use.CORRECTED, Health.OFFSET)])
    chapter = report.Chapter("Who is where", "Text.", table=(HEADINGS, *found.lines()))
    page = report.render(report.Report("A drive", "Lead.", chapters=(chapter,)))
    assert "<th>claimed pose</th>" in page and "<td>offset</td>" in page and "-1 (roadside unit)" in page
