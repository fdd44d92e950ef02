# SPDX-License-Identifier: Apache-2.0
"""Trust from evidence on each claimed object: the ego's detections and rays, third agents, and tracks of claims.

A sender is named malicious if its claim is refuted again and again, never supported and not disputed; then, or at low trust, it is
excluded for a term, is still assessed, and returns. Its refuted claims are removed from the first frame on. Claims that cannot be
checked change no trust.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.isolation import Quarantine
from manyeyes.agents.trust.association import Floats
from manyeyes.agents.trust.beta_trust import BetaTrust, TrustConfig, fusion_weight, update
from manyeyes.agents.trust.claim_evidence import CheckedClaims, ClaimCheckConfig, check_claims
from manyeyes.agents.trust.claim_offset import OffsetConfig, find_offset
from manyeyes.agents.trust.claim_tracks import ClaimChecks, count_refuted_checks, find_tracks, update_tracks
from manyeyes.agents.trust.copies import CopyConfig, add_contents, find_copies, is_known
from manyeyes.agents.trust.interface import (
    AssessedClaims,
    Assessment,
    Evidence,
    MisbehaviourDetector,
    MisbehaviourInput,
    SenderAssessment,
    SenderStatus,
)
from manyeyes.agents.trust.observers import ObserverConfig, PlacedBoxes, count_observers
from manyeyes.agents.trust.omissions import OmissionConfig, OwnObjects, find_unclaimed, is_in_sight, make_probes
from manyeyes.agents.trust.registry import register_misbehaviour_detector
from manyeyes.agents.trust.sender_state import (
    NEVER_NS,
    UNKNOWN_SENDER,
    SenderMemory,
    TrustState,
    advance,
    forget_oldest,
)
from manyeyes.agents.trust.unconfirmed import UnconfirmedConfig, has_excess
from manyeyes.datatypes import Boxes, Message

LOW_TRUST = "low trust"
NUM_MESSAGES = 5
"""Number of last messages of a sender that are counted as copies, or as contested."""
# Members of an enumeration are slow to read.
_SUPPORTED, _CORROBORATED = int(Evidence.SUPPORTED), int(Evidence.CORROBORATED)
_DISPUTED, _REFUTED = int(Evidence.DISPUTED), int(Evidence.REFUTED)
_UNCHECKED = int(Evidence.UNCHECKED)


@dataclass(frozen=True)
class _Findings:
    """What whole messages of one frame show. contradicted: senders whose stated pose is. copied: sources by their copiers."""

    contradicted: frozenset[int]
    copied: Mapping[int, int]

    @property
    def unused(self) -> frozenset[int]:
        """Senders whose content is not fused in this frame and corroborates nothing."""
        return self.contradicted | self.copied.keys()


@dataclass(frozen=True)
class NamingConfig:
    """When a sender is named malicious.

    min_score: of a claim that counts against its sender: honest detectors err for seconds with scores up to 0.75, and a refuted
    claim is removed whatever its score. min_refuted: of the last five checks of one claim. min_refuted_each: of
    the checks of each of two claims. many_claims: above so many claims of all senders in one frame, min_refuted is one more,
    since more chances of an error make more errors. min_contested: of refuted claims of one sender that trusted senders claim too,
    whose places are hence disputed. In min_refuted of its last messages they name it, if the senders of such claims are fewer than
    the other agents, the ego among these: two that support each other. sign_change_ns: a place where the evidence turns within it
    is disputed.
    """

    min_score: float = 0.8
    min_refuted: int = 3
    min_refuted_each: int = 2
    many_claims: int = 200
    min_contested: int = 2
    sign_change_ns: int = 1_000_000_000


@register_misbehaviour_detector("ray-evidence")
@dataclass(frozen=True)
class RayEvidenceDetector(MisbehaviourDetector):
    """Evidence, trust, omissions, common offsets, copies, unconfirmed claims, observers and naming, each with its constants."""

    evidence: ClaimCheckConfig = field(default_factory=ClaimCheckConfig)
    trust: TrustConfig = field(default_factory=TrustConfig)
    omissions: OmissionConfig = field(default_factory=OmissionConfig)
    naming: NamingConfig = field(default_factory=NamingConfig)
    offset: OffsetConfig = field(default_factory=OffsetConfig)
    copies: CopyConfig = field(default_factory=CopyConfig)
    unconfirmed: UnconfirmedConfig = field(default_factory=UnconfirmedConfig)
    observers: ObserverConfig = field(default_factory=ObserverConfig)

    def excluded(self, state: object | None, agent_ids: Collection[int], now_ns: int) -> frozenset[int]:
        """Return the senders whose term of exclusion has not ended."""
        if not isinstance(state, TrustState):
            return frozenset()
        return frozenset(agent_id for agent_id in agent_ids if state.exclusions.contains(agent_id, now_ns))

    def assess(self, received: MisbehaviourInput, state: object | None) -> Assessment:
        """Assess claims, update trust and exclusions; all before fusion of the same frame."""
        before = state if isinstance(state, TrustState) else TrustState.start(received.frame)
        detections = _Detections.of(received.own)
        own = detections.places(self.evidence.min_own_score)
        now, rotation, shift = advance(before, received.frame, detections.objects(self.omissions.min_score))
        unclaimed = [
            _memory(now, one.agent_id).omitted.follow(
                find_unclaimed(now.own, one, self.omissions), rotation, shift, 0.0
            )
            for one in received.claims
        ]
        now, found = self._compare_messages(received, own, now)
        checked, omits = self._check(received, own, now, unclaimed, found)
        checked = self._check_observers(received, detections, checked, now, found)
        contested = self._find_contested(checked, found)
        checks = [self._follow(one, now) for one in checked]
        now = replace(now, disputes=now.disputes.add(self._find_disputes(checked, checks, now), now.now_ns))
        if len(now.disputes.xy):
            checks = [_mark_disputed(check, now.disputes.cover(check.xy)) for check in checks]
        counted = [
            _drop_uncounted(check, one.is_uncounted) if one.is_uncounted.any() else check
            for one, check in zip(checked, checks)
        ]
        num_claims = sum(len(check.xy) for check in checks)
        claims = tuple(
            AssessedClaims(one.claims, check.evidence, one.is_detected) for one, check in zip(checked, checks)
        )
        senders, exclusions, assessments = dict(now.senders), now.exclusions, list[SenderAssessment]()
        for message, check, omitted, is_omitting, assessed in zip(received.messages, counted, unclaimed, omits, claims):
            agent_id = message.agent_id
            is_faulty = agent_id in received.faulty or agent_id in found.contradicted
            fault = self.trust.omitted * is_omitting
            is_unused = is_faulty or agent_id in found.copied
            memory = self._update_sender(now, message, check, fault, is_unused, omitted, agent_id in contested)
            memory = self._count_excess(memory, now, message, assessed)
            memory, exclusions = self._decide(agent_id, memory, exclusions, now, num_claims, is_faulty)
            senders[agent_id] = memory
            is_excluded = exclusions.contains(agent_id, now.now_ns)
            assessments.append(self._assess_sender(agent_id, memory, is_excluded, is_faulty, found))
        return Assessment(
            tuple(assessments), claims, replace(now, senders=forget_oldest(senders), exclusions=exclusions)
        )

    def record_orphans(self, state: object | None, agent_ids: Collection[int]) -> object | None:
        """Return the state in which the trust in these senders is lower by a fault."""
        if not isinstance(state, TrustState) or not agent_ids:
            return state
        senders = dict(state.senders)
        for agent_id in agent_ids:
            trust = update(state.trust_of(agent_id, self.trust), 0.0, self.trust.track_fault, self.trust)
            senders[agent_id] = replace(_memory(state, agent_id), trust=trust, updated_ns=state.now_ns)
        return replace(state, senders=senders)

    def _compare_messages(
        self, received: MisbehaviourInput, own: Floats, now: TrustState
    ) -> tuple[TrustState, _Findings]:
        """Return the state with what each message as a whole shows, and that: common offsets of its claims, and copied content."""
        times_ns = [message.timestamp_ns for message in received.messages]
        contents = {agent_id: memory.contents for agent_id, memory in now.senders.items() if memory.contents}
        copied = find_copies(received.claims, times_ns, contents, self.copies)
        senders, contradicted = dict(now.senders), set[int]()
        for one, time_ns in zip(received.claims, times_ns):
            memory = _memory(now, one.agent_id)
            is_wrong = find_offset(one.xy, own, one.sender_xy, self.offset).contradicts(self.offset)
            contradicted_ns = memory.contradicted_ns if is_wrong is None else now.now_ns if is_wrong else NEVER_NS
            if contradicted_ns >= now.now_ns - round(self.offset.memory_s * 1e9):
                contradicted.add(one.agent_id)
            copies, contents = memory.copies, add_contents(memory.contents, one, time_ns)
            if not is_known(memory.contents, time_ns):
                copies = (one.agent_id in copied, *copies)[:NUM_MESSAGES]
            trust = now.trust_of(one.agent_id, self.trust)
            senders[one.agent_id] = replace(
                memory,
                trust=trust,
                updated_ns=now.now_ns,
                copies=copies,
                contents=contents,
                contradicted_ns=contradicted_ns,
            )
        return replace(now, senders=senders), _Findings(frozenset(contradicted), copied)

    def _check(
        self,
        received: MisbehaviourInput,
        own: Floats,
        now: TrustState,
        unclaimed: Sequence[OwnObjects],
        found: _Findings,
    ) -> tuple[tuple[CheckedClaims, ...], list[bool]]:
        """Return the evidence on all claims, and whether each sender omits an object; excluded senders corroborate nothing."""
        excluded = self.excluded(now, received.agent_ids, now.now_ns) | found.unused
        trust = {a: now.trust_of(a, self.trust).mean for a in received.agent_ids if a not in excluded}
        probes = [make_probes(one, c.sender_xy, self.omissions) for one, c in zip(unclaimed, received.claims)]
        checked, rays = check_claims(
            received.frame, own, received.claims, trust, self.evidence, np.concatenate([np.zeros((0, 7)), *probes])
        )
        ends = np.cumsum([0, *map(len, probes)])
        return checked, [is_in_sight(rays[a:b], self.omissions) for a, b in pairwise(ends)]

    def _check_observers(
        self,
        received: MisbehaviourInput,
        detections: _Detections,
        checked: tuple[CheckedClaims, ...],
        now: TrustState,
        found: _Findings,
    ) -> tuple[CheckedClaims, ...]:
        """Refute claims that the ego cannot check where trusted senders state free space; the ego's own evidence stays."""
        if sum(message.sight is not None for message in received.messages) < self.observers.min_observers:
            return checked
        unused = self.excluded(now, received.agent_ids, now.now_ns) | found.unused | received.faulty
        trusted = {
            one.claims.agent_id
            for one in checked
            if one.claims.agent_id not in unused
            and now.trust_of(one.claims.agent_id, self.trust).mean >= self.evidence.min_corroborating_trust
            and not self._is_accused(one, now)
        }
        own = detections.boxes(self.observers.min_own_score)
        sources = self.evidence.sources
        counts = count_observers(
            received.frame, received.messages, received.claims, own, trusted, sources, self.observers
        )
        num_senders = len(set(received.agent_ids) - unused)
        return tuple(
            one.refute(count >= self.observers.min_observers, 2 * count <= num_senders)
            for one, count in zip(checked, counts)
        )

    def _find_contested(self, checked: Sequence[CheckedClaims], found: _Findings) -> Set[int]:
        """Return the senders of several refuted claims that trusted senders claim too, if these senders are a minority."""
        senders = {
            one.claims.agent_id
            for one in checked
            if np.count_nonzero(
                (one.kinds == _REFUTED)
                & one.corroborated
                & ~one.is_uncounted
                & (one.claims.score >= self.naming.min_score)
            )
            >= self.naming.min_contested
        }
        num_agents = 1 + sum(one.claims.agent_id not in found.unused for one in checked)
        return senders if 2 * len(senders) < num_agents else frozenset()

    def _is_accused(self, one: CheckedClaims, now: TrustState) -> bool:
        """Return whether a claim of a sender is refuted now, or was in one of its last checks."""
        is_refuted = (one.kinds == _REFUTED) & ~one.is_uncounted & (one.claims.score >= self.naming.min_score)
        tracks = _memory(now, one.claims.agent_id).tracks
        return bool(is_refuted.any() or count_refuted_checks(tracks, self.naming.min_score).any())

    def _decide(
        self,
        agent_id: int,
        memory: SenderMemory,
        exclusions: Quarantine,
        now: TrustState,
        num_claims: int,
        is_faulty: bool,
    ) -> tuple[SenderMemory, Quarantine]:
        """Begin or end the exclusion of a sender."""
        named = "" if is_faulty else self._find_reason(memory, num_claims)
        is_low = memory.trust.mean < self.trust.min_trust and not is_faulty
        if exclusions.contains(agent_id, now.now_ns):
            return memory, exclusions
        if named or (is_low and not memory.reason):
            is_copier = sum(memory.copies) >= self.copies.min_copies
            is_refuted = bool(count_refuted_checks(memory.tracks, self.naming.min_score).any() or any(memory.contested))
            memory = replace(memory, reason=named or LOW_TRUST, keeps_confirmed=is_refuted and not is_copier)
            return memory, exclusions.add(agent_id, now.now_ns)
        if memory.reason:
            memory = replace(memory, trust=BetaTrust(*self.trust.returned), reason="")
        return memory, exclusions

    def _follow(self, one: CheckedClaims, now: TrustState) -> ClaimChecks:
        """Associate claims with the tracks of their sender."""
        claims, tracks = one.claims, _memory(now, one.claims.agent_id).tracks
        track = find_tracks(tracks, claims.xy, claims.sigma_m)
        return ClaimChecks(claims.xy, claims.velocity, claims.score, one.kinds, track)

    def _find_disputes(
        self, checked: Sequence[CheckedClaims], checks: Sequence[ClaimChecks], now: TrustState
    ) -> Floats:
        """Return places (N, 2) where a trusted third agent contradicts the ego, or the ego's evidence turned."""
        places = [np.zeros((0, 2))]
        for one, check in zip(checked, checks):
            is_refuted, tracks = one.kinds == _REFUTED, _memory(now, one.claims.agent_id).tracks
            if not is_refuted.any() and not tracks.refuted_ns.any():
                continue
            # A weak claim changes no trust, so its place needs no dispute.
            is_likely = one.claims.score >= self.evidence.min_corroborating_score
            is_supported, disputed = one.kinds == _SUPPORTED, is_refuted & one.corroborated & is_likely
            if len(tracks):
                rows = check.track.clip(0)
                turned = is_refuted & self._is_recent(tracks.supported_ns[rows], now.now_ns)
                turned |= is_supported & self._is_recent(tracks.refuted_ns[rows], now.now_ns)
                disputed |= turned & (check.track >= 0)
            places.append(check.xy[disputed])
        return np.concatenate(places)

    def _is_recent(self, time_ns: NDArray[np.int64], now_ns: int) -> NDArray[np.bool_]:
        return (time_ns > 0) & (np.abs(now_ns - time_ns) <= self.naming.sign_change_ns)

    def _update_sender(
        self,
        now: TrustState,
        message: Message,
        checks: ClaimChecks,
        fault: float,
        is_faulty: bool,
        omitted: OwnObjects,
        is_contested: bool,
    ) -> SenderMemory:
        """Return the memory of a sender after its claims of this frame; a message that was assessed before adds nothing.

        fault: beside that of its claims.
        """
        trust, memory = now.trust_of(message.agent_id, self.trust), _memory(now, message.agent_id)
        if memory.captured_ns == message.timestamp_ns:
            return replace(memory, trust=trust, updated_ns=now.now_ns, omitted=omitted)
        kinds, score = checks.evidence, checks.score
        is_support = (kinds == _SUPPORTED) | (kinds == _CORROBORATED)
        is_fault = (kinds == _REFUTED) & (score >= self.naming.min_score)
        fault += self.trust.refuted * float(score[is_fault].sum())
        if not is_faulty:
            trust = update(trust, float(score[is_support].sum()), fault, self.trust)
        tracks = update_tracks(memory.tracks, checks, now.now_ns)
        captured_ns = message.timestamp_ns
        return replace(
            memory,
            trust=trust,
            updated_ns=now.now_ns,
            captured_ns=captured_ns,
            tracks=tracks,
            omitted=omitted,
            contested=(is_contested, *memory.contested)[:NUM_MESSAGES],
        )

    def _count_excess(
        self, memory: SenderMemory, now: TrustState, message: Message, claims: AssessedClaims
    ) -> SenderMemory:
        """Return the memory of a sender with whether its message has an excess of unconfirmed claims."""
        excess = memory.excess
        if _memory(now, message.agent_id).captured_ns == message.timestamp_ns:
            excess = excess[1:]
        is_excess = has_excess(claims, self.unconfirmed)
        return replace(memory, excess=(is_excess, *excess)[: self.unconfirmed.num_messages])

    def _find_reason(self, memory: SenderMemory, num_claims: int) -> str:
        """Return why a sender is named malicious, or nothing."""
        tracks = memory.tracks
        if sum(memory.copies) >= self.copies.min_copies:
            return f"{sum(memory.copies)} of its last messages were copies of others' content"
        if sum(memory.contested) >= self.naming.min_refuted:
            return f"several claims were refuted in {sum(memory.contested)} of its last messages, and few other senders claim them"
        refuted = count_refuted_checks(tracks, self.naming.min_score)
        needed = self.naming.min_refuted + (num_claims > self.naming.many_claims)
        max_refuted = int(refuted.max(initial=0))
        if max_refuted >= needed:
            return f"a claim was refuted in {max_refuted} of its last checks and never supported"
        num_claims_refuted = int((refuted >= self.naming.min_refuted_each).sum())
        return f"{num_claims_refuted} claims were refuted repeatedly" if num_claims_refuted >= 2 else ""

    def _assess_sender(
        self, agent_id: int, memory: SenderMemory, is_excluded: bool, is_faulty: bool, found: _Findings
    ) -> SenderAssessment:
        trust = memory.trust.mean
        if is_excluded:
            keeps_confirmed = memory.keeps_confirmed and not (
                is_faulty or agent_id in found.unused or any(memory.excess)
            )
            return SenderAssessment(agent_id, trust, 0.0, SenderStatus.MALICIOUS, memory.reason, keeps_confirmed)
        if agent_id in found.contradicted:
            reason = "its claims have a common offset to the ego's detections"
            return SenderAssessment(agent_id, trust, 0.0, SenderStatus.FAULTY, reason)
        if agent_id in found.copied:
            return SenderAssessment(
                agent_id, trust, 0.0, reason=f"its content is that of agent {found.copied[agent_id]}"
            )
        status = SenderStatus.FAULTY if is_faulty else SenderStatus.NORMAL
        reason = "its poses have an offset or a drift" if is_faulty else ""
        if any(memory.excess):
            return SenderAssessment(agent_id, trust, 0.0, status, reason or "too many of its claims are unconfirmed")
        return SenderAssessment(agent_id, trust, fusion_weight(trust, self.trust), status, reason)


def _memory(state: TrustState, agent_id: int) -> SenderMemory:
    return state.senders.get(agent_id, UNKNOWN_SENDER)


@dataclass(frozen=True)
class _Detections:
    """The ego's detections (K): columns (K, 7) centre, size and yaw; velocity (K, 2); score (K,)."""

    columns: Floats
    velocity: Floats
    score: Floats

    @classmethod
    def of(cls, own: Boxes) -> _Detections:
        columns = np.empty((len(own), 7))
        columns[:, :3], columns[:, 3:6], columns[:, 6] = own.center.numpy(), own.size.numpy(), own.yaw.numpy()
        return cls(columns, own.velocity.double().numpy(), own.score.double().numpy())

    def places(self, min_score: float) -> Floats:
        """Return the centres (M, 2) of those of a score."""
        return np.ascontiguousarray(self.columns[self.score >= min_score, :2])

    def boxes(self, min_score: float) -> PlacedBoxes:
        """Return those of a score, without errors of their own."""
        kept = self.score >= min_score
        return PlacedBoxes(self.columns[kept], self.velocity[kept], np.zeros(int(kept.sum())))

    def objects(self, min_score: float) -> OwnObjects:
        """Return those of a score as objects of one frame."""
        kept = self.score >= min_score
        columns = self.columns[kept]
        return OwnObjects(columns, self.velocity[kept], np.ones(len(columns), np.int64))


def _mark_disputed(checks: ClaimChecks, is_disputed: NDArray[np.bool_]) -> ClaimChecks:
    """Return checks whose claims at disputed places are disputed, on either side."""
    return replace(checks, evidence=np.where(is_disputed, np.uint8(_DISPUTED), checks.evidence))


def _drop_uncounted(checks: ClaimChecks, is_uncounted: NDArray[np.bool_]) -> ClaimChecks:
    """Return checks in which claims that count against no sender are unchecked, as trust and naming count them."""
    is_dropped = is_uncounted & (checks.evidence == _REFUTED)
    return replace(checks, evidence=np.where(is_dropped, np.uint8(_UNCHECKED), checks.evidence))
