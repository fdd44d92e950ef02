# SPDX-License-Identifier: Apache-2.0
"""What aligning egos said of each sender during a drive: how its claims were, what became of its messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from manyeyes.agents.pose_correction import Use, Verdict
from manyeyes.pose.pose_monitor import Health, Report

HEADINGS = ("agent", "claimed pose", "first seen so at", "corrected", "as claimed", "left out", "drift m/s")
WORST = (Health.DRIFTING, Health.OFFSET)


@dataclass
class _Sender:
    name: str
    uses: Counter[Use] = field(default_factory=Counter[Use])
    last: Report | None = None
    first: dict[Health, int] = field(default_factory=dict[Health, int])


@dataclass
class Whereabouts:
    """Verdicts of one method's egos, by sender."""

    senders: dict[int, _Sender] = field(default_factory=dict[int, _Sender])

    def add(self, index: int, verdicts: Iterable[Verdict]) -> None:
        """Those of one ego at one instant of the drive."""
        for verdict in verdicts:
            name = f"{verdict.agent_id}{' (roadside unit)' if verdict.is_infrastructure else ''}"
            sender = self.senders.setdefault(verdict.agent_id, _Sender(name))
            sender.uses[verdict.use] += 1
            sender.last = verdict.health
            sender.first.setdefault(verdict.health.health, index)

    def lines(self) -> tuple[tuple[str, ...], ...]:
        """A line for each sender under HEADINGS: the worst that was seen of it, and when first."""
        return tuple(_line(self.senders[agent]) for agent in sorted(self.senders))

    def warnings(self) -> tuple[str, ...]:
        """A sentence for each sender whose claims were found wrong."""
        out = []
        for agent in sorted(self.senders):
            sender = self.senders[agent]
            worst = _worst(sender)
            if worst in WORST:
                out.append(
                    f"agent {sender.name}: its claimed pose is {worst.value}, first in frame {sender.first[worst]}"
                )
        return tuple(out)


def _worst(sender: _Sender) -> Health:
    """What is worst and lasting: a doubtful frame now and then is honest."""
    for health in (*WORST, Health.SOUND, Health.DOUBTFUL):
        if health in sender.first:
            return health
    return Health.UNKNOWN


def _line(sender: _Sender) -> tuple[str, ...]:
    worst, report = _worst(sender), sender.last
    left_out = sender.uses[Use.UNSURE] + sender.uses[Use.CONTRADICTED]
    speed = float((report.drift[0] ** 2 + report.drift[1] ** 2) ** 0.5) if report else 0.0
    return (
        sender.name,
        worst.value,
        str(sender.first.get(worst, "")) if worst in WORST else "",
        str(sender.uses[Use.CORRECTED]),
        str(sender.uses[Use.CLAIMED]),
        str(left_out),
        f"{speed:.2f}" if worst is Health.DRIFTING else "",
    )
