"""Edge inference's three answers, sampled edges, and messages."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from model_scenes import compiled

from contactgraph.data.graph import pair_indices
from contactgraph.model import (
    HOLD,
    TOUCH,
    ArgmaxSample,
    ContactBelief,
    EdgeNetwork,
    GumbelSample,
    MemorylessEdges,
    MessagePassing,
    PriorEdges,
    RecurrentEdges,
    TypedMessagePassing,
    two_type_belief,
    usual_edge_types,
)

NODES, NODE_SIZE, EDGE_SIZE, WIDTH = 4, 3, 2, 8
ENDS = jnp.asarray(pair_indices(NODES).T)
EDGES = ENDS.shape[1]


def passing(seed: int = 0) -> MessagePassing:
    return MessagePassing(NODE_SIZE, EDGE_SIZE, WIDTH, key=jax.random.PRNGKey(seed))


def graph(seed: int = 1):
    rng = np.random.default_rng(seed)
    node = rng.normal(size=(NODES, NODE_SIZE))
    edge = rng.normal(size=(2, EDGES, EDGE_SIZE))
    return tuple(values.astype(np.float32) for values in (node, edge, rng.uniform(size=EDGES)))


@pytest.fixture(scope="module")
def recurrent() -> RecurrentEdges:
    return RecurrentEdges(passing(), key=jax.random.PRNGKey(1))


def predicted(edges, probability, embedding):
    belief = two_type_belief(probability)
    return edges.predict(belief, embedding, belief.type_probability)[0].type_probability


@settings(max_examples=100, deadline=None)
@given(
    probability=st.floats(0, 1),
    scores=st.lists(st.floats(-1e4, 1e4), min_size=6, max_size=6),
)
def test_recurrent_beliefs_are_beliefs(recurrent, probability, scores) -> None:
    found = np.asarray(compiled(predicted, recurrent, np.array([probability]), np.array([scores])))
    assert np.all((found >= 0) & (found <= 1))
    np.testing.assert_allclose(found.sum(axis=-1), 1, atol=1e-6)


def test_recurrent_edges_can_be_sure(recurrent) -> None:
    # The cell's state lies in [-1, 1]; without a temperature its softmax ends at 0.88.
    sure = np.array([[0.0, 0.0, -50.0, -50.0, -50.0, 50.0]])
    assert compiled(predicted, recurrent, np.array([0.5]), sure)[0, 1] > 0.9999
    blunt = RecurrentEdges(passing(), temperature=1.0, key=jax.random.PRNGKey(1))
    assert compiled(predicted, blunt, np.array([0.5]), sure)[0, 1] < 0.89


def test_the_cell_is_a_gated_recurrent_unit(recurrent) -> None:
    """Against the equations, with the library's own cell as the judge."""
    cell = eqx.nn.GRUCell(WIDTH, 2, key=jax.random.PRNGKey(0))
    mixed, hidden = recurrent.output, recurrent.hidden
    hidden_bias = np.asarray(hidden.bias)
    gates = np.where(np.arange(6) < 4, hidden_bias, 0.0)
    cell = eqx.tree_at(
        lambda cell: (cell.weight_ih, cell.weight_hh, cell.bias, cell.bias_n),
        cell,
        (mixed.weight, hidden.weight, np.asarray(mixed.bias) + gates, hidden_bias[4:]),
    )

    @eqx.filter_jit
    def both(message, state):
        found, _ = recurrent.predict(ContactBelief(state[None]), mixed(message)[None], state[None])
        expected = jax.nn.softmax(cell(message, state) / recurrent.temperature)
        return found.type_probability[0], expected

    message = np.random.default_rng(4).normal(size=WIDTH).astype(np.float32)
    found, expected = both(message, np.array([0.3, 0.7], np.float32))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_memoryless_edges_ignore_the_belief() -> None:
    edges = MemorylessEdges(passing(), key=jax.random.PRNGKey(1))
    embedding = compiled(edges.embed, *graph(), ENDS)
    found = [compiled(predicted, edges, np.full(EDGES, p), embedding) for p in (0.0, 1.0)]
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("types", [2, 3])
def test_all_edges_are_surely_active(types) -> None:
    edges = PriorEdges(usual_edge_types(types), least=1.0)
    belief = ContactBelief(jnp.full((EDGES, types), 1.0 / types))
    found, _ = edges.predict(belief, edges.embed(*graph(), ENDS), belief.type_probability)
    np.testing.assert_array_equal(found.type_probability, np.eye(types)[[1] * EDGES])


@pytest.mark.parametrize(("active_type", "expected"), [(1, [0.7, 0.3, 0.0]), (2, [0.7, 0.0, 0.3])])
def test_prior_edges_forget_the_belief_and_put_all_of_the_prior_into_one_type(
    active_type, expected
) -> None:
    edges = PriorEdges((TOUCH, HOLD), active_type)
    prior = jnp.tile(jnp.array([0.7, 0.15, 0.15]), (EDGES, 1))
    for certain in np.eye(3):
        belief = ContactBelief(jnp.tile(certain, (EDGES, 1)))
        found, _ = edges.predict(belief, edges.embed(*graph(), ENDS), prior)
        np.testing.assert_allclose(found.type_probability, [expected] * EDGES, rtol=1e-6)


def test_edge_inference_is_symmetric_in_the_end_nodes(recurrent) -> None:
    node, edge, weight = graph()
    one = compiled(recurrent.embed, node, edge, weight, ENDS)
    other = compiled(recurrent.embed, node, edge[::-1], weight, ENDS[::-1])
    np.testing.assert_allclose(one, other, atol=1e-6)


def test_an_edge_of_weight_zero_does_not_exist() -> None:
    network = passing()
    node, edge, weight = graph()
    without = weight * (np.arange(EDGES) != 2)
    kept = np.array([0, 1, 3, 4, 5])
    found, messages = compiled(network, node, edge, without, ENDS)
    fewer_ends = np.asarray(ENDS)[:, kept]
    expected, fewer = compiled(network, node, edge[:, kept], weight[kept], fewer_ends)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    messages = np.asarray(messages)
    np.testing.assert_allclose(messages[:, kept], fewer, atol=1e-6)
    assert not np.any(messages[:, 2])


def test_typed_messages_are_summed_over_the_types() -> None:
    networks = [passing(0), passing(1)]
    node, edge, _ = graph()
    weight = np.random.default_rng(0).uniform(size=(EDGES, 2)).astype(np.float32)
    found, messages = compiled(TypedMessagePassing(networks), node, edge, weight, ENDS)
    alone = [
        jax.tree.map(np.asarray, compiled(network, node, edge, weight[:, i], ENDS))
        for i, network in enumerate(networks)
    ]
    np.testing.assert_allclose(found, alone[0][0] + alone[1][0], atol=1e-6)
    assert messages.shape == (2, 2, EDGES, WIDTH)
    np.testing.assert_array_equal(np.asarray(messages)[1], alone[1][1])


def test_the_factored_first_layer_is_one_layer_on_both_ends_and_the_edge() -> None:
    network = MessagePassing(NODE_SIZE, EDGE_SIZE, WIDTH, rounds=1, key=jax.random.PRNGKey(0))
    only = network.steps[0]
    node, edge, weight = graph()
    _, messages = compiled(network, node, edge, weight, ENDS)
    messages, bias = np.asarray(messages), np.asarray(only.receiver.bias)
    whole = np.concatenate([only.receiver.weight, only.sender.weight, only.edge.weight], axis=1)
    for index, (first, second) in enumerate(pair_indices(NODES)):
        for way, (receiver, sender) in enumerate([(first, second), (second, first)]):
            inputs = np.concatenate([node[receiver], node[sender], edge[way, index]])
            hidden = np.maximum(whole @ inputs + bias, 0.0)
            expected = np.maximum(compiled(only.message, hidden), 0.0) * weight[index]
            np.testing.assert_allclose(messages[way, index], expected, atol=1e-5)


def test_an_edge_networks_message_is_its_edges_own_affair() -> None:
    network = EdgeNetwork(EDGE_SIZE, WIDTH, key=jax.random.PRNGKey(0))
    node, edge, weight = graph()
    embedding, message = compiled(network, node, edge, weight, ENDS)
    assert embedding.shape == (NODES, 0) and message.shape == (2, EDGES, WIDTH)
    np.testing.assert_array_equal(message[0], message[1])
    # Nodes, connectivity, the order of end nodes and other edges have no effect.
    _, same = compiled(network, node + 1.0, edge[::-1], weight, ENDS[::-1])
    np.testing.assert_allclose(same, message, atol=1e-6)
    _, alone = compiled(network, node, edge[:, 2:3], weight[2:3], ENDS[:, 2:3])
    message = np.asarray(message)
    np.testing.assert_allclose(np.asarray(alone)[:, 0], message[:, 2], atol=1e-6)
    # Weights scale: an edge of weight 0 does not exist.
    kept = np.arange(EDGES) != 4
    half = np.asarray(compiled(network, node, edge, 0.5 * weight * kept, ENDS)[1])
    np.testing.assert_allclose(half[:, kept], 0.5 * message[:, kept], atol=1e-6)
    assert not np.any(half[:, 4]) and np.any(message > 0)


PROBABILITY = np.array([[0.7, 0.2, 0.1], [0.05, 0.05, 0.9]], np.float32)


def test_argmax_takes_the_most_probable_type_and_passes_the_gradient_on() -> None:
    sample = ArgmaxSample()
    np.testing.assert_array_equal(compiled(sample, PROBABILITY, None), [[1, 0, 0], [0, 0, 1]])
    weight = np.arange(6.0).reshape(2, 3)
    slope = jax.jit(jax.grad(lambda p: jnp.sum(weight * sample(p, None))))(PROBABILITY)
    np.testing.assert_array_equal(slope, weight)


def test_doubt_between_touch_and_hold_does_not_part_bodies() -> None:
    beliefs = np.array([[0.4, 0.25, 0.35], [0.4, 0.35, 0.25], [0.5, 0.3, 0.2]], np.float32)
    taken = np.argmax(compiled(ArgmaxSample(), beliefs, None), axis=-1)
    np.testing.assert_array_equal(taken, [2, 1, 0])


def test_gumbel_draws_with_the_right_frequency() -> None:
    count = 20_000
    keys = jax.random.split(jax.random.PRNGKey(0), count)
    draws = np.asarray(jax.jit(jax.vmap(lambda key: GumbelSample()(PROBABILITY, key)))(keys))
    np.testing.assert_allclose(draws.sum(axis=-1), 1, atol=1e-6)
    error = np.sqrt(PROBABILITY * (1 - PROBABILITY) / count)
    assert np.all(np.abs(draws.mean(axis=0) - PROBABILITY) < 4.5 * error)


def test_gumbel_never_draws_the_impossible_and_needs_no_key_to_plan() -> None:
    keys = jax.random.split(jax.random.PRNGKey(0), 2000)
    sure = np.array([[0.0, 1.0]], np.float32)
    sample = GumbelSample()

    def drawn_and_slope(key):
        return jax.value_and_grad(lambda p: sample(p, key)[0, 1])(sure)

    draws, slopes = jax.jit(jax.vmap(drawn_and_slope))(keys)
    assert np.all(draws == 1) and np.all(np.isfinite(slopes))
    without_key = compiled(sample, PROBABILITY, None)
    np.testing.assert_array_equal(without_key, compiled(ArgmaxSample(), PROBABILITY, None))


@pytest.mark.usefixtures("double_precision")
def test_gumbels_gradient_is_that_of_the_softened_draw() -> None:
    key, sample = jax.random.PRNGKey(3), GumbelSample(0.7)
    probability = PROBABILITY.astype(np.float64)

    def soft(p):
        noise = jax.random.gumbel(key, p.shape, p.dtype)
        return jax.nn.softmax((jnp.log(p) + noise) / 0.7, axis=-1)

    weight = np.arange(6.0).reshape(2, 3)
    found = jax.jit(jax.grad(lambda p: jnp.sum(weight * sample(p, key))))(probability)
    expected = jax.jit(jax.grad(lambda p: jnp.sum(weight * soft(p))))(probability)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    check_grads(jax.jit(soft), (probability,), order=1, eps=1e-6)
