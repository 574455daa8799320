"""The Riccati pass against oracles that share no code with it."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import blocks, varying_problem

from contactgraph.control import ControlLimits, LQRProblem, solve_lqr
from contactgraph.control.box_qp import solve_box_qp, solve_small
from contactgraph.control.lqr import block_dynamics, improve_policy
from contactgraph.control.riccati import block_operator, dense_operator
from contactgraph.model import LinearDynamics

solve = jax.jit(solve_lqr, static_argnums=1)
improve = jax.jit(improve_policy)
evaluated = jax.jit(lambda value, state: value(state))
small = jax.jit(solve_small)


pytestmark = pytest.mark.usefixtures("double_precision")


def random_problem(seed: int, horizon: int = 15, n: int = 6, U: int = 2) -> LQRProblem:
    return varying_problem(np.random.default_rng(seed), horizon, n, U, 0.2, 0.1)


def total_cost(problem: LQRProblem, states, controls):
    p, states, controls = jax.tree.map(np.asarray, (problem, states, controls))
    state = np.einsum("ti,tij,tj->", states, p.Q, states) + 2 * np.sum(p.q * states)
    control = np.einsum("ti,tij,tj->", controls, p.R, controls) + 2 * np.sum(p.r * controls)
    return state + control


def follow(problem: LQRProblem, start, controls):
    states, problem = [np.asarray(start)], jax.tree.map(np.asarray, problem)
    for t, u in enumerate(controls):
        states.append(problem.A[t] @ states[-1] + problem.B[t] @ np.asarray(u) + problem.offset[t])
    return np.stack(states)


def kkt_solution(problem: LQRProblem, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States and controls from one dense linear system of the optimality conditions."""
    horizon, n, U = problem.B.shape
    xs, us = (horizon + 1) * n, horizon * U
    problem = jax.tree.map(np.asarray, problem)
    hessian, slope = np.zeros((xs + us, xs + us)), np.zeros(xs + us)
    equality, right = np.zeros((xs, xs + us)), np.zeros(xs)
    equality[:n, :n], right[:n] = np.eye(n), start
    for t in range(horizon + 1):
        x = slice(t * n, t * n + n)
        hessian[x, x], slope[x] = 2 * problem.Q[t], 2 * problem.q[t]
        if t == horizon:
            break
        u, after = slice(xs + t * U, xs + t * U + U), slice((t + 1) * n, (t + 2) * n)
        hessian[u, u], slope[u] = 2 * problem.R[t], 2 * problem.r[t]
        equality[after, after] = np.eye(n)
        equality[after, x], equality[after, u] = -problem.A[t], -problem.B[t]
        right[after] = problem.offset[t]
    matrix = np.block([[hessian, equality.T], [equality, np.zeros((xs, xs))]])
    answer = np.linalg.solve(matrix, np.concatenate([-slope, right]))
    return answer[:xs].reshape(-1, n), answer[xs : xs + us].reshape(-1, U)


@pytest.mark.parametrize(
    ("seed", "n", "U"), [(0, 6, 2), (1, 4, 1), (2, 8, 3), (3, 5, 7), (4, 20, 2)]
)
def test_equals_the_dense_kkt_solution(seed, n, U):
    problem = random_problem(seed, n=n, U=U)
    start = np.random.default_rng(seed).normal(size=n)
    policy, value = jax.tree.map(np.asarray, solve(problem))
    states, controls = kkt_solution(problem, start)
    problem, x = jax.tree.map(np.asarray, problem), start
    for t in range(problem.B.shape[0]):
        u = policy.K[t] @ x + policy.k[t]
        np.testing.assert_allclose(x, states[t], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(u, controls[t], rtol=1e-9, atol=1e-9)
        x = problem.A[t] @ x + problem.B[t] @ u + problem.offset[t]
    cost = total_cost(problem, states, controls)
    first = jax.tree.map(lambda leaf: leaf[0], value)
    np.testing.assert_allclose(evaluated(first, start), cost, rtol=1e-9)


def test_value_slope_and_gain_against_finite_differences():
    problem = random_problem(5)
    policy, value = solve(problem)
    first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], value)
    x = np.random.default_rng(5).normal(size=6)
    for i, step in enumerate(1e-5 * np.eye(6)):
        slope = (evaluated(first, x + step) - evaluated(first, x - step)) / 2e-5
        np.testing.assert_allclose(slope, 2 * (first.P @ x + first.p)[i], rtol=1e-6)
        # The gain is how the optimal first control, solved afresh, moves with the state.
        gain = (
            kkt_solution(problem, x + step)[1][0] - kkt_solution(problem, x - step)[1][0]
        ) / 2e-5
        np.testing.assert_allclose(gain, policy.K[0][:, i], rtol=1e-5, atol=1e-8)


def test_expected_decrease_is_exact_on_linear_dynamics():
    problem = random_problem(6)
    rng = np.random.default_rng(6)
    start, controls = rng.normal(size=6), rng.normal(size=(15, 2))
    states = follow(problem, start, controls)
    better = improve(problem, states[:-1], controls, jnp.zeros(()), None)
    best = total_cost(problem, *kkt_solution(problem, start))
    gained = total_cost(problem, states, controls) - best
    np.testing.assert_allclose(better.expected_decrease, gained, rtol=1e-9)
    softer = improve(problem, states[:-1], controls, jnp.asarray(10.0), None)
    assert 0 < softer.expected_decrease < better.expected_decrease
    assert np.sum(np.square(softer.step)) < np.sum(np.square(better.step))


def test_controls_at_a_limit_have_no_feedback_and_the_others_have_that_of_their_own_problem():
    problem = random_problem(6)
    start, controls = jnp.ones(6), jnp.zeros((15, 2))
    states = follow(problem, start, controls)
    limits = ControlLimits(jnp.asarray([-2.0, -90.0]), jnp.asarray([2.0, 90.0]))
    bounded = improve(problem, states[:-1], controls, jnp.zeros(()), limits)
    held = np.abs(np.asarray(bounded.step)) == np.array([2.0, 90.0])
    assert held[:, 0].any() and not held[:, 0].all() and not held[:, 1].any()
    gains = np.asarray(bounded.policy.K)
    assert not np.any(gains[held]) and np.all(gains[~held] != 0.0)
    # Backwards from the last step: with a control held, the gain of the other is -G / S of its own.
    final = np.asarray(problem.Q[-1])
    B, A, R = (np.asarray(leaf[-1]) for leaf in (problem.B, problem.A, problem.R))
    S, G = R + B.T @ final @ B, B.T @ final @ A
    free = ~held[-1]
    expected = np.zeros((2, 6))
    expected[free] = -np.linalg.solve(S[np.ix_(free, free)], G[free])
    np.testing.assert_allclose(gains[-1], expected, atol=1e-9)


def test_no_step_is_left_at_the_optimum():
    problem = random_problem(7)
    states, controls = kkt_solution(problem, np.ones(6))
    for damping in (0.0, 3.0):
        again = improve(problem, states[:-1], controls, jnp.asarray(damping), None)
        np.testing.assert_allclose(again.step, 0.0, atol=1e-9)
        np.testing.assert_allclose(again.expected_decrease, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("N", "U"),
    [
        (3, 2),
        (7, 3),
        (66, 2),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((5, 2), (6, 1))),
    ],
)
def test_block_diagonal_form_equals_the_dense_one(N, U):
    """Up to 16 states in sums, above in quadrants."""
    rng = np.random.default_rng(8)
    horizon, D = 10, 2
    shape = (horizon, N, D)
    linear = jax.jit(blocks)(
        *(rng.normal(size=shape) for _ in range(2)),
        rng.normal(size=(*shape, U)),
        rng.normal(size=shape),
    )
    A, B, offset = jax.tree.map(np.asarray, jax.jit(LinearDynamics.stacked)(linear))
    dense = random_problem(8, horizon, 2 * N * D, U)
    dense = LQRProblem(A, B, offset, dense.Q, dense.R, dense.q, dense.r)
    # From [N, 2, D] to [2, N, D].
    index = np.arange(2 * N * D).reshape(N, 2, D).swapaxes(0, 1).ravel()
    by_block = jax.jit(block_dynamics)(linear)
    np.testing.assert_array_equal(by_block[1], B[:, index])
    block = LQRProblem(
        *by_block,
        dense.Q[:, index[:, None], index],
        dense.R,
        dense.q[:, index],
        dense.r,
    )
    expected, value = jax.tree.map(np.asarray, solve(dense))
    found, block_value = solve(block, block_operator)
    np.testing.assert_allclose(found.K, expected.K[:, :, index], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.k, expected.k, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(block_value.constant, value.constant, rtol=1e-9, atol=1e-9)
    matrix = value.P[:, index[:, None], index]
    np.testing.assert_allclose(block_value.P, matrix, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("operator", [dense_operator, block_operator])
def test_rounding_does_not_grow_where_the_dynamics_are_unstable(operator):
    """Without feedback a state doubles in every step; what is antisymmetric in P would, too."""
    rng = np.random.default_rng(9)
    horizon, half = 60, 10
    n = 2 * half
    blocks = 1.8 * np.eye(2)[:, :, None] + 0.3 * rng.normal(size=(horizon, 2, 2, half))
    dense = np.block([[blocks[:, i, j][:, :, None] * np.eye(half) for j in (0, 1)] for i in (0, 1)])
    given = random_problem(9, horizon, n, n // 2)
    exact = solve(eqx.tree_at(lambda p: p.A, given, dense))[0]
    A = blocks if operator is block_operator else dense
    single = jax.tree.map(
        lambda leaf: leaf.astype(np.float32), eqx.tree_at(lambda p: p.A, given, A)
    )
    found = solve(single, operator)[0]
    scale = np.max(np.abs(exact.K))
    np.testing.assert_allclose(found.K, exact.K, atol=1e-3 * scale)


@pytest.mark.parametrize("size", [1, 2, 4, 6, 7])
def test_small_solve(size):
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size))
    matrix, right = root @ root.T + 0.1 * np.eye(size), rng.normal(size=(size, 4))
    found = small(matrix, right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("U", [1, 2, 3, 5])
def test_bounded_minimum_is_the_best_of_all_corners_edges_and_the_inside(U):
    rng = np.random.default_rng(U)
    limits = ControlLimits(-jnp.ones(U), jnp.full(U, 0.5))
    best_of = jax.jit(lambda S, slope: solve_box_qp(S, slope, limits))
    for _ in range(300 if U < 5 else 10):
        root = rng.normal(size=(U, U))
        S, slope = root @ root.T + (0.05 if U < 5 else 1.0) * np.eye(U), 2 * rng.normal(size=U)
        found, free = best_of(S, slope)
        best, at = np.inf, None
        for held in itertools.product([-1.0, 0.5, None], repeat=U):
            inside = [i for i in range(U) if held[i] is None]
            u = np.array([0.0 if bound is None else bound for bound in held])
            if inside:
                part = np.ix_(inside, inside)
                u[inside] = np.linalg.solve(S[part], -(slope + S @ u)[inside])
            value = u @ S @ u + 2 * slope @ u
            if np.all(u >= -1) and np.all(u <= 0.5) and value < best:
                best, at = value, u
        np.testing.assert_allclose(found, at, atol=1e-9 if U < 5 else 1e-3)
        np.testing.assert_array_equal(free, (at > -1) & (at < 0.5))
