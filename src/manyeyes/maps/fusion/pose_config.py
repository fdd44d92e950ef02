# SPDX-License-Identifier: Apache-2.0
"""Configuration of the pose optimization, and the schedule of its steps."""

from __future__ import annotations

from dataclasses import dataclass, field

from manyeyes.maps.fusion.coarse_search import CoarseSearchConfig


@dataclass(frozen=True)
class SolverStep:
    """One step of the schedule.

    gate_and_kernel_m: gate and kernel of a sweep, metres; None: repeat the coarse search.
    is_rejection_pass: whether the step belongs to a rejection pass.
    reinstates: whether rejected agents are re-evaluated after it.
    point_stride: every n-th point of an observation is used.
    """

    gate_and_kernel_m: tuple[float, float] | None
    is_rejection_pass: bool
    reinstates: bool
    point_stride: int = 1


@dataclass(frozen=True)
class PoseSolverConfig:
    """Configuration of the pose optimization.

    spacing_m: distance of the sampled points.
    rejection_gates_m, rejection_kernels_m: lateral gate and Geman-McClure scale of each sweep of a rejection pass;
        num_rejection_passes: number of such passes, each followed by a restart; rejection_point_stride: every n-th point is
        used in them.
    gates_m, kernels_m: lateral gate and Geman-McClure scale of each sweep of the final pass.
    max_longitudinal_m, max_heading_rad: longitudinal and heading gate of neighbours.
    sigma_m: standard deviation of lines of other observations. points_per_independent: points of one line that count as one.
    damping: fraction of a step that is taken. prior_scale: Geman-McClure scale of the prior, in standard deviations.
    max_variance_ratio: posterior over prior variance above which a direction keeps the prior.
    max_observations_per_cell: observations that count per cell of 8 m, class and heading.
    gauge_radius_m: radius of the gauge offset; gauge_scale, rejection_gauge_scale: its Geman-McClure scale in standard
        deviations, in the final and the rejection passes.
    agent_scale: Geman-McClure scale of an agent's mean correction, in standard deviations; rejection_agent_scale: limit of
        rejection.
    drive_correlation: fraction of the prior variance that is common to a drive; drive_scale: Geman-McClure scale of that bias,
        in standard deviations.
    coarse_search: configuration of the coarse search.
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
        """The steps after the first search: for each rejection pass its sweeps and a search, then the final sweeps."""
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
        """The number of steps after the first search."""
        return len(self.schedule)


DEFAULT_ALIGN = PoseSolverConfig()
