# SPDX-License-Identifier: Apache-2.0
"""Rows of the study: an attack with a method and a defence, against the clean run, the oracle, and the ego alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from manyeyes.agents.strategies.names import form_of
from manyeyes.evaluation.attacks.metrics import (
    FIRST_FRAMES,
    EventRate,
    Survival,
    count_false_accusations,
    detection_rate,
    make_roc,
    measure_survival,
    times_to_detection,
)
from manyeyes.evaluation.attacks.records import DriveRecord
from manyeyes.evaluation.attacks.removed_objects import count_removed
from manyeyes.evaluation.detection.frame_match import FrameMatch
from manyeyes.evaluation.detection.protocols import DetectionProtocol
from manyeyes.evaluation.statistics.bootstrap import BootstrapSamples, Interval, bootstrap
from manyeyes.evaluation.statistics.proportion import Proportion
from manyeyes.evaluation.statistics.roc import RocCurve
from manyeyes.studies.attacks.catalog import get_attack
from manyeyes.studies.attacks.conditions import NO_ATTACK, NO_DEFENCE, ORACLE, AttackCondition

Key = tuple[AttackCondition, str]


@dataclass(frozen=True)
class AttackResults:
    """The records of all pairs of condition and method, one a scenario. protocol: of the one class that is judged."""

    records: dict[Key, tuple[DriveRecord, ...]]
    protocol: DetectionProtocol
    _samples: dict[object, BootstrapSamples] = field(default_factory=dict, repr=False, compare=False)

    def matches(self, key: Key, iou: int) -> list[FrameMatch]:
        """Return the evaluated frames of the class, in the order of scenarios."""
        frames = (match for record in self.records[key] for match in record.matches[iou])
        return [match for match in frames if match.class_name == self.protocol.class_name]

    def ap_pair(self, key: Key) -> tuple[Interval, Interval]:
        """Return AP at both IoU thresholds."""
        return self._sample(key, 0).interval(), self._sample(key, 1).interval()

    def difference_pair(self, key: Key, other: Key) -> tuple[Interval, Interval] | None:
        """Return the AP of one pair minus that of another, paired over scenarios; None where one was not played."""
        if not {key, other} <= self.records.keys():
            return None
        half, seven = (self._sample(key, iou).paired_difference(self._sample(other, iou)) for iou in (0, 1))
        return half, seven

    def num_scenarios(self, key: Key) -> int:
        """Number of scenarios with an ego that could be played."""
        return sum(bool(record.egos) for record in self.records[key])

    def _sample(self, key: Key, iou: int) -> BootstrapSamples:
        if (key, iou) not in self._samples:
            self._samples[key, iou] = bootstrap(self.matches(key, iou), protocol=self.protocol)
        return self._samples[key, iou]


@dataclass(frozen=True)
class AttackRow:
    """One attack, method and defence. Differences of AP are at both IoUs, paired over scenarios.

    vs_clean: from nothing attacked and no defence; vs_oracle: from the run without the malicious agents' messages; vs_alone: from
    no fusion. named: fraction of malicious senders named within each of FIRST_FRAMES; named_checkable: of those with a checkable
    claim; named_by_ego: of those with a claim that the ego itself can check. seen, blind: survival of checkable and of other false
    claims. removed: true objects that the clean run finds and this one does not, of those that it finds. times: frames to
    detection, None never. accusations: false ones.
    """

    attack: str
    knowledge: str
    num_malicious: int
    method: str
    defence: str
    num_scenarios: int
    ap: tuple[Interval, Interval]
    vs_clean: tuple[Interval, Interval] | None
    vs_oracle: tuple[Interval, Interval] | None
    vs_alone: tuple[Interval, Interval] | None
    named: tuple[Proportion, ...]
    named_checkable: tuple[Proportion, ...]
    named_by_ego: tuple[Proportion, ...]
    seen: Survival
    blind: Survival
    removed: Proportion
    accusations: EventRate
    times: tuple[int | None, ...]
    roc: RocCurve | None
    mean_bytes: float
    perceive_ms: float


def make_row(results: AttackResults, key: Key) -> AttackRow:
    """Reduce one pair of condition and method."""
    condition, method = key
    drives, size = results.records[key], condition.num_malicious
    clean, oracle = (AttackCondition(NO_ATTACK, size, defence) for defence in (NO_DEFENCE, ORACLE))
    alone = AttackCondition(num_malicious=size), f"no-fusion{form_of(method)}"
    times, checkable = times_to_detection(drives), times_to_detection(drives, checkable=True)
    by_ego = times_to_detection(drives, checkable=True, by_ego=True)
    is_clean, is_alone = key == (clean, method), method == alone[1]
    found = removed = 0
    if not is_alone:
        found, removed = count_removed(results.matches((clean, method), 0), results.matches(key, 0))
    return AttackRow(
        condition.attack,
        "" if condition.attack == NO_ATTACK else get_attack(condition.attack).attack.knowledge,
        size,
        method,
        condition.defence,
        results.num_scenarios(key),
        results.ap_pair(key),
        None if is_clean or is_alone else results.difference_pair(key, (clean, method)),
        None if is_alone else results.difference_pair(key, (oracle, method)),
        None if is_alone else results.difference_pair(key, alone),
        tuple(detection_rate(times, frames) for frames in FIRST_FRAMES),
        tuple(detection_rate(checkable, frames) for frames in FIRST_FRAMES),
        tuple(detection_rate(by_ego, frames) for frames in FIRST_FRAMES),
        measure_survival(drives, checkable=True),
        measure_survival(drives, checkable=False),
        Proportion.of(removed, found),
        count_false_accusations(drives),
        times,
        make_roc(drives),
        _mean([drive.mean_bytes for drive in drives if drive.egos]),
        _mean([drive.perceive_ms for drive in drives if drive.egos]),
    )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.0
