# SPDX-License-Identifier: Apache-2.0
"""Collects what agents say of the map, from any bus or replay, and keeps the map that follows.

Each message with a section of the map becomes an observation: who, when, from where with what covariance, in which view. It is
added to a map in memory at once (``maps.fusion.incremental``); the fold over all observations (``maps.fusion.fuse``) stays the
map of record. Source: the requirement that observations reach a map as bytes that were sent, like all else between agents.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.comms.inbox import Reception
from manyeyes.datatypes import Message
from manyeyes.datatypes.map_element import MapElements
from manyeyes.datatypes.message import SeenMap
from manyeyes.maps.elements.observation import Frame, Observation, ObservationError, is_simple_ring
from manyeyes.maps.elements.observation_limits import LIMITS
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.incremental import Assimilated, StreamConfig, StreamingMap

Floats = NDArray[np.float64]

LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.05, float(np.radians(0.05))
"""Nobody knows where it is better than this, whatever it claims: a format without covariance reads as zero."""
NEW_PASS_NS = 60_000_000_000
"""An agent that was silent for longer comes by anew."""
FIRST_FOLD = 8
"""Observations after which the map in memory is folded anew, and again whenever they have doubled."""


@dataclass(frozen=True)
class Refused:
    """A message whose map cannot be used, and why."""

    agent: str
    time_ns: int
    reason: str


class Cartographer:
    """The map service: hears messages, keeps observations and the map.

    frame: of the map, whose zero is the world's point origin_xy (m). trusted: pseudonyms of surveyed poles, whose one word
    counts; whoever says of itself that it is one, is not. start: a map to go on from.

    What is added one by one is never moved again, so that a map that grows from nothing doubles lines. Hence it is folded anew
    whenever its observations have doubled, which costs each of them a constant number of folds; not so a map to go on from, whose
    observations are not here.
    """

    def __init__(
        self,
        frame: Frame | None = None,
        origin_xy: tuple[float, float] = (0.0, 0.0),
        trusted: Collection[str] = (),
        config: StreamConfig | None = None,
        start: VectorMap | None = None,
    ) -> None:
        self.frame = start.frame if start is not None else frame or Frame()
        self._origin, self._trusted = np.array([*origin_xy, 0.0]), frozenset(trusted)
        self._config = config or StreamConfig()
        self._live = StreamingMap(VectorMap.empty(self.frame) if start is None else start, self._config)
        self._next_fold = None if start is not None else FIRST_FOLD
        self._taken: dict[tuple[str, int], Observation] = {}
        self._refused: dict[tuple[str, int], Refused] = {}
        self._partial: set[tuple[str, int]] = set()
        self._passes: dict[str, tuple[int, int]] = {}

    @property
    def observations(self) -> tuple[Observation, ...]:
        """All that was taken, in order."""
        return tuple(self._taken.values())

    @property
    def refused(self) -> tuple[Refused, ...]:
        """Messages whose map could not be used."""
        return tuple(self._refused.values())

    @property
    def incomplete(self) -> int:
        """Messages of which packets are missing: what they do not say must not count as not seen, so none was taken."""
        return len(self._partial)

    def listen(self, receptions: Iterable[Reception], drive: str = "") -> list[Assimilated]:
        """Take what is new of an inbox, as often as it is asked; see :meth:`hear`."""
        return [done for one in receptions if (done := self.hear(one, drive)) is not None]

    def hear(self, reception: Reception, drive: str = "") -> Assimilated | None:
        """Take one message; None where it has no map, was taken before, is not whole yet, or cannot be used.

        drive: names whom the sender's number means, where several drives number their agents alike.
        """
        message = reception.message
        agent = f"{drive}/{message.agent_id}" if drive else str(message.agent_id)
        key = agent, message.timestamp_ns
        if message.seen_map is None or key in self._taken or key in self._refused:
            return None
        if not reception.complete:
            self._partial.add(key)
            return None
        self._partial.discard(key)
        try:
            pass_id = f"{agent}-p{self._pass(*key)}"
            observation = observation_of(message, agent, pass_id, self._origin, agent in self._trusted)
        except ObservationError as error:
            self._refused[key] = Refused(*key, str(error))
            return None
        self._taken[key] = observation
        done = self._live.assimilate(observation)
        if len(self._taken) == self._next_fold:
            self._live, self._next_fold = StreamingMap(self.fold(), self._config), 2 * len(self._taken)
        return done

    def map(self) -> VectorMap:
        """The map as it stands: every observation added when it came."""
        return self._live.map()

    def fold(self) -> VectorMap:
        """The map of record: all observations at once, in no order; without what a map to go on from held."""
        return fuse(self.observations, self._config.fuse, self.frame)

    def _pass(self, agent: str, time_ns: int) -> int:
        """The number of the drive that this look belongs to."""
        last, number = self._passes.get(agent, (time_ns, 0))
        number += abs(time_ns - last) > NEW_PASS_NS
        self._passes[agent] = time_ns, number
        return number


def observation_of(
    message: Message, agent: str, pass_id: str, origin: Floats | None = None, trusted: bool = False
) -> Observation:
    """A message's map as an observation; ObservationError says what of it cannot be used.

    origin: (3,) x, y of the map's zero in the world (m), and 0. A claim's covariance is widened by the least that anybody errs.
    Crossings whose rings cross themselves are left out.
    """
    if message.seen_map is None:
        raise ObservationError("Observation.elements: expected a message with a map; got one without.")
    x, y, _ = message.world_from_agent.translation.tolist()
    pose = np.array([x, y, float(message.world_from_agent.yaw)])
    least = np.diag(np.square([LEAST_SIGMA_M, LEAST_SIGMA_M, LEAST_SIGMA_RAD]))
    seen = message.seen_map
    return Observation(
        agent=agent,
        pass_id=pass_id,
        time_ns=message.timestamp_ns,
        pose=pose if origin is None else pose - origin,
        covariance=message.pose_covariance.double().numpy() + least,
        view=seen.view,
        elements=_simple(seen),
        model="" if message.fingerprint == bytes(8) else message.fingerprint.hex(),
        trusted=trusted,
        occluders=seen.occluders,
    )


def _simple(seen: SeenMap) -> MapElements:
    """The elements without crossings whose rings cross themselves; rings of too many points stay, and are refused later."""
    elements = seen.elements
    rings = np.flatnonzero(elements.closed & (elements.counts <= LIMITS.max_ring_points)).tolist()
    crossed = [row for row in rings if not is_simple_ring(elements.polyline(row))]
    return elements.take(np.setdiff1d(np.arange(len(elements)), crossed)) if crossed else elements
