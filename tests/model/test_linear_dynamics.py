"""One linear step in blocks and stacked; stacking and its inverse; derivatives of the step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from contactgraph.model import (
    LinearDynamics,
    SpringMassDamper,
    ThetaMethod,
    from_physical,
    stack_state,
)


def random_step(nodes: int, dimension: int, size: int, lead: tuple[int, ...] = ()):
    rng = np.random.default_rng(0)
    shapes = [(2, 2), (2, size), (2,)]
    draws = [rng.normal(size=(*lead, nodes, dimension, *shape)) for shape in shapes]
    return LinearDynamics(*(jnp.asarray(draw.astype(np.float32)) for draw in draws))


stacked_form = jax.jit(LinearDynamics.stacked)


@jax.jit
def both_steps(step: LinearDynamics, position, velocity, control) -> tuple:
    """The next stacked state by the stacked form, and by the blocks."""
    A, B, offset = step.stacked()
    stacked = A @ stack_state(position, velocity) + B @ control + offset
    return stacked, stack_state(*step(position, velocity, control))


@pytest.mark.parametrize(
    ("nodes", "dimension", "size"), [(1, 1, 1), (3, 2, 2), (4, 3, 0), (2, 2, 5)]
)
def test_the_stacked_step_is_that_of_the_blocks(nodes, dimension, size) -> None:
    step = random_step(nodes, dimension, size)
    rng = np.random.default_rng(1)
    position, velocity = rng.normal(size=(2, nodes, dimension))
    stacked, expected = both_steps(step, position, velocity, rng.normal(size=size))
    assert stacked.shape == (2 * nodes * dimension,)
    np.testing.assert_allclose(stacked, expected, atol=1e-5)


def test_a_step_and_the_next_are_one() -> None:
    both = random_step(3, 2, 2, (2,))
    first, second = (jax.tree.map(lambda leaf, i=i: leaf[i], both) for i in (0, 1))
    position, velocity, control = jnp.ones((3, 2)), jnp.full((3, 2), -2.0), jnp.array([0.5, 3.0])
    expected = second(*first(position, velocity, control), control)
    found = first.then(second)(position, velocity, control)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_stacking() -> None:
    position, velocity = jnp.asarray(np.random.default_rng(0).normal(size=(2, 7, 3, 2)))
    stacked = stack_state(position, velocity)
    assert stacked.shape == (7, 12)
    # For each node its positions, then its velocities.
    np.testing.assert_array_equal(stacked[0, :4], [*position[0, 0], *velocity[0, 0]])


def test_a_step_by_hand() -> None:
    step = LinearDynamics(
        A=jnp.array([[[[1.0, 0.1], [-0.2, 0.9]]]]),
        B=jnp.array([[[[0.0], [0.5]]]]),
        offset=jnp.array([[[0.01, 0.02]]]),
    )
    position, velocity = step(jnp.array([[2.0]]), jnp.array([[3.0]]), jnp.array([4.0]))
    np.testing.assert_allclose(position, [[2.0 + 0.3 + 0.01]], rtol=1e-6)
    np.testing.assert_allclose(velocity, [[-0.4 + 2.7 + 2.0 + 0.02]], rtol=1e-6)


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("learned", [True, False])
def test_derivatives_of_the_theta_method(learned) -> None:
    def moved(response, k, c, rest, rest_velocity, shift, raw):
        parameters = SpringMassDamper(response, k, c, rest, rest_velocity, shift, 0.0 * k)
        method = ThetaMethod(0.6, learned=learned)
        method = jax.tree.map(lambda leaf: leaf + raw, method)
        return jax.tree.leaves(method(parameters, 0.05))

    rng = np.random.default_rng(0)
    values = [rng.uniform(0, 5, shape) for shape in ((2, 2, 3), *[(2, 2)] * 5)]
    values[1] *= 100
    check_grads(jax.jit(moved), (*values, np.array(0.1)), order=1, eps=1e-6)
    slope = jax.jit(jax.grad(lambda raw: sum(jnp.sum(x) for x in moved(*values, raw))))(0.1)
    assert (slope == 0) == (not learned)


def test_physical_parameters_are_rates_times_the_mass() -> None:
    rng = np.random.default_rng(0)
    w, k, c, rest = jnp.asarray(rng.uniform(0.1, 5, (4, 3, 2)))
    parameters = from_physical(w, k, c, rest)
    np.testing.assert_allclose(parameters.stiffness_rate, w * k, rtol=1e-5)
    np.testing.assert_allclose(parameters.damping_rate, w * c, rtol=1e-5)
    assert not np.any(parameters.impact_displacement) and not np.any(
        parameters.equilibrium_velocity
    )
