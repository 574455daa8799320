"""Models of bodies as they are: types, servos, static bodies, planes, and what data tell."""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import follow, slippery_bodies

from contactgraph.data import InvalidInputError, Scene
from contactgraph.dynamics.body_types import PACE
from contactgraph.dynamics.contact_law import ContactLaw
from contactgraph.model import (
    ActuationFit,
    ContactBelief,
    ContactDynamics,
    Impacts,
    ModelConfig,
    ModelState,
    ours,
    scene_nodes,
)
from contactgraph.model.presets import PLANE
from contactgraph.model.scene import check_fit

DT, STEPS = 0.05, 20
TYPES = ("ball", "pillar", "hand")
SERVO = ActuationFit(100.0 * np.eye(2), np.zeros(2), stiffness=100.0, damping=15.0, residual=0.0)
CONFIG = ModelConfig(
    2, 2, DT, 0.1, width=4, node_types=TYPES, actuation={"hand": SERVO}, averaged=True
)


@cache
def model() -> ContactDynamics:
    """Fresh weights, on a ground without friction."""
    return slippery_bodies(CONFIG)


def scene(types: tuple[str, ...] = ("hand", "ball", "pillar"), **options) -> Scene:
    static = np.array([name == "pillar" for name in types])
    actuated = np.array([name == "hand" for name in types])
    names = tuple(f"{name}-{index}" for index, name in enumerate(types))
    return Scene(names, types, actuated, DT, static=static, **options)


def test_a_free_servo_follows_its_own_equation() -> None:
    nodes, target = scene_nodes(scene()), np.array([0.3, -0.2])
    position = jnp.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])
    controls = jnp.tile(jnp.asarray(target), (STEPS, 1))
    found = follow(model(), nodes, position, jnp.zeros((3, 2)), controls)
    x, v, expected = np.zeros(2), np.zeros(2), []
    for _ in range(STEPS):
        pull = 100.0 * (target - x - DT * v) - 15.0 * v
        v = v + DT * pull / (1.0 + 15.0 * DT + 100.0 * DT**2)
        x = x + DT * v
        expected.append(x)
    np.testing.assert_allclose(found.position[:, 0], expected, atol=1e-5)
    np.testing.assert_array_equal(found.position[:, 1:], np.tile(position[1:], (STEPS, 1, 1)))


def test_a_free_servo_is_linear_in_its_state_as_its_equation() -> None:
    nodes = scene_nodes(scene())
    position = jnp.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])
    velocity = jnp.array([[0.4, -0.3], [0.0, 0.0], [0.0, 0.0]])
    state = ModelState(position, velocity, model().initial_belief(position, velocity, nodes))
    linear, _ = eqx.filter_jit(model().linear_step)(state, jnp.zeros(2), nodes)
    inertia = 1.0 + 15.0 * DT + 100.0 * DT**2
    by_position, by_velocity = -100.0 * DT / inertia, 1.0 / inertia
    expected = np.broadcast_to([by_position, by_velocity], (2, 2))
    np.testing.assert_allclose(linear.A[0, :, 1], expected, rtol=1e-3)


def test_a_stiff_servo_pushes_and_static_bodies_stay_exactly() -> None:
    nodes = scene_nodes(scene())
    position = jnp.array([[0.0, 0.0], [0.12, 0.0], [0.36, 0.0]])
    controls = jnp.tile(jnp.array([0.15, 0.0]), (STEPS, 1))
    found = follow(model(), nodes, position, jnp.zeros((3, 2)), controls)
    assert np.all(np.isfinite(found.position))
    np.testing.assert_array_equal(found.position[:, 2], np.tile(position[2], (STEPS, 1)))
    ball = np.asarray(found.position[:, 1, 0])
    assert ball[3] > 0.15, "the hand pushes the ball"
    hand = np.asarray(found.position[:, 0, 0])
    assert np.all(hand < ball - 0.08) and hand[3] > 0.04, "the ball hardly hinders the hand"


TABLE = {"planes": np.array([[0.0, 1.0, 0.0]]), "gravity": np.array([0.0, -9.81])}


def on_rough_ground() -> ContactDynamics:
    """What touches the ground is slowed by 3 m/s^2."""
    return eqx.tree_at(lambda each: each.local_dynamics.head.deceleration_raw, model(), jnp.ones(3))


def test_the_ground_slows_what_touches_it_and_nothing_in_the_air() -> None:
    nodes = scene_nodes(scene(("ball", "ball", "hand"), **TABLE))
    position = jnp.array([[0.0, 0.05], [1.0, 1.0], [5.0, 0.0]])
    velocity = jnp.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    after = follow(on_rough_ground(), nodes, position, velocity, jnp.zeros((1, 2))).velocity[0]
    np.testing.assert_allclose(after[1], [1.0, -9.81 * DT], rtol=1e-3)
    np.testing.assert_allclose(after[0], [1.0 - 10.0 * np.log1p(np.exp(-1.0)) * DT, 0.0], atol=0.01)


@eqx.filter_jit
def lift(
    model: ContactDynamics,
    held: jax.Array,
    hand: jax.Array,
    target: jax.Array,
    velocity: float = 0.0,
    steps: int = 10,
) -> jax.Array:
    """[2, 2] m: hand and ball, 8 cm below it, after the steps towards the target; both rise with
    the ``velocity`` [m/s] at first."""
    nodes = scene_nodes(scene(("hand", "ball"), **TABLE))
    types = ContactBelief(jax.nn.one_hot(jnp.where(held, 2, 0), 3)[None])

    def step(state: tuple, _: None) -> tuple:
        graph = model.encode(*state, target, nodes, types)
        return model.linearize(model.cut_edges(graph, types))(*state, target), None

    first = jnp.stack([hand, hand - jnp.array([0.0, 0.08])])
    moving = jnp.zeros((2, 2)).at[:, 1].set(velocity)
    return jax.lax.scan(step, (first, moving), length=steps)[0][0]


def test_a_servo_hardly_sinks_under_what_it_holds() -> None:
    at = jnp.array([0.0, 0.4])
    hand, ball = np.asarray(lift(on_rough_ground(), jnp.asarray(True), at, at))
    np.testing.assert_allclose(hand, at, atol=2e-3)
    np.testing.assert_allclose(ball, hand - [0.0, 0.08], atol=2e-3)


def test_a_body_that_is_held_does_not_fall_onto_the_plane_that_it_meets() -> None:
    """Its hand lowers it by 2 mm onto a plane: 5 mm in a step, if nothing were there."""
    at = jnp.array([0.0, 0.132])
    low = at - jnp.array([0.0, 0.1])
    _, ball = np.asarray(lift(on_rough_ground(), jnp.asarray(True), at, low, -0.1, steps=1))
    assert 0.048 < ball[1] < 0.052, "a free ball would be 12 mm further down"


@pytest.mark.parametrize("held", [True, False])
def test_a_body_that_is_held_is_lifted_off_its_plane(held: bool) -> None:
    """A hand above a ball that rests on a plane rises."""
    target = jnp.array([0.4, 0.4])
    start = jnp.array([0.0, 0.13])
    hand, ball = np.asarray(lift(on_rough_ground(), jnp.asarray(held), start, target))
    if held:
        np.testing.assert_allclose(ball - hand, [0.0, -0.08], atol=0.02)
        assert ball[1] > 0.15
    else:
        np.testing.assert_allclose(ball, [0.0, 0.05], atol=1e-3)


def test_each_arm_follows_its_own_components() -> None:
    config = dataclasses.replace(
        CONFIG,
        control_size=4,
        driving_size=4,
        actuated_nodes=2,
        actuation={"hand": dataclasses.replace(SERVO, matrix=100.0 * np.tile(np.eye(2), 2))},
    )
    acts = np.zeros((2, 4), bool)
    acts[0, :2], acts[1, 2:] = True, True
    nodes = scene_nodes(scene(("hand", "hand"), control_of=acts))
    start = jnp.array([[0.0, 0.0], [3.0, 0.0]])
    control = jnp.tile(jnp.array([0.5, 0.0, 3.0, 0.5]), (60, 1))
    found = follow(slippery_bodies(config), nodes, start, jnp.zeros((2, 2)), control)
    np.testing.assert_allclose(found.position[-1], [[0.5, 0.0], [3.0, 0.5]], atol=1e-2)


def test_types_have_their_own_sizes() -> None:
    sized = eqx.tree_at(
        lambda each: each.features.log_size, model(), jnp.log(jnp.array([0.8, 1.2, 1.0])) / 5.0
    )
    edges = jnp.array([[0, 0, 1], [1, 2, 2]])
    nodes = scene_nodes(scene())
    found = sized.features.distances(nodes, edges, jnp.float32)
    np.testing.assert_allclose(found, [0.09, 0.11, 0.1], rtol=1e-5)


def test_a_type_that_the_model_does_not_know_is_an_error() -> None:
    check_fit(model(), scene(), 2, "the data")
    with pytest.raises(InvalidInputError, match=r"puck.*ball, pillar, hand"):
        check_fit(model(), scene(("hand", "puck")), 2, "the data")


KINDS = ("ball", "puck", "cue")
NAMES = (*KINDS, PLANE)


def head(impacts: dict[tuple[str, str], Impacts]) -> ContactLaw:
    config = ModelConfig(2, 2, 0.05, 0.1, width=4, node_types=KINDS, impacts=impacts, rough=True)
    made = ours(config, key=jax.random.key(0)).local_dynamics.head
    assert isinstance(made, ContactLaw)
    return made


def sums(raw: np.ndarray, pair: tuple[str, str]) -> float:
    return PACE * float(sum(np.asarray(raw)[NAMES.index(name)] for name in pair))


SEEN = {
    ("ball", "puck"): Impacts(0.8, 0.3, 0.25),
    ("ball", PLANE): Impacts(0.5, 0.1, None),
    ("puck", PLANE): Impacts(0.5, None, None),
}


def test_pairs_start_with_what_they_show() -> None:
    made = head(SEEN)
    for pair, each in SEEN.items():
        bounce = 1.0 / (1.0 + np.exp(3.0 - sums(made.bounce_raw, pair)))
        assert bounce == pytest.approx(each.bounce, rel=1e-5), pair
        if each.friction is not None:
            friction = np.log1p(np.exp(sums(made.friction_raw, pair) - 4.0))
            assert friction == pytest.approx(each.friction, rel=1e-4), pair
    ball, puck, cue = np.exp(PACE * np.asarray(made.log_mass))
    assert ball / puck == pytest.approx(0.25, rel=1e-5)
    assert min(ball, puck, cue) == pytest.approx(1.0), "ratios alone are seen"
    assert cue == pytest.approx(2.0)


def test_what_all_types_show_is_not_learned() -> None:
    slides = {"ball": (1.0, 0.0), "puck": (2.0, 0.0)}
    met = ("ball", "puck"), ("ball", "cue")
    impacts = dict.fromkeys(met, Impacts(0.8, 0.3, None))
    slowing = ("deceleration_raw", "damper_raw")
    seen = ModelConfig(2, 2, 0.1, node_types=KINDS, slowing=slides, impacts=impacts)
    assert seen.told == (*slowing, "bounce_raw", "friction_raw")
    quick = dataclasses.replace(seen, slowing=slides | {"puck": (2.0, 50.0)})
    assert quick.told == seen.told
    assert dataclasses.replace(quick, averaged=True).told == ("bounce_raw", "friction_raw")
    smooth = {**impacts, met[0]: Impacts(0.8, None, None)}
    assert dataclasses.replace(seen, slowing={"ball": (1.0, 0.0)}, impacts=smooth).told == (
        "bounce_raw",
    )
    fewer = {met[0]: Impacts(0.8, 0.3, None)}
    assert dataclasses.replace(seen, slowing={}, impacts=fewer).told == ()

    def laws(head: ContactLaw) -> jax.Array:
        types = jnp.eye(3)
        each = (*head.laws(types, jnp.array([0]), jnp.array([1])), *head.slowing(types))
        return jnp.stack([jnp.sum(one) for one in each]) @ jnp.ones(4)

    learned = head({})
    gradient = eqx.filter_grad(laws)
    names = (*slowing, "bounce_raw", "friction_raw")
    kept = head(dict.fromkeys(met, Impacts(0.8, 0.3, None)))
    assert all(np.any(getattr(gradient(learned), name)) for name in names)
    assert [np.any(getattr(gradient(kept), name)) for name in names] == [True, True, False, False]


def test_a_type_that_is_not_seen_is_like_the_others() -> None:
    made, fresh = head(SEEN), head({})
    between_others = sums(made.bounce_raw, ("ball", "puck"))
    assert sums(made.bounce_raw, ("cue", "cue")) == pytest.approx(between_others, rel=1e-5)
    assert sums(fresh.bounce_raw, ("cue", "cue")) == 0.0
    np.testing.assert_array_equal(fresh.log_mass, 0.0)
