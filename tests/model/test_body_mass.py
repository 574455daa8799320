"""Masses that differ within a type, inferred from motion."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import state_at

from contactgraph.data import Scene, TrajectoryBatch
from contactgraph.model import (
    ContactBelief,
    ContactSensor,
    ModelConfig,
    ModelState,
    MotionNoise,
    first_masses,
    ours,
    scene_nodes,
    told_log_mass,
    with_masses,
)
from contactgraph.model.body_mass import MassBelief, correct_masses, mass_score
from contactgraph.model.filter import filter_trajectory
from contactgraph.model.motion_likelihood import motion_given_types

STEPS, DT = 12, 0.05
NOISE = MotionNoise(model_position=1e-4, model_velocity=2e-3, model_share=0.02, type_share=0.02)
SCENE = Scene(
    node_name=("pusher", "near", "far"),
    node_type=("pusher", "block", "block"),
    actuated=np.array([True, False, False]),
    dt=DT,
    control_kind=("force", "force"),
    mass=np.array([1.0, 1.7, 0.6]),
)
CONFIG = ModelConfig(
    2, 2, DT, contact_distance=0.08, node_types=("block", "pusher"), varying_mass=True
)


@pytest.fixture(scope="module")
def model():
    return ours(CONFIG, key=jax.random.key(0))


@pytest.fixture(scope="module")
def pushed(model):
    """A pusher pushes a block whose mass is exp(z) times the usual; what the model says of it."""

    @eqx.filter_jit
    def follow(log_mass, bad):
        nodes = scene_nodes(SCENE)
        heavy = nodes._replace(log_mass=jnp.array([0.0, log_mass, 0.0]))
        position = jnp.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.5]])
        still = jnp.zeros((3, 2))
        first = ModelState(position, still, model.initial_belief(position, still, nodes))
        control = jnp.tile(jnp.array([2.0, 0.0]), (STEPS, 1))
        states = model.rollout(first, control, heavy)
        positions = jnp.concatenate([position[None], states.position])
        velocities = jnp.concatenate([still[None], states.velocity])
        velocities = jnp.where(bad, velocities.at[1:].set(jnp.nan), velocities)
        batch = TrajectoryBatch(positions, velocities, control, None, nodes, jnp.array(STEPS))
        return filter_trajectory(model, batch, ContactSensor(), NOISE), positions

    return follow


@pytest.mark.parametrize("log_mass", [-0.7, 0.0, 0.7])
def test_motion_tells_the_mass_of_a_pushed_body(pushed, log_mass):
    filtered, _ = pushed(jnp.array(log_mass), jnp.array(False))
    assert float(filtered.masses.mean[-1, 1]) == pytest.approx(log_mass, abs=0.05)
    low, high = (float(bound[-1, 1]) for bound in filtered.masses.interval())
    assert low <= np.exp(log_mass) <= high
    assert high / low < 1.5
    assert np.all(np.diff(filtered.masses.variance[:, 1]) <= 1e-9)


def test_only_a_touched_body_tells_its_mass(model, pushed):
    first = first_masses(model, scene_nodes(SCENE))
    filtered, _ = pushed(jnp.array(0.7), jnp.array(False))
    np.testing.assert_array_equal(filtered.masses.mean[:, 2], 0.0)
    np.testing.assert_allclose(filtered.masses.variance[:, 2], first.variance[2], rtol=1e-6)
    assert first.variance[1] > 0.1
    assert first.variance[0] == 0.0  # The control determines the mass of what it drives.


def test_observations_that_are_not_finite_tell_nothing(pushed):
    filtered, _ = pushed(jnp.array(0.7), jnp.array(True))
    np.testing.assert_array_equal(filtered.masses.mean, 0.0)
    assert np.all(np.isfinite(filtered.masses.variance))


def test_the_step_uses_the_mass(model):
    heavy, light = (MassBelief(jnp.array([0.0, mean, 0.0]), jnp.zeros(3)) for mean in (0.7, -0.7))
    position = jnp.array([[0.0, 0.0], [0.08, 0.0], [0.0, 0.5]])
    velocity = jnp.array([[0.5, 0.0], [0.0, 0.0], [0.0, 0.0]])
    nodes = scene_nodes(SCENE)
    state = state_at(model, position, velocity, nodes)

    @eqx.filter_jit
    def step(masses):
        return model.step(state, jnp.zeros(2), with_masses(nodes, masses))

    assert float(step(light).velocity[1, 0]) > 1.3 * float(step(heavy).velocity[1, 0])


def test_told_masses_are_in_units_of_the_driven_body(model):
    told = told_log_mass(model, SCENE)
    nodes = scene_nodes(SCENE)._replace(log_mass=jnp.asarray(told))
    np.testing.assert_allclose(told, np.log([1.0, 1.7, 0.6]), atol=1e-6)
    np.testing.assert_array_equal(first_masses(model, nodes).variance, 0.0)
    alike = ours(replace(CONFIG, varying_mass=False), key=jax.random.key(0))
    assert first_masses(alike, nodes) is None and told_log_mass(alike, SCENE) is None


def test_the_score_is_least_at_the_spread_and_the_mean_of_the_masses(model):
    nodes, found = scene_nodes(SCENE), jnp.array([0.0, 0.9, 0.3])
    spread, masses = 0.3, MassBelief(found, jnp.zeros(3))

    def score(log_mass, log_spread):
        at = eqx.tree_at(
            lambda each: (
                each.local_dynamics.head.log_mass,
                each.local_dynamics.head.log_spread,
            ),
            model,
            (jnp.array([log_mass, 0.0]) / 5.0, jnp.array([log_spread, 0.0]) / 5.0),
        )
        return jnp.sum(jnp.where(nodes.passive, mass_score(at, masses, nodes), 0.0))

    slope = jax.grad(partial(score, log_spread=np.log(spread)))(0.0)
    assert float(slope) == pytest.approx(-2 * 0.6 / spread**2)
    own = jnp.sqrt(jnp.mean(found[1:] ** 2))
    assert float(jax.grad(partial(score, 0.0))(jnp.log(own))) == pytest.approx(0.0, abs=1e-5)


def test_one_strike_tells_a_body_much_lighter_than_its_type(model):
    """In data of free bodies and of welded ones the usual mass is far from both. At the usual mass
    the pusher would stop, and a little less would make no difference."""
    heavy = eqx.tree_at(
        lambda each: (each.local_dynamics.head.log_mass, each.local_dynamics.head.log_spread),
        model,
        (jnp.array([3.4, 0.0]) / 5.0, jnp.array([np.log(4.0), 0.0]) / 5.0),
    )
    nodes = scene_nodes(SCENE)
    noise = replace(NOISE, model_share=0.4, model_velocity=1e-4, model_position=4e-6)
    position = jnp.array([[0.0, 0.0], [0.087, 0.0], [0.0, 0.5]])
    velocity = jnp.array([[0.2, 0.1], [0.0, 0.0], [0.0, 0.0]])
    held = jnp.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    belief = ContactBelief(held, edge_types=heavy.inference.edge_types)

    @eqx.filter_jit
    def inferred(log_mass):
        state, still = ModelState(position, velocity, belief), jnp.zeros(2)
        weighed = nodes._replace(log_mass=jnp.array([0.0, log_mass, 0.0]))
        observed = motion_given_types(heavy, position, velocity, still, weighed, held)
        first = first_masses(heavy, nodes)
        return correct_masses(heavy, first, state, belief, still, observed, nodes, noise).mean[1]

    for log_mass in (-3.4, -2.0, 1.2):
        assert float(inferred(log_mass)) == pytest.approx(log_mass, abs=0.2)
