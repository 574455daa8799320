"""The differentiable LQR against finite differences, plain autodiff and its own conditions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import varying_problem
from jax.flatten_util import ravel_pytree

from contactgraph.control import (
    LQRProblem,
    LQRTrajectory,
    lqr_trajectory,
    solve_lqr,
    tracking_problem,
)
from contactgraph.control.box_qp import solve_small
from contactgraph.control.lqr_adjoint import factor_kkt, solve_kkt

pytestmark = pytest.mark.usefixtures("double_precision")


def random_problem(seed: int, horizon: int = 6, n: int = 4, U: int = 2):
    """A time-varying problem with every term, its start, and weights that make a loss of it."""
    rng = np.random.default_rng(seed)
    problem = varying_problem(rng, horizon, n, U, 0.3, 1.0)
    weights = LQRTrajectory(rng.normal(size=(horizon + 1, n)), rng.normal(size=(horizon, U)))
    return problem, rng.normal(size=n), weights


def by_scan(problem: LQRProblem, start) -> LQRTrajectory:
    """The same trajectory by rolling out the policy of `solve_lqr`."""
    policy, _ = solve_lqr(problem)

    def step(x, stage):
        A, B, offset, policy = stage
        u = policy(x)
        return A @ x + B @ u + offset, (x, u)

    last, (states, controls) = jax.lax.scan(
        step, start, (problem.A, problem.B, problem.offset, policy)
    )
    return LQRTrajectory(jnp.concatenate([states, last[None]]), controls)


def loss_of(solver, weights: LQRTrajectory):
    """A loss that is neither linear nor quadratic in the trajectory."""

    def loss(problem, start):
        trajectory = solver(problem, start)
        errors = jax.tree.map(
            lambda a, b: jnp.sum(jnp.tanh(a) * b + 0.1 * a**2), trajectory, weights
        )
        return sum(jax.tree.leaves(errors))

    return loss


def close_to(relative: float):
    """Equal up to a fraction of the largest entry, which is not zero."""

    def check(ours, expected):
        scale = np.max(np.abs(expected))
        assert ours.shape == expected.shape and scale > 1e-3
        np.testing.assert_allclose(ours, expected, rtol=0, atol=relative * scale)

    return check


def symmetric(W):
    return 0.5 * (W + W.swapaxes(-1, -2))


def with_symmetric_cost(problem: LQRProblem) -> LQRProblem:
    return eqx.tree_at(lambda p: (p.Q, p.R), problem, replace_fn=symmetric)


def finite_differences(loss, at):
    """Central differences with respect to every entry of every leaf."""

    @jax.jit
    def differences(at):
        flat, unflatten = ravel_pytree(at)

        def difference(direction):
            return (loss(unflatten(flat + direction)) - loss(unflatten(flat - direction))) / 2e-5

        return unflatten(jax.vmap(difference)(1e-5 * jnp.eye(flat.size)))

    return differences(at)


SIZES = [
    (0, 3, 3, 2),
    (3, 2, 2, 7),
    *(pytest.param(*each, marks=pytest.mark.slow) for each in ((1, 1, 3, 1), (2, 5, 5, 3))),
]
"""Seed, H, n, U. Above six controls another way of solving for them is used."""


@pytest.mark.parametrize(("seed", "horizon", "n", "U"), SIZES)
def test_equals_rollout_of_the_riccati_policy_and_autodiff_through_it(seed, horizon, n, U):
    problem, start, weights = random_problem(seed, horizon, n, U)
    ours, expected = jax.jit(lqr_trajectory)(problem, start), jax.jit(by_scan)(problem, start)
    assert ours.states.shape == (horizon + 1, n) and ours.controls.shape == (horizon, U)
    jax.tree.map(close_to(1e-10), ours, expected)
    ours, expected = (
        jax.tree.map(
            np.asarray, jax.jit(jax.grad(loss_of(solver, weights), argnums=(0, 1)))(problem, start)
        )
        for solver in (lqr_trajectory, by_scan)
    )
    jax.tree.map(close_to(1e-9), ours, (with_symmetric_cost(expected[0]), expected[1]))


@pytest.mark.parametrize(("horizon", "U"), [(3, 2), pytest.param(1, 1, marks=pytest.mark.slow)])
def test_gradients_of_every_leaf_against_finite_differences(horizon, U):
    problem, start, weights = random_problem(4, horizon, 3, U)

    def loss(arguments):
        # Only changes that keep Q and R symmetric are changes of the problem.
        return loss_of(lqr_trajectory, weights)(with_symmetric_cost(arguments[0]), arguments[1])

    ours = jax.jit(jax.grad(loss))((problem, start))
    jax.tree.map(close_to(1e-6), ours, finite_differences(loss, (problem, start)))


def test_gradients_of_a_constant_cost_and_its_goal_against_finite_differences():
    varying, start, weights = random_problem(5, 6, 3, 2)

    def loss(cost):
        Q, R, goal = symmetric(cost[0]), symmetric(cost[1]), cost[2]
        problem = tracking_problem(varying.A, varying.B, varying.offset, Q, R, goal)
        return loss_of(lqr_trajectory, weights)(problem, start)

    cost = (varying.Q[0], varying.R[0], varying.q[0])
    jax.tree.map(close_to(1e-6), jax.jit(jax.grad(loss))(cost), finite_differences(loss, cost))


def test_a_tracking_problem_brings_the_state_to_its_goal():
    goal = jnp.asarray([1.0, -2.0])
    eye = jnp.broadcast_to(jnp.eye(2), (40, 2, 2))
    problem = tracking_problem(eye, eye, jnp.zeros((40, 2)), jnp.eye(2), jnp.eye(2), goal)
    last = jax.jit(lqr_trajectory)(problem, jnp.zeros(2)).states[-1]
    np.testing.assert_allclose(last, goal, atol=1e-9)


def test_the_optimality_conditions_hold():
    p, start, _ = random_problem(6)

    @jax.jit
    def solve(p, start):
        return solve_kkt(factor_kkt(p.A, p.B, p.Q, p.R), p.q, p.r, p.offset, start)

    solution = solve(p, start)
    x, u, after = map(np.asarray, (solution.states, solution.controls, solution.costates))

    def times(matrices, vectors):
        return np.einsum("tij,tj->ti", matrices, vectors)

    pulled = times(p.A.swapaxes(1, 2), after)[1:]
    costate = times(p.Q, x)[1:] + p.q[1:] + np.pad(pulled, ((0, 1), (0, 0)))
    np.testing.assert_allclose(x[0], start)
    np.testing.assert_allclose(x[1:], times(p.A, x[:-1]) + times(p.B, u) + p.offset, atol=1e-12)
    np.testing.assert_allclose(
        times(p.R, u) + p.r + times(p.B.swapaxes(1, 2), after), 0, atol=1e-10
    )
    np.testing.assert_allclose(after, costate, atol=1e-10)


def sample_loss(sample, weights):
    problem = LQRProblem(**{name: sample[name] for name in sample if name != "start"})
    return loss_of(lqr_trajectory, weights)(problem, sample["start"])


loss_and_slope = jax.jit(jax.value_and_grad(sample_loss))
SHARED = [(("Q", "R"), -1), (("A", "B", "Q", "R"), 0), (("q", "offset", "start"), -1)]


@pytest.mark.parametrize(("shared", "axis"), SHARED)
def test_a_batch_equals_one_by_one(shared, axis):
    """Any leaf may be shared: its gradient is the sum over the batch."""
    samples = [random_problem(seed, 3, 2, 2) for seed in range(4)]
    # A loss of one sample, of a dictionary of all that the trajectory depends on.
    flat = [vars(problem) | {"start": start} for problem, start, _ in samples]
    for sample in flat[1:]:
        sample |= {name: flat[0][name] for name in shared}
    weights = samples[0][2]

    def loss(sample):
        return sample_loss(sample, weights)

    axes = {name: None if name in shared else axis for name in flat[0]}
    batch = {
        name: flat[0][name] if name in shared else np.stack([s[name] for s in flat], axis)
        for name in axes
    }

    def losses(batch):
        each = jax.vmap(loss, in_axes=(axes,))(batch)
        return jnp.sum(each), each

    total, each = jax.jit(jax.grad(losses, has_aux=True))(batch)
    values, slopes = zip(*[loss_and_slope(sample, weights) for sample in flat], strict=True)
    np.testing.assert_allclose(each, values, rtol=1e-12)
    for name, slope in total.items():
        alone = [np.asarray(s[name]) for s in slopes]
        close_to(1e-10)(slope, sum(alone) if name in shared else np.stack(alone, axis))


def test_a_batch_of_batches_and_a_map_over_batches():
    problems = [random_problem(seed, 3, 2, 1)[:2] for seed in range(6)]
    batch = jax.tree.map(
        lambda *leaves: np.stack(leaves).reshape(2, 3, *leaves[0].shape), *problems
    )
    inner = jax.vmap(lqr_trajectory)
    nested = jax.jit(jax.vmap(inner))(*batch)
    mapped = jax.jit(lambda batch: jax.lax.map(lambda each: inner(*each), batch))(batch)
    alone = jax.jit(lqr_trajectory)(*problems[4])
    jax.tree.map(close_to(1e-12), nested, mapped)
    jax.tree.map(close_to(1e-12), jax.tree.map(lambda leaf: np.asarray(leaf)[1, 1], nested), alone)


@pytest.mark.parametrize("U", [2, 7])
def test_small_systems_are_solved_with_the_batch_last(U):
    rng = np.random.default_rng(U)
    root, right = rng.normal(size=(U, U, 5)), rng.normal(size=(U, 3, 5))
    matrix = np.einsum("ikb,jkb->ijb", root, root) + np.eye(U)[..., None]
    answer = jax.jit(solve_small)(matrix, right)
    np.testing.assert_allclose(np.einsum("ikb,kjb->ijb", matrix, answer), right, atol=1e-10)


def test_single_precision_stays_single():
    problem, start, weights = random_problem(7, 3, 2, 1)
    single = jax.tree.map(lambda leaf: leaf.astype(np.float32), (problem, start))
    slopes = jax.jit(jax.grad(loss_of(lqr_trajectory, weights), argnums=(0, 1)))
    ours, expected = slopes(*single), slopes(problem, start)
    assert {leaf.dtype for leaf in jax.tree.leaves(ours)} == {jnp.dtype("float32")}
    jax.tree.map(close_to(1e-4), ours, expected)


def test_a_long_horizon_of_an_unstable_system_in_single_precision():
    """A gain that undoes a growth of 1.5 a step, 300 steps: errors must not grow with it."""
    rng = np.random.default_rng(8)
    A = 1.5 * np.eye(4) + 0.2 * rng.normal(size=(300, 4, 4))
    dynamics = A, rng.normal(size=(300, 4, 2)), rng.normal(size=(300, 4))

    @jax.jit
    def tracked(dynamics, Q, R, goal):
        return lqr_trajectory(tracking_problem(*dynamics, Q, R, goal), goal)

    given = dynamics, np.eye(4), np.eye(2), np.ones(4)
    single = jax.tree.map(lambda leaf: leaf.astype(np.float32), given)
    jax.tree.map(close_to(1e-3), tracked(*single), tracked(*given))


def test_forward_mode_is_refused():
    problem, start, _ = random_problem(9, 2, 2, 1)
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jit(lambda x: jax.jvp(lambda x: lqr_trajectory(problem, x), (x,), (x,)))(start)
