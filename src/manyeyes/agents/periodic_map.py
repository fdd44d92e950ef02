# SPDX-License-Identifier: Apache-2.0
"""Local maps at a period: roads do not change from frame to frame, and predicting them takes time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from manyeyes.agents.map_perception import MapPredictor
from manyeyes.datatypes import AgentFrame, ConfigError, Message
from manyeyes.datatypes.message import LocalMap


@dataclass
class PeriodicMapPredictor:
    """Another predictor, in the first frame of each period alone; periods count from 1970 by the times of frames."""

    predictor: MapPredictor
    period_ns: int = 1_000_000_000
    _last: int | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if self.period_ns <= 0:
            raise ConfigError(f"PeriodicMapPredictor.period_ns is above 0; got {self.period_ns}.")

    def __call__(self, frame: AgentFrame, received: Sequence[Message] = ()) -> LocalMap | None:
        """Return the local map where it is due, else None."""
        period = frame.timestamp_ns // self.period_ns
        if period == self._last:
            return None
        self._last = period
        return self.predictor(frame, received)
