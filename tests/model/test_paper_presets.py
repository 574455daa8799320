"""The paper's forms: what each has, and what its options change."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import DT, nodes_of, state_at, with_random_weights

from contactgraph.model import PAPER_PRESETS, ContactDynamics, ModelConfig
from contactgraph.model.local_dynamics import FreeLinearDynamics

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
    return np.asarray(encode(model, state, NODES).weight)


@pytest.mark.parametrize("form", ["paper-literal", "paper-local"])
def test_a_form_has_the_models_that_the_paper_compares(form: str) -> None:
    whole = made(form)
    assert type(made(f"{form}-non-temp").inference).__name__ == "MemorylessEdges"
    assert type(made(f"{form}-no-gim").inference).__name__ == "AllEdges"
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
        graph = encode(model, state, NODES)
        graph = dataclasses.replace(graph, embedding=20.0 * graph.embedding)
        probability = np.asarray(model.predict_belief(state.belief, graph).type_probability)
        assert (probability.max() > bound + 1e-3) == certain


def test_edges_may_be_drawn_in_training() -> None:
    drawn, likeliest = made("paper-literal", gumbel=True), made("paper-literal")
    even = jnp.full((1000, 2), 0.5).at[:, 1].add(0.1)
    for model, share in ((drawn, 0.6 / 1.1), (likeliest, 1.0)):
        active = model.sample(even / 1.1, jax.random.key(1))[:, 1]
        assert float(jnp.mean(active)) == pytest.approx(share, abs=0.05)
