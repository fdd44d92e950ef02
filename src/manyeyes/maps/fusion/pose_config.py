# SPDX-License-Identifier: Apache-2.0
"""Settings of the pose optimization, and the schedule of its steps."""

from __future__ import annotations

from dataclasses import dataclass, field

from manyeyes.maps.fusion.coarse_search import GrossConfig


@dataclass(frozen=True)
class Step:
    """width: gate and kernel of a sweep, metres; None: the search once more. judges: those whom nobody believed before
    may be believed again after it. stride: every n-th point of an observation has its vote.
    """

    width: tuple[float, float] | None
    trial: bool
    judges: bool
    stride: int = 1


@dataclass(frozen=True)
class AlignConfig:
    """gates_m: how far across a line a neighbour may be, one number a sweep; kernels_m: the Geman-McClure scale of each
    sweep. trial_gates_m, trial_kernels_m: of the sweeps that only tell whom to believe, trials times, by every
    trial_stride-th point; after each all begins again.

    along_m, heading_rad: how far along and how turned a neighbour may be. sigma_m: what lines of other observations
    scatter. correlation: points of one line that count as one. damping: share of a step taken. prior_scale: corrections
    beyond about so many standard deviations stop pulling back. frozen_above: posterior over prior variance above which
    a direction stays as claimed. most: observations that count in a cell of 8 m, class and heading. gauge_m: within
    which distance what all were moved alike is taken back; gauge_scale: standard deviations beyond which a correction
    has little say in that, trial_gauge_scale in the trial; agent_scale: beyond which an agent's mean correction makes
    its lines weigh little, and agent_limit next to nothing; alike: part of the variance of claims that is one error of
    a whole drive; drive_scale: standard deviations beyond which such an error is no longer held to be small.
    """

    spacing_m: float = 1.0
    trial_gates_m: tuple[float, ...] = (2.0, 2.0, 1.3, 0.8)
    trial_kernels_m: tuple[float, ...] = (0.8, 0.8, 0.5, 0.35)
    trials: int = 2
    trial_stride: int = 3
    gates_m: tuple[float, ...] = (2.0, 2.0, 1.6, 1.3, 1.0, 0.8, 0.8, 0.8)
    kernels_m: tuple[float, ...] = (0.8, 0.8, 0.6, 0.5, 0.4, 0.35, 0.35, 0.35)
    along_m: float = 1.0
    heading_rad: float = 0.31
    sigma_m: float = 0.2
    correlation: float = 8.0
    damping: float = 0.7
    prior_scale: float = 3.0
    frozen_above: float = 0.8
    most: int = 32
    gauge_m: float = 250.0
    gauge_scale: float = 1.25
    trial_gauge_scale: float = 1.0
    agent_scale: float = 2.0
    agent_limit: float = 2.5
    alike: float = 0.5
    drive_scale: float = 3.0
    gross: GrossConfig = field(default_factory=GrossConfig)

    @property
    def schedule(self) -> tuple[Step, ...]:
        """What follows the first search: the sweeps of each trial and the search once more, then the sweeps."""
        tried, last = tuple(zip(self.trial_gates_m, self.trial_kernels_m)), len(self.trial_gates_m) - 1
        out: list[Step] = []
        for trial in range(self.trials):
            out += [Step(width, True, trial == 0 or k == last, self.trial_stride) for k, width in enumerate(tried)]
            out.append(Step(None, True, False))
        return (*out, *(Step(width, False, False) for width in zip(self.gates_m, self.kernels_m)))

    @property
    def steps(self) -> int:
        """How many follow the first search."""
        return len(self.schedule)


DEFAULT_ALIGN = AlignConfig()
