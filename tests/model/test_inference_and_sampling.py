"""Edge inference's three answers, sampled edges, and messages."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from contactgraph.data.graph import pair_indices
from contactgraph.model import (
    AllEdges,
    ArgmaxSample,
    ContactBelief,
    EdgeNetwork,
    GumbelSample,
    MemorylessEdges,
    MessagePassing,
    RecurrentEdges,
    TypedMessagePassing,
    two_type_belief,
)

NODES, NODE_SIZE, EDGE_SIZE, WIDTH = 4, 3, 2, 8
ENDS = jnp.asarray(pair_indices(NODES).T)
EDGES = ENDS.shape[1]


def passing(seed: int = 0) -> MessagePassing:
    return MessagePassing(NODE_SIZE, EDGE_SIZE, WIDTH, key=jax.random.PRNGKey(seed))


def graph(seed: int = 1):
    keys = jax.random.split(jax.random.PRNGKey(seed), 3)
    node = jax.random.normal(keys[0], (NODES, NODE_SIZE))
    edge = jax.random.normal(keys[1], (2, EDGES, EDGE_SIZE))
    return node, edge, jax.random.uniform(keys[2], (EDGES,))


@pytest.fixture(scope="module")
def recurrent() -> RecurrentEdges:
    return RecurrentEdges(passing(), key=jax.random.PRNGKey(1))


@settings(max_examples=100, deadline=None)
@given(
    probability=st.floats(0, 1),
    scores=st.lists(st.floats(-1e4, 1e4), min_size=6, max_size=6),
)
def test_recurrent_beliefs_are_beliefs(recurrent, probability, scores) -> None:
    belief = two_type_belief(jnp.array([probability], jnp.float32))
    found = np.asarray(recurrent.predict(belief, jnp.array([scores])).type_probability)
    assert np.all((found >= 0) & (found <= 1))
    np.testing.assert_allclose(found.sum(axis=-1), 1, atol=1e-6)


def test_recurrent_edges_can_be_sure(recurrent) -> None:
    # The cell's state lies in [-1, 1]; without a temperature its softmax ends at 0.88.
    sure = jnp.array([[0.0, 0.0, -50.0, -50.0, -50.0, 50.0]])
    found = recurrent.predict(two_type_belief(jnp.array([0.5])), sure)
    assert found.probability[0] > 0.9999
    blunt = RecurrentEdges(passing(), temperature=1.0, key=jax.random.PRNGKey(1))
    assert blunt.predict(two_type_belief(jnp.array([0.5])), sure).probability[0] < 0.89


def test_the_cell_is_a_gated_recurrent_unit(recurrent) -> None:
    """Against the equations, with the library's own cell as the judge."""
    cell = eqx.nn.GRUCell(WIDTH, 2, key=jax.random.PRNGKey(0))
    mixed, hidden = recurrent.input, recurrent.hidden
    cell = eqx.tree_at(
        lambda cell: (cell.weight_ih, cell.weight_hh, cell.bias, cell.bias_n),
        cell,
        (mixed.weight, hidden.weight, mixed.bias + hidden.bias.at[4:].set(0.0), hidden.bias[4:]),
    )
    message = jax.random.normal(jax.random.PRNGKey(4), (WIDTH,))
    state = jnp.array([0.3, 0.7])
    expected = jax.nn.softmax(cell(message, state) / recurrent.temperature)
    found = recurrent.predict(ContactBelief(state[None]), mixed(message)[None])
    np.testing.assert_allclose(found.type_probability[0], expected, atol=1e-6)


def test_memoryless_edges_ignore_the_belief() -> None:
    edges = MemorylessEdges(passing(), key=jax.random.PRNGKey(1))
    embedding = edges.embed(*graph(), ENDS)
    found = [
        edges.predict(two_type_belief(jnp.full(EDGES, p)), embedding).type_probability
        for p in (0.0, 1.0)
    ]
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("types", [2, 3])
def test_all_edges_are_surely_active(types) -> None:
    edges = AllEdges(edge_types=types)
    belief = ContactBelief(jnp.full((EDGES, types), 1.0 / types))
    found = edges.predict(belief, edges.embed(*graph(), ENDS))
    np.testing.assert_array_equal(found.type_probability, np.eye(types)[[1] * EDGES])


def test_edge_inference_is_symmetric_in_the_end_nodes(recurrent) -> None:
    node, edge, weight = graph()
    one = recurrent.embed(node, edge, weight, ENDS)
    other = recurrent.embed(node, edge[::-1], weight, ENDS[::-1])
    np.testing.assert_allclose(one, other, atol=1e-6)


def test_an_edge_of_weight_zero_does_not_exist() -> None:
    network = passing()
    node, edge, weight = graph()
    without = weight.at[2].set(0.0)
    kept = jnp.array([0, 1, 3, 4, 5])
    found, messages = network(node, edge, without, ENDS)
    expected, fewer = network(node, edge[:, kept], weight[kept], ENDS[:, kept])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(messages[:, kept], fewer, atol=1e-6)
    assert not np.any(messages[:, 2])


def test_typed_messages_are_summed_over_the_types() -> None:
    networks = [passing(0), passing(1)]
    node, edge, _ = graph()
    weight = jnp.asarray(np.random.default_rng(0).uniform(size=(EDGES, 2)), jnp.float32)
    found, messages = TypedMessagePassing(networks)(node, edge, weight, ENDS)
    alone = [network(node, edge, weight[:, i], ENDS) for i, network in enumerate(networks)]
    np.testing.assert_allclose(found, alone[0][0] + alone[1][0], atol=1e-6)
    assert messages.shape == (2, 2, EDGES, WIDTH)
    np.testing.assert_array_equal(messages[1], alone[1][1])


def test_the_factored_first_layer_is_one_layer_on_both_ends_and_the_edge() -> None:
    network = MessagePassing(NODE_SIZE, EDGE_SIZE, WIDTH, rounds=1, key=jax.random.PRNGKey(0))
    only = network.steps[0]
    node, edge, weight = graph()
    _, messages = network(node, edge, weight, ENDS)
    whole = jnp.concatenate([only.receiver.weight, only.sender.weight, only.edge.weight], axis=1)
    for index, (first, second) in enumerate(pair_indices(NODES)):
        for way, (receiver, sender) in enumerate([(first, second), (second, first)]):
            inputs = jnp.concatenate([node[receiver], node[sender], edge[way, index]])
            hidden = jax.nn.relu(whole @ inputs + only.receiver.bias)
            expected = jax.nn.relu(only.message(hidden)) * weight[index]
            np.testing.assert_allclose(messages[way, index], expected, atol=1e-5)


def test_an_edge_networks_message_is_its_edges_own_affair() -> None:
    network = EdgeNetwork(EDGE_SIZE, WIDTH, key=jax.random.PRNGKey(0))
    node, edge, weight = graph()
    embedding, message = network(node, edge, weight, ENDS)
    assert embedding.shape == (NODES, 0) and message.shape == (2, EDGES, WIDTH)
    np.testing.assert_array_equal(message[0], message[1])
    # Nodes, connectivity, the order of end nodes and other edges have no effect.
    _, same = network(node + 1.0, edge[::-1], weight, ENDS[::-1])
    np.testing.assert_allclose(same, message, atol=1e-6)
    _, alone = network(node, edge[:, 2:3], weight[2:3], ENDS[:, 2:3])
    np.testing.assert_allclose(alone[:, 0], message[:, 2], atol=1e-6)
    # Weights scale: an edge of weight 0 does not exist.
    _, half = network(node, edge, 0.5 * weight.at[4].set(0.0), ENDS)
    kept = jnp.arange(EDGES) != 4
    np.testing.assert_allclose(half[:, kept], 0.5 * message[:, kept], atol=1e-6)
    assert not np.any(half[:, 4]) and np.any(message > 0)


def test_edge_networks_stand_in_for_messages_of_any_kind() -> None:
    key = jax.random.PRNGKey(0)
    network = EdgeNetwork(EDGE_SIZE, WIDTH, key=key)
    node, edge, weight = graph()
    for edges in (RecurrentEdges(network, key=key), MemorylessEdges(network, key=key)):
        found = edges.predict(
            two_type_belief(jnp.full(EDGES, 0.5)), edges.embed(node, edge, weight, ENDS)
        )
        np.testing.assert_allclose(found.type_probability.sum(axis=-1), 1, atol=1e-6)
        assert np.ptp(found.probability) > 1e-3
    _, messages = TypedMessagePassing([network, network])(
        node, edge, jnp.stack([weight, 0 * weight], axis=-1), ENDS
    )
    assert np.any(messages[0]) and not np.any(messages[1])


PROBABILITY = jnp.array([[0.7, 0.2, 0.1], [0.05, 0.05, 0.9]])


def test_argmax_takes_the_most_probable_type_and_passes_the_gradient_on() -> None:
    sample = ArgmaxSample()
    np.testing.assert_array_equal(sample(PROBABILITY, None), [[1, 0, 0], [0, 0, 1]])
    weight = jnp.arange(6.0).reshape(2, 3)
    slope = jax.grad(lambda p: jnp.sum(weight * sample(p, None)))(PROBABILITY)
    np.testing.assert_array_equal(slope, weight)


def test_gumbel_draws_with_the_right_frequency() -> None:
    count = 20_000
    keys = jax.random.split(jax.random.PRNGKey(0), count)
    draws = jax.vmap(lambda key: GumbelSample()(PROBABILITY, key))(keys)
    np.testing.assert_allclose(draws.sum(axis=-1), 1, atol=1e-6)
    error = np.sqrt(PROBABILITY * (1 - PROBABILITY) / count)
    assert np.all(np.abs(draws.mean(axis=0) - PROBABILITY) < 4.5 * error)


def test_gumbel_never_draws_the_impossible_and_needs_no_key_to_plan() -> None:
    keys = jax.random.split(jax.random.PRNGKey(0), 2000)
    sure = jnp.array([[0.0, 1.0]])
    sample = GumbelSample()

    def drawn_and_slope(key):
        return jax.value_and_grad(lambda p: sample(p, key)[0, 1])(sure)

    draws, slopes = jax.vmap(drawn_and_slope)(keys)
    assert np.all(draws == 1) and np.all(np.isfinite(slopes))
    np.testing.assert_array_equal(sample(PROBABILITY, None), ArgmaxSample()(PROBABILITY, None))


@pytest.mark.usefixtures("double_precision")
def test_gumbels_gradient_is_that_of_the_softened_draw() -> None:
    key, sample = jax.random.PRNGKey(3), GumbelSample(0.7)
    probability = jnp.asarray(np.asarray(PROBABILITY), jnp.float64)

    def soft(p):
        noise = jax.random.gumbel(key, p.shape, p.dtype)
        return jax.nn.softmax((jnp.log(p) + noise) / 0.7, axis=-1)

    weight = jnp.arange(6.0).reshape(2, 3)
    found = jax.grad(lambda p: jnp.sum(weight * sample(p, key)))(probability)
    expected = jax.grad(lambda p: jnp.sum(weight * soft(p)))(probability)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    check_grads(soft, (probability,), order=1, eps=1e-6)
