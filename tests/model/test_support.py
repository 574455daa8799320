"""Ground support: the lifted fraction, and its effect on a step."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import jitted_geometry, with_random_weights

from contactgraph.data import pair_indices
from contactgraph.dynamics.free_bodies import lifted_fraction
from contactgraph.large_scenes.block_inverse import GroupsOf
from contactgraph.model import (
    PRESETS,
    ContactBelief,
    ContactDynamics,
    ModelConfig,
    ModelState,
    Nodes,
)

jitted_fraction = eqx.filter_jit(lifted_fraction)

pytestmark = pytest.mark.usefixtures("double_precision")
DT = 0.01
WEIGHT = np.array([0.0, 0.0, -3.9])


@cache
def model_with_weight() -> ContactDynamics:
    """Its unactuated nodes weigh 3.9 N and rub on the ground, nothing reaches them otherwise."""
    config = ModelConfig(3, 3, DT, 0.05)
    model = with_random_weights(
        lambda: PRESETS["ours-recurrent"](config, key=jax.random.PRNGKey(0))
    )
    head = model.local_dynamics.head
    last = head.edge.layers[-1]
    head = eqx.tree_at(
        lambda h: (
            h.log_mass,
            h.damper_raw,
            h.edge.layers[-1].weight,
            h.edge.layers[-1].bias,
        ),
        head,
        (
            jnp.log(jnp.array([0.4, 4.0])) / 5.0,
            jnp.full(2, 1.2),  # 0.7 1/s
            jnp.zeros_like(last.weight),
            # Holds as firmly as an edge can, without a spring.
            jnp.array([20.0, -40.0, 0.0]),
        ),
    )
    return eqx.tree_at(lambda m: m.local_dynamics.head, model, head)


def state(velocity: np.ndarray, active: list[float]) -> tuple[ModelState, Nodes]:
    position = jnp.asarray([[0.0, 0.0, 0.3], [0.0, 0.0, 0.29], [0.0, 0.02, 0.29]])
    probability = np.array(active)
    belief = ContactBelief(jnp.asarray(np.stack([1.0 - probability, probability], axis=-1)))
    nodes = Nodes(jnp.asarray(np.arange(3) == 0), jnp.ones(3, bool), jnp.asarray(probability > 0.5))
    nodes = nodes._replace(gravity=jnp.asarray(WEIGHT / 0.4))
    return ModelState(position, jnp.asarray(velocity), belief), nodes


@eqx.filter_jit
def next_velocity(
    model: ContactDynamics, start: ModelState, nodes: Nodes, control: jax.Array
) -> jax.Array:
    encoded = model.encode_state(start, control, nodes)
    linear = model.linearize(model.cut_edges(encoded, start.belief))
    return linear(start.position, start.velocity, control)[1]


def change(active: list[float], velocity: np.ndarray, control: np.ndarray) -> np.ndarray:
    """[N, D] m/s: change of the velocities in a step in which exactly these edges hold."""
    found = next_velocity(model_with_weight(), *state(velocity, active), jnp.asarray(control))
    return np.asarray(found) - velocity


def test_supported_nodes_rest_and_have_no_weight() -> None:
    found = change([0.0, 0.0, 1.0], np.zeros((3, 3)), np.array([0.0, 0.0, 8.0]))
    assert np.allclose(found[0], [0, 0, DT * 8.0], rtol=1e-6)
    assert np.allclose(found[1:], 0.0, atol=1e-12), "two blocks that touch do not fall"


def test_a_carried_node_loads_its_carrier() -> None:
    found = change([1.0, 0.0, 0.0], np.zeros((3, 3)), np.array([0.0, 0.0, 8.0]))
    together = DT * (4.0 * 8.0 + WEIGHT[2]) / 4.4
    assert np.allclose(found[:2, 2], together, rtol=0.02)
    assert np.allclose(found[2], 0.0)


def test_weight_reaches_along_a_chain() -> None:
    found = change([1.0, 0.0, 1.0], np.zeros((3, 3)), np.zeros(3))
    assert np.allclose(found[:, 2], DT * 2 * WEIGHT[2] / 4.8, rtol=0.03)


def test_ground_friction_acts_on_supported_nodes_only() -> None:
    sliding = np.tile([0.2, 0.0, 0.0], (3, 1))
    free, held = (change(active, sliding, np.zeros(3)) for active in ([0.0] * 3, [1.0, 0.0, 0.0]))
    assert free[1, 0] < -1e-4
    assert abs(held[1, 0]) < 0.1 * abs(free[1, 0])


def test_carried_is_the_best_chain_to_an_actuated_node() -> None:
    position = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)))
    pairs = pair_indices(4)
    hold = jnp.asarray([{(0, 1): 0.9, (1, 2): 0.5}.get((i, j), 0.0) for i, j in pairs.tolist()])
    edges = jitted_geometry(position, np.zeros((4, 3)), jnp.asarray(pairs.T), DT, 0.05)
    actuated = jnp.asarray([1.0, 0.0, 0.0, 0.0])
    share = jitted_fraction(actuated, hold, edges)
    assert np.allclose(share, [1.0, 0.9, 0.45, 0.0])
    # Propagated along the edges, where no more than so many hold each other.
    assert np.array_equal(jitted_fraction(actuated, hold, edges, GroupsOf(3)), share)
    assert not np.array_equal(jitted_fraction(actuated, hold, edges, GroupsOf(2)), share)


def test_a_given_contact_distance_is_not_a_model_weight() -> None:
    model = PRESETS["ours-recurrent"](
        ModelConfig(3, 3, DT, 0.02, learned_contact_distance=False), key=jax.random.PRNGKey(0)
    )
    assert model.features.contact_distance == 0.02
    assert not eqx.is_array(model.features.contact_distance)
