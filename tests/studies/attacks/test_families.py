# SPDX-License-Identifier: Apache-2.0
"""Each attack changes what it states and nothing else, on messages drawn by hand (``cases``)."""

import math
from dataclasses import fields, replace

import pytest
import torch
from tests.studies.attacks.cases import (
    CARS,
    CHANNELS,
    EGO_POSE,
    KEY,
    make_input,
    make_message,
    same_objects,
    same_tokens,
)

from manyeyes.datatypes import ConfigError, Message
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat, proposed_velocity
from manyeyes.studies.attacks.catalog import ATTACKS, get_attack
from manyeyes.studies.attacks.families.alternation import OnOffAttack
from manyeyes.studies.attacks.families.displacement import ObjectShiftAttack, PoseShiftAttack
from manyeyes.studies.attacks.families.feature_noise import FeatureNoiseAttack
from manyeyes.studies.attacks.families.flooding import FloodAttack
from manyeyes.studies.attacks.families.framing import FramingAttack
from manyeyes.studies.attacks.families.ghost import GhostAttack
from manyeyes.studies.attacks.families.old_messages import CopyAttack, ReplayAttack
from manyeyes.studies.attacks.families.removal import RemovalAttack
from manyeyes.studies.attacks.interface import AttackKey
from manyeyes.studies.attacks.message_edit import list_objects, proposed_xy


def changed_fields(before: Message, after: Message) -> set[str]:
    """Names of the fields that are not the same object."""
    return {f.name for f in fields(Message) if getattr(before, f.name) is not getattr(after, f.name)}


def centres(message: Message) -> torch.Tensor:
    assert message.tokens is not None
    xy = list_objects(replace(message, objects=None), min_score=0.6).center[:, :2]
    return xy[xy[:, 0].argsort()]


def test_a_ghost_adds_one_box_and_its_tokens_at_its_place() -> None:
    given = make_input()
    output = GhostAttack(1, "seen").begin(KEY)(given)
    sent, ghost = output.message, output.claims.invented
    assert sent is not None and len(ghost) == 1 and len(output.claims.hidden) == 0
    assert changed_fields(given.message, sent) == {"tokens", "token_score", "objects", "descriptors"}
    assert sent.objects is not None and sent.tokens is not None and sent.token_score is not None
    here = ghost.transform(sent.world_from_agent.inverse()).center[0, :2].float()
    assert torch.equal(sent.objects.center[:2], given.message.objects.center)
    assert torch.allclose(sent.objects.center[2, :2], here, atol=1e-4)
    assert float(sent.objects.score[2]) == pytest.approx(0.9)
    own = (proposed_xy(sent.tokens) - here).norm(dim=1) < 0.01
    assert int(own.sum()) == 3 and float(sent.token_score[own].min()) > float(sent.token_score[~own].max())
    assert float(proposed_heat(sent.tokens.features[own, -PROPOSAL_DIM:]).max()) == pytest.approx(math.log(9), abs=1e-4)
    # What was there before is still there, bit for bit.
    before = given.message.tokens
    kept = torch.isin(sent.tokens.sites.key, before.sites.key)
    assert torch.equal(sent.tokens.features[kept], before.features)


def test_a_ghost_on_seen_road_is_crossed_by_the_victims_rays_and_stays() -> None:
    run = GhostAttack(2, "seen").begin(KEY)
    first, later = (run(make_input(instant)).claims.invented for instant in (0, 3))
    assert torch.equal(first.center, later.center) and first.id.tolist() == [0, 1]
    away = (first.center[:, :2] - EGO_POSE.translation[:2]).norm(dim=1)
    assert bool(((away >= 8) & (away <= 40)).all())


def test_no_ghost_is_put_in_a_blind_area_where_all_is_seen() -> None:
    given = make_input()
    output = GhostAttack(1, "blind").begin(KEY)(given)
    assert (
        len(output.claims.invented) == 0 and output.message is not None and same_tokens(output.message, given.message)
    )


def test_a_ghost_ahead_is_8_to_25_m_ahead_of_the_victim() -> None:
    ghost = GhostAttack(1, "ahead").begin(KEY)(make_input()).claims.invented
    x, y = ghost.transform(EGO_POSE.inverse()).center[0, :2].tolist()
    assert 8 <= x <= 25 and abs(y) <= 3


def test_flicker_sends_the_honest_message_every_second_time() -> None:
    run = GhostAttack(1, "seen", period=2).begin(KEY)
    inputs = [make_input(instant) for instant in range(4)]
    assert [run(given).message is given.message for given in inputs] == [False, True, False, True]


def test_growing_ghosts_are_sent_one_by_one() -> None:
    run = GhostAttack(3, "seen", growth=2).begin(KEY)
    assert [len(run(make_input(instant)).claims.invented) for instant in range(7)] == [1, 1, 2, 2, 3, 3, 3]


def test_agents_of_one_group_invent_the_same_objects_and_others_do_not() -> None:
    attack = GhostAttack(2, "seen")
    here, same, other = (
        attack.begin(key)(make_input()).claims.invented.center for key in (KEY, KEY, AttackKey(0, "drive", 2))
    )
    assert torch.equal(here, same) and not torch.equal(here, other)


def test_silence_removes_the_object_nearest_to_the_victim_alone() -> None:
    given = make_input()
    output = RemovalAttack("silent").begin(KEY)(given)
    sent = output.message
    assert sent is not None and sent.objects is not None and sent.tokens is not None and sent.descriptors is not None
    assert sent.objects.center[:, :2].tolist() == [list(CARS[1])] and len(sent.descriptors) == 1
    assert len(sent.tokens.sites) == 3 and torch.allclose(
        proposed_xy(sent.tokens), torch.tensor([CARS[1]] * 3), atol=1e-4
    )
    assert torch.allclose(output.claims.hidden.center[0, :2].float(), torch.tensor(CARS[0]))


def test_a_twin_is_displaced_and_of_low_score() -> None:
    sent = RemovalAttack("twin").begin(KEY)(make_input()).message
    assert sent is not None and sent.objects is not None
    place = torch.tensor([CARS[0][0] + 0.8, CARS[0][1]])
    assert torch.allclose(sent.objects.center[-1, :2], place) and float(sent.objects.score[-1]) == pytest.approx(0.1)


def test_removal_by_features_keeps_all_cells_and_denies_the_object() -> None:
    given = make_input()
    sent = RemovalAttack("features").begin(KEY)(given).message
    assert sent is not None and sent.tokens is not None and same_objects(sent, given.message)
    assert torch.equal(sent.tokens.sites.key, given.message.tokens.sites.key)
    heat = proposed_heat(sent.tokens.features[:, -PROPOSAL_DIM:])
    assert int((heat == -8).sum()) == 3 and float(heat.max()) == 2


def test_a_shifted_object_is_as_far_and_turned_as_stated() -> None:
    given = make_input()
    output = ObjectShiftAttack(2.0, 10.0).begin(KEY)(given)
    sent = output.message
    assert sent is not None and sent.objects is not None and len(sent.objects) == 2
    moved, real = output.claims.invented, output.claims.hidden
    assert float((moved.center - real.center).norm()) == pytest.approx(2.0)
    assert float(moved.yaw - real.yaw) == pytest.approx(math.radians(10))
    assert float((sent.objects.center[:, :2] - torch.tensor(CARS[1])).norm(dim=1).min()) == 0
    moved_to = moved.transform(sent.world_from_agent.inverse()).center[:, :2].float()
    assert float(torch.cdist(centres(sent), moved_to).min()) < 0.01


@pytest.mark.parametrize(("instant", "distance_m"), [(0, 0.0), (10, 0.1), (20, 0.2)])
def test_a_drift_grows_with_time(instant: int, distance_m: float) -> None:
    run = PoseShiftAttack(drift_mps=0.1).begin(KEY)
    run(make_input(0))
    given = make_input(instant)
    sent = run(given).message
    assert sent is not None and changed_fields(given.message, sent) == {"world_from_agent"}
    shift = sent.world_from_agent.translation - given.message.world_from_agent.translation
    assert float(shift.norm()) == pytest.approx(distance_m)


def test_a_shifted_pose_is_displaced_and_turned() -> None:
    given = make_input()
    sent = PoseShiftAttack(2.0, 5.0).begin(KEY)(given).message
    assert sent is not None
    relative = given.message.world_from_agent.inverse() @ sent.world_from_agent
    assert float(relative.translation.norm()) == pytest.approx(2.0)
    assert float(relative.yaw) == pytest.approx(math.radians(5))


def test_a_replay_has_the_old_content_and_the_new_stamp() -> None:
    run = ReplayAttack(0.3).begin(KEY)
    messages = [make_message(timestamp_ns=k * 100_000_000, x=float(k)) for k in range(6)]
    sent = [run(make_input(k, message)).message for k, message in enumerate(messages)]
    assert [m.world_from_agent.translation[0].item() for m in sent if m] == [0, 0, 0, 0, 1, 2]
    assert [m.timestamp_ns for m in sent if m] == [m.timestamp_ns for m in messages]


def test_a_copy_has_the_content_of_another_agent_under_the_own_identity() -> None:
    other = make_message(7, x=30.0)
    given = replace(make_input(5), received=(other, replace(make_message(8), tokens=None, objects=None)))
    sent = CopyAttack().begin(KEY)(given).message
    assert sent is not None and same_objects(sent, other) and sent.world_from_agent is other.world_from_agent
    assert (sent.agent_id, sent.timestamp_ns) == (1, given.message.timestamp_ns)
    assert CopyAttack().begin(KEY)(make_input()).message is not None


def test_noise_leaves_cells_and_proposals_as_they_are_and_is_of_its_size() -> None:
    given = make_input()
    sent = FeatureNoiseAttack(2.0).begin(KEY)(given).message
    assert sent is not None and sent.tokens is not None
    before, after = given.message.tokens.features, sent.tokens.features
    assert torch.equal(after[:, CHANNELS:], before[:, CHANNELS:])
    ratio = ((after - before)[:, :CHANNELS] / before[:, :CHANNELS].std(0, unbiased=False)).std()
    assert 1.4 < float(ratio) < 2.6
    assert sent.objects is not None and torch.equal(sent.objects.center, given.message.objects.center)


def test_scaled_features_are_multiples() -> None:
    given = make_input()
    sent = FeatureNoiseAttack(0.0, scale=4.0).begin(KEY)(given).message
    assert sent is not None and sent.tokens is not None
    assert torch.allclose(sent.tokens.features[:, :CHANNELS], 4 * given.message.tokens.features[:, :CHANNELS])


def test_saturated_features_are_at_the_bound() -> None:
    sent = FeatureNoiseAttack(saturate=True).begin(KEY)(make_input()).message
    assert (
        sent is not None
        and sent.tokens is not None
        and set(sent.tokens.features[:, :CHANNELS].abs().unique().tolist()) == {32.0}
    )


def test_a_flood_has_so_many_objects_each_in_a_new_place() -> None:
    run = FloodAttack(20).begin(KEY)
    first, second = (run(make_input(k)) for k in (0, 1))
    assert first.message is not None and first.message.objects is not None and len(first.message.objects) == 22
    assert not torch.equal(first.claims.invented.center, second.claims.invented.center)


def test_framing_sends_certain_objects_that_the_target_lacks_and_denies_its_own() -> None:
    given = make_input()
    target = replace(make_message(7), tokens=None, objects=given.message.objects[1:], descriptors=None)
    given = replace(given, received=(target,))
    output = FramingAttack().begin(KEY)(given)
    sent = output.message
    assert sent is not None and sent.objects is not None and sent.tokens is not None
    assert sent.objects.score.tolist() == pytest.approx([0.98, 0.05])
    assert torch.equal(sent.objects.center, given.message.objects.center) and len(output.claims.invented) == 0
    heat, xy = proposed_heat(sent.tokens.features[:, -PROPOSAL_DIM:]), proposed_xy(sent.tokens)
    assert set(heat[xy[:, 0] < 0].tolist()) == {-6.0} and float(heat[xy[:, 0] > 0].max()) == 4.0
    assert FramingAttack().begin(KEY)(make_input()).message is not None


def test_on_off_sends_the_honest_message_between() -> None:
    run = OnOffAttack(GhostAttack(1, "seen"), 2, 3).begin(KEY)
    inputs = [make_input(instant) for instant in range(7)]
    assert [run(given).message is given.message for given in inputs] == [False, False, True, True, True, False, False]


def test_velocities_of_copies_are_those_of_the_ghost() -> None:
    sent = GhostAttack(1, "seen").begin(KEY)(make_input()).message
    assert sent is not None and sent.tokens is not None
    assert float(proposed_velocity(sent.tokens.features[:, -PROPOSAL_DIM:]).abs().max()) == 0


@pytest.mark.parametrize("name", [name for name in ATTACKS if not name.startswith(("pgd", "bim"))])
def test_every_attack_keeps_the_header_and_never_raises(name: str) -> None:
    run = ATTACKS[name].attack.begin(KEY)
    for instant in range(3):
        given = replace(make_input(instant), received=(make_message(7, x=30.0),))
        sent = run(given).message
        assert sent is not None
        assert (sent.agent_id, sent.timestamp_ns) == (1, given.message.timestamp_ns)
        assert sent.is_infrastructure is False and sent.tokens is not None
        assert bool(torch.isfinite(sent.tokens.features).all())


def test_an_unknown_attack_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="known: ghost-1-seen"):
        get_attack("none-such")
