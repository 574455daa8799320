"""Sensitivity of positions to a step's own control: only present contacts count."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from model_scenes import nodes_of, preset, state_at

from contactgraph.data.graph import pair_indices
from contactgraph.model import (
    ContactDynamics,
    LinearDynamics,
    ModelState,
    control_sensitivity,
    two_type_belief,
    with_control_displacement,
)

COUNT = 4
sensitivity = eqx.filter_jit(control_sensitivity)
linear_step = eqx.filter_jit(ContactDynamics.linear_step)
encode = eqx.filter_jit(ContactDynamics.encode)


class Counts(eqx.Module):
    """1 N moves every node by as many metres as it has candidate edges, and makes it as fast."""

    def linear_step(self, state, nodes):
        first, second = pair_indices(COUNT).T
        edges = jnp.zeros(COUNT).at[first].add(nodes.candidate).at[second].add(nodes.candidate)
        position = edges[:, None, None] * jnp.eye(2)
        B = jnp.stack([position, 100.0 + position], axis=-2)
        still = jnp.zeros((COUNT, 2, 2, 2))
        return LinearDynamics(still, B, still[..., 0]), state.belief


def test_only_present_contacts_transmit_the_control() -> None:
    nodes = nodes_of(3, capacity=COUNT)
    probability = jnp.array([0.9, 0.4, 0.51, 0.9, 0.9, 0.9])  # The last three: with padding.
    state = ModelState(jnp.zeros((COUNT, 2)), jnp.ones((COUNT, 2)), two_type_belief(probability))
    response = control_sensitivity(Counts(), state, nodes)
    # Pairs in order: 0-1, 0-2, 1-2.
    np.testing.assert_array_equal(response, jnp.array([1.0, 2, 1, 0])[:, None, None] * jnp.eye(2))
    # In metres a newton: the row of the positions.
    linear, _ = Counts().linear_step(state, nodes)
    np.testing.assert_array_equal(linear.control_sensitivity, linear.B[..., 0, :])


def test_control_displacement_is_sensitivity_times_control() -> None:
    rng = np.random.default_rng(0)
    response, control = rng.normal(size=(COUNT, 2, 3)), rng.normal(size=3)
    still = jnp.zeros((COUNT, 2))
    state = ModelState(still, still, two_type_belief(jnp.zeros(6)))
    found = with_control_displacement(
        Counts(), state, jnp.asarray(response), jnp.asarray(control), nodes_of(3, capacity=COUNT)
    )
    np.testing.assert_allclose(found.control_displacement, response @ control, rtol=1e-5)
    # What else is known stays as it was.
    for one, other in zip(
        (found.position, found.velocity), (state.position, state.velocity), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    assert state.control_displacement is None


def test_a_contact_that_the_control_would_make_does_not_transmit_it() -> None:
    """Two bodies just out of contact: the model couples them, the force acts on the first."""
    model, nodes = preset("no_gim"), nodes_of(2)
    position = jnp.array([[0.0, 0.0], [0.1, 0.0]])
    state = state_at(model, position, jnp.zeros((2, 2)), nodes)
    apart = dataclasses.replace(state, belief=two_type_belief(jnp.zeros(1)))
    held = dataclasses.replace(state, belief=two_type_belief(jnp.ones(1)))
    alone, together = (sensitivity(model, each, nodes) for each in (apart, held))
    assert np.any(alone[0] > 0) and np.all(np.abs(together[0]) <= np.abs(alone[0]))
    linear, _ = linear_step(model, apart, nodes)
    np.testing.assert_allclose(linear.control_sensitivity, together, rtol=1e-5)
    assert np.abs(together[0] - alone[0]).max() > 1e-5


def test_the_control_decides_the_contact() -> None:
    """Bodies at rest, 2 cm from touch: pushed together within the step they meet in it."""
    model, nodes = preset("gim_temp"), nodes_of(2)
    touch = float(model.features.contact_distance)
    position, still = jnp.array([[0.0, 0.0], [touch + 0.02, 0.0]]), jnp.zeros((2, 2))
    shares = []
    for push in (None, jnp.array([[0.03, 0.0], [0.0, 0.0]]), jnp.array([[-0.03, 0.0], [0.0, 0.0]])):
        encoded = encode(model, position, still, nodes, push)
        shares.append(float(encoded.geometry.fraction_after_impact[0]))
    assert shares[0] == shares[2] == 0.0
    assert 0.0 < shares[1] < 0.5
