# SPDX-License-Identifier: Apache-2.0
"""Weights of agents from the residuals of their prior poses: sums over all observations of an agent, wherever they stand.

The sums are integers of a fixed unit, so that they are exact and the same for any order and any division of the observations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.fusion.pose_solution import REJECTED_WEIGHT, PoseSolution

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

START_SCALE_M = 0.2
_UNITS = 2.0**30
# Columns of the sums of an agent.
_XX, _XY, _YY, _X, _Y, _VARIANCE, _COUNT, _SQUARES, _VOTES = range(9)
NUM_COLUMNS = 9
"""What an observation adds to the sums of its agent."""
# A prior of 20 points keeps the scale of an agent without matches at its start.
_PRIOR_VOTES = 20.0


@dataclass(frozen=True)
class AgentLimits:
    """What the mean correction of an agent means, all but the last in standard deviations.

    tolerance: up to it the weight is 1; an honest agent's bias moves its poses, not its weight. scale: of the Geman-McClure weight
    beyond. rejection: from it on the agent is rejected. bias_fraction: fraction of the prior variance that is common to a drive.
    """

    tolerance: float
    scale: float
    rejection: float
    bias_fraction: float


@dataclass(frozen=True, eq=False)
class AgentSums:
    """Sums over the observations of A agents, names ascending.

    sums: (A, 9) in units of 2^-30: observability (xx, xy, yy), its product with the offset (x, y; metres), prior variance (m²),
        number of observations, weighted squared residuals of the points (m²), their votes.
    """

    names: tuple[str, ...]
    sums: Ints

    @classmethod
    def of(cls, agents: Sequence[str], columns: Floats) -> AgentSums:
        """Sum the columns (O, 9) of observations by agent."""
        return cls._add(agents, np.rint(columns * _UNITS).astype(np.int64))

    @classmethod
    def merge(cls, parts: Sequence[AgentSums]) -> AgentSums:
        """Add the sums of parts of the observations."""
        return cls._add([n for part in parts for n in part.names], np.concatenate([part.sums for part in parts]))

    @classmethod
    def _add(cls, agents: Sequence[str], values: Ints) -> AgentSums:
        names, agent = np.unique(np.array(agents), return_inverse=True)
        sums = np.zeros((len(names), NUM_COLUMNS), np.int64)
        np.add.at(sums, agent, values)
        return cls(tuple(names.tolist()), sums)


@dataclass(frozen=True, eq=False)
class AgentWeights:
    """Error (A,) in standard deviations, weight (A,) in (0, 1] and residual scale (A,) in metres of agents, names ascending."""

    names: tuple[str, ...]
    error: Floats
    weight: Floats
    scale: Floats

    @classmethod
    def of_state(cls, state: PoseSolution) -> AgentWeights:
        """Collect what the observations of a state carry; surveyed poles leave the weight at 1."""
        names, agent = np.unique(np.array(state.agents), return_inverse=True)
        weight, scale, error = np.ones(len(names)), np.full(len(names), START_SCALE_M), np.zeros(len(names))
        weighted = state.is_surveyed == 0
        weight[agent[weighted]] = state.agent_weight[weighted]
        scale[agent], error[agent] = state.scale, state.agent_error
        return cls(tuple(names.tolist()), error, weight, scale)

    @classmethod
    def of_sums(
        cls, found: AgentSums, previous: AgentWeights | None, decides: bool, limits: AgentLimits
    ) -> AgentWeights:
        """Weigh agents; only a step that decides rejects or reinstates one."""
        values = found.sums / _UNITS
        error = _estimate_errors(values, limits.bias_fraction)
        weight = _weigh(error, limits if decides else replace(limits, rejection=np.inf))
        if previous is not None and not decides:
            weight = np.where(previous.weight[previous.rows(found.names)] <= REJECTED_WEIGHT, REJECTED_WEIGHT, weight)
        variance = values[:, _SQUARES] + _PRIOR_VOTES * START_SCALE_M**2
        return cls(found.names, error, weight, np.sqrt(variance / (values[:, _VOTES] + _PRIOR_VOTES)))

    def restart(self) -> AgentWeights:
        """Return the table at the start of a pass: agents are inliers, or rejected."""
        weight = np.where(self.weight > REJECTED_WEIGHT, 1.0, REJECTED_WEIGHT)
        return AgentWeights(self.names, np.zeros(len(weight)), weight, np.full(len(weight), START_SCALE_M))

    def rows(self, names: Sequence[str]) -> Ints:
        """Return the rows of agents."""
        place = {name: k for k, name in enumerate(self.names)}
        return np.array([place[name] for name in names], np.int64)


def make_agent_columns(
    offset: Floats, observability: Floats, prior_variance: Floats, squares: Floats, votes: Floats
) -> Floats:
    """Make what an observation adds to the sums of its agent: (O, 9).

    Args:
        offset: (O, 2) metres, correction of the prior pose. observability: (O, 2, 2) of it.
        prior_variance: (O,) m², mean variance of the prior position.
        squares, votes: (O,) weighted squared residuals (m²) and votes of the points.
    """
    out = np.empty((len(offset), NUM_COLUMNS))
    out[:, _XX], out[:, _XY], out[:, _YY] = observability[:, 0, 0], observability[:, 0, 1], observability[:, 1, 1]
    out[:, [_X, _Y]] = np.einsum("oij,oj->oi", observability, offset)
    out[:, _VARIANCE], out[:, _COUNT], out[:, _SQUARES], out[:, _VOTES] = prior_variance, 1.0, squares, votes
    return out


def estimate_agent_weights(
    offset: Floats, observability: Floats, prior_variance: Floats, agent: Ints, limits: AgentLimits
) -> Floats:
    """Estimate agent weights (O,) in (0, 1] from the mean correction of each agent's prior poses (robust M-estimation).

    The mean over an agent's observations is used because independent noise averages out, while a bias or an attack does not.
    Only observable directions count.

    Args:
        offset: (O, 2) metres, correction of each observation relative to those nearby.
        observability: (O, 2, 2) symmetric, fraction of the prior information that the lines add.
        prior_variance: (O,) m², mean variance of the prior position.
        agent: (O,) agent of each observation, from 0.
        limits: see :class:`AgentLimits`.
    """
    none = np.zeros(len(offset))
    columns = make_agent_columns(offset, observability, prior_variance, none, none)
    table = AgentWeights.of_sums(AgentSums.of([str(a) for a in agent], columns), None, True, limits)
    return table.weight[table.rows([str(a) for a in agent])]


def apply_agents(state: PoseSolution, table: AgentWeights | None) -> PoseSolution:
    """Return the state with the weights and scales of a table; surveyed poles have weight 1. None: as it is."""
    if table is None:
        return state
    rows = table.rows(state.agents)
    weight = np.where(state.is_surveyed > 0, 1.0, table.weight[rows])
    return state.with_agents(table.error[rows], weight, table.scale[rows])


def _estimate_errors(values: Floats, bias_fraction: float) -> Floats:
    """Return the mean correction (A,) of the prior poses of agents in standard deviations, from their sums (A, 9)."""
    weight = values[:, [_XX, _XY, _XY, _YY]].reshape(-1, 2, 2)
    mean = np.linalg.solve(weight + 0.1 * np.eye(2), values[:, [_X, _Y]][:, :, None])[:, :, 0]
    shared = bias_fraction * (np.trace(weight, axis1=1, axis2=2) / 2 - 1.0).clip(0.0)
    spread = values[:, _VARIANCE] / values[:, _COUNT] * (1.0 + shared)
    return np.sqrt(np.einsum("ai,aij,aj->a", mean, weight, mean).clip(0.0) / np.maximum(spread, 1e-12))


def _weigh(error: Floats, limits: AgentLimits) -> Floats:
    """Return the weights (A,) of agents of these errors (A,)."""
    beyond = (error - limits.tolerance).clip(0.0)
    robust = (limits.scale**2 / (limits.scale**2 + beyond**2)) ** 2
    return np.where(error > limits.rejection, REJECTED_WEIGHT, robust)
