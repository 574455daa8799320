"""The model's step: symmetries, locality, derivatives, stages, its rollout and sensitivity.

Everything runs in float64 on scenes of four nodes, and all variants of a scene in one compiled,
vmapped step per model.
"""

from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import (
    DT,
    PRESETS,
    assert_same,
    hinged,
    nodes_of,
    preset,
    with_random_weights,
)

from contactgraph.data.graph import pair_indices
from contactgraph.model import (
    HOLD,
    TOUCH,
    Actuation,
    ArgmaxSample,
    ContactBelief,
    ContactDynamics,
    ContactLaw,
    ContactSensor,
    DistancePrior,
    InvariantFeatures,
    MessagePassing,
    ModelConfig,
    ModelState,
    Nodes,
    RecurrentEdges,
    SmoothCutoff,
    SpringMassDamperDynamics,
    ThetaMethod,
    TypedMessagePassing,
    correct,
)

pytestmark = pytest.mark.usefixtures("double_precision")
COUNT = 4
PAIRS = pair_indices(COUNT)
HINGE = (0.35, 0.2)
CASES = [*((name, False) for name in PRESETS), ("recurrent", True)]
BOTH = [("recurrent", False), ("memoryless", False), ("ours", False), ("recurrent", True)]
LOCAL, INVARIANT = [*BOTH, ("full_ab", False)], [*BOTH, ("no_inference", False)]
ORDER = np.array([3, 0, 1, 2])
VARIANTS = [
    "base",
    "permuted",
    "turned",
    "far",
    "far_moving",
    "absent",
    "absent_elsewhere",
    "alone",
]
Arrays = dict[str, np.ndarray]
assert_close = partial(assert_same, atol=1e-9)


@eqx.filter_jit
def steps(model: ContactDynamics, scenes: tuple) -> tuple:
    """The next position, velocity and belief of every scene, from its prior, under its control."""

    def step(position, velocity, control, nodes):
        state = ModelState(position, velocity, model.initial_belief(position, velocity, nodes))
        linear, belief = model.linear_step(state, control, nodes)
        return *linear(position, velocity, control), belief.type_probability

    return jax.vmap(step)(*scenes)


def orthogonal(dimension: int) -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(5).normal(size=(dimension, dimension)))[0]


def dimension_of(name: str, hinges: bool) -> int:
    """One of the models lives in three dimensions."""
    return 3 if (name, hinges) == ("recurrent", False) else 2


def scene(name: str, hinges: bool, variant: str) -> tuple[Arrays, np.ndarray]:
    """Position, velocity, actuated, mask and anchor of four close nodes, and the control."""
    dimension = dimension_of(name, hinges)
    rng = np.random.default_rng(1)
    arrays: Arrays = {
        "position": rng.uniform(-0.1, 0.1, (COUNT, dimension)),
        "velocity": rng.normal(size=(COUNT, dimension)),
        "actuated": np.arange(COUNT) == 0,
        "mask": np.ones(COUNT, bool),
        "anchor": np.full((COUNT, dimension), np.nan),
    }
    control = np.array([3.0, -2.0, 1.0])[:dimension]
    if hinges:
        arrays["anchor"][1] = HINGE
    if variant == "permuted":
        return {key: value[ORDER] for key, value in arrays.items()}, control
    if variant == "turned":
        turn, shift = orthogonal(dimension), np.full(dimension, 0.3)
        arrays["position"] = arrays["position"] @ turn.T + shift
        arrays["anchor"] = arrays["anchor"] @ turn.T + shift
        arrays["velocity"], control = arrays["velocity"] @ turn.T, turn @ control
    elif variant == "alone":
        arrays["mask"][1:] = False
    elif variant != "base":
        arrays["position"][3] = 5.0 if variant == "far" else -9.0
        arrays["velocity"][3] = 0.0 if variant == "far" else 2.0
        if variant == "absent_elsewhere":  # among the others
            arrays["position"][3] = 0.05
        arrays["mask"][3] = not variant.startswith("absent")
    return arrays, control


def after(name: str, hinges: bool, every: Arrays, controls: np.ndarray) -> tuple:
    """Position, velocity and belief of several scenes after a step."""
    model = preset(name, dimension_of(name, hinges), width=8, hinges=hinges)
    nodes = Nodes(
        actuated=every["actuated"],
        mask=every["mask"],
        candidate=every["mask"][:, pair_indices(every["mask"].shape[1])].all(axis=-1),
        anchor=every["anchor"] if hinges else None,
    )
    scenes = every["position"], every["velocity"], controls, nodes
    return steps(model, jax.tree.map(jnp.asarray, scenes))


@cache
def results(name: str, hinges: bool) -> dict[str, list[np.ndarray]]:
    """Position, velocity and belief after a step of every variant."""
    all_of = [scene(name, hinges, variant) for variant in VARIANTS]
    every = {key: np.stack([arrays[key] for arrays, _ in all_of]) for key in all_of[0][0]}
    found = after(name, hinges, every, np.stack([control for _, control in all_of]))
    return {
        variant: [np.asarray(part[index]) for part in found]
        for index, variant in enumerate(VARIANTS)
    }


def dense(edges: np.ndarray) -> np.ndarray:
    """[N, N, K] symmetric, from values on the pairs [E, K]."""
    full = np.zeros((COUNT, COUNT, edges.shape[-1]))
    full[PAIRS[:, 0], PAIRS[:, 1]] = full[PAIRS[:, 1], PAIRS[:, 0]] = edges
    return full


@pytest.mark.parametrize(("name", "hinges"), CASES)
def test_the_order_of_the_nodes_does_not_matter(name: str, hinges: bool) -> None:
    position, velocity, belief = results(name, hinges)["base"]
    belief = dense(belief)[ORDER][:, ORDER][PAIRS[:, 0], PAIRS[:, 1]]
    assert_close(results(name, hinges)["permuted"], [position[ORDER], velocity[ORDER], belief])
    moved = velocity - scene(name, hinges, "base")[0]["velocity"]
    assert np.abs(moved).max() > 1e-2, "the scene must be one in which something happens"


@pytest.mark.parametrize(("name", "hinges"), CASES)
def test_padding_does_not_matter(name: str, hinges: bool) -> None:
    assert_same(*(first(3, results(name, hinges)[each]) for each in ("absent", "absent_elsewhere")))


def first(count: int, parts: list[np.ndarray]) -> list[np.ndarray]:
    """Position and velocity of the first bodies, and the belief of the pairs among them."""
    position, velocity, belief = parts
    return [position[:count], velocity[:count], belief[: count * (count - 1) // 2]]


@pytest.mark.parametrize(
    ("name", "hinges", "count"),
    [
        ("recurrent", True, 3),
        ("paper_literal", False, 3),
        *((name, False, 1) for name in ("recurrent", "full_ab", "paper_literal")),
    ],
)
def test_padding_gives_what_a_smaller_array_gives(name: str, hinges: bool, count: int) -> None:
    """Also of a single body, which has no edges."""
    variant = "absent" if count == 3 else "alone"
    arrays, control = scene(name, hinges, variant)
    bare = {key: value[None, :count] for key, value in arrays.items()}
    found = [np.asarray(part[0]) for part in after(name, hinges, bare, control[None])]
    assert_close(first(count, results(name, hinges)[variant]), found)
    assert np.all(np.isfinite(found[0]))
    assert np.abs(found[1] - arrays["velocity"][:count]).max() > 1e-3


@pytest.mark.parametrize(("name", "hinges"), LOCAL)
def test_a_far_object_changes_no_other_prediction_at_all(name: str, hinges: bool) -> None:
    """Bit for bit, although the whole scene is solved as one."""
    for variant in ("far_moving", "absent"):
        assert_same(*(first(3, results(name, hinges)[each]) for each in ("far", variant)))


def test_without_a_cutoff_a_far_object_does_change_predictions() -> None:
    """The counterpart: the effect that the test above excludes is real."""
    for name, part in (("paper_literal", 2), ("no_inference", 1)):
        far, moving = (results(name, False)[variant][part] for variant in ("far", "far_moving"))
        assert np.abs(far[:3] - moving[:3]).max() > 1e-4


@pytest.mark.parametrize(("name", "hinges"), INVARIANT)
def test_turned_and_moved_scenes_are_predicted_turned_and_moved(name: str, hinges: bool) -> None:
    position, velocity, belief = results(name, hinges)["base"]
    turn = orthogonal(position.shape[1])
    assert_close(
        results(name, hinges)["turned"], [position @ turn.T + 0.3, velocity @ turn.T, belief]
    )


def test_absolute_features_depend_on_position() -> None:
    turned, base = (results("paper_literal", False)[variant][2] for variant in ("turned", "base"))
    assert np.abs(turned - base).max() > 1e-3


def random_state(model: ContactDynamics, nodes: Nodes, seed: int = 4) -> ModelState:
    rng = np.random.default_rng(seed)
    position = jnp.asarray(rng.uniform(-0.1, 0.1, (len(nodes.mask), 2)))
    velocity = jnp.asarray(0.3 * rng.normal(size=position.shape))
    return ModelState(position, velocity, jitted_belief(model, position, velocity, nodes))


jitted_belief = eqx.filter_jit(ContactDynamics.initial_belief)
linear_step = eqx.filter_jit(ContactDynamics.linear_step)


class FixedEdges(eqx.Module):
    """The given edges are active: nothing is sampled."""

    active: jax.Array

    def __call__(self, type_probability, key):
        return jnp.stack([1 - self.active, self.active], axis=-1)


class SoftEdges(eqx.Module):
    """Edges are as active as they are probable."""

    def __call__(self, type_probability, key):
        return type_probability


def test_the_gradient_of_a_step_against_finite_differences() -> None:
    """And it is finite where all nodes coincide, at rest, on their hinge."""
    nodes = hinged(nodes_of(3), HINGE)
    model = preset("recurrent", width=4, hinges=True)
    model = eqx.tree_at(lambda m: m.sample, model, FixedEdges(jnp.array([1.0, 0.3, 0.6])))
    learned = jax.tree.map(eqx.is_inexact_array, model)
    # No gradient flows to it from features and prior: see test_collision.
    learned = eqx.tree_at(lambda model: model.features.contact_distance, learned, False)
    given = jax.tree.map(lambda _: False, model.local_dynamics.head.actuation)
    learned = eqx.tree_at(lambda model: model.local_dynamics.head.actuation, learned, given)
    # Nor where bodies would coast to.
    learned = eqx.tree_at(lambda model: model.local_dynamics.head.damper_raw, learned, False)
    arrays, rest = eqx.partition(model, learned)
    rng = np.random.default_rng(4)
    weights = [rng.normal(size=shape) for shape in ((3, 2), (3, 2), (3, 2))]

    @jax.jit
    @jax.value_and_grad
    def total(inputs):
        arrays, position, velocity, control = inputs
        model = eqx.combine(arrays, rest)
        state = ModelState(position, velocity, model.initial_belief(position, velocity, nodes))
        linear, belief = model.linear_step(state, control, nodes)
        parts = *linear(position, velocity, control), belief.type_probability
        return sum(jnp.sum(weight * part) for weight, part in zip(weights, parts, strict=True))

    position = rng.uniform(-0.1, 0.1, (3, 2))
    inputs = arrays, position, 0.3 * rng.normal(size=(3, 2)), np.array([0.7, -0.4])
    _, gradient = total(inputs)
    leaves, tree = jax.tree.flatten(inputs)
    for leaf, slope in enumerate(jax.tree.leaves(gradient)):
        direction = rng.normal(size=np.shape(slope))
        ends = []
        for sign in (1, -1):
            moved = [np.asarray(each) for each in leaves]
            moved[leaf] = moved[leaf] + sign * 1e-6 * direction
            ends.append(float(total(tree.unflatten(moved))[0]))
        expected = (ends[0] - ends[1]) / 2e-6
        assert np.sum(slope * direction) == pytest.approx(expected, rel=1e-4, abs=1e-7)
    zero = np.zeros((3, 2))
    _, gradient = total((arrays, zero, zero, inputs[-1]))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


def test_a_linear_step_is_about_the_control() -> None:
    """Bodies at rest, 2 cm from touch: a push together changes the dynamics of the step."""
    model, nodes = preset("recurrent", width=8), nodes_of(3)
    model = eqx.tree_at(lambda m: m.sample, model, SoftEdges())
    touch = float(model.features.contact_distance)
    position = jnp.array([[0.0, 0.0], [touch + 0.02, 0.0], [2.0, 0.0]])
    still = jnp.zeros((3, 2))
    state = ModelState(position, still, ContactBelief(jnp.full((3, 2), 0.5)))

    def pushed(force: float):
        return linear_step(model, state, jnp.array([force, 0.0]), nodes)

    none, together = pushed(0.0), pushed(20.0)
    assert np.abs(together[1].probability[0] - none[1].probability[0]) > 0.1
    assert np.abs(together[0].B - none[0].B).max() > 1e-3


def test_the_stages_of_a_step_in_their_order() -> None:
    """The stages one by one are the linear step."""
    model, nodes = preset("recurrent", width=8), nodes_of(3)
    state, control = random_state(model, nodes), jnp.array([3.0, -1.0])

    @eqx.filter_jit
    def separately(state):
        graph = model.encode(state.position, state.velocity, control, nodes, state.belief)
        belief = model.predict_belief(state.belief, graph)
        cut = model.cut_edges(graph, belief)
        return belief, model.linearize(cut), model.local_dynamics.parameters(cut, DT)

    belief, dynamics, parameters = separately(state)
    assert_close(linear_step(model, state, control, nodes), (dynamics, belief))
    found = eqx.filter_jit(ContactDynamics.parameters)(model, state, control, nodes)
    assert_close(found, parameters)
    assert_close(model.local_dynamics.discretization(parameters, DT), dynamics)
    for rate in (parameters.inverse_mass, parameters.stiffness_rate, parameters.damping_rate):
        assert np.all(rate >= 0)


def test_a_rollout_is_its_steps() -> None:
    model, nodes = preset("recurrent", width=8), nodes_of(3)
    state = begin = random_state(model, nodes)
    controls = jnp.array([[4.0, -2.0], [-8.0, 3.0], [5.0, 9.0]])
    found = eqx.filter_jit(ContactDynamics.rollout)(model, state, controls, nodes)
    for index, control in enumerate(controls):
        linear, belief = linear_step(model, state, control, nodes)
        state = ModelState(*linear(state.position, state.velocity, control), belief)
        assert_close(jax.tree.map(lambda leaf, at=index: leaf[at], found), state)
    one = eqx.filter_jit(ContactDynamics.step)(model, begin, controls[0], nodes)
    assert_close(one, jax.tree.map(lambda leaf: leaf[0], found))


def test_a_corrected_belief_changes_the_next_one() -> None:
    nodes = nodes_of(3)
    position = jnp.zeros((3, 2)).at[1, 0].set(0.12).at[2, 0].set(2.0)
    still = jnp.zeros((3, 2))

    def probability_after(model, measured: float) -> np.ndarray:
        belief = jitted_belief(model, position, still, nodes)
        belief = correct(belief, jnp.array([measured, jnp.nan, jnp.nan]), ContactSensor())
        state = ModelState(position, still, belief)
        return np.asarray(linear_step(model, state, jnp.zeros(2), nodes)[1].probability)

    recurrent, memoryless = preset("recurrent", width=8), preset("memoryless", width=8)
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
        inference=RecurrentEdges(
            MessagePassing(*sizes, key=keys[2]), edge_types=(TOUCH, HOLD), key=keys[3]
        ),
        local_dynamics=SpringMassDamperDynamics(
            message_passing=TypedMessagePassing(networks),
            head=ContactLaw(8, 2, length=0.1, actuation=Actuation(2, 2, 2), key=keys[4]),
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
    state = random_state(model, nodes)
    belief = state.belief.type_probability
    assert belief.shape == (3, 3)
    np.testing.assert_allclose(belief[:, 1], belief[:, 2])
    graph = eqx.filter_jit(ContactDynamics.encode_state)(model, state, jnp.zeros(2), nodes)
    predicted = eqx.filter_jit(ContactDynamics.predict_belief)(model, state.belief, graph)
    np.testing.assert_allclose(predicted.type_probability.sum(axis=-1), 1, atol=1e-6)
    measured = correct(state.belief, jnp.array([1.0, 0.0, jnp.nan]), ContactSensor())
    assert measured.probability[0] > belief[0, 1:].sum()

    @jax.jit
    def offset_if(certain):
        return model.linearize(model.cut_edges(graph, ContactBelief(certain))).offset

    first, second = (offset_if(jnp.eye(3)[jnp.full(3, active)]) for active in (1, 2))
    assert np.abs(first - second).max() > 1e-5, "each active type has a network of its own"


def test_free_matrices_have_no_spring() -> None:
    model, nodes = preset("full_ab"), nodes_of(2)
    state = ModelState(jnp.zeros((2, 2)), jnp.zeros((2, 2)), ContactBelief(jnp.ones((1, 2))))
    with pytest.raises(TypeError, match="FreeLinearDynamics has no spring-mass-damper"):
        model.parameters(state, jnp.zeros(2), nodes)


def test_the_papers_form_gives_the_papers_matrices() -> None:
    model, nodes = preset("paper_literal", width=8), nodes_of(3)
    state, control = random_state(model, nodes), jnp.zeros(2)
    parameters = eqx.filter_jit(ContactDynamics.parameters)(model, state, control, nodes)
    linear, _ = linear_step(model, state, control, nodes)
    m = 1 / parameters.inverse_mass
    k, c = m * parameters.stiffness_rate, m * parameters.damping_rate
    one = jnp.ones_like(m)
    A = jnp.stack(
        [jnp.stack([one, DT * one], -1), jnp.stack([-k * DT / m, 1 - c * DT / m], -1)], -2
    )
    B2 = DT / m[..., None] * jnp.eye(2)
    offset2 = k * parameters.equilibrium * DT / m
    assert_close(linear.A, A)
    assert_close(linear.B, jnp.stack([0 * B2, B2], -2))
    assert_close(linear.offset, jnp.stack([0 * m, offset2], -1))


def test_free_matrices_use_every_component_of_the_control() -> None:
    model = eqx.filter_eval_shape(
        PRESETS["full_ab"], ModelConfig(2, 3, DT, width=8), key=jax.random.PRNGKey(0)
    )
    assert model.control_size == 3 and model.local_dynamics.control_size == 3


displacement = eqx.filter_jit(ContactDynamics.control_displacement)


def test_what_is_held_moves_with_what_the_control_drives() -> None:
    """A body of 1 kg driven alone, and rigidly together with one or two others of 1 kg."""
    model, nodes = preset("ours"), nodes_of(3, capacity=COUNT)
    model = eqx.tree_at(
        lambda each: each.local_dynamics.head.log_mass, model, replace_fn=jnp.zeros_like
    )
    position = jnp.zeros((COUNT, 2)).at[:, 0].set(jnp.array([0.0, 0.1, 0.2, 9.0]))
    control, theta = jnp.array([4.0, -2.0]), float(model.local_dynamics.discretization.theta)
    free = theta * DT**2 * np.array([4.0, -2.0])
    # Pairs in order: 0-1, 0-2, 1-2, then those with padding, which hold nothing.
    for holding, shares in (
        ([0.4, 0.0, 0.9, 0.9, 0.9, 0.9], [1.0, 0.0, 0.0, 0.0]),
        ([0.9, 0.0, 0.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0]),
        ([0.9, 0.0, 0.51, 0.0, 0.0, 0.0], [1 / 3, 1 / 3, 1 / 3, 0.0]),
    ):
        held = jnp.asarray(holding)
        belief = ContactBelief(jnp.stack([1.0 - held, 0.0 * held, held], axis=-1))
        state = ModelState(position, jnp.zeros_like(position), belief)
        found = displacement(model, state, control, nodes)
        np.testing.assert_allclose(found, np.outer(shares, free), rtol=2e-3, atol=1e-8)


def test_a_touch_does_not_transmit_the_control_within_a_step() -> None:
    model, nodes = preset("ours"), nodes_of(2)
    position = jnp.array([[0.0, 0.0], [0.1, 0.0]])
    touching = ContactBelief(jnp.array([[0.0, 1.0, 0.0]]))
    state = ModelState(position, jnp.zeros((2, 2)), touching)
    found = displacement(model, state, jnp.array([4.0, 0.0]), nodes)
    assert found[0, 0] > 1e-4 and not np.any(found[1])


def test_the_papers_form_leaves_the_control_out_of_account_within_a_step() -> None:
    model, nodes = preset("paper_literal", width=8), nodes_of(3)
    assert model.control_displacement(random_state(model, nodes), jnp.ones(2), nodes) is None
