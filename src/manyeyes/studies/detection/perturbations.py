# SPDX-License-Identifier: Apache-2.0
"""Disturbances that studies play methods under. Levels are those of CoSTr, Table II and Fig. 4; loss and the hard one are ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.studies.running import with_replay

LATEST = 4
"""Frames between the capture of a message and its use at the greatest delay, 0.4 s at 10 Hz."""


@dataclass(frozen=True)
class Disturbance:
    """delay_s: how much later every packet comes, while the ego waits for none. heading_deg, position_m: standard deviations
    of collaborators' claimed poses, anew in each frame. loss: share of packets lost.
    """

    delay_s: float = 0.0
    heading_deg: float = 0.0
    position_m: float = 0.0
    loss: float = 0.0

    @property
    def name(self) -> str:
        """How tables call it."""
        parts = (
            (self.delay_s, f"{self.delay_s:g} s"),
            (self.heading_deg, f"{self.heading_deg:g}°"),
            (self.position_m, f"{self.position_m:g} m"),
            (self.loss, f"{100 * self.loss:g} % lost"),
        )
        return ", ".join(text for level, text in parts if level) or "perfect"

    def on(self, config: BenchmarkConfig) -> BenchmarkConfig:
        """The configuration under it.

        Under any, as many more frames are played before the first judged one as the latest message is late: conditions of one
        history share what their agents see.
        """
        radio, played = config.replay.radio, config.replay
        channel = replace(radio, base_latency_s=radio.base_latency_s + self.delay_s)
        noise = PoseNoise("collaborators_iid", self.position_m, math.radians(self.heading_deg), played.seed)
        disturbed = with_replay(
            config, channel=channel.with_loss(self.loss) if self.loss else channel, history=played.history + LATEST
        )
        return replace(disturbed, noise=noise if self.position_m or self.heading_deg else config.noise)


PERFECT = Disturbance()


def chosen(names: Sequence[str], among: Sequence[Disturbance]) -> tuple[Disturbance, ...]:
    """The perfect setting and those of a study's disturbances that have these names; all of them for none."""
    unknown = sorted(set(names) - {d.name for d in among})
    if unknown:
        raise ConfigError(f"No disturbance {unknown[0]!r}; choose from {', '.join(d.name for d in among)}.")
    return tuple(d for d in among if not names or d == PERFECT or d.name in names)


DELAYS = tuple(Disturbance(delay_s=d) for d in (0.1, 0.2, 0.3, 0.4))
HEADINGS = tuple(Disturbance(heading_deg=h) for h in (0.2, 0.4, 0.6, 0.8))
POSITIONS = tuple(Disturbance(position_m=p) for p in (0.2, 0.4, 0.6, 0.8))
LOSSES = tuple(Disturbance(loss=p) for p in (0.1, 0.2, 0.3))
JOINT = Disturbance(0.1, 0.2, 0.2)
HARD = Disturbance(0.4, 0.8, 0.8, 0.3)
