# SPDX-License-Identifier: Apache-2.0
"""Summary of pose correction by sender over a drive: health of its prior poses and use of its messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from manyeyes.agents.pose_correction import CorrectionOutcome, MessageUse
from manyeyes.pose.pose_monitor import PoseHealth, PoseReport

HEADINGS = ("agent", "prior pose", "first frame", "corrected", "at prior pose", "excluded", "drift [m/s]")
FAULTS = (PoseHealth.DRIFTING, PoseHealth.OFFSET)


@dataclass
class _SenderSummary:
    name: str
    use_counts: Counter[MessageUse] = field(default_factory=Counter[MessageUse])
    last_report: PoseReport | None = None
    first_frame: dict[PoseHealth, int] = field(default_factory=dict[PoseHealth, int])


@dataclass
class PoseCorrectionSummary:
    """Verdicts of one method's egos, by sender."""

    senders: dict[int, _SenderSummary] = field(default_factory=dict[int, _SenderSummary])

    def add(self, index: int, corrections: Iterable[CorrectionOutcome]) -> None:
        """Those of one ego at one instant of the drive."""
        for correction in corrections:
            name = f"{correction.agent_id}{' (roadside unit)' if correction.is_infrastructure else ''}"
            sender = self.senders.setdefault(correction.agent_id, _SenderSummary(name))
            sender.use_counts[correction.use] += 1
            sender.last_report = correction.health
            sender.first_frame.setdefault(correction.health.health, index)

    def make_rows(self) -> tuple[tuple[str, ...], ...]:
        """Return a row under HEADINGS for each sender: its worst state, and the first frame of it."""
        return tuple(_make_row(self.senders[agent]) for agent in sorted(self.senders))

    def make_warnings(self) -> tuple[str, ...]:
        """Return a sentence for each sender whose prior poses are inconsistent."""
        out = []
        for agent in sorted(self.senders):
            sender = self.senders[agent]
            worst = _worst_health(sender)
            if worst in FAULTS:
                out.append(
                    f"agent {sender.name}: its prior pose is {worst.value}, first in frame {sender.first_frame[worst]}"
                )
        return tuple(out)


def _worst_health(sender: _SenderSummary) -> PoseHealth:
    """Return the worst lasting state; single suspect frames occur for correct priors, too."""
    for health in (*FAULTS, PoseHealth.SOUND, PoseHealth.SUSPECT):
        if health in sender.first_frame:
            return health
    return PoseHealth.UNKNOWN


def _make_row(sender: _SenderSummary) -> tuple[str, ...]:
    worst, report = _worst_health(sender), sender.last_report
    left_out = sender.use_counts[MessageUse.UNCERTAIN] + sender.use_counts[MessageUse.INCONSISTENT]
    speed = float((report.drift_per_s[0] ** 2 + report.drift_per_s[1] ** 2) ** 0.5) if report else 0.0
    return (
        sender.name,
        worst.value,
        str(sender.first_frame.get(worst, "")) if worst in FAULTS else "",
        str(sender.use_counts[MessageUse.CORRECTED]),
        str(sender.use_counts[MessageUse.PRIOR]),
        str(left_out),
        f"{speed:.2f}" if worst is PoseHealth.DRIFTING else "",
    )
