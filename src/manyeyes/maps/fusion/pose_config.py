# SPDX-License-Identifier: Apache-2.0
"""Settings of the pose optimization, and the schedule of its steps."""

from __future__ import annotations

from dataclasses import dataclass, field

from manyeyes.maps.fusion.coarse_search import CoarseSearchConfig


@dataclass(frozen=True)
class SolverStep:
    """gate_and_kernel_m: gate and kernel of a sweep, metres; None: the search once more. reinstates: those whom nobody believed
    before may be believed again after it. point_stride: every n-th point of an observation has its vote.
    """

    gate_and_kernel_m: tuple[float, float] | None
    is_rejection_pass: bool
    reinstates: bool
    point_stride: int = 1


@dataclass(frozen=True)
class PoseSolverConfig:
    """gates_m: how far across a line a neighbour may be, one number a sweep; kernels_m: the Geman-McClure scale of each
    sweep. rejection_gates_m, rejection_kernels_m: of the sweeps that only tell whom to believe, trials times, by every
    trial_stride-th point; after each all begins again.

    max_longitudinal_m, max_heading_rad: how far along and how turned a neighbour may be. sigma_m: what lines of other observations
    scatter. points_per_independent: points of one line that count as one. damping: share of a step taken. prior_scale: corrections
    beyond about so many standard deviations stop pulling back. max_variance_ratio: posterior over prior variance above which
    a direction stays as claimed. max_observations_per_cell: observations that count in a cell of 8 m, class and heading.
    gauge_radius_m: within which distance what all were moved alike is taken back; gauge_scale: standard deviations beyond which a
    correction has little say in that, trial_gauge_scale in the trial; agent_scale: beyond which an agent's mean correction makes
    its lines weigh little, and agent_limit next to nothing; drive_correlation: part of the variance of claims that is one error of
    a whole drive; drive_scale: standard deviations beyond which such an error is no longer held to be small.
    """

    spacing_m: float = 1.0
    rejection_gates_m: tuple[float, ...] = (2.0, 2.0, 1.3, 0.8)
    rejection_kernels_m: tuple[float, ...] = (0.8, 0.8, 0.5, 0.35)
    num_rejection_passes: int = 2
    rejection_point_stride: int = 3
    gates_m: tuple[float, ...] = (2.0, 2.0, 1.6, 1.3, 1.0, 0.8, 0.8, 0.8)
    kernels_m: tuple[float, ...] = (0.8, 0.8, 0.6, 0.5, 0.4, 0.35, 0.35, 0.35)
    max_longitudinal_m: float = 1.0
    max_heading_rad: float = 0.31
    sigma_m: float = 0.2
    points_per_independent: float = 8.0
    damping: float = 0.7
    prior_scale: float = 3.0
    max_variance_ratio: float = 0.8
    max_observations_per_cell: int = 32
    gauge_radius_m: float = 250.0
    gauge_scale: float = 1.25
    rejection_gauge_scale: float = 1.0
    agent_scale: float = 2.0
    rejection_agent_scale: float = 2.5
    drive_correlation: float = 0.5
    drive_scale: float = 3.0
    coarse_search: CoarseSearchConfig = field(default_factory=CoarseSearchConfig)

    @property
    def schedule(self) -> tuple[SolverStep, ...]:
        """What follows the first search: the sweeps of each trial and the search once more, then the sweeps."""
        rejection_widths, last = (
            tuple(zip(self.rejection_gates_m, self.rejection_kernels_m)),
            len(self.rejection_gates_m) - 1,
        )
        out: list[SolverStep] = []
        for rejection_pass in range(self.num_rejection_passes):
            out += [
                SolverStep(width, True, rejection_pass == 0 or k == last, self.rejection_point_stride)
                for k, width in enumerate(rejection_widths)
            ]
            out.append(SolverStep(None, True, False))
        return (*out, *(SolverStep(width, False, False) for width in zip(self.gates_m, self.kernels_m)))

    @property
    def num_steps(self) -> int:
        """How many follow the first search."""
        return len(self.schedule)


DEFAULT_ALIGN = PoseSolverConfig()
