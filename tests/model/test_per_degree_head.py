"""The paper's head: bounded, at rest at its damper, its equilibrium relative to hinge or node."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from model_scenes import DT, jitted_geometry, nodes_of

from contactgraph.data.graph import pair_indices
from contactgraph.model import PerDegreeHead, SpringMassDamper
from contactgraph.model.types import LocalInput, Step

WIDTH, NODES = 6, 3
STEP = Step(jnp.zeros(()), DT, 2)


@eqx.filter_jit
def parameters(*arguments) -> SpringMassDamper:
    return PerDegreeHead(WIDTH, 2, key=jax.random.PRNGKey(1))(*arguments, STEP)


def inputs() -> tuple[LocalInput, jax.Array, jax.Array]:
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape).astype(np.float32))

    position, velocity = normal(NODES, 2), normal(NODES, 2)
    pairs = jnp.asarray(pair_indices(NODES))
    local = LocalInput(
        position=position,
        velocity=velocity,
        node_type=jnp.zeros((NODES, 2)),
        actuated=jnp.zeros(NODES),
        node_features=jnp.zeros((NODES, 0)),
        edge_features=jnp.zeros((2, len(pairs), 0)),
        weight=jnp.ones((len(pairs), 1)),
        geometry=jitted_geometry(position, velocity, pairs.T, DT, 0.1),
        anchor=None,
        nodes=nodes_of(NODES),
        control_displacement=None,
    )
    return local, normal(NODES, WIDTH), normal(1, 2, len(pairs), WIDTH)


def test_the_papers_parameters_are_bounded_and_its_damper_rests() -> None:
    local, embedding, message = inputs()
    found = parameters(local, embedding, message)
    for rate in (found.inverse_mass, found.stiffness_rate, found.damping_rate):
        assert rate.shape == (NODES, 2)
        assert np.all((rate > 0) & (rate < 5))
    assert not np.any(found.equilibrium_velocity) and not np.any(found.impact_displacement)
    off_diagonal = found.response * (1 - jnp.eye(2))
    assert not np.any(off_diagonal), "each degree of freedom takes its own control"


def test_the_equilibrium_is_relative_to_the_hinge_if_any() -> None:
    local, embedding, message = inputs()
    free = parameters(local, embedding, message)
    hinge = jnp.array([2.0, -1.0])
    anchor = jnp.full((NODES, 2), jnp.nan).at[1].set(hinge)
    hung = parameters(dataclasses.replace(local, anchor=anchor), embedding, message)
    moved = hung.equilibrium - free.equilibrium
    np.testing.assert_allclose(moved[1], hinge - local.position[1], atol=1e-6)
    np.testing.assert_array_equal(moved[jnp.array([0, 2])], 0.0)
    assert np.all(np.isfinite(hung.equilibrium))
