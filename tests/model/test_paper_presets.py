"""The paper's forms: what each has, what its options change, and its head."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import DT, nodes_of, state_at, with_random_weights

from contactgraph.bodies.graph import EncodedGraph
from contactgraph.data.graph import pair_indices
from contactgraph.inference.contact_belief import nothing_active
from contactgraph.model import (
    PAPER_PRESETS,
    ContactDynamics,
    ModelConfig,
    PerDegreeHead,
    SpringMassDamper,
)
from contactgraph.model.paper import FreeLinearDynamics

CONFIG = ModelConfig(2, 2, DT, 0.1, width=8)
NODES = nodes_of(3)
# Node 1 is near both others, which are 0.4 m apart.
POSITION = jnp.array([[0.0, 0.0], [0.2, 0.0], [0.4, 0.0]])
encode = eqx.filter_jit(ContactDynamics.encode_state)


def made(name: str, **changes) -> ContactDynamics:
    config = dataclasses.replace(CONFIG, **changes)
    return with_random_weights(lambda: PAPER_PRESETS[name](config, key=jax.random.key(0)))


def weights(model: ContactDynamics) -> np.ndarray:
    """Of the pairs 0-1, 0-2 and 1-2; node 0 is actuated."""
    state = state_at(model, POSITION, jnp.zeros((3, 2)), NODES)
    return np.asarray(encode(model, state, jnp.zeros(2), NODES).weight)


@pytest.mark.parametrize("form", ["paper-literal", "paper-local"])
def test_a_form_has_the_models_that_the_paper_compares(form: str) -> None:
    whole = made(form)
    assert type(made(f"{form}-non-temp").inference).__name__ == "MemorylessEdges"
    assert type(made(f"{form}-no-gim").inference).__name__ == "PriorEdges"
    assert isinstance(made(f"{form}-full-ab").local_dynamics, FreeLinearDynamics)
    assert whole.local_dynamics.discretization.learned == (form == "paper-local")
    assert type(whole.features).__name__ == "AbsoluteFeatures"
    assert whole.prior.threshold == CONFIG.contact_distance


def test_the_form_that_is_cared_for_infers_edges_of_near_nodes_alone() -> None:
    assert np.all(weights(made("paper-literal")) == 1.0)
    near, far, other = weights(made("paper-local"))
    assert near > 0.0 and other > 0.0 and far == 0.0
    assert np.all(weights(made("paper-local-no-gim")) == 1.0)


def test_a_star_has_the_edges_of_the_actuated_node() -> None:
    np.testing.assert_array_equal(weights(made("paper-literal", star=True)), [1.0, 1.0, 0.0])


def test_temperature_one_leaves_no_edge_certain() -> None:
    """The cell's state lies in [-1, 1], and starts from a belief within [0, 1]."""
    bound = 1.0 / (1.0 + np.exp(-2.0))
    for temperature, certain in ((1.0, False), (0.15, True)):
        model = made("paper-literal", temperature=temperature)
        state = state_at(model, POSITION, 5.0 * jnp.ones((3, 2)), NODES)
        graph = encode(model, state, jnp.zeros(2), NODES)
        graph = dataclasses.replace(graph, embedding=20.0 * graph.embedding)
        probability = np.asarray(model.predict_belief(state.belief, graph).type_probability)
        assert (probability.max() > bound + 1e-3) == certain


def test_edges_may_be_drawn_in_training() -> None:
    drawn, likeliest = made("paper-literal", gumbel=True), made("paper-literal")
    even = jnp.full((1000, 2), 0.5).at[:, 1].add(0.1)
    for model, share in ((drawn, 0.6 / 1.1), (likeliest, 1.0)):
        active = model.sample(even / 1.1, jax.random.key(1))[:, 1]
        assert float(jnp.mean(active)) == pytest.approx(share, abs=0.05)


WIDTH, COUNT = 6, 3


@eqx.filter_jit
def parameters_of(*arguments) -> SpringMassDamper:
    head = PerDegreeHead(WIDTH, 2, key=jax.random.PRNGKey(1))
    return head(*arguments, theta=jnp.zeros(()), dt=DT)


def graph_of_three() -> tuple[EncodedGraph, jax.Array, jax.Array]:
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape).astype(np.float32))

    position, velocity = normal(COUNT, 2), normal(COUNT, 2)
    model, pairs = made("paper-literal"), pair_indices(COUNT)
    nothing = nothing_active(model.inference.edge_types)
    graph = model.encode(position, velocity, jnp.zeros(2), nodes_of(COUNT), nothing)
    return graph, normal(COUNT, WIDTH), normal(1, 2, len(pairs), WIDTH)


def test_the_papers_parameters_are_bounded_and_its_damper_rests() -> None:
    graph, embedding, message = graph_of_three()
    found = parameters_of(graph, embedding, message)
    for rate in (found.inverse_mass, found.stiffness_rate, found.damping_rate):
        assert rate.shape == (COUNT, 2)
        assert np.all((rate > 0) & (rate < 5))
    assert not np.any(found.equilibrium_velocity) and not np.any(found.impact_displacement)
    off_diagonal = found.response * (1 - jnp.eye(2))
    assert not np.any(off_diagonal), "each degree of freedom takes its own control"


def test_the_equilibrium_is_relative_to_the_hinge_if_any() -> None:
    graph, embedding, message = graph_of_three()
    free = parameters_of(graph, embedding, message)
    hinge = jnp.array([2.0, -1.0])
    anchor = jnp.full((COUNT, 2), jnp.nan).at[1].set(hinge)
    nodes = graph.bodies.nodes._replace(anchor=anchor)
    hinged = dataclasses.replace(graph, bodies=graph.bodies._replace(nodes=nodes))
    hung = parameters_of(hinged, embedding, message)
    moved = hung.equilibrium - free.equilibrium
    np.testing.assert_allclose(moved[1], hinge - graph.bodies.position[1], atol=1e-6)
    np.testing.assert_array_equal(moved[jnp.array([0, 2])], 0.0)
    assert np.all(np.isfinite(hung.equilibrium))
