"""The differentiable LQR against the dense conditions, finite differences and plain autodiff."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.control import LQRProblem, LQRTrajectory, lqr_trajectory, solve_lqr


@pytest.fixture(autouse=True)
def double_precision():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


def random_problem(seed: int, horizon: int = 6, n: int = 4, U: int = 2):
    """A time-varying problem with every term, its start, and weights that make a loss of it."""
    rng = np.random.default_rng(seed)
    root_Q, root_R = rng.normal(size=(horizon + 1, n, n)), rng.normal(size=(horizon, U, U))
    problem = LQRProblem(
        A=jnp.asarray(np.eye(n) + 0.3 * rng.normal(size=(horizon, n, n))),
        B=jnp.asarray(rng.normal(size=(horizon, n, U))),
        offset=jnp.asarray(rng.normal(size=(horizon, n))),
        Q=jnp.asarray(root_Q @ root_Q.swapaxes(1, 2)),
        R=jnp.asarray(root_R @ root_R.swapaxes(1, 2) + np.eye(U)),
        q=jnp.asarray(rng.normal(size=(horizon + 1, n))),
        r=jnp.asarray(rng.normal(size=(horizon, U))),
    )
    weights = LQRTrajectory(
        jnp.asarray(rng.normal(size=(horizon + 1, n))), jnp.asarray(rng.normal(size=(horizon, U)))
    )
    return problem, jnp.asarray(rng.normal(size=n)), weights


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


SIZES = [(0, 6, 4, 2), (1, 1, 3, 1), (2, 5, 5, 3), (3, 12, 2, 1)]


@pytest.mark.parametrize(("seed", "horizon", "n", "U"), SIZES)
def test_equals_the_rollout_of_the_riccati_policy(seed, horizon, n, U):
    problem, start, _ = random_problem(seed, horizon, n, U)
    ours, expected = jax.jit(lqr_trajectory)(problem, start), by_scan(problem, start)
    assert ours.states.shape == (horizon + 1, n) and ours.controls.shape == (horizon, U)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10), ours, expected
    )


@pytest.mark.parametrize(("seed", "horizon", "n", "U"), SIZES)
def test_gradients_equal_autodiff_through_the_scan(seed, horizon, n, U):
    problem, start, weights = random_problem(seed, horizon, n, U)
    ours = jax.jit(jax.grad(loss_of(lqr_trajectory, weights), argnums=(0, 1)))(problem, start)
    problem_slope, start_slope = jax.jit(jax.grad(loss_of(by_scan, weights), argnums=(0, 1)))(
        problem, start
    )
    symmetric = eqx.tree_at(
        lambda p: (p.Q, p.R),
        problem_slope,
        replace_fn=lambda slope: 0.5 * (slope + slope.swapaxes(-1, -2)),
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9),
        ours,
        (symmetric, start_slope),
    )
