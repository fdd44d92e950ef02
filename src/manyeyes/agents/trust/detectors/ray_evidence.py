# SPDX-License-Identifier: Apache-2.0
"""Trust from evidence on each claimed object: the ego's detections and rays, third agents, and tracks of claims.

A sender is named malicious if its claim is refuted again and again, never supported and not disputed; then, or at low trust, it is
excluded for a term, watched, and returns. Its refuted claims are removed from the first frame on. Claims that nobody can check
change no trust.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.agents.trust.association import Floats
from manyeyes.agents.trust.beta_trust import BetaTrust, TrustConfig, fusion_weight, update
from manyeyes.agents.trust.claim_evidence import CheckedClaims, EvidenceConfig, check_claims
from manyeyes.agents.trust.claim_tracks import ClaimLooks, ClaimTracks, find_tracks, update_tracks
from manyeyes.agents.trust.interface import (
    AssessedClaims,
    Assessment,
    Evidence,
    MisbehaviourDetector,
    MisbehaviourInput,
    SenderAssessment,
    SenderStatus,
)
from manyeyes.agents.trust.omissions import OmissionConfig, OwnObjects, count_omitted, find_omitted
from manyeyes.agents.trust.registry import register_misbehaviour_detector
from manyeyes.agents.trust.sender_state import SenderMemory, TrustState, advance, forget_oldest

LOW_TRUST = "low trust"


@dataclass(frozen=True)
class NamingConfig:
    """When a sender is named malicious.

    min_score: of a claim that counts against its sender. min_refuted: of the last five looks at one claim. min_refuted_each: of the
    looks at each of two claims. many_claims: above so many claims of all senders in one frame, min_refuted is one more, so that
    more chances of an error do not make more errors. sign_change_ns: a place where the evidence turns within it is disputed.
    """

    min_score: float = 0.5
    min_refuted: int = 3
    min_refuted_each: int = 2
    many_claims: int = 200
    sign_change_ns: int = 1_000_000_000


@register_misbehaviour_detector("ray-evidence")
@dataclass(frozen=True)
class RayEvidenceDetector(MisbehaviourDetector):
    """Evidence, trust, omissions and naming, each with its constants."""

    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    trust: TrustConfig = field(default_factory=TrustConfig)
    omissions: OmissionConfig = field(default_factory=OmissionConfig)
    naming: NamingConfig = field(default_factory=NamingConfig)

    def excluded(self, state: object | None, agent_ids: Collection[int], now_ns: int) -> frozenset[int]:
        """Return the senders whose term of exclusion has not ended."""
        if not isinstance(state, TrustState):
            return frozenset()
        return frozenset(agent_id for agent_id in agent_ids if state.exclusions.contains(agent_id, now_ns))

    def assess(self, received: MisbehaviourInput, state: object | None) -> Assessment:
        """Assess claims, update trust and exclusions; all before fusion of the same frame."""
        before = state if isinstance(state, TrustState) else TrustState.start(received.frame)
        now, rotation, shift = advance(before, received.frame, received.own, self.omissions.min_score)
        checked = self._check(received, now)
        looks = {one.claims.agent_id: self._look(one, now) for one in checked}
        now = replace(now, disputes=now.disputes.add(self._find_disputes(checked, looks, now), now.now_ns))
        looks = {
            one.claims.agent_id: _mark_disputed(looks[one.claims.agent_id], now.disputes.cover(one.xy))
            for one in checked
        }
        num_claims = sum(len(one.xy) for one in checked)
        senders, assessments, exclusions = dict(now.senders), list[SenderAssessment](), now.exclusions
        for one, message in zip(checked, received.messages):
            agent_id, is_faulty = message.agent_id, message.agent_id in received.faulty
            found = find_omitted(received.frame, received.own, now.own, one.claims, self.omissions)
            memory = senders.get(agent_id)
            omitted = count_omitted(OwnObjects.empty() if memory is None else memory.omitted, found, rotation, shift)
            memory = self._update_sender(now, agent_id, message.timestamp_ns, looks[agent_id], omitted, is_faulty)
            named = "" if is_faulty else self._find_reason(memory.tracks, num_claims)
            is_low = memory.trust.mean < self.trust.min_trust and not is_faulty
            was_excluded = bool(memory.reason)
            is_excluded = exclusions.contains(agent_id, now.now_ns)
            if not is_excluded and (named or (is_low and not was_excluded)):
                exclusions, is_excluded = exclusions.add(agent_id, now.now_ns), True
                memory = replace(memory, reason=named or LOW_TRUST)
            elif was_excluded and not is_excluded:
                memory = replace(memory, trust=BetaTrust(*self.trust.returned), reason="")
            senders[agent_id] = memory
            assessments.append(self._assess_sender(agent_id, memory, is_excluded, is_faulty))
        state = replace(now, senders=forget_oldest(senders), exclusions=exclusions)
        claims = tuple(
            AssessedClaims(one.claims.agent_id, one.claims.boxes, torch.from_numpy(looks[one.claims.agent_id].evidence))
            for one in checked
        )
        return Assessment(tuple(assessments), claims, state)

    def _check(self, received: MisbehaviourInput, now: TrustState) -> tuple[CheckedClaims, ...]:
        """Return the evidence on all claims; excluded senders corroborate nothing."""
        excluded = self.excluded(now, received.agent_ids, now.now_ns)
        trust = {a: now.trust_of(a, self.trust).mean for a in received.agent_ids if a not in excluded}
        return check_claims(received.frame, received.own, received.claims, trust, self.evidence)

    def _look(self, one: CheckedClaims, now: TrustState) -> ClaimLooks:
        """Associate claims with the tracks of their sender."""
        memory = now.senders.get(one.claims.agent_id)
        tracks = ClaimTracks.empty() if memory is None else memory.tracks
        velocity = one.claims.boxes.velocity.double().numpy()
        return ClaimLooks(one.xy, velocity, one.score, one.kinds, find_tracks(tracks, one.xy, one.sigma_m))

    def _find_disputes(
        self, checked: tuple[CheckedClaims, ...], looks: Mapping[int, ClaimLooks], now: TrustState
    ) -> Floats:
        """Return places (N, 2) where a trusted third agent contradicts the ego, or the ego's evidence turned."""
        places = [np.zeros((0, 2))]
        for one in checked:
            is_refuted, is_supported = one.kinds == Evidence.REFUTED, one.kinds == Evidence.SUPPORTED
            disputed = is_refuted & one.corroborated
            memory, track = now.senders.get(one.claims.agent_id), looks[one.claims.agent_id].track
            if memory is not None and len(memory.tracks):
                rows, is_known = track.clip(0), track >= 0
                turned = is_refuted & self._is_recent(memory.tracks.supported_ns[rows], now.now_ns)
                turned |= is_supported & self._is_recent(memory.tracks.refuted_ns[rows], now.now_ns)
                disputed |= turned & is_known
            places.append(one.xy[disputed])
        return np.concatenate(places)

    def _is_recent(self, time_ns: NDArray[np.int64], now_ns: int) -> NDArray[np.bool_]:
        return (time_ns > 0) & (np.abs(now_ns - time_ns) <= self.naming.sign_change_ns)

    def _update_sender(
        self,
        now: TrustState,
        agent_id: int,
        captured_ns: int,
        looks: ClaimLooks,
        omitted: OwnObjects,
        is_faulty: bool,
    ) -> SenderMemory:
        """Return the memory of a sender after its claims of this frame; a message that was assessed before adds nothing."""
        trust, memory = now.trust_of(agent_id, self.trust), now.senders.get(agent_id)
        if memory is not None and memory.captured_ns == captured_ns:
            return replace(memory, trust=trust, updated_ns=now.now_ns)
        kinds, score = looks.evidence, looks.score
        is_support = (kinds == Evidence.SUPPORTED) | (kinds == Evidence.CORROBORATED)
        is_fault = (kinds == Evidence.REFUTED) & (score >= self.naming.min_score)
        fault = self.trust.refuted * float(score[is_fault].sum())
        fault += self.trust.omitted * int((omitted.num_frames >= self.omissions.min_missing).sum())
        support = float(score[is_support].sum())
        trust = update(trust, 0.0 if is_faulty else support, 0.0 if is_faulty else fault, self.trust)
        before = ClaimTracks.empty() if memory is None else memory.tracks
        tracks, reason = update_tracks(before, looks, now.now_ns), "" if memory is None else memory.reason
        return SenderMemory(trust, now.now_ns, captured_ns, tracks, omitted, reason)

    def _find_reason(self, tracks: ClaimTracks, num_claims: int) -> str:
        """Return why a sender is named malicious, or nothing."""
        refuted = tracks.count(Evidence.REFUTED)
        counts = (tracks.score >= self.naming.min_score) & (tracks.count(Evidence.SUPPORTED) == 0)
        counts &= tracks.count(Evidence.DISPUTED) == 0
        needed = self.naming.min_refuted + (num_claims > self.naming.many_claims)
        if bool((counts & (refuted >= needed)).any()):
            return f"a claim was refuted in {int(refuted[counts].max())} of its last looks and never supported"
        num_claims_refuted = int((counts & (refuted >= self.naming.min_refuted_each)).sum())
        return f"{num_claims_refuted} claims were refuted repeatedly" if num_claims_refuted >= 2 else ""

    def _assess_sender(
        self, agent_id: int, memory: SenderMemory, is_excluded: bool, is_faulty: bool
    ) -> SenderAssessment:
        trust = memory.trust.mean
        if is_excluded:
            return SenderAssessment(agent_id, trust, 0.0, SenderStatus.MALICIOUS, memory.reason)
        status = SenderStatus.FAULTY if is_faulty else SenderStatus.NORMAL
        reason = "its poses have an offset or a drift" if is_faulty else ""
        return SenderAssessment(agent_id, trust, fusion_weight(trust, self.trust), status, reason)


def _mark_disputed(looks: ClaimLooks, is_disputed: NDArray[np.bool_]) -> ClaimLooks:
    """Return looks whose claims at disputed places are disputed, on either side."""
    return replace(looks, evidence=np.where(is_disputed, np.uint8(Evidence.DISPUTED), looks.evidence))
