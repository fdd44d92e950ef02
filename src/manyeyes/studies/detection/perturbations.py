# SPDX-License-Identifier: Apache-2.0
"""Perturbations of the detection studies, at the levels of CoSTr, Table II and Fig. 4; packet loss and COMBINED_SEVERE are ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.studies.engine.replay_study import with_replay

MAX_DELAY_FRAMES = 4
"""Frames between the capture of a message and its use at the greatest delay, 0.4 s at 10 Hz."""


@dataclass(frozen=True)
class Perturbation:
    """delay_s: delay of every packet, while the ego does not wait. heading_sigma_deg, position_sigma_m: standard deviations of
    collaborators' prior poses; how they go on in time is a setting of the study. packet_loss: fraction of packets that are lost.
    """

    delay_s: float = 0.0
    heading_sigma_deg: float = 0.0
    position_sigma_m: float = 0.0
    packet_loss: float = 0.0

    @property
    def name(self) -> str:
        """Its name in tables and on the command line."""
        parts = (
            (self.delay_s, f"{self.delay_s:g} s"),
            (self.heading_sigma_deg, f"{self.heading_sigma_deg:g}°"),
            (self.position_sigma_m, f"{self.position_sigma_m:g} m"),
            (self.packet_loss, f"{100 * self.packet_loss:g} % loss"),
        )
        return ", ".join(text for level, text in parts if level) or "clean"

    def apply_to(self, config: BenchmarkConfig, pose_noise: PoseNoise | None = None) -> BenchmarkConfig:
        """Apply it to a configuration. pose_noise: the kind of pose error, at any level; None: the default one.

        With any of them, the warm-up is longer by the largest delay, so that conditions share the features of their agents.
        """
        radio, replay = config.replay.radio, config.replay
        channel = replace(radio, base_latency_s=radio.base_latency_s + self.delay_s)
        kind = pose_noise or PoseNoise(seed=replay.seed)
        noise = kind.at_level(self.position_sigma_m, math.radians(self.heading_sigma_deg))
        perturbed = with_replay(
            config,
            channel=channel.with_loss(self.packet_loss) if self.packet_loss else channel,
            warmup_frames=replay.warmup_frames + MAX_DELAY_FRAMES,
        )
        return replace(perturbed, pose_noise=noise or config.pose_noise)


CLEAN = Perturbation()


def select_perturbations(names: Sequence[str], candidates: Sequence[Perturbation]) -> tuple[Perturbation, ...]:
    """Return CLEAN and the perturbations of a study with these names; all of them without names."""
    unknown = sorted(set(names) - {d.name for d in candidates})
    if unknown:
        raise ConfigError(f"No perturbation {unknown[0]!r}; choose from {', '.join(d.name for d in candidates)}.")
    return tuple(d for d in candidates if not names or d == CLEAN or d.name in names)


DELAYS = tuple(Perturbation(delay_s=d) for d in (0.1, 0.2, 0.3, 0.4))
HEADINGS = tuple(Perturbation(heading_sigma_deg=h) for h in (0.2, 0.4, 0.6, 0.8))
POSITIONS = tuple(Perturbation(position_sigma_m=p) for p in (0.2, 0.4, 0.6, 0.8))
LOSSES = tuple(Perturbation(packet_loss=p) for p in (0.1, 0.2, 0.3))
COMBINED = Perturbation(0.1, 0.2, 0.2)
COMBINED_SEVERE = Perturbation(0.4, 0.8, 0.8, 0.3)
