# SPDX-License-Identifier: Apache-2.0
"""Common parts of commands that read a recording: options, excerpts, latency budgets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from manyeyes._bounds import ByteCount, DurationMs
from manyeyes.agents.strategies.names import TEMPORAL, current_name
from manyeyes.datatypes import ConfigError

if TYPE_CHECKING:
    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.datasets.base import Recording
    from manyeyes.datatypes import Snapshot

ALL_METHODS = ("no-fusion", "late", "intermediate", "early")
WITH_MEMORY = tuple(name + TEMPORAL for name in ALL_METHODS)
"""One form of all methods: comparisons are made within a form."""
BOTH_FORMS = tuple(
    name + form for form in ("", TEMPORAL) for name in ("no-fusion", "late", "late-weighted", "intermediate", "early")
)
FRAME_PERIOD_MS = 100.0
IDEAL_LATENCY_BUDGET_MS = 0.0


@dataclass(frozen=True)
class ReplayOptions:
    """How agents collaborate while a recording is played."""

    weights: str = "costr-small"
    """Shipped weights or a registered detector by name, or a .safetensors file of 'manyeyes train'."""
    methods: tuple[str, ...] = ALL_METHODS
    """What is compared: strategies by name, NAME-temporal with memory, those of your own too; an unknown name lists them."""
    channel: str = "ideal"
    """The channel between agents: ideal, its-g5-6 (6 Mb/s), its-g5-27mbps, lte-v2x, nr-sidelink, cellular."""
    latency_budget_ms: DurationMs | None = None
    """How long an ego waits for messages after its own sweep; by default 0 on the ideal channel, else one period, 100."""
    budget_bytes: ByteCount = 1 << 17
    """The most that a message of tokens may weigh."""
    token_encoding: Literal["float32", "float16", "int8", "codebook", "clusters"] | None = None
    """How tokens are written: their features as numbers, all of them as the codes of the weights' codebook, or one row a cluster
    (fusion ermvp); by default as clusters or codes where the weights have them, else as float16."""
    request_maps: bool = False
    """Send request maps with token messages, and weight tokens by the latest received ones (Where2comm)."""
    sight: bool = False
    """Send with each message how far the space around the sender's LiDAR is free, 248 bytes: with --misbehaviour ray-evidence, two
    trusted senders refute what the ego cannot see."""
    pose_correction: str | None = None
    """Correct the poses of senders before fusion, by objects that both agents detect; leave out messages without a usable pose.
    Corrector: voting, learned-voting, feakm, a .safetensors file of FeaKM, or a baseline: identity, coalign, fpv-rcnn, feaco, icp,
    vips, clipper, max-clique, v2x-reg-odist, v2x-reg-oiou, mash."""
    misbehaviour: str | None = None
    """Weigh senders by trust: ray-evidence, or a baseline: none, oracle, robosac, cp-guard; a name of your own too."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "methods", tuple(map(current_name, self.methods)))

    def make_replay_config(self, seed: int, all_egos: bool = False) -> ReplayConfig:
        """The same as the player takes it; unknown names are refused here, before any work."""
        from manyeyes.agents.pose_correction import PoseCorrection
        from manyeyes.agents.replay import WARMUP_FRAMES, ReplayConfig
        from manyeyes.agents.strategies.registry import get_strategy
        from manyeyes.agents.trust.registry import get_misbehaviour_detector
        from manyeyes.comms.channel import channel_preset

        channel_preset(self.channel)
        if not self.methods or len(set(self.methods)) < len(self.methods):
            raise ConfigError(f"--methods takes each name once, at least one; got {' '.join(self.methods) or 'none'}.")
        for name in self.methods:
            get_strategy(name)
        latency_budget_ms = (
            (IDEAL_LATENCY_BUDGET_MS if self.channel == "ideal" else FRAME_PERIOD_MS)
            if self.latency_budget_ms is None
            else self.latency_budget_ms
        )
        return ReplayConfig(
            channel=self.channel,
            token_encoding=self.token_encoding,
            budget_bytes=self.budget_bytes,
            latency_budget_s=latency_budget_ms / 1e3,
            all_egos=all_egos,
            send_request_map=self.request_maps,
            send_sight=self.sight,
            warmup_frames=WARMUP_FRAMES,
            seed=seed,
            pose_correction=None if self.pose_correction is None else PoseCorrection(self.pose_correction),
            misbehaviour=None if self.misbehaviour is None else get_misbehaviour_detector(self.misbehaviour),
        )


@dataclass(frozen=True)
class FileChecks:
    """What all commands that make numbers or weights of a recording do about its files."""

    allow_missing: bool = False
    """Go on where files of the recording are missing or do not match; they are counted in the JSON and under the table. Without
    it they are an error."""


@dataclass(frozen=True)
class Excerpt:
    """One scenario of a recording, at most so many evaluated frames of it, all for None."""

    recording: Recording
    scenario: str
    max_frames: int | None

    @property
    def scenarios(self) -> tuple[str, ...]:
        """The replayed scenario only."""
        return (self.scenario,)

    def length(self, scenario: str) -> int:
        """As in the recording."""
        return self.recording.length(scenario)

    def eval_indices(self, scenario: str) -> range:
        """The first of those that the recording judges."""
        return self.recording.eval_indices(scenario)[: self.max_frames]

    def agents(self, scenario: str) -> tuple[int, ...]:
        """As in the recording."""
        return self.recording.agents(scenario)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """As in the recording."""
        return self.recording.snapshot(scenario, index)


def make_excerpt(recording: Recording, scenario: str | None, max_frames: int | None = None) -> Excerpt:
    """The named scenario, or the first; a name that is not there lists those that are."""
    names = recording.scenarios
    if scenario is not None and scenario not in names:
        more = f" and {len(names) - 8} more" if len(names) > 8 else ""
        raise ConfigError(f"There is no scenario {scenario!r} in the recording; it has {', '.join(names[:8])}{more}.")
    if max_frames is not None and max_frames < 1:
        raise ConfigError(f"--frames is at least 1; got {max_frames}.")
    return Excerpt(recording, scenario or names[0], max_frames)


def display_name(weights: str) -> str:
    """How tables call the weights: a shipped name, or the file's."""
    return Path(weights).stem if weights.endswith(".safetensors") else weights
