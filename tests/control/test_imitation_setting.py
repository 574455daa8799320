"""The imitation setting in which differentiable MPC was published (Amos et al. 2018, section 5).

``n = m = 3, T = 5``, an expert with ``A = I + 0.2 N(0,1), B ~ N(0,1), Q = R = I``, a linear term
and 128 first states ``~ N(0,1)``. A learner that is an LQR controller itself sees the expert's
states and controls and knows either the cost or the dynamics; its imitation loss must go to zero.

Three things differ from the publication, for reasons seen here. Both losses are minimised by L-BFGS
in double precision: with Adam the last decades take thousands of steps, because the problem is
badly conditioned. Unknown dynamics start at a small control matrix, ``B = 0.02 N(0,1)``: from
``B ~ N(0,1)`` nine of ten starts run off to an ever larger ``B``, since one with a wrong sign would
have to pass through a singular one. And the better of two such starts counts, as one in
sixteen still gets stuck.
"""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from contactgraph.control import LQRProblem, LQRTrajectory, lqr_trajectory

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("double_precision")]

SIZE, HORIZON, BATCH = 3, 4, 128
"""T = 5 states are four steps."""
SEEDS = jnp.arange(3)


def trajectories(dynamics, weights, linear, starts) -> LQRTrajectory:
    """Of one controller from all starts, the batch last; weights are the diagonal of the cost."""
    A, B = dynamics

    def over(horizon, leaf):
        return jnp.broadcast_to(leaf, (horizon, *leaf.shape))

    problem = LQRProblem(
        A=over(HORIZON, A),
        B=over(HORIZON, B),
        offset=jnp.zeros((HORIZON, SIZE)),
        Q=over(HORIZON + 1, jnp.diag(weights[:SIZE])),
        R=over(HORIZON, jnp.diag(weights[SIZE:])),
        q=over(HORIZON + 1, linear[:SIZE]),
        r=over(HORIZON, linear[SIZE:]),
    )
    return jax.vmap(lqr_trajectory, in_axes=(None, -1), out_axes=-1)(problem, starts)


def error(ours: LQRTrajectory, expert: LQRTrajectory):
    """Mean squared error of states and of controls."""
    return sum(jax.tree.leaves(jax.tree.map(lambda a, b: jnp.mean((a - b) ** 2), ours, expert)))


def random_dynamics(key, scale=1.0):
    keys = jax.random.split(key)
    A = jnp.eye(SIZE) + 0.2 * jax.random.normal(keys[0], (SIZE, SIZE))
    return A, scale * jax.random.normal(keys[1], (SIZE, SIZE))


def expert_of(seed):
    """Its dynamics, linear term, first states and trajectories."""
    keys = jax.random.split(jax.random.key(seed), 3)
    dynamics, linear = random_dynamics(keys[0]), jax.random.normal(keys[1], (2 * SIZE,))
    starts = jax.random.normal(keys[2], (SIZE, BATCH))
    shown = trajectories(dynamics, jnp.ones(2 * SIZE), linear, starts)
    return dynamics, linear, starts, shown


def left_of_the_loss(loss, start, steps: int):
    """The last loss over the first one."""
    optimiser = optax.lbfgs(memory_size=18)
    value_and_slope = optax.value_and_grad_from_state(loss)

    def step(carry, _):
        unknown, state = carry
        value, slope = value_and_slope(unknown, state=state)
        change, state = optimiser.update(
            slope, state, unknown, value=value, grad=slope, value_fn=loss
        )
        return (optax.apply_updates(unknown, change), state), value

    _, values = jax.lax.scan(step, (start, optimiser.init(start)), None, length=steps)
    return values[-1] / values[0]


def test_unknown_dynamics():
    def learned(seed, attempt):
        _, linear, starts, shown = expert_of(seed)

        @jax.jit
        def loss(dynamics):
            return error(trajectories(dynamics, jnp.ones(2 * SIZE), linear, starts), shown)

        key = jax.random.fold_in(jax.random.key(100 + seed), attempt)
        return left_of_the_loss(loss, random_dynamics(key, scale=0.02), steps=150)

    attempts = jax.vmap(learned, in_axes=(None, 0))
    left = jax.jit(jax.vmap(attempts, in_axes=(0, None)))(SEEDS, jnp.arange(2))
    np.testing.assert_array_less(jnp.min(left, axis=1), 1e-6)


def test_unknown_cost():
    def learned(seed):
        dynamics, _, starts, shown = expert_of(seed)

        @jax.jit
        def loss(cost):
            logarithms, linear = cost
            return error(trajectories(dynamics, jnp.exp(logarithms), linear, starts), shown)

        keys = jax.random.split(jax.random.key(100 + seed))
        start = (0.5 * jax.random.normal(keys[0], (6,)), jax.random.normal(keys[1], (6,)))
        return left_of_the_loss(loss, start, steps=50)

    np.testing.assert_array_less(jax.jit(jax.vmap(learned))(SEEDS), 1e-6)
