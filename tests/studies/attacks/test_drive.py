# SPDX-License-Identifier: Apache-2.0
"""Laws of a drive under attack, on a small scene with weights that were never trained."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from tests.studies.attacks.scene import make_detector, make_snapshot

from manyeyes.agents.own_detections import SAME_OBJECT_DISTANCE_M
from manyeyes.agents.replay import DetectionReplay, ReplayConfig
from manyeyes.agents.trust.registry import get_misbehaviour_detector
from manyeyes.datatypes import Boxes, Sight
from manyeyes.datatypes.sight import NUM_SECTORS
from manyeyes.models.detector.detector import Detector
from manyeyes.studies.attacks.catalog import ATTACKS
from manyeyes.studies.attacks.drive import AttackedDrive, DriveSetting, DriveStep
from manyeyes.studies.attacks.families.ghost import GhostAttack
from manyeyes.studies.attacks.interface import AlterMessage, AttackInput, AttackKey, AttackOutput, AttackSettings
from manyeyes.studies.attacks.recording import DriveRecorder
from manyeyes.studies.attacks.roles import FIRST_PSEUDONYM, Roles, choose_roles

CONFIG = ReplayConfig(channel="its-g5-6", latency_budget_s=0.1, budget_bytes=4096)
METHODS = ("late", "intermediate-temporal")
ROLES = Roles(5, (6,))
NOTHING_FREE = Sight(np.zeros(NUM_SECTORS, np.uint8))


@pytest.fixture(scope="module")
def detector() -> Detector:
    return make_detector()


@pytest.fixture(scope="module")
def cache() -> dict:
    return {}


def play(detector: Detector, cache: dict, setting: DriveSetting, begin: int = 2, frames: int = 5) -> list[DriveStep]:
    drive = AttackedDrive("a", detector, setting, cache)
    return [drive.play(make_snapshot("a", index), index >= begin) for index in range(frames)]


def same_boxes(a: Boxes, b: Boxes) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in vars(a))


@pytest.mark.slow
@pytest.mark.parametrize("sends_sights", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_without_malicious_agents_a_drive_is_the_replay_bit_for_bit(detector, cache, method, sends_sights) -> None:
    config = replace(CONFIG, send_sight=sends_sights)
    replayed = DetectionReplay(method, detector, config)
    for index, played in enumerate(play(detector, cache, DriveSetting(method, config, Roles(5, ())))):
        (step,) = replayed.step(make_snapshot("a", index))
        assert same_boxes(step.boxes, played.step.boxes)
        assert [s.packet_sizes for s in step.sent] == [s.packet_sizes for s in played.step.sent]
        assert step.ages_s == played.step.ages_s and not played.claims


@pytest.mark.slow
def test_an_attack_changes_no_message_before_it_begins_and_no_honest_one_after(detector, cache, monkeypatch) -> None:
    sent: dict[str, list[dict[int, list[bytes]]]] = {"none": [], "ghost": []}
    for name, attack in (("none", None), ("ghost", GhostAttack(2, "ahead"))):
        drive = AttackedDrive("a", detector, DriveSetting("late", CONFIG, ROLES, attack), cache)
        send, log = drive._exchange.send, sent[name]

        def keep(frame, packets, positions, send=send, log=log) -> None:
            log[-1][frame.agent_id] = packets
            send(frame, packets, positions)

        monkeypatch.setattr(drive._exchange, "send", keep)
        for index in range(4):
            log.append({})
            drive.play(make_snapshot("a", index), index >= 2)
    for index, (honest, attacked) in enumerate(zip(sent["none"], sent["ghost"])):
        assert {k for k in honest if honest[k] != attacked[k]} == ({6} if index >= 2 else set())


@dataclass(frozen=True)
class SightAttack(AttackSettings):
    """State that nothing is free; sights: the honest ones."""

    sights: list[Sight | None] = field(default_factory=list)

    def begin(self, key: AttackKey) -> AlterMessage:
        return self.alter

    def alter(self, given: AttackInput) -> AttackOutput:
        self.sights.append(given.message.sight)
        return AttackOutput(replace(given.message, sight=NOTHING_FREE))


@pytest.mark.slow
def test_an_attack_is_given_the_honest_sight_and_its_own_is_sent(detector, cache) -> None:
    attack, config = SightAttack(), replace(CONFIG, send_sight=True)
    honest, attacked = (
        play(detector, cache, DriveSetting("late", config, ROLES, one), begin=2, frames=3)[-1].step.perception.received
        for one in (None, attack)
    )
    wanted, sent = ({r.message.agent_id: r.message.sight.steps for r in received} for received in (honest, attacked))
    (given,) = attack.sights
    assert given is not None and np.array_equal(given.steps, wanted[6]) and wanted[6].any()
    assert not sent[6].any() and all(np.array_equal(sent[k], wanted[k]) for k in (7, 8))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ghost-3-seen", "flood", "poison", "remove-twin", "sybil-8", "shift-pose-2m", "copy"])
@pytest.mark.parametrize("method", METHODS)
def test_own_detections_are_never_displaced(detector, cache, method, name) -> None:
    """Each own box of score 0.3 has a result within 1 m, but for the ego's own body."""
    attack = ATTACKS[name].attack
    drive = AttackedDrive("a", detector, DriveSetting(method, CONFIG, ROLES, attack), cache)
    for index in range(4):
        snapshot = make_snapshot("a", index)
        result = drive.play(snapshot, index >= 1).step.boxes
        own = cache[5, snapshot.frames[0].timestamp_ns].boxes
        own = own[(own.score >= 0.3) & (own.center[:, :2].abs().amax(1) > 3)]
        distance = torch.cdist(own.center[:, :2].double(), result.center[:, :2].double())
        assert bool((distance.amin(1) <= SAME_OBJECT_DISTANCE_M + 0.05).all())


@pytest.mark.slow
def test_the_oracle_is_the_run_without_the_messages_of_malicious_agents(detector, cache) -> None:
    dropped = play(detector, cache, DriveSetting("late", CONFIG, ROLES, GhostAttack(3), drops_malicious=True))
    assert [r.message.agent_id for r in dropped[-1].step.perception.received] == [7, 8]
    defended = replace(CONFIG, misbehaviour=get_misbehaviour_detector("none"))
    undefended = play(detector, cache, DriveSetting("late", defended, ROLES, GhostAttack(3)))
    assert [r.message.agent_id for r in undefended[-1].step.perception.received] == [6, 7, 8]


@pytest.mark.slow
def test_a_sybil_attack_sends_under_eight_more_names(detector, cache) -> None:
    attack = ATTACKS["sybil-8"].attack
    setting = DriveSetting("late", CONFIG, ROLES, attack)
    steps = play(detector, cache, setting, begin=3)
    names = [{s.agent_id for s in step.step.sent} for step in steps]
    assert names[2] == {5, 6, 7, 8} and names[3] == {5, 6, 7, 8, *range(FIRST_PSEUDONYM, FIRST_PSEUDONYM + 8)}
    assert set(steps[3].claims) == {6, *range(FIRST_PSEUDONYM, FIRST_PSEUDONYM + 8)}


@pytest.mark.slow
def test_a_record_has_a_row_per_sender_and_claim(detector, cache) -> None:
    setting = DriveSetting("late", CONFIG, ROLES, GhostAttack(2, "ahead", knowledge="black-box"))
    recorder = DriveRecorder(5, setting.roles.identities(0))
    for index, step in enumerate(play(detector, cache, setting)):
        if index >= 2:
            recorder.add(step)
    assert [(s.sender, s.is_malicious, s.is_received.tolist()) for s in recorder.senders()] == [
        (6, True, [True] * 3),
        (7, False, [True] * 3),
        (8, False, [True] * 3),
    ]
    claims = recorder.claims()
    assert {c.sender for c in claims} == {6} and all(bool(c.is_sent.all()) for c in claims)
    # Late fusion without a defence takes every confident box.
    assert all(bool((c.score >= 0.5).all()) for c in claims if not c.is_near_real)


def test_roles_keep_an_honest_majority_and_grow() -> None:
    snapshot = make_snapshot("a", 0)
    one = choose_roles(snapshot, 0, 1, 70.0, 0)
    assert one is not None and one.ego == 5 and len(one.malicious) == 1
    assert choose_roles(snapshot, 0, 2, 70.0, 0) is None
    assert choose_roles(snapshot, 0, 1, 20.0, 0) is None
    two = choose_roles(make_snapshot("a", 0, num_agents=5), 0, 2, 70.0, 0)
    assert two is not None and len(two.malicious) == 2
    first = choose_roles(make_snapshot("a", 0, num_agents=5), 0, 1, 70.0, 0)
    assert first is not None and two.malicious[:1] == first.malicious
