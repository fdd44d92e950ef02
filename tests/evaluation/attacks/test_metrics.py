# SPDX-License-Identifier: Apache-2.0
"""Metrics of attacks on records written by hand."""

import math

import pytest
import torch

from manyeyes.agents.trust.interface import Evidence
from manyeyes.evaluation.attacks.metrics import (
    EventRate,
    count_false_accusations,
    detection_rate,
    make_roc,
    measure_survival,
    times_to_detection,
)
from manyeyes.evaluation.attacks.records import ClaimRecord, DriveRecord, SenderRecord
from manyeyes.evaluation.attacks.removed_objects import count_removed
from manyeyes.evaluation.detection.frame_match import FrameMatch
from manyeyes.evaluation.statistics.proportion import Proportion


def sender(number: int, malicious: bool, named: list[int], trust: list[float] | None = None) -> SenderRecord:
    received = torch.ones(len(named), dtype=torch.bool)
    values = torch.tensor(trust or [1.0] * len(named), dtype=torch.float64)
    return SenderRecord(0, number, malicious, received, values, torch.tensor(named, dtype=torch.bool))


def claim(
    rays: list[int],
    score: list[float],
    near_real: bool = False,
    evidence: Evidence = Evidence.UNCHECKED,
    ego_rays: list[int] | None = None,
) -> ClaimRecord:
    n = len(rays)
    return ClaimRecord(
        0, 2, 0, near_real, torch.ones(n, dtype=torch.bool), torch.tensor(rays),
        torch.tensor(ego_rays or rays), torch.tensor(score).double(), torch.full((n,), int(evidence)),
        torch.full((n,), 0.9).double(),
    )  # fmt: skip


def drive(senders: tuple[SenderRecord, ...] = (), claims: tuple[ClaimRecord, ...] = ()) -> DriveRecord:
    return DriveRecord("a", (0,), ((), ()), senders, claims, 0.1, 0.0, 0.0)


def test_an_accusation_counts_once_until_it_ends() -> None:
    honest = sender(1, False, [0, 1, 1, 0, 1, 0])
    rate = count_false_accusations([drive((honest, sender(2, True, [1, 1, 1, 1, 1, 1])))])
    assert rate.events == 2 and rate.minutes == pytest.approx(6 * 0.1 / 60)


def test_no_event_in_300_minutes_excludes_one_percent() -> None:
    """Garwood: the one-sided 95 % upper bound of zero events is -ln 0.05 = 2.9957."""
    rate = EventRate.of(0, 300.0)
    assert rate.upper == pytest.approx(-math.log(0.05) / 300) and rate.low == 0


def test_clopper_pearson_of_the_rule_of_three() -> None:
    assert Proportion.of(0, 10).high == pytest.approx(1 - 0.025**0.1)
    assert Proportion.of(10, 10).low == pytest.approx(0.025**0.1)


def test_time_to_detection_counts_frames_from_one() -> None:
    drives = [drive((sender(2, True, [0, 0, 1, 1]), sender(3, True, [0, 0, 0, 0]), sender(1, False, [1, 0, 0, 0])))]
    times = times_to_detection(drives)
    assert times == (3, None)
    rates = [detection_rate(times, k) for k in (2, 3)]
    assert [(r.successes, r.total) for r in rates] == [(0, 2), (1, 2)]


def test_only_senders_with_a_checkable_claim_are_selected() -> None:
    with_claim = drive((sender(2, True, [0, 1, 1]),), (claim([12, 12, 12], [0.9, 0.9, 0.9]),))
    near_real = drive((sender(2, True, [0, 1, 1]),), (claim([12, 12, 12], [0.9, 0.9, 0.9], near_real=True),))
    assert times_to_detection([with_claim, near_real, drive((sender(2, True, [0, 1, 1]),))], checkable=True) == (2,)


def test_a_claim_that_only_others_see_through_is_not_checkable_by_the_ego() -> None:
    drives = [
        drive((sender(2, True, [0, 1, 1]),), (claim([12, 12, 12], [0.9] * 3, ego_rays=[12, 0, 0]),)),
        drive((sender(2, True, [0, 0, 1]),), (claim([12, 12, 12], [0.9] * 3),)),
    ]
    assert times_to_detection(drives, checkable=True) == (2, 3)
    assert times_to_detection(drives, checkable=True, by_ego=True) == (3,)


def test_survival_splits_checkable_from_blind_claims() -> None:
    drives = [
        drive(
            (),
            (claim([12, 12, 12], [0.6, 0.4, 0.5]), claim([0, 0, 0], [0.9, 0.9, 0.0], evidence=Evidence.CORROBORATED)),
        )
    ]
    seen, blind = (measure_survival(drives, checkable) for checkable in (True, False))
    assert (seen.surviving.successes, seen.surviving.total, seen.marked.successes) == (2, 3, 2)
    assert (blind.surviving.successes, blind.marked.successes, blind.per_frame) == (2, 0, pytest.approx(2 / 3))


def test_roc_of_separated_senders_has_area_one_and_of_equal_ones_a_half() -> None:
    apart = drive((sender(1, False, [0, 0], [0.9, 0.8]), sender(2, True, [0, 0], [0.1, 0.2])))
    equal = drive((sender(1, False, [0, 0], [0.5, 0.5]), sender(2, True, [0, 0], [0.5, 0.5])))
    for record, area in ((apart, 1.0), (equal, 0.5)):
        roc = make_roc([record])
        assert roc is not None and roc.area == pytest.approx(area)
    assert make_roc([drive((sender(1, False, [0]),))]) is None


def test_removed_objects_are_those_found_before_and_not_after() -> None:
    def match(rows: list[int], score: list[float]) -> FrameMatch:
        return FrameMatch("a", 0, torch.tensor(score).double(), torch.tensor(rows), 3)

    before, after = match([0, 1, -1], [0.9, 0.6, 0.5]), match([0, 1], [0.9, 0.4])
    assert count_removed([before], [after]) == (2, 1)
    assert count_removed([before], [before]) == (2, 0)
