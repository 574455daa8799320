"""The reach of actuated nodes: they stop at its bounds, gain no energy there, and only they do."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import follow, slippery_bodies, state_at
from test_contact_law import CONFIG, DT, SERVO, model, scene

from contactgraph.control import ILQR, ControlLimits, chain_cost
from contactgraph.model import ModelState, Nodes, scene_nodes

LOW, HIGH = np.array([-0.2, -0.3]), np.array([0.1, 0.25])
FORCE = dataclasses.replace(CONFIG, actuation={}, averaged=False)
STILL = np.zeros((3, 2))
APART = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])


def bounded(*types: str, low=LOW, high=HIGH) -> Nodes:
    """The first node, a hand, has a reach."""
    types = types or ("hand", "ball", "pillar")
    reach = np.full((len(types), 2, 2), np.nan)
    reach[0] = low, high
    return scene_nodes(scene(types, reach=reach))


FREE = bounded(low=np.full(2, np.nan), high=np.array([np.nan, 1e3]))


def pushes(size: float) -> np.ndarray:
    """In random directions, each for four steps."""
    found = np.random.default_rng(0).uniform(-size, size, (25, 2))
    return np.repeat(found, 4, axis=0)


@pytest.mark.parametrize(
    ("fits", "size", "averaged"), [({"hand": SERVO}, 1.5, True), ({}, 30.0, False)]
)
def test_a_hand_stays_within_its_reach_and_uses_all_of_it(fits, size, averaged) -> None:
    moved = slippery_bodies(dataclasses.replace(CONFIG, actuation=fits, averaged=averaged))
    free = follow(moved, FREE, APART, STILL, pushes(size)).position[:, 0]
    assert np.any(np.max(free, axis=0) > HIGH + 0.2) and np.any(np.min(free, axis=0) < LOW - 0.2)
    found = follow(moved, bounded(), APART, STILL, pushes(size))
    hand = np.asarray(found.position[:, 0])
    np.testing.assert_allclose(np.stack([hand.min(0), hand.max(0)]), [LOW, HIGH], atol=1e-6)
    np.testing.assert_array_equal(found.position[:, 1:], np.tile(APART[1:], (100, 1, 1)))
    if averaged:
        before = np.concatenate([APART[None, 0], hand[:-1]])
        np.testing.assert_allclose(hand - before, DT * found.velocity[:, 0], atol=2e-3)


def test_without_a_bound_nothing_changes_to_the_bit() -> None:
    controls = pushes(1.5)
    with_it = follow(model(), FREE, APART, STILL, controls)
    without = follow(model(), scene_nodes(scene()), APART, STILL, controls)
    np.testing.assert_array_equal(with_it.position, without.position)


def test_other_bodies_pass_the_bounds_and_do_not_push_a_hand_out() -> None:
    """A ball strikes a hand that rests at its bound; another one flies past it."""
    nodes = bounded("hand", "ball", "ball")
    position = jnp.array([[0.1, 0.0], [-0.1, 0.0], [-0.1, 0.2]])
    velocity = jnp.array([[0.0, 0.0], [1.5, 0.0], [1.5, 0.0]])
    found = follow(slippery_bodies(FORCE), nodes, position, velocity, np.zeros((100, 2)))
    assert found.velocity[19, 1, 0] < 1.0 and found.position[19, 2, 0] > 1.0
    np.testing.assert_allclose(found.position[:20, 0, 0], 0.1, atol=1e-6)


@pytest.mark.parametrize("side", [-0.4, 0.3])
def test_a_hand_outside_its_reach_goes_no_farther_and_comes_back(side: float) -> None:
    start = APART + np.array([[side, 0.0], [0.0, 0.0], [0.0, 0.0]])
    targets = np.repeat([[2.0 * side, 0.0], [0.0, 0.0]], [5, 95], axis=0)
    hand = follow(model(), bounded(), start, STILL, targets).position[:, 0]
    np.testing.assert_allclose(hand[:5, 0], side, atol=1e-6)
    np.testing.assert_allclose(hand[-1], 0.0, atol=1e-3)


@eqx.filter_jit
def batch_step(force, nodes, position, velocity):
    def step(position, velocity):
        belief = force.initial_belief(position, velocity, nodes)
        after = force.rollout(ModelState(position, velocity, belief), jnp.zeros((1, 2)), nodes)
        return after.position[0, 0], after.velocity[0]

    return jax.vmap(step)(position, velocity)


@pytest.mark.usefixtures("double_precision")
def test_kinetic_energy_never_grows_at_a_bound() -> None:
    """Also where a ball strikes the hand in the step in which the hand comes to a bound."""
    rng = np.random.default_rng(0)
    nodes, force = bounded("hand", "ball", "ball"), slippery_bodies(FORCE)
    elastic = jnp.full_like(force.local_dynamics.head.bounce_raw, 0.6)
    force = eqx.tree_at(lambda each: each.local_dynamics.head.bounce_raw, force, elastic)
    position = rng.uniform(-0.15, 0.15, (2000, 3, 2))
    velocity = 2.0 * rng.normal(size=(2000, 3, 2))
    hand, after = batch_step(force, nodes, jnp.asarray(position), jnp.asarray(velocity))
    ratio = np.sum(np.asarray(after) ** 2, axis=(1, 2)) / np.sum(velocity**2, axis=(1, 2))
    assert ratio.max() <= 1.0 + 1e-9 and ratio.min() < 0.5
    inside = np.clip(position[:, 0], LOW, HIGH) == position[:, 0]
    at_bound = (np.abs(hand - LOW) < 1e-12) | (np.abs(hand - HIGH) < 1e-12)
    assert np.any(at_bound & inside, axis=1).sum() > 50


@pytest.mark.usefixtures("double_precision")
def test_derivatives_at_a_bound_are_those_of_finite_differences() -> None:
    """Of a hand that comes to its bound along one axis, slides along it, and leaves it again."""
    nodes, moved = bounded("hand"), slippery_bodies(dataclasses.replace(CONFIG, averaged=False))
    targets = np.repeat([[0.3, 0.1], [-0.1, 0.2]], 6, axis=0)

    @jax.jit
    def end(values: jax.Array) -> jax.Array:
        found = follow(moved, nodes, *values.reshape(2, 1, 2), targets)
        return jnp.stack([found.position[4, 0], found.position[-1, 0], found.velocity[-1, 0]])

    begin = jnp.array([0.02, -0.03, 0.3, 0.1])
    at_bound, last, _ = end(begin)
    np.testing.assert_allclose(at_bound[0], HIGH[0], atol=1e-12)
    assert last[0] < 0.0
    exact = np.asarray(jax.jit(jax.jacobian(end))(begin))
    step = 1e-6 * np.eye(4)
    differences = [(end(begin + each) - end(begin - each)) / 2e-6 for each in step]
    np.testing.assert_allclose(exact, np.stack(differences, axis=-1), atol=1e-6)
    np.testing.assert_allclose(exact[0, 0], 0.0, atol=1e-12)


def test_a_plan_to_a_goal_beyond_the_reach_ends_at_the_bound() -> None:
    cost = chain_cost((0,), np.zeros(4), [50.0, 50.0, 1.0, 1.0], 1e-3, np.array([0.6, 0.1]), 1)
    planner = ILQR(20, 8, ControlLimits(jnp.full(2, -1.0), jnp.full(2, 1.0)))
    start, nodes = state_at(model(), *jnp.zeros((2, 1, 2)), bounded("hand")), bounded("hand")
    plan = eqx.filter_jit(planner.solve)(model(), start, nodes, cost)
    np.testing.assert_allclose(np.asarray(plan.states)[-1, 0, 0], [0.1, 0.1], atol=0.01)
