# SPDX-License-Identifier: Apache-2.0
"""How well the map solver distinguishes malicious agents from honest ones: the error of each agent, and the ROC of it.

The score of an agent is the mean correction of its prior poses in standard deviations, at the end of the solution
(``maps.fusion.joint_solver.estimate_agent_errors``). Malicious agents, which displace all that they observe, are positive, honest
ones negative. Agents whose poses are wrong without intent (``outlier``) are in the fleet and in neither class: that they are found
is no error, and no merit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.evaluation.maps.registry import MethodSettings
from manyeyes.evaluation.statistics.proportion import Proportion
from manyeyes.evaluation.statistics.roc import RocCurve, compute_roc, count_found
from manyeyes.maps.fusion.pose_optimization import solve_poses
from manyeyes.maps.registry import OURS
from manyeyes.simulator.fleet.simulate import HONEST, MALICIOUS

MAX_FALSE_POSITIVE = 0.05
LOW_WEIGHT = 0.1


@dataclass(frozen=True)
class AgentErrors:
    """One trial. honest, malicious: errors of the agents of both classes, in standard deviations.

    low_weight: honest observations whose agent has a weight below LOW_WEIGHT, of all honest ones.
    """

    place: str
    seed: int
    attack: str
    fraction: float
    offset_m: float
    honest: tuple[float, ...]
    malicious: tuple[float, ...]
    low_weight: tuple[int, int]


@dataclass(frozen=True)
class AgentDetection:
    """Agents of several trials of one attack. found: malicious agents at MAX_FALSE_POSITIVE of the honest ones.

    low_weight: see :class:`AgentErrors`.
    """

    attack: str
    fraction: float
    offset_m: float
    roc: RocCurve
    found: Proportion
    low_weight: Proportion


def measure_agent_errors(trial: FleetTrial, settings: MethodSettings) -> AgentErrors:
    """Solve the poses of a trial, and collect the errors of its agents."""
    experiment = run_trial(trial)
    solution = solve_poses(experiment.observations, settings.config_of(OURS).pose_solver)
    rows = solution.row_indices([o.id for o in experiment.observations])
    error, weight, roles = solution.agent_error[rows], solution.agent_weight[rows], experiment.fleet.roles
    of_role: dict[int, dict[str, float]] = {HONEST: {}, MALICIOUS: {}}
    for observation, role, value in zip(experiment.observations, roles.tolist(), error.tolist()):
        if role in of_role:
            of_role[role][observation.agent] = value
    honest = roles == HONEST
    config = trial.fleet_config
    return AgentErrors(
        trial.place,
        trial.seed,
        config.attack_mode,
        config.malicious_fraction,
        config.malicious_offset_m[0],
        tuple(of_role[HONEST].values()),
        tuple(of_role[MALICIOUS].values()),
        (int((weight[honest] < LOW_WEIGHT).sum()), int(honest.sum())),
    )


def summarize_agents(results: Sequence[AgentErrors]) -> list[AgentDetection]:
    """Pool the agents of all trials of each attack, fraction and offset; one without agents of both classes is left out."""
    out: list[AgentDetection] = []
    for key in dict.fromkeys((r.attack, r.fraction, r.offset_m) for r in results):
        chosen = [r for r in results if (r.attack, r.fraction, r.offset_m) == key]
        score = np.array([value for r in chosen for value in (*r.honest, *r.malicious)])
        positive = np.array([k >= len(r.honest) for r in chosen for k in range(len(r.honest) + len(r.malicious))], bool)
        roc = compute_roc(score, positive)
        if roc is not None:
            low, total = (sum(r.low_weight[k] for r in chosen) for k in (0, 1))
            found = count_found(score, positive, MAX_FALSE_POSITIVE)
            out.append(AgentDetection(*key, roc, found, Proportion.of(low, total)))
    return out
