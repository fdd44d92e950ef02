# SPDX-License-Identifier: Apache-2.0
"""Metrics of attacks and defences, from records of drives.

Definitions:

- *sender-minute*: a minute of frames in which one ego received messages of one honest sender.
- *false accusation*: an honest sender becomes named; it counts once until it is no longer named. The rate is per honest
  sender-minute, with the exact Poisson bounds of Garwood (Biometrika 1936).
- *detection rate within k frames*: fraction of malicious senders that are named in one of the first k frames of the attack, with
  the interval of Clopper and Pearson (Biometrika 1934).
- *time to detection*: number of the frame, from 1, in which a malicious sender is named first; none if it never is.
- *ROC*: senders in frames, ranked by 1 - trust; malicious ones are positive.
- *survival*: fraction of sent false claims on which a box of at least MIN_SCORE rests, by whether the claim is checkable
  (``evaluation.attacks.sight``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from manyeyes.agents.trust.interface import Evidence
from manyeyes.evaluation.attacks.records import ClaimRecord, DriveRecord, SenderRecord
from manyeyes.evaluation.attacks.sight import is_checkable
from manyeyes.evaluation.statistics.proportion import CONFIDENCE_LEVEL, Proportion
from manyeyes.evaluation.statistics.roc import RocCurve, compute_roc

MIN_SCORE, MIN_TRUST = 0.5, 0.8
MARKED = (int(Evidence.UNCHECKED), int(Evidence.DISPUTED))
"""Evidence that marks a box as one that nothing confirms."""
FIRST_FRAMES = (5, 10)


@dataclass(frozen=True)
class EventRate:
    """Events per minute in so many minutes, with Poisson bounds: low and high two-sided, upper one-sided."""

    events: int
    minutes: float
    low: float
    high: float
    upper: float

    @classmethod
    def of(cls, events: int, minutes: float) -> EventRate:
        """Return the rate; bounds are infinite without time."""
        if minutes <= 0:
            return cls(events, minutes, 0.0, float("inf"), float("inf"))
        tail = (1 - CONFIDENCE_LEVEL) / 2
        low = float(chi2.ppf(tail, 2 * events)) / 2 if events else 0.0
        high, upper = (float(chi2.ppf(1 - p, 2 * events + 2)) / 2 for p in (tail, 1 - CONFIDENCE_LEVEL))
        return cls(events, minutes, low / minutes, high / minutes, upper / minutes)

    @property
    def value(self) -> float:
        """Events per minute; NaN without time."""
        return self.events / self.minutes if self.minutes > 0 else float("nan")


def count_false_accusations(drives: Sequence[DriveRecord]) -> EventRate:
    """Return the rate of false accusations per honest sender-minute."""
    events, minutes = 0, 0.0
    for drive in drives:
        for sender in drive.senders:
            if not sender.is_malicious:
                named = sender.is_named.numpy().astype(np.int64)
                events += int((np.diff(named, prepend=0) > 0).sum())
                minutes += float(sender.is_received.sum()) * drive.frame_s / 60
    return EventRate.of(events, minutes)


def first_named(sender: SenderRecord) -> int | None:
    """Return the number of the frame, from 1, in which a sender is named first; None if it is not."""
    named = sender.is_named.nonzero()
    return int(named[0]) + 1 if len(named) else None


def times_to_detection(
    drives: Sequence[DriveRecord], checkable: bool = False, by_ego: bool = False
) -> tuple[int | None, ...]:
    """Return the time to detection of each malicious sender that was received.

    checkable: of those with a checkable claim; by_ego: that the ego itself can check.
    """
    return tuple(
        first_named(sender)
        for drive in drives
        for sender in drive.senders
        if sender.is_malicious and bool(sender.is_received.any())
        if not checkable or has_checkable_claim(drive, sender, by_ego)
    )


def detection_rate(times: Sequence[int | None], num_frames: int) -> Proportion:
    """Return the fraction of senders that are named within the first frames."""
    return Proportion.of(sum(at is not None and at <= num_frames for at in times), len(times))


def has_checkable_claim(drive: DriveRecord, sender: SenderRecord, by_ego: bool = False) -> bool:
    """Return whether one of a sender's false claims can be checked by an honest agent; by_ego: by the ego itself."""
    return any(
        is_claim_checkable(claim, by_ego)
        for claim in drive.claims
        if (claim.ego, claim.sender) == (sender.ego, sender.sender)
    )


def is_claim_checkable(claim: ClaimRecord, by_ego: bool = False) -> bool:
    """Return whether enough rays, of any honest agent or of the ego, cross a claim while it is sent, and nothing real is near."""
    rays = np.where(claim.is_sent.numpy(), (claim.num_ego_rays if by_ego else claim.num_rays).numpy(), 0)
    return not claim.is_near_real and is_checkable(rays)


@dataclass(frozen=True)
class Survival:
    """False claims on which a box of MIN_SCORE rests, of those sent, frame by frame; num_frames: evaluated with a false claim.

    marked: of the surviving ones, with evidence of MARKED; trusted: of the surviving ones, of senders of at least MIN_TRUST.
    """

    surviving: Proportion
    marked: Proportion
    trusted: Proportion
    num_frames: int

    @property
    def per_frame(self) -> float:
        """Surviving false claims in a frame; NaN without frames."""
        return self.surviving.successes / self.num_frames if self.num_frames else float("nan")


def measure_survival(drives: Sequence[DriveRecord], checkable: bool) -> Survival:
    """Return the survival of the checkable or of the other false claims; those near real objects are left out."""
    sent = surviving = marked = trusted = frames = 0
    for drive in drives:
        claims = [c for c in drive.claims if not c.is_near_real and is_claim_checkable(c) == checkable]
        for claim in claims:
            is_sent = claim.is_sent.numpy()
            survives = is_sent & (claim.score.numpy() >= MIN_SCORE)
            sent, surviving = sent + int(is_sent.sum()), surviving + int(survives.sum())
            marked += int((survives & np.isin(claim.evidence.numpy(), MARKED)).sum())
            trusted += int((survives & (claim.trust.numpy() >= MIN_TRUST)).sum())
        if claims:
            frames += int(np.any([claim.is_sent.numpy() for claim in claims], axis=0).sum())
    return Survival(
        Proportion.of(surviving, sent), Proportion.of(marked, surviving), Proportion.of(trusted, surviving), frames
    )


def make_roc(drives: Sequence[DriveRecord]) -> RocCurve | None:
    """Return the ROC of 1 - trust over senders in frames; None where one class is empty."""
    suspicion, positive = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for drive in drives:
        for sender in drive.senders:
            received = sender.is_received.numpy()
            suspicion.append(1 - sender.trust.numpy()[received])
            positive.append(np.full(int(received.sum()), sender.is_malicious))
    return compute_roc(np.concatenate(suspicion), np.concatenate(positive))
