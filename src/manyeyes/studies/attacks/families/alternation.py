# SPDX-License-Identifier: Apache-2.0
"""On and off: any attack that pauses, so that trust recovers before it goes on."""

from __future__ import annotations

from dataclasses import dataclass

from manyeyes.studies.attacks.interface import AlterMessage, Attack, AttackInput, AttackKey, AttackOutput, Knowledge


@dataclass(frozen=True)
class OnOffAttack:
    """Attack for num_on instants, then send the honest message for num_off, and so on."""

    attack: Attack
    num_on: int = 3
    num_off: int = 3

    @property
    def knowledge(self) -> Knowledge:
        """As the attack that alternates."""
        return self.attack.knowledge

    @property
    def num_pseudonyms(self) -> int:
        """As the attack that alternates."""
        return self.attack.num_pseudonyms

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        alter = self.attack.begin(key)

        def alternate(given: AttackInput) -> AttackOutput:
            output = alter(given)
            is_on = given.instant % (self.num_on + self.num_off) < self.num_on
            return output if is_on else AttackOutput(given.message)

        return alternate
