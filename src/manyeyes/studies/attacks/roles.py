# SPDX-License-Identifier: Apache-2.0
"""Roles in a scenario: the ego, and which of the agents around it are malicious; drawn by key, the same for all conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.datatypes import Snapshot, Transform
from manyeyes.ops.keyed_random import keyed_uniform

FIRST_PSEUDONYM = 1_000_000
"""Agent id of the first pseudonym; recordings use smaller ones."""
PSEUDONYMS_PER_AGENT = 64


@dataclass(frozen=True)
class Roles:
    """ego: agent id. malicious: ids of the agents that attack."""

    ego: int
    malicious: tuple[int, ...]

    def pseudonyms(self, agent_id: int, count: int) -> tuple[int, ...]:
        """Return count further identities of one malicious agent."""
        first = FIRST_PSEUDONYM + self.malicious.index(agent_id) * PSEUDONYMS_PER_AGENT
        return tuple(range(first, first + count))

    def identities(self, num_pseudonyms: int) -> frozenset[int]:
        """Return all identities of malicious agents."""
        extra = (name for agent in self.malicious for name in self.pseudonyms(agent, num_pseudonyms))
        return frozenset((*self.malicious, *extra))


def choose_roles(snapshot: Snapshot, ego_row: int, num_malicious: int, comm_range_m: float, seed: int) -> Roles | None:
    """Return the roles where frames[ego_row] is the ego; None where no majority of the agents around it is honest.

    snapshot: of the instant at which the attack begins. The malicious agents of a smaller number are among those of a larger one.
    """
    others = _find_neighbours(snapshot, ego_row, comm_range_m)
    if 2 * num_malicious >= len(others) + 1:
        return None
    ego = snapshot.frames[ego_row].agent_id
    draws = keyed_uniform((len(others),), seed, "malicious agents", snapshot.scenario, ego).tolist()
    order = [agent for _, agent in sorted(zip(draws, others))]
    return Roles(ego, tuple(order[:num_malicious]))


def _find_neighbours(snapshot: Snapshot, ego_row: int, comm_range_m: float) -> Sequence[int]:
    """Return the ids of the other agents within range of the ego, by true poses where there are any."""
    poses = (
        snapshot.truth.world_from_agent
        if snapshot.truth
        else Transform.stack([frame.world_from_agent for frame in snapshot.frames])
    )
    xy = poses.translation[:, :2]
    near = (xy - xy[ego_row]).norm(dim=1) <= comm_range_m
    return [f.agent_id for row, f in enumerate(snapshot.frames) if row != ego_row and bool(near[row])]
