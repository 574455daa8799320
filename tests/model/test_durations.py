"""The explicit-duration model of an edge: against sums over all paths; what its odds may see."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import DT, assert_same, compiled, nodes_of, with_random_weights

from contactgraph.data import InvalidInputError, Scene
from contactgraph.inference.contact_belief import (
    nothing_active,
    posterior_by_motion,
    without_change,
)
from contactgraph.inference.edge_inference import EdgeAges, PriorEdges, aged, smoothed_flows
from contactgraph.large_scenes import NeighborList
from contactgraph.model import (
    HOLD,
    TOUCH,
    ActuationFit,
    ContactBelief,
    ContactDynamics,
    ContactSensor,
    DurationEdges,
    EdgeType,
    ModelConfig,
    ModelState,
    correct,
    ours,
    scene_nodes,
    usual_edge_types,
)

STILL, NOTHING = jnp.zeros(2), nothing_active((TOUCH, HOLD))

LEAST, AGES = 2e-3, 44
pytestmark = pytest.mark.usefixtures("double_precision")


EMBEDDING = jnp.asarray(np.random.default_rng(0).normal(size=(1, 8))).at[0, -3].set(0.0)
PRIOR = np.array([[0.5, 0.3, 0.2]])


def edges(seed: int | None = None, edge_types: tuple[EdgeType, ...] = (TOUCH, HOLD)):
    """Fresh, or with random weights."""

    def construct() -> DurationEdges:
        return DurationEdges((False, False), edge_types)

    return construct() if seed is None else with_random_weights(construct, seed)


def belief(*types: float) -> ContactBelief:
    return ContactBelief(jnp.array([types]), memory=EdgeAges(jnp.zeros((1, len(types), AGES))))


def test_before_training_geometry_decides_what_begins_and_a_hold_lasts() -> None:
    def of_gap(gap: float) -> np.ndarray:
        apart, prior = jnp.zeros((1, 8)).at[0, -1].set(gap), jnp.array([[0.5, 0.25, 0.25]])
        return np.asarray(compiled(edges().transitions, apart, prior))[0, :, 3]

    found = of_gap(0.001)
    np.testing.assert_allclose(found[:2, 2], 0.5 / (1.0 + np.exp(3.0)), rtol=0.1)
    np.testing.assert_allclose(found[:2, 0] / found[:2, 1], 1.0, rtol=0.1)
    assert found[2, 2] > 0.99 and of_gap(0.5)[2, 2] < 0.6
    np.testing.assert_allclose(found.sum(axis=-1), 1.0)
    assert found.min() >= 0.5 * LEAST


def test_what_is_free_or_touches_at_rest_stays_so_and_an_approach_begins_a_touch() -> None:
    touching = jnp.array([[0.02, 0.49, 0.49]])
    rests, approaches = jnp.zeros((1, 8)), jnp.zeros((1, 8)).at[0, -2].set(1.0)
    at_rest, after = (compiled(edges().transitions, each, touching) for each in (rests, approaches))
    assert at_rest[0, 0, 0, 0] > 0.9 > 0.1 > after[0, 0, 0, 0]
    assert at_rest[0, 1, 0, 0] < 0.01 and after[0, 1, 0, 0] < 0.01


def test_a_hold_lasts_as_long_wherever_its_ends_are_driven() -> None:
    inference, embedding = edges(seed=2), EMBEDDING.at[0, -1].set(0.0)
    together, parting = (
        compiled(inference.transitions, embedding, jnp.array([[q, 0.5 - 0.5 * q, 0.5 - 0.5 * q]]))
        for q in (0.01, 0.99)
    )
    np.testing.assert_allclose(together[:, 2, :, 2], parting[:, 2, :, 2], atol=LEAST)
    assert together[0, 2, :, 1].max() > 10.0 * parting[0, 2, :, 1].max() > 0.0
    assert together[0, 1, :, 2].max() > 10.0 * parting[0, 1, :, 2].max() > 0.0


def paths(first: np.ndarray, transitions: np.ndarray, ratios: np.ndarray, apart: bool):
    """Every path of types and ages, before each step and after the last, and its weight.

    ``first`` [K, A] is before the first step; bodies ``apart`` are free before each.
    """
    types, ages = first.shape

    def begin(kind: int, age: int) -> tuple[int, int]:
        return (0, 0) if apart and kind == 1 else (kind, age)

    for state in np.ndindex(types, ages):
        for rest in itertools.product(range(types), repeat=len(ratios)) if first[state] else ():
            path, weight = [begin(*state)], first[state]
            for step, after in enumerate(rest):
                before, age = path[-1]
                weight *= transitions[before, age, after] * np.exp(ratios[step, before, after])
                reached = after, min(age + 1, ages - 1) if before == after else 0
                path.append(begin(*reached) if step + 1 < len(rest) else reached)
            yield path, rest, weight


@pytest.mark.parametrize("apart", [False, True])
def test_filter_and_smoother_are_sums_over_all_paths(apart: bool) -> None:
    """Types and ages after five steps, and of every step given all, from unknown ages."""
    inference, rng, steps = edges(seed=2), np.random.default_rng(0), 4
    ratios, state = rng.normal(size=(steps, 3, 3)), belief(0.2, 0.3, 0.5)
    embedding = EMBEDDING.at[0, -1].set(0.5 * apart)
    table, prior = inference.table(state), jnp.asarray(PRIOR)
    transitions = compiled(inference.transitions, embedding, prior)
    assert np.ptp(transitions[0], axis=1).max() > 0.1, "ages matter"

    @eqx.filter_jit
    def filtered(state: ContactBelief, ratios: jax.Array) -> ContactBelief:
        for ratio in ratios:
            predicted, joint = inference.predict(state, embedding, prior)
            state = posterior_by_motion(predicted, joint, ratio[None])
        return state

    last = np.asarray(inference.table(filtered(state, jnp.asarray(ratios))))[0]
    every = (jnp.repeat(each[None], steps, axis=0) for each in (embedding, transitions))
    smoothed = compiled(smoothed_flows, inference, table, *every, jnp.asarray(ratios)[:, None])
    flows, final = np.zeros((steps, *transitions.shape[1:])), np.zeros_like(last)
    for path, rest, weight in paths(
        np.asarray(table)[0], np.asarray(transitions)[0], ratios, apart
    ):
        final[path[-1]] += weight
        for step, after in enumerate(rest):
            flows[step][path[step]][after] += weight
    np.testing.assert_allclose(last, final / final.sum(), atol=1e-6)
    np.testing.assert_allclose(np.asarray(smoothed)[:, 0], flows / final.sum(), atol=1e-6)


def test_the_longest_age_stands_for_all_longer_ones() -> None:
    flow = np.zeros((1, 2, AGES, 2))
    flow[0, 1, -1, 1], flow[0, 1, -2, 1], flow[0, 0, 3, 1] = 0.5, 0.3, 0.2
    found = np.asarray(compiled(aged, jnp.asarray(flow)))[0]
    np.testing.assert_allclose(found[1, [0, -1]], [0.2, 0.8])
    np.testing.assert_allclose(found.sum(), 1.0)


def test_a_strong_pull_ends_a_hold_at_any_age_and_a_weak_one_does_not() -> None:
    """`strength` is where half of them end, and how suddenly."""
    inference = edges(seed=2)
    limit = jnp.log(jnp.array([0.05, 8.0])) / 10.0
    strength = jnp.broadcast_to(limit[:, None, None], inference.strength.shape)
    inference = eqx.tree_at(lambda each: each.strength, inference, strength)

    def lasts(pull: float) -> np.ndarray:
        embedding = EMBEDDING.at[0, -3].set(pull)
        return np.asarray(compiled(inference.transitions, embedding, jnp.asarray(PRIOR)))[0, 2]

    still = lasts(0.0)
    np.testing.assert_array_equal(lasts(-1.0), still)
    np.testing.assert_allclose(lasts(0.005)[:, 2], still[:, 2], rtol=1e-3)
    np.testing.assert_allclose(lasts(0.05)[:, 2], 0.5 * still[:, 2], atol=LEAST)
    assert lasts(0.5)[:, 2].max() < 2.0 * LEAST
    np.testing.assert_allclose(lasts(0.5).sum(axis=-1), 1.0)


def test_no_force_but_a_pull_changes_the_odds_of_a_hold_and_a_switch_does() -> None:
    """What a planner intends is no evidence of contact; geometry may see whether bodies meet. A
    pull of an actuated body away from the other one makes a hold less likely, and no other force.
    """
    config = ModelConfig(2, 3, DT, width=8, driving_size=2)
    model = with_random_weights(lambda: ours(config, key=jax.random.PRNGKey(0)))
    distance = float(model.features.contact_distance)

    def odds(gap: float, *control: float) -> jax.Array:
        """Log odds of hold where geometry is open."""
        position = jnp.array([[0.0, 0.0], [(1.0 + gap) * distance, 0.0]])
        graph = model.encode(position, jnp.zeros((2, 2)), jnp.array(control), nodes_of(2), NOTHING)
        found = model.inference.transitions(graph.embedding, 0.0 * graph.prior + 1.0 / 3.0)
        return jax.scipy.special.logit(found[..., 2])

    for gap in (0.0, 0.05):
        still = compiled(odds, gap, 0.0, 0.0, 0.0)
        for force in ((5.0, 0.0), (0.0, 5.0)):
            np.testing.assert_allclose(compiled(odds, gap, *force, 0.0), still, atol=1e-9)
        assert np.all(compiled(odds, gap, -5.0, 3.0, 0.0) <= still + 1e-9)
        assert np.ptp(compiled(odds, gap, -50.0, 0.0, 0.0) - still) > 1e-3
        assert np.abs(compiled(odds, gap, 0.0, 0.0, 1.0) - still).max() > 1e-3


def test_the_pull_of_a_servo_is_not_known() -> None:
    """Whatever its command: see `DurationEdges.servos`."""
    servo = ActuationFit(60.0 * np.eye(2), np.zeros(2), 0.0, 60.0, residual=0.0)
    types, position = ("object", "hand"), jnp.array([[0.0, 0.0], [0.0, 0.08]])
    nodes = scene_nodes(Scene(types[::-1], types[::-1], np.array([True, False]), DT))

    def pull(actuation: dict[str, ActuationFit]) -> float:
        config = ModelConfig(2, 2, DT, width=8, node_types=types, actuation=actuation)
        model = ours(config, key=jax.random.PRNGKey(0))
        graph = compiled(model.encode, position, 0 * position, jnp.array([0, -9.0]), nodes, NOTHING)
        return float(graph.embedding[0, -3])

    assert pull({"hand": servo}) == 0.0 < pull({})


def test_what_is_believed_to_hold_is_judged_as_if_it_did_not() -> None:
    """A hand pulls at, or presses on, a body that is taken for held. How strong that is, and
    whether the bodies meet, does not depend on the belief, which would be evidence of itself; and
    where the hold ends in the step, they move as any that touch."""
    model = ours(ModelConfig(2, 2, DT, width=8), key=jax.random.PRNGKey(0))
    position = jnp.array([[0.0, 0.0], [0.999 * float(model.features.contact_distance), 0.0]])
    held, free = (belief(*types) for types in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)))
    touch = ContactBelief(jnp.array([[0.0, 1.0, 0.0]]))

    def judged(before: ContactBelief, force: float) -> tuple[jax.Array, ...]:
        before = dataclasses.replace(before, edge_types=model.inference.edge_types)
        control = jnp.array([force, 0.3])
        graph = model.encode(position, 0 * position, control, nodes_of(2), before)
        after = model.linearize(model.cut_edges(graph, touch))(position, 0 * position, control)
        return graph.embedding, graph.prior, graph.geometry.approach, *after

    for force in (-6.0, 6.0):
        assert_same(compiled(judged, held, force), compiled(judged, free, force), atol=1e-9)


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


def test_ages_go_from_list_to_list() -> None:
    ages = EdgeAges(jnp.arange(6.0 * 3 * AGES).reshape(6, 3, AGES))
    every = ContactBelief(jnp.tile(jnp.array([0.1, 0.2, 0.7]), (6, 1)), memory=ages)
    listed = every.over(jnp.array([1, 4, 6]), 6)
    back = listed.over(None, 6)
    np.testing.assert_array_equal(listed.memory.age, [ages.age[1], ages.age[4], 0.0 * ages.age[0]])
    np.testing.assert_array_equal(back.memory.age[4], ages.age[4])
    np.testing.assert_array_equal(back.memory.age[0], 0.0)
    np.testing.assert_array_equal(back.type_probability[0], [1.0, 0.0, 0.0])


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
    inference, prior = edges(edge_types=(HOLD, TOUCH)), jnp.array([[0.1, 0.8, 0.1]])
    first = inference.init(EMBEDDING, prior)
    predicted, _ = inference.predict(first, EMBEDDING, prior)
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
    known = np.asarray(every[2].age).sum(axis=(1, 2))
    assert np.any(known == 0.0) and np.any(known > 0.0), "nothing beyond the cutoff"


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
