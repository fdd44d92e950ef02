# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import ConfigError, ShapeError, Transform, wrap_angle
from manyeyes.ops.se2 import (
    PoseGraphEdges,
    adjoint,
    between,
    compose,
    edge_error,
    edge_jacobians,
    exp,
    inverse,
    log,
    right_jacobian_inverse,
    solve_pose_graph,
)

F64 = torch.float64


def poses(n, seed=0, spread=20.0):
    g = torch.Generator().manual_seed(seed)
    return torch.cat(
        (torch.randn(n, 2, generator=g, dtype=F64) * spread, torch.rand(n, 1, generator=g, dtype=F64) * 6.2 - 3.1), 1
    )


def same(a, b, atol=1e-9):
    delta = a - b
    delta[..., 2] = wrap_angle(delta[..., 2])
    assert delta.abs().max() < atol, delta


def as_transform(p):
    zero = torch.zeros_like(p[..., 0])
    return Transform.from_rpy(torch.stack((p[..., 0], p[..., 1], zero), -1), zero, zero, p[..., 2])


def test_the_group():
    a, b, c = poses(50, 1), poses(50, 2), poses(50, 3)
    same(compose(compose(a, b), c), compose(a, compose(b, c)))
    same(compose(a, inverse(a)), torch.zeros(50, 3, dtype=F64))
    same(compose(a, between(a, b)), b)
    torch.testing.assert_close(as_transform(compose(a, b)).matrix(), (as_transform(a) @ as_transform(b)).matrix())
    torch.testing.assert_close(as_transform(inverse(a)).matrix(), as_transform(a).inverse().matrix())


@pytest.mark.parametrize("yaw", [0.0, 1e-12, 1e-5, 0.009, 0.011, 1.0, -2.5, 3.14159, -math.pi])
def test_log_undoes_exp_at_every_angle(yaw):
    tangent = torch.tensor([3.0, -2.0, yaw], dtype=F64)
    same(log(exp(tangent)), tangent)
    assert torch.isfinite(right_jacobian_inverse(tangent)).all()


def test_exp_is_the_matrix_exponential():
    tangent = poses(20, 4, spread=3.0)
    vx, vy, omega = tangent.unbind(-1)
    zero = torch.zeros_like(vx)
    generator = torch.stack(
        (torch.stack((zero, -omega, vx), -1), torch.stack((omega, zero, vy), -1), torch.zeros(20, 3, dtype=F64)), -2
    )
    matrix = torch.linalg.matrix_exp(generator)
    got = exp(tangent)
    torch.testing.assert_close(got[:, :2], matrix[:, :2, 2])
    torch.testing.assert_close(got[:, 2].sin(), matrix[:, 1, 0])


def test_adjoint_moves_a_motion_from_right_to_left():
    a, d = poses(20, 5), poses(20, 6, spread=0.1) / 10
    on_the_right, on_the_left = compose(a, exp(d)), compose(exp((adjoint(a) @ d[..., None])[..., 0]), a)
    # A yaw of almost pi may have either sign.
    assert wrap_angle(on_the_right[:, 2] - on_the_left[:, 2]).abs().max() < 1e-9
    assert (on_the_right[:, :2] - on_the_left[:, :2]).abs().max() < 1e-9 < (on_the_right - a)[:, :2].abs().min()


def graph(n=6, extra=6, noise=0.0, seed=0):
    """True poses, and edges of a chain and some chords, with noise."""
    truth = poses(n, seed)
    g = torch.Generator().manual_seed(seed + 100)
    i = torch.cat((torch.arange(n - 1), torch.randint(0, n, (extra,), generator=g)))
    j = torch.cat((torch.arange(1, n), (i[n - 1 :] + 1 + torch.randint(0, n - 1, (extra,), generator=g)) % n))
    error = torch.randn(len(i), 3, generator=g, dtype=F64) * torch.tensor([1, 1, 0.1], dtype=F64) * noise
    information = torch.diag_embed(
        torch.tensor([4.0, 9.0, 400.0], dtype=F64) * (1 + torch.rand(len(i), 1, generator=g, dtype=F64))
    )
    return truth, PoseGraphEdges(i, j, compose(between(truth[i], truth[j]), exp(error)), information)


def anchored(n):
    return torch.arange(n) == 0


@pytest.mark.parametrize("noise", [0.0, 0.01, 1.0])
def test_jacobians_equal_those_of_autograd(noise):
    at, edges = graph(noise=noise)

    def by(which):
        def error(delta):
            moved = [at[edges.i], at[edges.j]]
            moved[which] = compose(moved[which], exp(delta))
            return log(compose(inverse(edges.measured), between(*moved)))

        full = torch.autograd.functional.jacobian(error, torch.zeros(len(edges.i), 3, dtype=F64))
        return torch.stack([full[e, :, e] for e in range(len(edges.i))])

    for which, got in enumerate(edge_jacobians(at, edges)):
        torch.testing.assert_close(got, by(which), atol=1e-9, rtol=1e-9)


def test_an_exact_graph_is_recovered_from_a_bad_start():
    truth, edges = graph()
    start = compose(truth, exp(poses(6, 9, spread=1.0) / 4))
    start[0] = truth[0]
    got = solve_pose_graph(start, edges, anchored(6))
    assert got.converged and got.cost < 1e-18
    same(got.poses, truth, atol=1e-9)
    assert torch.equal(got.poses[0], truth[0])


def test_two_agents_six_objects():
    """Agent-object graph: 0.8 m and 0.8 degrees of pose error vanish when the boxes are exact."""
    agents = torch.tensor([[0, 0, 0.2], [40, 5, 2.9]], dtype=F64)
    objects = poses(6, 3)
    truth = torch.cat((agents, objects))
    i, j = torch.arange(2).repeat_interleave(6), torch.arange(6).repeat(2) + 2
    edges = PoseGraphEdges(
        i, j, between(truth[i], truth[j]), torch.diag(torch.tensor([16.0, 16, 400], dtype=F64)).expand(12, 3, 3)
    )
    start = truth.clone()
    start[1] += torch.tensor([0.8, -0.8, math.radians(0.8)], dtype=F64)
    start[2:] = compose(start[1].expand(6, 3), edges.measured[6:])
    got = solve_pose_graph(start, edges, torch.arange(8) == 0)
    assert (got.poses - truth).abs().max() < 1e-6


def test_a_noisy_graph_reaches_the_minimum_that_scipy_finds():
    optimize = pytest.importorskip("scipy.optimize")
    truth, edges = graph(noise=0.3, seed=2)
    root = torch.linalg.cholesky(edges.information).mT

    def residual(free):
        at = torch.cat((truth[:1], torch.from_numpy(free).view(-1, 3)))
        return (root @ edge_error(at, edges)[..., None]).flatten().numpy()

    expected = optimize.least_squares(residual, truth[1:].flatten().numpy(), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    got = solve_pose_graph(truth, edges, anchored(6))
    assert got.cost == pytest.approx(expected.cost, rel=1e-9)
    same(got.poses[1:], torch.from_numpy(expected.x).view(-1, 3), atol=1e-5)
    slope = torch.from_numpy(expected.jac)
    torch.testing.assert_close(got.covariance[3:, 3:], torch.linalg.inv(slope.mT @ slope), rtol=1e-3, atol=1e-6)
    assert (got.covariance[:3] == 0).all() and (got.covariance[:, :3] == 0).all()


@pytest.mark.slow
def test_the_covariance_is_that_of_repeated_measurements():
    truth, edges = graph(n=4, extra=3, seed=4)
    g = torch.Generator().manual_seed(0)
    spread = torch.linalg.cholesky(torch.linalg.inv(100 * edges.information))
    errors = []
    for _ in range(150):
        noise = (spread @ torch.randn(len(edges.i), 3, 1, generator=g, dtype=F64))[..., 0]
        measured = compose(edges.measured, exp(noise))
        got = solve_pose_graph(truth, PoseGraphEdges(edges.i, edges.j, measured, 100 * edges.information), anchored(4))
        delta = got.poses[3] - truth[3]
        delta[2] = wrap_angle(delta[2])
        errors.append(delta @ torch.linalg.inv(got.covariance[9:, 9:]) @ delta)
    assert torch.stack(errors).mean().item() == pytest.approx(3.0, abs=0.5)


def test_huber_resists_an_outlier_edge():
    truth, edges = graph(n=6, extra=14, noise=0.02, seed=5)
    measured = edges.measured.clone()
    measured[8] = compose(measured[8], torch.tensor([30.0, -20, 1.0], dtype=F64))
    with_outlier = replace(edges, measured=measured)
    plain, robust = (
        solve_pose_graph(truth, with_outlier, anchored(6)),
        solve_pose_graph(truth, with_outlier, anchored(6), huber=1.0),
    )
    assert (robust.poses - truth)[:, :2].norm(dim=-1).max() < 0.2 * (plain.poses - truth)[:, :2].norm(dim=-1).max()
    clean = solve_pose_graph(truth, edges, anchored(6), huber=1e6)
    torch.testing.assert_close(clean.poses, solve_pose_graph(truth, edges, anchored(6)).poses)


def test_the_robust_cost_grows_linearly_beyond_its_bound():
    """One edge, off by 3 standard deviations: 9 / 2 plain, (2 * 3 * 1 - 1) / 2 with a bound of 1."""
    at = torch.zeros(2, 3, dtype=F64)
    edge = PoseGraphEdges(
        torch.tensor([0]), torch.tensor([1]), torch.tensor([[1.5, 0, 0]], dtype=F64), 4 * torch.eye(3, dtype=F64)[None]
    )
    everything = torch.ones(2).bool()
    assert solve_pose_graph(at, edge, everything).cost == pytest.approx(4.5)
    assert solve_pose_graph(at, edge, everything, huber=1.0).cost == pytest.approx(2.5)
    assert solve_pose_graph(at, edge, everything, huber=4.0).cost == pytest.approx(4.5)


def test_the_answer_moves_with_the_world():
    truth, edges = graph(noise=0.2, seed=6)
    world = torch.tensor([2500.0, -900.0, 2.0], dtype=F64)
    here, there = (
        solve_pose_graph(truth, edges, anchored(6)),
        solve_pose_graph(compose(world.expand(6, 3), truth), edges, anchored(6)),
    )
    same(compose(world.expand(6, 3), here.poses), there.poses, atol=1e-6)
    turn = torch.block_diag(*[as_transform(world).rotation] * 6)  # x, y turn with the world; yaw does not
    torch.testing.assert_close(turn @ here.covariance @ turn.mT, there.covariance, atol=1e-9, rtol=1e-5)


def test_an_unconstrained_pose_has_infinite_covariance():
    truth, edges = graph()
    alone = solve_pose_graph(torch.cat((truth, truth[:1])), edges, anchored(7))
    assert torch.isinf(alone.covariance).all()
    same(alone.poses[:6], truth)
    with pytest.raises(ConfigError, match="at least one fixed"):
        solve_pose_graph(truth, edges, torch.zeros(6).bool())
    with pytest.raises(ShapeError, match="there are 3"):
        solve_pose_graph(truth[:3], edges, anchored(3))
    with pytest.raises(ConfigError, match="finite"):
        solve_pose_graph(truth / 0, edges, anchored(6))
    with pytest.raises(ShapeError, match="edge 0 joins one to itself"):
        replace(edges, j=edges.i)
    with pytest.raises(ShapeError, match=r"PoseGraphEdges\.measured"):
        replace(edges, measured=edges.measured[1:])


def test_everything_fixed_and_no_edges():
    truth, edges = graph(noise=0.1)
    got = solve_pose_graph(truth, edges, torch.ones(6).bool())
    assert got.converged and torch.equal(got.poses, truth) and (got.covariance == 0).all()
    nothing = PoseGraphEdges(torch.zeros(0).long(), torch.zeros(0).long(), torch.zeros(0, 3), torch.zeros(0, 3, 3))
    assert torch.isinf(solve_pose_graph(truth, nothing, anchored(6)).covariance).all()


def test_gradients_flow_through_the_algebra_at_zero():
    zero = torch.zeros(3, dtype=F64, requires_grad=True)
    for f in (exp, log):
        jacobian = torch.autograd.functional.jacobian(f, zero)
        torch.testing.assert_close(jacobian, torch.eye(3, dtype=F64))
