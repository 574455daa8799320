"""The hidden Markov filter of an edge: its transitions, Bayes' rule over three types, its clock."""

import dataclasses
import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import DT, assert_same, compiled, nodes_of, slippery_bodies, with_random_weights

from contactgraph.data import InvalidInputError
from contactgraph.inference.contact_belief import (
    nothing_active,
    posterior_by_motion,
    without_change,
)
from contactgraph.inference.edge_inference import EdgeClock, PriorEdges
from contactgraph.inference.features import stillness
from contactgraph.large_scenes import NeighborList
from contactgraph.model import (
    HOLD,
    TOUCH,
    ContactBelief,
    ContactDynamics,
    ContactSensor,
    EdgeNetwork,
    EdgeType,
    ModelConfig,
    ModelState,
    TransitionEdges,
    correct,
    ours,
    usual_edge_types,
)

STILL, NOTHING = jnp.zeros(2), nothing_active((TOUCH, HOLD))

LEAST = 2e-3
pytestmark = pytest.mark.usefixtures("double_precision")


def edges(types: int, seed: int | None = None) -> TransitionEdges:
    """Fresh, or with random weights."""
    network = EdgeNetwork(4 + 2, 8, key=jax.random.PRNGKey(0))

    def construct() -> TransitionEdges:
        return TransitionEdges(
            network, node_types=2, edge_types=usual_edge_types(types), key=jax.random.PRNGKey(1)
        )

    return construct() if seed is None else with_random_weights(construct, seed)


def belief(*types: float) -> ContactBelief:
    clock = EdgeClock(*(jnp.zeros((1, size)) for size in (1, 8, len(types) - 1)))
    return ContactBelief(jnp.array([types]), memory=clock)


def bounded(types: np.ndarray) -> np.ndarray:
    return LEAST + (1.0 - types.shape[-1] * LEAST) * types


@pytest.mark.parametrize("before", [(1.0, 0.0, 0.0), (0.2, 0.3, 0.5)])
def test_fresh_transitions_are_the_geometric_prior(before) -> None:
    prior = np.array([[0.7, 0.2, 0.1]])
    found, _ = compiled(edges(3).predict, belief(*before), jnp.ones((1, 8)), jnp.asarray(prior))
    np.testing.assert_allclose(found.type_probability, bounded(prior), rtol=1e-6)


def test_a_row_of_rates_leads_from_its_own_type() -> None:
    inference = edges(2)
    stays = jnp.array([4.0, 0.0, 0.0, 4.0])  # from inactive to (inactive, active), then from active
    inference = eqx.tree_at(lambda each: each.rates.layers[-1].bias, inference, stays)
    prior = jnp.array([[0.5, 0.5]])
    kept = bounded(np.exp([4.0, 0.0]) / np.exp([4.0, 0.0]).sum())
    for before, expected in (((1.0, 0.0), kept), ((0.0, 1.0), kept[::-1])):
        found, _ = compiled(inference.predict, belief(*before), jnp.zeros((1, 8)), prior)
        np.testing.assert_allclose(found.type_probability[0], expected, rtol=1e-6)


def test_rates_beyond_the_least_transition_can_return() -> None:
    """There a step of gradient ascent was worth nothing, and an unlucky filter stayed as it was."""
    prior = jnp.array([[0.5, 0.5]])

    def changes(rate: float) -> jax.Array:
        never = jnp.array([rate, 0.0, 0.0, 0.0])  # from inactive to inactive
        inference = eqx.tree_at(lambda each: each.rates.layers[-1].bias, edges(2), never)
        after, _ = inference.predict(belief(1.0, 0.0), jnp.zeros((1, 8)), prior)
        return jnp.log(after.type_probability[0, 1])

    value, slope = compiled(jax.value_and_grad(changes), 40.0)
    np.testing.assert_allclose(value, np.log(LEAST), rtol=1e-6)
    np.testing.assert_allclose(slope, -0.1, rtol=1e-3)


def test_motion_corrects_three_types_by_bayes_rule() -> None:
    """The types in the end of a step are those of all pairs that lead to them."""
    rng = np.random.default_rng(1)
    joint, ratios = rng.dirichlet(np.ones(9)).reshape(3, 3), rng.normal(size=(3, 3))
    predicted = belief(*joint.sum(axis=0))

    def corrected(ratios: np.ndarray) -> np.ndarray:
        found = compiled(posterior_by_motion, predicted, jnp.asarray(joint)[None], ratios[None])
        return np.asarray(found.type_probability[0])

    expected = (joint * np.exp(ratios)).sum(axis=0)
    np.testing.assert_allclose(corrected(ratios), expected / expected.sum(), rtol=1e-6)
    np.testing.assert_array_equal(corrected(np.zeros((3, 3))), predicted.type_probability[0])


def test_without_transitions_no_type_changes_within_a_step_and_none_is_impossible() -> None:
    _, found = compiled(without_change, belief(0.999, 0.001))
    np.testing.assert_allclose(found[0], [[0.99, 0.0], [0.0, 0.01]], rtol=1e-6)


@pytest.mark.parametrize(
    ("reports_touch", "likelihood"), [(True, [0.1, 0.8, 0.8]), (False, [0.1, 0.1, 0.8])]
)
def test_a_sensor_of_holding_says_nothing_about_touch(reports_touch, likelihood) -> None:
    before = np.array([0.2, 0.5, 0.3])
    sensor = ContactSensor(false_alarm=0.1, miss=0.2, reports_touch=reports_touch)
    found = compiled(correct, belief(*before), jnp.array([1.0]), sensor)
    expected = before * likelihood
    np.testing.assert_allclose(found.type_probability[0], expected / expected.sum(), rtol=1e-6)


def test_the_filter_is_exact_where_transitions_are_known() -> None:
    """Against the sum over all paths of six steps."""
    inference, rng = edges(2), np.random.default_rng(0)
    rates = np.array([1.5, -0.5, -1.0, 0.8])
    inference = eqx.tree_at(lambda each: each.rates.layers[-1].bias, inference, jnp.asarray(rates))
    prior = np.array([[0.6, 0.4]])
    logits = np.log(prior) + rates.reshape(2, 2)
    transition = bounded(np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True))
    first, ratios = np.array([0.7, 0.3]), rng.normal(size=(6, 2, 2))

    @eqx.filter_jit
    def filtered(state: ContactBelief, ratios: jax.Array) -> ContactBelief:
        for ratio in ratios:
            predicted, joint = inference.predict(state, jnp.zeros((1, 8)), jnp.asarray(prior))
            state = posterior_by_motion(predicted, joint, ratio[None])
        return state

    found = filtered(belief(*first), jnp.asarray(ratios))
    weight = np.zeros(2)
    for path in itertools.product((0, 1), repeat=7):
        probability = first[path[0]]
        for step, (before, after) in enumerate(itertools.pairwise(path)):
            probability *= transition[before, after] * np.exp(ratios[step, before, after])
        weight[path[-1]] += probability
    np.testing.assert_allclose(found.type_probability[0], weight / weight.sum(), atol=1e-6)


def test_an_age_is_expected_given_the_type_and_known_by_motion() -> None:
    """Against all paths: how long an edge has had a type if it has it, however unlikely that is."""
    inference, rng = edges(3), np.random.default_rng(0)
    first, prior = np.array([0.2, 0.3, 0.5]), np.array([0.5, 0.3, 0.2])
    ratios = rng.normal(size=(3, 3, 3))
    corrected = belief(*first)
    for ratio in ratios:
        given = jnp.zeros((1, 8)), jnp.asarray(prior)[None]
        predicted, joint = compiled(inference.predict, corrected, *given)
        corrected = compiled(posterior_by_motion, predicted, joint, jnp.asarray(ratio)[None])
    weight, steps = np.zeros(3), np.zeros(3)
    for path in itertools.product(range(3), repeat=4):
        pairs = list(itertools.pairwise(path))
        moves = [ratio[pair] for ratio, pair in zip(ratios, pairs, strict=True)]
        likely = first[path[0]] * np.prod(bounded(prior)[list(path[1:])]) * np.exp(sum(moves))
        run = len(list(itertools.takewhile(lambda one, end=path[-1]: one == end, path[:0:-1])))
        weight[path[-1]] += likely
        steps[path[-1]] += likely * run
    np.testing.assert_allclose(corrected.type_probability[0], weight / weight.sum(), rtol=1e-6)
    np.testing.assert_allclose(corrected.memory.age[0], (steps / weight)[1:], rtol=1e-6)


def test_gradients_stay_finite_where_ages_are_of_improbable_types() -> None:
    """In single precision, with large rates: slopes of these ages multiplied from step to step."""
    single = jnp.float32

    def large(leaf: jax.Array) -> jax.Array:
        return 30.0 * leaf

    inference = edges(3, seed=2)
    for layer in (0, -1):
        inference = eqx.tree_at(
            lambda each, layer=layer: each.rates.layers[layer].weight, inference, replace_fn=large
        )
    cast = partial(jax.tree.map, lambda leaf: leaf.astype(single) if eqx.is_array(leaf) else leaf)
    inference, first = cast(inference), cast(belief(1.0, 0.0, 0.0))
    free = 6.0 * jnp.zeros((1, 3, 3), single).at[0, 0, 0].set(1.0)

    def score(embedding: jax.Array) -> jax.Array:
        def step(state: ContactBelief, embedding: jax.Array) -> tuple[ContactBelief, jax.Array]:
            prior = jnp.array([[1.0, 0.0, 0.0]], single)
            predicted, joint = inference.predict(state, embedding[None], prior)
            after = posterior_by_motion(predicted, joint, free)
            return after, after.type_probability

        return jnp.sum(jax.lax.scan(step, first, embedding)[1][:, 0, 0])

    slope = compiled(jax.grad(score), jax.random.normal(jax.random.PRNGKey(0), (200, 8), single))
    assert slope.dtype == single and np.all(np.isfinite(slope))


def test_an_embedding_is_bounded_whatever_the_weights() -> None:
    inference = edges(3, seed=2)
    large = jax.tree.map(
        lambda leaf: 1e4 * leaf if eqx.is_inexact_array(leaf) else leaf, inference.message_passing
    )
    inference = eqx.tree_at(lambda each: each.message_passing, inference, large)
    given = jnp.eye(2), jnp.ones((2, 1, 4)), jnp.ones(1), jnp.array([[0], [1]])
    found = compiled(inference.embed, *given)
    assert 0.9 < float(jnp.mean(found**2)) <= 1.0


def test_a_clock_runs_and_goes_from_list_to_list() -> None:
    inference = edges(3, seed=2)
    before = belief(0.2, 0.3, 0.5)
    once, _ = compiled(inference.predict, before, jnp.ones((1, 8)), before.type_probability)
    twice, _ = compiled(inference.predict, once, jnp.ones((1, 8)), before.type_probability)
    assert np.abs(np.asarray(once.memory.hidden)).max() > 0.01
    assert np.abs(np.asarray(twice.memory.hidden - once.memory.hidden)).max() > 1e-3
    clock = EdgeClock(jnp.arange(6.0)[:, None], jnp.arange(24.0).reshape(6, 4), jnp.ones((6, 2)))
    every = ContactBelief(jnp.tile(jnp.array([0.1, 0.2, 0.7]), (6, 1)), memory=clock)
    listed = every.over(jnp.array([1, 4, 6]), 6)
    back = listed.over(None, 6)
    for all_pairs, some, again in zip(
        *(jax.tree.leaves(each.memory) for each in (every, listed, back)), strict=True
    ):
        np.testing.assert_array_equal(some, [all_pairs[1], all_pairs[4], 0.0 * all_pairs[0]])
        np.testing.assert_array_equal(again[4], all_pairs[4])
        np.testing.assert_array_equal(again[0], 0.0)
    np.testing.assert_array_equal(back.type_probability[0], [1.0, 0.0, 0.0])


def test_the_rates_know_for_how_long_nothing_was_observed() -> None:
    inference = edges(2, seed=2)
    last = inference.rates.layers[-1]
    inference = eqx.tree_at(
        lambda each: each.rates.layers[-1].weight, inference, 0.3 + 0.0 * last.weight
    )
    inference = eqx.tree_at(
        lambda each: each.rates.layers[-1].bias, inference, 2.0 * jnp.eye(2).reshape(-1)
    )
    before = belief(0.2, 0.8)
    seen, _ = compiled(inference.predict, before, jnp.zeros((1, 8)), before.type_probability)
    np.testing.assert_array_equal(seen.memory.unobserved, 1.0)
    np.testing.assert_array_equal(seen.observed.memory.unobserved, 0.0)
    np.testing.assert_array_equal(seen.observed.memory.age, seen.memory.age)
    nothing = jnp.array([jnp.nan])
    assert_same(correct(seen, nothing, ContactSensor()).memory, seen.observed.memory)


def fresh(edge_types: int = 3) -> ContactDynamics:
    config = ModelConfig(2, 2, DT, width=8, edge_types=usual_edge_types(edge_types))
    return ours(config, key=jax.random.PRNGKey(0))


@pytest.mark.parametrize(("types", "coupling"), [(2, [1]), (5, [1, 1, 2 / 3, 1 / 3])])
def test_types_that_hold_start_apart(types, coupling) -> None:
    """By the share of its relative velocity that a lone pair loses in a step."""
    model = fresh(types)
    position = jnp.array([[0.0, 0.0], [0.08, 0.0]])
    velocity = jnp.array([[0.1, 0.0], [-0.1, 0.0]])
    nodes = nodes_of(2)._replace(actuated=jnp.zeros(2, bool))

    @eqx.filter_jit
    def coupled(model: ContactDynamics, types: jax.Array) -> jax.Array:
        graph = model.encode(position, velocity, STILL, nodes, NOTHING)
        cut = model.cut_edges(graph, ContactBelief(types[None]))
        after = model.linearize(cut)(position, velocity, STILL)[1]
        return 1.0 - (after[0, 0] - after[1, 0]) / (velocity[0, 0] - velocity[1, 0])

    found = np.array([coupled(model, kind) for kind in jnp.eye(types)])
    assert found[0] == pytest.approx(0.0, abs=1e-3), "free"
    # A damper of c / (1 - c) kg between two bodies of 1 kg takes 2 c / (1 + c).
    np.testing.assert_allclose(found[1:] / (2.0 - found[1:]), coupling, atol=0.1)


def test_the_law_follows_the_types_in_any_order_and_leaves_others_alone() -> None:
    """Bodies that approach each other; the networks of the types are the same in another order."""
    position = jnp.array([[0.0, 0.0], [0.08, 0.0]])
    velocity = jnp.array([[0.1, 0.1], [-0.1, 0.0]])
    usual = fresh()
    touch, hold = usual.local_dynamics.message_passing.types
    kinds = {"hold": (HOLD, hold), "magnet": (EdgeType("magnet"), hold), "touch": (TOUCH, touch)}
    config = ModelConfig(2, 2, DT, width=8, edge_types=tuple(kind for kind, _ in kinds.values()))
    networks = [network for _, network in kinds.values()]
    other = ours(config, key=jax.random.PRNGKey(0))
    where = lambda each: (each.local_dynamics.message_passing.types, each.local_dynamics.head)  # noqa: E731
    other = eqx.tree_at(where, other, (networks, usual.local_dynamics.head))

    @eqx.filter_jit
    def moved(model: ContactDynamics, index: int) -> jax.Array:
        types = jax.nn.one_hot(jnp.array([index]), 1 + len(model.inference.edge_types))
        graph = model.encode(position, velocity, STILL, nodes_of(2), NOTHING)
        cut = model.cut_edges(graph, ContactBelief(types, edge_types=model.inference.edge_types))
        return model.linearize(cut)(position, velocity, STILL)[1]

    for index, same in ((0, 0), (3, 1), (1, 2), (2, 0)):
        np.testing.assert_allclose(moved(other, index), moved(usual, same), atol=1e-6)
    assert not np.allclose(moved(usual, 1), moved(usual, 2)), "a touch does not pull"


@pytest.mark.parametrize("types", [-1, 0, 1, 17])
def test_a_number_of_edge_types_that_means_nothing_is_refused(types) -> None:
    with pytest.raises(InvalidInputError, match=f"edge types must be 2 to 16: .*found {types}"):
        usual_edge_types(types)


@pytest.mark.parametrize("coupling", [0.0, 1.5, float("nan")])
def test_a_coupling_outside_of_its_range_is_refused(coupling: float) -> None:
    with pytest.raises(InvalidInputError, match=r"coupling must lie in \(0, 1\]"):
        EdgeType("hold", holds=True, coupling=coupling)


def test_a_count_is_no_edge_types() -> None:
    with pytest.raises(InvalidInputError, match=r"usual_edge_types\(3\)"):
        ModelConfig(2, 2, DT, edge_types=3)  # type: ignore[arg-type]


def test_beliefs_of_an_inference_are_about_its_types() -> None:
    """Types in another order than the usual one."""
    inference = TransitionEdges(
        EdgeNetwork(6, 8, key=jax.random.PRNGKey(0)),
        node_types=2,
        edge_types=(HOLD, TOUCH),
        key=jax.random.PRNGKey(1),
    )
    embedding, prior = jnp.ones((1, 8)), jnp.array([[0.1, 0.8, 0.1]])
    first = inference.init(embedding, prior)
    predicted, _ = inference.predict(first, embedding, prior)
    for each in (first, predicted):
        np.testing.assert_allclose(each.holding, each.type_probability[:, 1])


@pytest.mark.parametrize("types", [0, 16])
def test_a_model_has_at_least_one_active_type_and_few(types) -> None:
    with pytest.raises(InvalidInputError, match=f"edge_types must be 1 to 15 .*found {types}"):
        ModelConfig(2, 2, DT, edge_types=types * (HOLD,))


def model_and_state():
    model = with_random_weights(fresh)
    rng = np.random.default_rng(3)
    position, velocity = (scale * jnp.asarray(rng.normal(size=(5, 2))) for scale in (0.12, 0.3))
    return model, position, velocity, nodes_of(5)


def test_a_filter_knows_whether_bodies_approach_at_all() -> None:
    """From the fifth of its inputs, whatever the speed of both together."""
    model = slippery_bodies(ModelConfig(2, 2, DT, width=8, node_types=("object", "actuated")))
    distance, nodes = float(model.features.contact_distance), nodes_of(2)
    sees = jnp.zeros((8, 4 + 1 + 2)).at[:, 4].set(jnp.linspace(-2.0, 2.0, 8))
    model = eqx.tree_at(
        lambda each: each.inference.message_passing.network.layers[0].weight, model, sees
    )

    @eqx.filter_vmap(in_axes=(None, 0))
    def known(model: ContactDynamics, closing: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of bodies that come nearer by that part of the contact distance in a step."""
        position = jnp.array([[0.0, 0.0], [1.1 * distance, 0.0]])
        velocity = jnp.array([[0.5, 0.2], [0.5, 0.2]]).at[1, 0].add(-closing * distance / DT)
        graph = model.encode(position, velocity, STILL, nodes, NOTHING)
        return stillness(graph.geometry)[0], graph.embedding[0]

    found, embedding = compiled(known, model, jnp.array([0.0, -0.3, 0.02, 0.2]))
    np.testing.assert_allclose(found, [1.0, 1.0, np.exp(-1.0), 0.0], atol=1e-6)
    np.testing.assert_allclose(embedding[0], embedding[1], atol=1e-9)
    for approaching in embedding[2:]:
        assert np.abs(approaching - embedding[0]).max() > 1e-3


def test_a_list_of_pairs_changes_no_prediction() -> None:
    model, position, velocity, nodes = model_and_state()
    listed = eqx.tree_at(
        lambda each: each.neighbor_list,
        model,
        NeighborList(10, None, 5),
        is_leaf=lambda x: x is None,
    )

    def rolled(model):
        state = ModelState(position, velocity, model.initial_belief(position, velocity, nodes))
        states = model.rollout(state, jnp.ones((3, 2)), nodes)
        last = jax.tree.map(lambda leaf: leaf[-1], states.belief).over(None, 10)
        return states.position, last.type_probability, last.memory

    every = compiled(rolled, model)
    assert_same(every, compiled(rolled, listed), atol=1e-9)
    clocks = np.asarray(every[2].unobserved)
    assert np.any(clocks == 0.0) and np.any(clocks > 0.0), "pairs beyond the cutoff have no clock"


@pytest.mark.parametrize("inference", [None, PriorEdges((TOUCH, HOLD), 2)])
def test_a_predicted_belief_has_the_parts_of_the_first_one(inference) -> None:
    """So that it can take its place in a loop, also with the inference replaced by the prior."""
    model, position, velocity, nodes = model_and_state()
    if inference is not None:
        model = dataclasses.replace(model, inference=inference)

    def both(position, velocity):
        graph = model.encode(position, velocity, STILL, nodes, NOTHING)
        return model.prior_belief(graph), model.predict_belief(model.prior_belief(graph), graph)

    first, second = jax.eval_shape(both, position, velocity)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    assert [leaf.shape for leaf in jax.tree.leaves(first)] == [
        leaf.shape for leaf in jax.tree.leaves(second)
    ]
