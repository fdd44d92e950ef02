# SPDX-License-Identifier: Apache-2.0
"""Configuration of the pose optimization, and the schedule of its steps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.maps.fusion.coarse_search import CoarseSearchConfig


@dataclass(frozen=True)
class JointIteration:
    """Widths of one joint step.

    gate_m, kernel_m: lateral gate and Geman-McClure scale of the pairs, metres. prior_scale: Geman-McClure scale of the priors,
        in standard deviations. point_stride: every n-th point of an observation is used.
    """

    gate_m: float
    kernel_m: float
    prior_scale: float
    point_stride: int = 1


@dataclass(frozen=True)
class SolverStep:
    """One step of the schedule.

    joint: widths of a joint step; None: repeat the coarse search. decides: agents are rejected, or reinstated, after the step.
    is_last: the step also gives the marginal covariance.
    """

    joint: JointIteration | None
    decides: bool = False
    is_last: bool = False


@dataclass(frozen=True)
class PoseSolverConfig:
    """Configuration of the pose optimization.

    spacing_m: distance of the sampled points.
    num_iterations: joint steps of the final pass; num_rejection_iterations: of a rejection pass; num_rejection_passes: number
        of such passes, each followed by a repeated search.
    gate_m, kernel_m, prior_scale: first and last lateral gate, Geman-McClure scale of the pairs, and Geman-McClure scale of the
        priors in standard deviations. They fall geometrically over the first settled_fraction of a pass and then stay.
    rejection_point_stride, annealed_point_stride, settled_point_stride: every n-th point is used in a rejection pass, in the steps
        of the final pass whose widths still fall, and in those after them.
    max_longitudinal_m, max_heading_rad: longitudinal and heading gate of pairs.
    sigma_m: standard deviation of the lines beside their own. points_per_independent: points of one line that count as one.
    surveyed_weight: weight of a surveyed pole's lines.
    max_step_m, max_step_rad: largest correction in one step.
    max_observations_per_cell: observations that count per cell of 8 m, class and heading.
    drive_fraction: fraction of the prior variance that is common to a drive. drift_length_m: distance after which the random
        walk of a drive's bias has that variance again. max_drive_gap_m: longer gaps end a drive.
    drive_support_m: an observation is shifted by the coarse search only where most of its drive within this distance are; at most
        domain_halo_m, since a domain sees no farther.
    domain_m, domain_halo_m: the ground is divided into squares of this side, the origin in the middle of one; the poses in one are
        solved with all that lie within the halo around it, and what lies farther away stays where it is during a step.
    max_factorized, covariance_squares, covariance_halo_m: the marginal covariance is that of the factorized system of a domain
        with at most so many observations; of more, that of so many squares along each side (an odd number), with a halo of at most
        this width.
    agent_tolerance, agent_scale, max_agent_error: of an agent's mean correction, in standard deviations: up to the first its weight
        is 1, then it falls with this Geman-McClure scale, and beyond the last the agent is rejected.
    observation_error_m: standard deviation of corrections beside that of the prior pose, from errors that all lines of an
        observation share.
    damping, align_prior_scale, max_variance_ratio: of the alignment of one observation to a fixed map: fraction of a step that is
        taken, Geman-McClure scale of the prior in standard deviations, and posterior over prior variance above which a direction
        keeps the prior.
    coarse_search: configuration of the coarse search.
    """

    spacing_m: float = 1.0
    num_iterations: int = 8
    num_rejection_iterations: int = 4
    num_rejection_passes: int = 2
    gate_m: tuple[float, float] = (2.0, 1.0)
    kernel_m: tuple[float, float] = (0.8, 0.5)
    prior_scale: tuple[float, float] = (9.0, 3.0)
    settled_fraction: float = 0.75
    rejection_point_stride: int = 3
    annealed_point_stride: int = 4
    settled_point_stride: int = 2
    max_longitudinal_m: float = 1.0
    max_heading_rad: float = 0.31
    sigma_m: float = 0.12
    points_per_independent: float = 5.0
    surveyed_weight: float = 50.0
    max_step_m: float = 1.0
    max_step_rad: float = 0.05
    max_observations_per_cell: int = 32
    drive_fraction: float = 0.5
    drift_length_m: float = 2400.0
    max_drive_gap_m: float = 300.0
    drive_support_m: float = 300.0
    domain_m: float = 1536.0
    domain_halo_m: float = 384.0
    max_factorized: int = 12_000
    covariance_squares: int = 3
    covariance_halo_m: float = 256.0
    agent_tolerance: float = 1.6
    agent_scale: float = 0.8
    max_agent_error: float = 2.5
    observation_error_m: float = 0.1
    damping: float = 0.7
    align_prior_scale: float = 3.0
    max_variance_ratio: float = 0.8
    coarse_search: CoarseSearchConfig = field(default_factory=CoarseSearchConfig)

    def __post_init__(self) -> None:
        if self.drive_support_m > self.domain_halo_m:
            raise ConfigError(
                f"PoseSolverConfig: drive_support_m ({self.drive_support_m:g} m) is larger than domain_halo_m "
                f"({self.domain_halo_m:g} m), beyond which a domain sees no observations of a drive; lower drive_support_m or "
                "raise domain_halo_m."
            )
        if self.covariance_squares % 2 != 1:
            raise ConfigError(
                f"PoseSolverConfig.covariance_squares: expected an odd number; got {self.covariance_squares}. Set it to 1 or 3."
            )

    @property
    def schedule(self) -> tuple[SolverStep, ...]:
        """The steps after the first search: for each rejection pass its joint steps and a search, then the final joint steps."""
        rejection = self._anneal(
            self.num_rejection_iterations, self.rejection_point_stride, self.rejection_point_stride
        )
        out: list[SolverStep] = []
        for _ in range(self.num_rejection_passes):
            out += [SolverStep(one, decides=one is rejection[-1]) for one in rejection]
            out.append(SolverStep(None))
        final = self._anneal(self.num_iterations, self.annealed_point_stride, self.settled_point_stride)
        return (*out, *(SolverStep(one, is_last=one is final[-1]) for one in final))

    @property
    def num_steps(self) -> int:
        """The number of steps after the first search."""
        return len(self.schedule)

    def _anneal(self, count: int, annealed_stride: int, settled_stride: int) -> list[JointIteration]:
        """Make the widths of a pass of joint steps, and the strides of its points."""
        settled = max(1.0, np.floor(count * self.settled_fraction))
        share = np.minimum(1.0, np.arange(count) / settled)
        columns = [a * (b / a) ** share for a, b in (self.gate_m, self.kernel_m, self.prior_scale)]
        gate, kernel, prior = (column.tolist() for column in columns)
        strides = [annealed_stride if k < settled else settled_stride for k in range(count)]
        return [JointIteration(*widths) for widths in zip(gate, kernel, prior, strides)]


DEFAULT_ALIGN = PoseSolverConfig()
