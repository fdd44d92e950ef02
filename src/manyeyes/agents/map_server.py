# SPDX-License-Identifier: Apache-2.0
"""Map server: collects local maps from messages and maintains the fused map.

Each message with a local map becomes an observation with agent, time, pose, covariance and view. It updates a map in memory
incrementally (``maps.fusion.incremental``); the batch fusion of all observations (``maps.fusion.fuse``) is the reference map.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.comms.inbox import ReceivedMessage
from manyeyes.datatypes import ManyeyesError, Message
from manyeyes.datatypes.map_element import MapElements
from manyeyes.datatypes.message import LocalMap
from manyeyes.maps.elements.observation import MapFrame, Observation, ObservationError, is_simple_ring
from manyeyes.maps.elements.observation_limits import LIMITS
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.incremental import IncrementalConfig, IncrementalMap, UpdateResult

Floats = NDArray[np.float64]

MIN_SIGMA_M, MIN_SIGMA_RAD = 0.05, float(np.radians(0.05))
"""Lower bounds of the standard deviations of a sender's pose; formats without covariance read as zero."""
NEW_PASS_NS = 60_000_000_000
"""A longer gap between messages of an agent starts a new pass."""
MAX_REMEMBERED = 1000
"""Number of rejected and of incomplete messages that are kept, the last ones: agent ids are not authenticated."""
FIRST_REBUILD_COUNT = 8
"""Number of observations at the first rebuild of the map in memory; it is rebuilt whenever their number has doubled."""


@dataclass(frozen=True)
class RejectedMessage:
    """A message whose map cannot be used, and why."""

    agent: str
    time_ns: int
    reason: str


class MapServer:
    """The map server: ingests messages and maintains observations and the map. Received content never raises.

    frame: of the map, whose origin is the world's point origin_xy (m). trusted: pseudonyms of surveyed roadside units, of which a
    single observation suffices; a flag in a message does not make its sender trusted. initial_map: a map to extend.

    Incremental updates never move elements again, so a map that grows from nothing has duplicate lines. It is therefore rebuilt
    whenever the number of observations has doubled, a constant number of rebuilds for each observation. An initial map is not
    rebuilt, because its observations are not available.
    """

    def __init__(
        self,
        frame: MapFrame | None = None,
        origin_xy: tuple[float, float] = (0.0, 0.0),
        trusted: Collection[str] = (),
        config: IncrementalConfig | None = None,
        initial_map: VectorMap | None = None,
    ) -> None:
        self.frame = initial_map.frame if initial_map is not None else frame or MapFrame()
        self._origin, self._trusted = np.array([*origin_xy, 0.0]), frozenset(trusted)
        self._config = config or IncrementalConfig()
        self._base_map = VectorMap.empty(self.frame) if initial_map is None else initial_map
        self._since_base: list[Observation] = []
        self._incremental_map = IncrementalMap(self._base_map, self._config)
        self._next_rebuild = None if initial_map is not None else FIRST_REBUILD_COUNT
        self._accepted: dict[tuple[str, int], Observation] = {}
        self._rejected: dict[tuple[str, int], RejectedMessage] = {}
        self._partial: dict[tuple[str, int], None] = {}
        self._passes: dict[str, tuple[int, int]] = {}

    @property
    def observations(self) -> tuple[Observation, ...]:
        """All accepted observations, in the order of ingestion."""
        return tuple(self._accepted.values())

    @property
    def rejected(self) -> tuple[RejectedMessage, ...]:
        """Messages whose map could not be used, the last MAX_REMEMBERED."""
        return tuple(self._rejected.values())

    @property
    def num_incomplete(self) -> int:
        """Number of messages with missing packets; they are not ingested, because absent elements would count as not observed."""
        return len(self._partial)

    def ingest(self, messages: Iterable[ReceivedMessage], drive: str = "") -> list[UpdateResult]:
        """Ingest the new messages of an inbox; see :meth:`ingest_message`."""
        return [result for one in messages if (result := self.ingest_message(one, drive)) is not None]

    def ingest_message(self, received: ReceivedMessage, drive: str = "") -> UpdateResult | None:
        """Ingest one message; None if it has no map, was ingested before, is incomplete, or is rejected.

        drive: prefix of the agent's name, where several drives use the same agent ids.
        """
        message = received.message
        agent = f"{drive}/{message.agent_id}" if drive else str(message.agent_id)
        key = agent, message.timestamp_ns
        if message.local_map is None or key in self._accepted or key in self._rejected:
            return None
        if not received.complete:
            self._partial[key] = None
            _drop_first(self._partial)
            return None
        self._partial.pop(key, None)
        number = self._find_pass_number(*key)
        try:
            observation = make_observation(message, agent, f"{agent}-p{number}", self._origin, agent in self._trusted)
            result = self._update(observation)
        except Exception as error:
            text = str(error) if isinstance(error, ObservationError) else f"{type(error).__name__}: {error}"
            self._rejected[key] = RejectedMessage(*key, text)
            _drop_first(self._rejected)
            return None
        self._accepted[key], self._passes[agent] = observation, (message.timestamp_ns, number)
        if len(self._accepted) == self._next_rebuild:
            self._rebuild_in_memory()
        return result

    def _update(self, observation: Observation) -> UpdateResult:
        """Add an observation to the map in memory; after an error the map is as before."""
        try:
            result = self._incremental_map.update(observation)
        except Exception:
            self._incremental_map = IncrementalMap(self._base_map, self._config)
            for earlier in self._since_base:
                self._incremental_map.update(earlier)
            raise
        self._since_base.append(observation)
        return result

    def _rebuild_in_memory(self) -> None:
        """Replace the map in memory by the batch fusion; if that fails, the incremental map is kept until the next one."""
        self._next_rebuild = 2 * len(self._accepted)
        try:
            rebuilt = self.rebuild()
        except (ManyeyesError, ArithmeticError, ValueError):
            return
        self._base_map, self._since_base = rebuilt, []
        self._incremental_map = IncrementalMap(rebuilt, self._config)

    def map(self) -> VectorMap:
        """Return the current map, updated with each observation in the order of arrival."""
        return self._incremental_map.build_map()

    def rebuild(self) -> VectorMap:
        """Batch fusion of all observations, independent of their order; an initial map is not included."""
        return fuse(self.observations, self._config.fusion, self.frame)

    def _find_pass_number(self, agent: str, time_ns: int) -> int:
        """Return the number of the pass that this observation belongs to."""
        last, number = self._passes.get(agent, (time_ns, 0))
        return number + (abs(time_ns - last) > NEW_PASS_NS)


def _drop_first(entries: dict[tuple[str, int], Any]) -> None:
    """Drop the first entry of more than MAX_REMEMBERED."""
    if len(entries) > MAX_REMEMBERED:
        del entries[next(iter(entries))]


def make_observation(
    message: Message, agent: str, pass_id: str, origin: Floats | None = None, trusted: bool = False
) -> Observation:
    """Return the local map of a message as an observation; invalid content raises ObservationError.

    origin: (3,) x, y of the map's origin in the world (m), and 0. The covariance of the pose is inflated by MIN_SIGMA_M and
    MIN_SIGMA_RAD. Crossings whose rings intersect themselves are dropped.
    """
    if message.local_map is None:
        raise ObservationError("Observation.elements: expected a message with a map; got one without.")
    x, y, _ = message.world_from_agent.translation.tolist()
    pose = np.array([x, y, float(message.world_from_agent.yaw)])
    min_covariance = np.diag(np.square([MIN_SIGMA_M, MIN_SIGMA_M, MIN_SIGMA_RAD]))
    local_map = message.local_map
    return Observation(
        agent=agent,
        pass_id=pass_id,
        time_ns=message.timestamp_ns,
        pose=pose if origin is None else pose - origin,
        covariance=message.pose_covariance.double().numpy() + min_covariance,
        view=local_map.view,
        elements=_drop_self_intersecting(local_map),
        model="" if message.fingerprint == bytes(8) else message.fingerprint.hex(),
        trusted=trusted,
        occluders=local_map.occluders,
    )


def _drop_self_intersecting(local_map: LocalMap) -> MapElements:
    """Return the elements without self-intersecting crossings; rings with too many points stay, and are rejected later."""
    elements = local_map.elements
    rings = np.flatnonzero(elements.closed & (elements.counts <= LIMITS.max_ring_points)).tolist()
    crossed = [row for row in rings if not is_simple_ring(elements.polyline(row))]
    return elements.take(np.setdiff1d(np.arange(len(elements)), crossed)) if crossed else elements
