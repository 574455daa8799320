"""The whole model's symmetries, its locality, its derivatives and its variants."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from model_scenes import (
    DT,
    PRESETS,
    crowd,
    hinged,
    nodes_of,
    preset,
    state_at,
    with_random_weights,
)

from contactgraph.data.graph import pair_indices
from contactgraph.model import (
    ArgmaxSample,
    ContactBelief,
    ContactDynamics,
    ContactSensor,
    CoupledHead,
    DistancePrior,
    InvariantFeatures,
    MessagePassing,
    ModelState,
    Nodes,
    RecurrentEdges,
    SmoothCutoff,
    SpringMassDamperDynamics,
    ThetaMethod,
    TypedMessagePassing,
    control_sensitivity,
    correct,
    response_of,
    with_control_displacement,
)

CONTROL = jnp.array([0.7, -0.4])
HINGE = (0.35, 0.2)
STEPS = jnp.tile(CONTROL, (3, 1))
roll_out = eqx.filter_jit(ContactDynamics.rollout)
linear_step = eqx.filter_jit(ContactDynamics.linear_step)
parameters_of = eqx.filter_jit(ContactDynamics.parameters)


def step(model, state, control, nodes) -> ModelState:
    """One step, by the rollout that the other tests have compiled already."""
    states = roll_out(model, state, jnp.tile(control, (3, 1)), nodes)
    return jax.tree.map(lambda leaf: leaf[0], states)


def assert_same(ours, theirs, atol=1e-9) -> None:
    """Symmetries are exact but for rounding, so they are tested in double precision."""
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, atol=atol)


def dense(edges: np.ndarray, count: int) -> np.ndarray:
    """[N, N, …] symmetric, from values on the pairs [E, …]."""
    pairs = pair_indices(count)
    full = np.zeros((count, count, *edges.shape[1:]), edges.dtype)
    full[pairs[:, 0], pairs[:, 1]] = full[pairs[:, 1], pairs[:, 0]] = edges
    return full


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("name", list(PRESETS))
def test_the_order_of_the_nodes_does_not_matter(name) -> None:
    model, count = preset(name), 4
    nodes = nodes_of(count)
    state = crowd(model, nodes)
    order = np.array([3, 0, 1, 2])
    pairs = pair_indices(count)
    swapped_nodes = eqx.tree_at(lambda nodes: nodes.actuated, nodes, nodes.actuated[order])
    swapped = state_at(model, state.position[order], state.velocity[order], swapped_nodes)
    found = step(model, swapped, CONTROL, swapped_nodes)
    expected = step(model, state, CONTROL, nodes)
    belief = dense(np.asarray(expected.belief.type_probability), count)
    belief = belief[order][:, order][pairs[:, 0], pairs[:, 1]]
    assert_same(
        [found.position, found.velocity, found.belief.type_probability],
        [expected.position[order], expected.velocity[order], belief],
    )
    moved = np.linalg.norm(expected.velocity - state.velocity, axis=-1)
    assert moved.max() > 1e-2, "the scene must be one in which something happens"


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize(
    ("name", "hinges"),
    [*((name, False) for name in PRESETS), ("gim_temp", True), ("paper_literal", True)],
)
def test_padding_changes_nothing(name, hinges) -> None:
    model = preset(name, hinges=hinges)
    small, large = nodes_of(3), nodes_of(3, capacity=4)
    if hinges:
        small, large = hinged(small, HINGE), hinged(large, HINGE)
    state = crowd(model, small)

    def pad(values):
        # What lies in the padding must not matter either.
        return jnp.concatenate([values, jnp.full((1, 2), 0.05)])

    padded = state_at(model, pad(state.position), pad(state.velocity), large)
    controls = STEPS
    expected, found = (
        roll_out(model, state, controls, small),
        roll_out(model, padded, controls, large),
    )
    assert_same(
        [found.position[:, :3], found.velocity[:, :3], found.belief.probability[:, :3]],
        [expected.position, expected.velocity, expected.belief.probability],
    )


def far_scene(model, far_position, far_velocity, exists=True, hinges=()) -> tuple:
    """Three nodes in a crowd, and a fourth elsewhere; the last ones may hang on hinges."""
    nodes = nodes_of(4)
    state = crowd(model, nodes_of(3), seed=2)
    if not exists:
        mask = jnp.array([True, True, True, False])
        pairs = pair_indices(4)
        nodes = Nodes(nodes.actuated & mask, mask, jnp.asarray(mask)[pairs].all(axis=1))
    if hinges:
        nodes = hinged(nodes, *hinges)
    position = jnp.concatenate([state.position, jnp.asarray([far_position])])
    velocity = jnp.concatenate([state.velocity, jnp.asarray([far_velocity])])
    return state_at(model, position, velocity, nodes), nodes


@pytest.mark.parametrize(
    ("name", "hinges"),
    [("gim_temp", False), ("gim_non_temp", False), ("full_ab", False), ("gim_temp", True)],
)
def test_a_far_object_changes_nobody_elses_prediction_at_all(name, hinges) -> None:
    """Bit for bit, in single precision, although the whole scene is solved as one."""
    model = preset(name, hinges=hinges)
    results = []
    for far_position, far_velocity, exists in (
        ([5.0, 5.0], [0.0, 0.0], True),
        ([-9.0, 4.0], [1.0, -2.0], True),
        ([40.0, 0.0], [0.0, 3.0], False),
        ([0.0, 0.0], [0.0, 0.0], False),
    ):
        far_hinge = tuple(np.add(far_position, [0.3, 0.1]))
        anchors = (HINGE, (np.nan, np.nan), far_hinge) if hinges else ()
        state, nodes = far_scene(model, far_position, far_velocity, exists, anchors)
        found = roll_out(model, state, STEPS, nodes)
        results.append(
            [found.position[:, :3], found.velocity[:, :3], found.belief.probability[:, :3]]
        )
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(one, two)


def test_without_a_reach_a_far_object_does_change_predictions() -> None:
    """The counterpart: what the test above guards against is real."""
    # All-pairs messages change the belief before any edge is active.
    found = []
    for far in ([5.0, 5.0], [-9.0, 4.0]):
        model = preset("paper_literal")
        state, nodes = far_scene(model, far, [0.0, 0.0])
        found.append(np.asarray(step(model, state, CONTROL, nodes).belief.probability[:3]))
    assert np.abs(found[0] - found[1]).max() > 1e-4
    # And what is held at any distance shares its momentum.
    found = []
    for velocity in ([0.0, 0.0], [1.0, -2.0]):
        model = preset("no_gim")
        state, nodes = far_scene(model, [5.0, 5.0], velocity)
        found.append(np.asarray(step(model, state, CONTROL, nodes).velocity[:3]))
    assert np.abs(found[0] - found[1]).max() > 0.1


ANGLE = 0.7
ROTATION = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])
REFLECTION = np.array([[1, 0], [0, -1]])


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("turn", [ROTATION, REFLECTION, ROTATION @ REFLECTION])
@pytest.mark.parametrize("name", ["gim_temp", "gim_non_temp", "no_gim"])
def test_turned_and_moved_scenes_are_predicted_turned_and_moved(name, turn) -> None:
    model, nodes = preset(name), nodes_of(4)
    state = crowd(model, nodes)
    shift = jnp.array([0.3, -0.2])
    turned = state_at(model, state.position @ turn.T + shift, state.velocity @ turn.T, nodes)
    controls = STEPS
    expected = roll_out(model, state, controls, nodes)
    found = roll_out(model, turned, controls @ turn.T, nodes)
    assert_same(
        [found.position, found.velocity, found.belief.probability],
        [
            expected.position @ turn.T + shift,
            expected.velocity @ turn.T,
            expected.belief.probability,
        ],
        atol=1e-4,
    )


@pytest.mark.usefixtures("double_precision")
def test_doors_turn_with_their_scene() -> None:
    model, nodes = preset("gim_temp", hinges=True), nodes_of(4)
    hung = hinged(nodes, HINGE, (-0.3, 0.1))
    state = crowd(model, hung)
    turn, shift = ROTATION @ REFLECTION, jnp.array([0.3, -0.2])
    turned_nodes = dataclasses.replace(hung, anchor=hung.anchor @ turn.T + shift)
    turned = state_at(model, state.position @ turn.T + shift, state.velocity @ turn.T, turned_nodes)
    expected = roll_out(model, state, STEPS, hung)
    found = roll_out(model, turned, STEPS @ turn.T, turned_nodes)
    assert_same(
        [found.position, found.velocity, found.belief.probability],
        [
            expected.position @ turn.T + shift,
            expected.velocity @ turn.T,
            expected.belief.probability,
        ],
    )
    free = roll_out(preset("gim_temp"), state, STEPS, nodes)
    assert np.abs(free.position - expected.position).max() > 1e-3, "hinges matter"


@pytest.mark.usefixtures("double_precision")
def test_a_scene_in_three_dimensions_turns_as_well() -> None:
    model, nodes = preset("gim_temp", dimension=3), nodes_of(4)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    state = crowd(model, nodes)
    turned = state_at(model, state.position @ turn.T, state.velocity @ turn.T, nodes)
    still = jnp.zeros(2)
    expected, found = step(model, state, still, nodes), step(model, turned, still, nodes)
    assert_same(found.velocity, expected.velocity @ turn.T)


@pytest.mark.usefixtures("double_precision")
def test_absolute_positions_are_not_blind_to_the_place() -> None:
    model, nodes = preset("paper_literal"), nodes_of(4)
    state = crowd(model, nodes)
    moved = state_at(model, state.position + 1.0, state.velocity, nodes)
    expected, found = step(model, state, CONTROL, nodes), step(model, moved, CONTROL, nodes)
    assert np.abs(found.velocity - expected.velocity).max() > 1e-3


@pytest.mark.usefixtures("double_precision")
def test_a_common_velocity_does_matter() -> None:
    """Friction with the ground tells rest from motion, so the model is not Galilean."""
    model, nodes = preset("gim_temp"), nodes_of(4)
    state = crowd(model, nodes)
    drift = jnp.array([0.5, 0.0])
    moving = state_at(model, state.position, state.velocity + drift, nodes)
    expected, found = step(model, state, CONTROL, nodes), step(model, moving, CONTROL, nodes)
    assert np.abs(found.velocity - drift - expected.velocity).max() > 1e-4


@pytest.mark.parametrize(
    ("name", "hinges"), [("gim_temp", False), ("gim_temp", True), ("paper_literal", False)]
)
def test_values_and_gradients_are_finite_where_nodes_coincide(name, hinges) -> None:
    model, nodes = preset(name, hinges=hinges), nodes_of(2, capacity=3)
    if hinges:  # Not even the hinge is elsewhere.
        nodes = hinged(nodes, (0.0, 0.0))
    zero = jnp.zeros((3, 2))

    def total(model, position, velocity):
        state = ModelState(position, velocity, model.initial_belief(position, velocity, nodes))
        found = model.rollout(state, STEPS, nodes)
        return jnp.sum(found.position) + jnp.sum(found.velocity**2)

    value, slopes = eqx.filter_jit(eqx.filter_value_and_grad(lambda all_of_it: total(*all_of_it)))(
        (model, zero, zero)
    )
    assert np.isfinite(value)
    for leaf in jax.tree.leaves(slopes):
        assert np.all(np.isfinite(leaf))


def doubled(model: ContactDynamics) -> ContactDynamics:
    """The same model in float64."""
    return jax.tree.map(
        lambda leaf: leaf.astype(jnp.float64) if eqx.is_inexact_array(leaf) else leaf, model
    )


class FixedEdges(eqx.Module):
    """The given edges, whatever is believed: nothing is sampled."""

    active: jax.Array

    def __call__(self, type_probability, key):
        return jnp.stack([1 - self.active, self.active], axis=-1)


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize(
    ("name", "hinges"),
    [("gim_temp", False), ("gim_temp", True), ("full_ab", False), ("paper_literal", False)],
)
def test_derivatives_of_a_rollout_against_finite_differences(name, hinges) -> None:
    nodes = hinged(nodes_of(3), HINGE) if hinges else nodes_of(3)
    model = doubled(preset(name, width=8, hinges=hinges))
    model = eqx.tree_at(lambda m: m.sample, model, FixedEdges(jnp.array([1.0, 0.3, 0.6])))
    state = crowd(model, nodes, seed=4)
    position, velocity = state.position, 0.3 * state.velocity
    learned = jax.tree.map(eqx.is_inexact_array, model)
    if name == "gim_temp":  # Features and prior only look at it: `test_geometry.py`.
        learned = eqx.tree_at(lambda model: model.features.contact_distance, learned, False)
    arrays, rest = eqx.partition(model, learned)

    @jax.jit
    def states(arrays, position, velocity, controls):
        model = eqx.combine(arrays, rest)
        state = ModelState(position, velocity, model.initial_belief(position, velocity, nodes))
        found = model.rollout(state, controls, nodes)
        return found.position, found.velocity, found.belief.type_probability

    # In float64 as well: a step of 1e-6 is lost in the rounding of a float32.
    controls = jnp.asarray(np.tile(CONTROL, (2, 1)), jnp.float64)
    check_grads(
        states, (arrays, position, velocity, controls), order=1, modes=["rev"], eps=1e-6, rtol=1e-4
    )


def test_a_corrected_belief_changes_what_comes_next() -> None:
    nodes = nodes_of(2, capacity=4)
    position = jnp.zeros((4, 2)).at[1, 0].set(0.12)
    still = jnp.zeros((4, 2))

    def probability_after(model, measured: float) -> np.ndarray:
        belief = state_at(model, position, still, nodes).belief
        measurement = jnp.full(6, jnp.nan).at[0].set(measured)
        belief = correct(belief, measurement, ContactSensor())
        found = step(model, ModelState(position, still, belief), CONTROL, nodes)
        return np.asarray(found.belief.probability)

    recurrent, memoryless = preset("gim_temp"), preset("gim_non_temp")
    change = probability_after(recurrent, 1.0) - probability_after(recurrent, 0.0)
    assert abs(change[0]) > 1e-3 and not np.any(change[1:])
    np.testing.assert_array_equal(
        probability_after(memoryless, 1.0), probability_after(memoryless, 0.0)
    )


def three_types() -> ContactDynamics:
    keys = jax.random.split(jax.random.PRNGKey(3), 6)
    features = InvariantFeatures()
    sizes = (features.node_size(2), features.edge_size(2), 8)
    networks = [MessagePassing(*sizes, key=key) for key in keys[:2]]
    return ContactDynamics(
        inference=RecurrentEdges(MessagePassing(*sizes, key=keys[2]), edge_types=3, key=keys[3]),
        local_dynamics=SpringMassDamperDynamics(
            message_passing=TypedMessagePassing(networks),
            head=CoupledHead(8, features.node_types, length=0.1, key=keys[4]),
            discretization=ThetaMethod(),
        ),
        features=features,
        prior=DistancePrior(),
        cutoff=SmoothCutoff(),
        sample=ArgmaxSample(),
        dt=DT,
        dimension=2,
        control_size=2,
    )


def test_three_edge_types_work_end_to_end() -> None:
    model, nodes = with_random_weights(three_types), nodes_of(3)
    state = crowd(model, nodes)
    belief = state.belief.type_probability
    assert belief.shape == (3, 3)
    np.testing.assert_allclose(belief[:, 1], belief[:, 2])
    found = roll_out(model, state, STEPS, nodes)
    np.testing.assert_allclose(found.belief.type_probability.sum(axis=-1), 1, atol=1e-6)
    measured = correct(state.belief, jnp.array([1.0, 0.0, jnp.nan]), ContactSensor())
    assert measured.probability[0] > belief[0, 1:].sum()

    @jax.jit
    def velocity_if(certain):
        percept = model.encode(state.position, state.velocity, nodes)
        belief = ContactBelief(certain)
        local = model.local_input(percept, belief, state.position, state.velocity, nodes)
        linear = model.local_dynamics(local, DT, 2)
        return linear(state.position, state.velocity, CONTROL)[1]

    first, second = (velocity_if(jnp.eye(3)[jnp.full(3, active)]) for active in (1, 2))
    assert np.abs(first - second).max() > 1e-3, "each active type has a network of its own"


@pytest.mark.usefixtures("double_precision")
def test_parameters_are_positive_and_those_of_the_step() -> None:
    model, nodes = preset("gim_temp"), nodes_of(4)
    state = crowd(model, nodes)
    parameters = parameters_of(model, state, nodes)
    for rate in (parameters.inverse_mass, parameters.stiffness_rate, parameters.damping_rate):
        assert np.all(rate >= 0)
    linear, _ = linear_step(model, state, nodes)
    assert_same(model.local_dynamics.discretization(parameters, DT), linear)


def test_free_matrices_have_no_spring() -> None:
    model, nodes = preset("full_ab"), nodes_of(2)
    with pytest.raises(TypeError, match="FreeLinearDynamics has no spring-mass-damper"):
        model.parameters(crowd(model, nodes), nodes)


@pytest.mark.usefixtures("double_precision")
def test_the_papers_form_gives_the_papers_matrices() -> None:
    model, nodes = preset("paper_literal"), nodes_of(4)
    state = crowd(model, nodes)
    parameters = parameters_of(model, state, nodes)
    linear, _ = linear_step(model, state, nodes)
    m, k, c = 1 / parameters.inverse_mass, parameters.stiffness, parameters.damping
    one = jnp.ones_like(m)
    A = jnp.stack(
        [jnp.stack([one, DT * one], -1), jnp.stack([-k * DT / m, 1 - c * DT / m], -1)], -2
    )
    B2 = DT / m[..., None] * jnp.eye(2)
    offset2 = k * parameters.equilibrium * DT / m
    assert_same(linear.A, A)
    assert_same(linear.B, jnp.stack([0 * B2, B2], -2))
    assert_same(linear.offset, jnp.stack([0 * m, offset2], -1))


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("name", ["gim_temp", "full_ab"])
def test_a_step_is_its_linear_step_under_its_push(name) -> None:
    model, nodes = preset(name), nodes_of(4)
    state = crowd(model, nodes)
    response = control_sensitivity(model, state, nodes)
    linear, belief = linear_step(model, with_control_displacement(state, response, CONTROL), nodes)
    position, velocity = linear(state.position, state.velocity, CONTROL)
    found = step(model, state, CONTROL, nodes)
    assert_same(found, ModelState(position, velocity, belief))


@pytest.mark.usefixtures("double_precision")
def test_a_rollout_knows_each_push_by_the_step_before() -> None:
    model, nodes = preset("gim_temp"), nodes_of(3)
    state = crowd(model, nodes)
    controls = jnp.array([[4.0, -2.0], [-8.0, 3.0], [5.0, 9.0]])
    found = roll_out(model, state, controls, nodes)
    response = control_sensitivity(model, state, nodes)
    for index, control in enumerate(controls):
        linear, belief = linear_step(
            model, with_control_displacement(state, response, control), nodes
        )
        state = ModelState(*linear(state.position, state.velocity, control), belief)
        response = response_of(linear, response)
        assert_same(jax.tree.map(lambda leaf: leaf[index], found), state)  # noqa: B023
