# SPDX-License-Identifier: Apache-2.0
"""Joint least squares over the poses of all observations and the errors of all drives: one robust Gauss-Newton step.

The prior pose of observation o of drive d is off by b_do + e_o. The bias b of a drive starts from N(0, rho P) and drifts as a
random walk over the distance driven; e is independent and has (1 - rho) P. Pairs of points
(:mod:`manyeyes.maps.fusion.pair_system`) couple the poses of different observations. All of it is one sparse linear system a
step. Each e and the first bias of each drive have a Geman-McClure weight, so that one bad observation, or one
bad drive, releases its own prior and no other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from manyeyes.maps.fusion.conjugate_gradients import solve_by_conjugate_gradients
from manyeyes.maps.fusion.drive_factor import DriveFactor
from manyeyes.maps.fusion.pair_blocks import PairBlocks
from manyeyes.maps.fusion.sparse_inverse import SymmetricFactor, solve_by_factors

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_ITERATIONS = 400
"""Of conjugate gradients; a step that needs more is continued by the next one."""


@dataclass(frozen=True, eq=False)
class DriveChain:
    """States of the biases of drives: the state (O,) of each observation; of each state (S,) the state before it, -1 at the
    start of a drive, and the variance ratio (S,) of the step from there, in units of the bias's prior variance.
    """

    state: Ints
    previous: Ints
    step_ratio: Floats

    @property
    def start(self) -> Ints:
        """The first state (S,) of the drive of each state."""
        first = np.arange(len(self.previous))
        for k in np.flatnonzero(self.previous >= 0).tolist():
            first[k] = first[self.previous[k]]
        return first


def make_drive_chain(
    drives: tuple[str, ...], time_ns: Ints, xy: Floats, drift_length_m: float, max_gap_m: float
) -> DriveChain:
    """Make one state an observation, in order of time along each drive; a gap beyond max_gap_m starts another drive."""
    name = np.unique(np.array(drives), return_inverse=True)[1]
    order = np.lexsort((np.arange(len(name)), time_ns, name))
    previous, ratio = np.full(len(name), -1), np.zeros(len(name))
    state = np.empty(len(name), np.int64)
    state[order] = np.arange(len(name))
    if len(order) > 1:
        gap = np.hypot(*(xy[order[1:]] - xy[order[:-1]]).T)
        linked = (name[order[1:]] == name[order[:-1]]) & (gap <= max_gap_m)
        previous[1:] = np.where(linked, np.arange(len(name) - 1), -1)
        ratio[1:] = np.where(linked, np.maximum(gap, 1.0) / drift_length_m, 0.0)
    return DriveChain(state, previous, ratio)


@dataclass(frozen=True, eq=False)
class JointPriors:
    """Priors of O observations and S states: correction of the prior pose (O, 3), covariance (O, 3, 3) of the prior, biases (S, 3),
    fixed (O,) poses, agent weights (O,), and the chain. bias_fraction: rho.
    """

    correction: Floats
    covariance: Floats
    bias: Floats
    fixed: NDArray[np.bool_]
    agent_weight: Floats
    chain: DriveChain
    bias_fraction: float


@dataclass(frozen=True, eq=False)
class JointStep:
    """Result of one step: increments of the poses (O, 3), biases (S, 3), weights (O,) of the priors of the observations' own
    errors, and the factors of the system, None where it was solved iteratively.
    """

    increment: Floats
    bias: Floats
    own_weight: Floats
    factor: SymmetricFactor | None


def compute_prior_weights(priors: JointPriors, scale: float) -> tuple[Floats, Floats]:
    """Compute the Geman-McClure weights of each observation's own error (O,) and of each state's drive (S,); scale in sigmas."""
    own = np.linalg.inv((1.0 - priors.bias_fraction) * priors.covariance)
    error = priors.correction - priors.bias[priors.chain.state]
    own_distance = np.einsum("oi,oij,oj->o", error, own, error)
    shared = _state_information(priors)
    start = priors.chain.start
    bias = priors.bias[start]
    drive = np.einsum("si,sij,sj->s", bias, shared[start], bias)
    return _geman_mcclure(own_distance, scale), _geman_mcclure(drive, scale)


def _geman_mcclure(square: Floats, scale: float) -> Floats:
    return (scale**2 / (scale**2 + square)) ** 2


def _state_information(priors: JointPriors) -> Floats:
    """Return (S, 3, 3) inverse of the prior covariance of each state's bias."""
    count = len(priors.chain.previous)
    covariance, number = np.zeros((count, 3, 3)), np.zeros(count)
    np.add.at(covariance, priors.chain.state, priors.covariance)
    np.add.at(number, priors.chain.state, 1.0)
    return np.asarray(np.linalg.inv(priors.bias_fraction * covariance / number[:, None, None]), np.float64)


def solve_joint_step(pairs: PairBlocks, priors: JointPriors, scale: float, tolerance: float | None = None) -> JointStep:
    """Solve one Gauss-Newton step of all poses and biases together; scale: of the priors' Geman-McClure weights, in sigmas.

    tolerance: relative residual of conjugate gradients, whose cost grows in proportion to the observations; None: by factors.
    """
    own_weight, drive_weight = compute_prior_weights(priors, scale)
    system = assemble_joint_system(pairs, priors, own_weight, drive_weight)
    factor = None
    if tolerance is None:
        found, factor = solve_by_factors(system.to_matrix().tocsc(), system.right_side)
    else:
        found = _solve_iteratively(system, priors.chain, tolerance)
    count = 3 * len(priors.correction)
    return JointStep(found[:count].reshape(-1, 3), found[count:].reshape(-1, 3), own_weight, factor)


def _solve_iteratively(system: JointSystem, chain: DriveChain, tolerance: float) -> Floats:
    """Solve by conjugate gradients, preconditioned by all but the couplings between observations."""
    factor = DriveFactor.of_matrix(system.apart, chain.state, chain.previous >= 0)
    return solve_by_conjugate_gradients(
        system.apart, system.pairs, factor, system.right_side, tolerance, MAX_ITERATIONS
    )


@dataclass(frozen=True, eq=False)
class JointSystem:
    """Normal equations: the increments of O poses first, then S biases, three unknowns each.

    apart: the matrix without the couplings between observations, which pairs holds. right_side: (3 (O + S),).
    """

    apart: bsr_array
    pairs: PairBlocks
    right_side: Floats

    def to_matrix(self) -> bsr_array:
        """Return the whole matrix."""
        row, other, coupling = self.pairs.row, self.pairs.other, self.pairs.coupling
        size = len(self.right_side) // 3
        own_row = np.repeat(np.arange(size), np.diff(self.apart.indptr))
        families = [
            (own_row, self.apart.indices, self.apart.data), (row, other, coupling),
            (other, row, coupling.transpose(0, 2, 1)),
        ]  # fmt: skip
        return bsr_from_blocks(families, size)


def assemble_joint_system(
    pairs: PairBlocks, priors: JointPriors, own_weight: Floats, drive_weight: Floats
) -> JointSystem:
    """Assemble the normal equations of a step."""
    chain, count, states = priors.chain, len(priors.correction), len(priors.chain.previous)
    rows, state = np.arange(count), count + chain.state
    own_information = np.linalg.inv((1.0 - priors.bias_fraction) * priors.covariance)
    own = (own_weight * priors.agent_weight)[:, None, None] * own_information
    shared = _state_information(priors)
    at = count + np.arange(states)
    linked = chain.previous >= 0
    start = np.where(linked, 0.0, drive_weight)[:, None, None] * shared
    step = shared[linked] / chain.step_ratio[linked, None, None]
    before, after = count + chain.previous[linked], at[linked]
    hold = np.where(priors.fixed, 1e12, 0.0)[:, None, None] * np.eye(3)
    # Row, column and sign of each family of blocks.
    families = [
        (rows, rows, pairs.own + own + hold), (rows, state, -own), (state, rows, -own), (state, state, own),
        (at, at, start), (after, after, step), (before, before, step), (before, after, -step), (after, before, -step),
    ]  # fmt: skip
    apart = bsr_from_blocks(families, count + states)
    pull = np.einsum("oij,oj->oi", own, priors.correction)
    right_side = np.zeros((count + states, 3))
    right_side[:count] = np.where(priors.fixed[:, None], 0.0, pairs.right_side - pull)
    np.add.at(right_side, state, pull)
    return JointSystem(apart, pairs, right_side.reshape(-1))


def bsr_from_blocks(families: list[tuple[Ints, Ints, Floats]], size: int) -> bsr_array:
    """Sum blocks (N, 3, 3) at block rows and columns (N,) into a sparse matrix of 3 size rows, those of one place in order."""
    place = np.concatenate([row * size + column for row, column, _ in families])
    block = np.concatenate([f[2] for f in families])
    order = np.argsort(place, kind="stable")
    place = place[order]
    begins = np.flatnonzero(np.concatenate((np.ones(min(1, len(place)), bool), place[1:] != place[:-1])))
    row, column = np.divmod(place[begins], size)
    offsets = np.concatenate(([0], np.cumsum(np.bincount(row, minlength=size))))
    return bsr_array((np.add.reduceat(block.take(order, 0), begins), column, offsets), shape=(3 * size, 3 * size))
