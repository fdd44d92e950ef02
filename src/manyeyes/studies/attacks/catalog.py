# SPDX-License-Identifier: Apache-2.0
"""All attacks by name, with their settings: one literal table.

Names of white-box attacks on features end in the goal; ``transfer`` knows the weights but not the victim's view.
"""

from __future__ import annotations

from dataclasses import dataclass

from manyeyes.datatypes import ConfigError
from manyeyes.studies.attacks.families.alternation import OnOffAttack
from manyeyes.studies.attacks.families.displacement import ObjectShiftAttack, PoseShiftAttack
from manyeyes.studies.attacks.families.false_sight import FalseSightAttack
from manyeyes.studies.attacks.families.feature_noise import FeatureNoiseAttack
from manyeyes.studies.attacks.families.flooding import FloodAttack
from manyeyes.studies.attacks.families.framing import FramingAttack
from manyeyes.studies.attacks.families.ghost import GhostAttack
from manyeyes.studies.attacks.families.gradient import GradientAttack
from manyeyes.studies.attacks.families.old_messages import CopyAttack, ReplayAttack
from manyeyes.studies.attacks.families.removal import RemovalAttack
from manyeyes.studies.attacks.interface import Attack


@dataclass(frozen=True)
class NamedAttack:
    """An attack of the table. num_malicious: agents that attack by default. colluding: they share one random key.

    needs_tokens, needs_sights: it changes nothing in messages without tokens, or without sights.
    """

    attack: Attack
    num_malicious: int = 1
    colluding: bool = False
    needs_tokens: bool = False
    needs_sights: bool = False


ATTACKS: dict[str, NamedAttack] = {
    "ghost-1-seen": NamedAttack(GhostAttack(1, "seen")),
    "ghost-3-seen": NamedAttack(GhostAttack(3, "seen")),
    "ghost-10-seen": NamedAttack(GhostAttack(10, "seen")),
    "ghost-1-blind": NamedAttack(GhostAttack(1, "blind")),
    "ghost-3-blind": NamedAttack(GhostAttack(3, "blind")),
    "ghost-1-ahead": NamedAttack(GhostAttack(1, "ahead", knowledge="black-box")),
    "ghost-3-black-box": NamedAttack(GhostAttack(3, "seen", knowledge="black-box")),
    "ghost-3-flicker": NamedAttack(GhostAttack(3, "seen", period=2)),
    "ghost-blind-growing": NamedAttack(GhostAttack(6, "blind", growth=2)),
    "ghost-3-on-off": NamedAttack(OnOffAttack(GhostAttack(3, "seen"), 3, 3)),
    "remove-silent": NamedAttack(RemovalAttack("silent")),
    "remove-twin": NamedAttack(RemovalAttack("twin")),
    "remove-features": NamedAttack(RemovalAttack("features", knowledge="grey-box")),
    "shift-object-1m": NamedAttack(ObjectShiftAttack(1.0)),
    "shift-object-3m": NamedAttack(ObjectShiftAttack(3.0, 10.0)),
    "shift-pose-0.5m": NamedAttack(PoseShiftAttack(0.5)),
    "shift-pose-2m": NamedAttack(PoseShiftAttack(2.0)),
    "shift-pose-5deg": NamedAttack(PoseShiftAttack(0.0, 5.0)),
    "drift-pose": NamedAttack(PoseShiftAttack(drift_mps=0.1)),
    "replay-0.3s": NamedAttack(ReplayAttack(0.3)),
    "replay-2s": NamedAttack(ReplayAttack(2.0)),
    "copy": NamedAttack(CopyAttack()),
    "noise-0.5": NamedAttack(FeatureNoiseAttack(0.5)),
    "noise-3": NamedAttack(FeatureNoiseAttack(3.0)),
    "random-features": NamedAttack(FeatureNoiseAttack(1.0, scale=0.0)),
    "scale-4": NamedAttack(FeatureNoiseAttack(0.0, scale=4.0)),
    "poison": NamedAttack(FeatureNoiseAttack(saturate=True)),
    "pgd-10-lower": NamedAttack(GradientAttack(10, 0.5, "lower"), needs_tokens=True),
    "pgd-10-raise": NamedAttack(GradientAttack(10, 0.5, "raise"), needs_tokens=True),
    "pgd-50-lower": NamedAttack(GradientAttack(50, 1.0, "lower"), needs_tokens=True),
    "pgd-50-raise": NamedAttack(GradientAttack(50, 1.0, "raise"), needs_tokens=True),
    "bim-10-lower": NamedAttack(GradientAttack(10, 0.25, "lower", random_start=False), needs_tokens=True),
    "pgd-10-transfer": NamedAttack(GradientAttack(10, 0.5, "lower", knowledge="grey-box"), needs_tokens=True),
    "collude-3": NamedAttack(GhostAttack(3, "seen"), 2, colluding=True),
    "collude-3-blind": NamedAttack(GhostAttack(3, "blind"), 2, colluding=True),
    "sybil-8": NamedAttack(GhostAttack(3, "seen", num_pseudonyms=8)),
    "frame": NamedAttack(FramingAttack()),
    "false-sight": NamedAttack(FalseSightAttack(), needs_sights=True),
    "flood": NamedAttack(FloodAttack()),
}


def get_attack(name: str) -> NamedAttack:
    """Return the attack of a name.

    Raises:
        ConfigError: none has the name.
    """
    if name not in ATTACKS:
        raise ConfigError(f"No attack is called {name!r}; known: {', '.join(ATTACKS)}.")
    return ATTACKS[name]
