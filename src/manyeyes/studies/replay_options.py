# SPDX-License-Identifier: Apache-2.0
"""What the verbs that read a recording have in common: options, an excerpt, how long an ego waits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from manyeyes.datatypes import ConfigError, Snapshot

if TYPE_CHECKING:
    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.datasets.base import Recording

ALL_METHODS = ("alone", "late", "intermediate", "early")
PERIOD_MS = 100.0
IDEAL_WAIT_MS = 0.0


@dataclass(frozen=True)
class Playing:
    """How agents collaborate while a recording is played."""

    weights: str = "costr-small"
    """Shipped weights by name, or a .safetensors file of 'manyeyes train'."""
    methods: tuple[str, ...] = ALL_METHODS
    """What is compared: any of alone, late, intermediate, early."""
    channel: str = "ideal"
    """The air between agents: ideal, its-g5, its-g5-27, lte-v2x, nr-sidelink, cellular."""
    wait_ms: float | None = None
    """How long an ego waits for messages after its own sweep; by default 0 on the ideal channel, else one period, 100."""
    budget_bytes: int = 1 << 17
    """The most that a message of tokens may weigh."""
    precision: Literal["float32", "float16", "int8", "codes"] | None = None
    """How tokens are written: their features as numbers, or all of them as the codes of the weights' codebook; by default as
    codes where the weights have one, else as float16."""
    requests: bool = False
    """Messages of tokens say where their sender needs no help; what came lately weighs what is sent."""
    align: str | None = None
    """Correct where others say they are before fusing, by the objects that both see; leave out whom nobody can place. By whom:
    vote, feakm, a .safetensors file of FeaKM, or a rival: given, coalign, fpv-rcnn, feaco, icp, vips, v2x-reg-odist,
    v2x-reg-oiou, mash."""

    def replay_config(self, seed: int, all_egos: bool = False) -> ReplayConfig:
        """The same as the player takes it; unknown names are refused here, before any work."""
        from manyeyes.agents.pose_correction import Aligner
        from manyeyes.agents.replay import STEADY, ReplayConfig
        from manyeyes.agents.strategies import method
        from manyeyes.comms.channel import channel_preset

        channel_preset(self.channel)
        if not self.methods or len(set(self.methods)) < len(self.methods):
            raise ConfigError(f"--methods takes each name once, at least one; got {' '.join(self.methods) or 'none'}.")
        for name in self.methods:
            method(name)
        wait_ms = (IDEAL_WAIT_MS if self.channel == "ideal" else PERIOD_MS) if self.wait_ms is None else self.wait_ms
        return ReplayConfig(
            channel=self.channel,
            precision=self.precision,
            budget_bytes=self.budget_bytes,
            wait_s=wait_ms / 1e3,
            all_egos=all_egos,
            requests=self.requests,
            history=STEADY,
            seed=seed,
            aligner=None if self.align is None else Aligner(self.align),
        )


@dataclass(frozen=True)
class FileChecks:
    """What all commands that make numbers or weights of a recording do about its files."""

    allow_missing: bool = False
    """Go on where files of the recording are missing or do not match; they are counted in the JSON and under the table. Without
    it they are an error."""


@dataclass(frozen=True)
class Excerpt:
    """One scenario of a recording, at most so many judged frames of it, all for None."""

    recording: Recording
    scenario: str
    frames: int | None

    @property
    def scenarios(self) -> tuple[str, ...]:
        """The one."""
        return (self.scenario,)

    def length(self, scenario: str) -> int:
        """As in the recording."""
        return self.recording.length(scenario)

    def judged(self, scenario: str) -> range:
        """The first of those that the recording judges."""
        return self.recording.judged(scenario)[: self.frames]

    def agents(self, scenario: str) -> tuple[int, ...]:
        """As in the recording."""
        return self.recording.agents(scenario)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """As in the recording."""
        return self.recording.snapshot(scenario, index)


def excerpt(recording: Recording, scenario: str | None, frames: int | None = None) -> Excerpt:
    """The named scenario, or the first; a name that is not there lists those that are."""
    names = recording.scenarios
    if scenario is not None and scenario not in names:
        more = f" and {len(names) - 8} more" if len(names) > 8 else ""
        raise ConfigError(f"There is no scenario {scenario!r} in the recording; it has {', '.join(names[:8])}{more}.")
    if frames is not None and frames < 1:
        raise ConfigError(f"--frames is at least 1; got {frames}.")
    return Excerpt(recording, scenario or names[0], frames)


def weights_name(weights: str) -> str:
    """How tables call the weights: a shipped name, or the file's."""
    return Path(weights).stem if weights.endswith(".safetensors") else weights
