"""The coupled head presents the network's solution as one spring-mass-damper for each node."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import DT, assert_same, jitted_geometry, nodes_of, with_random_weights

from contactgraph.model import CoupledHead, LinearDynamics, SpringMassDamper, ThetaMethod
from contactgraph.model.contact_solver import ContactSolver
from contactgraph.model.types import LocalInput, Step

pytestmark = pytest.mark.usefixtures("double_precision")
WIDTH, LENGTH, NODES, TYPES = 6, 0.1, 4, 3
PAIRS = np.array(list(itertools.combinations(range(NODES), 2)))
CONTROL = jnp.array([1.3, -0.8])
HINGE = np.array([0.3, 0.25])


def random_head(node_types: int = 2) -> CoupledHead:
    key = jax.random.PRNGKey(0)
    return with_random_weights(lambda: CoupledHead(WIDTH, node_types, length=LENGTH, key=key))


def inputs(hinges: bool = False) -> tuple[LocalInput, jax.Array]:
    rng = np.random.default_rng(1)
    position, velocity = 0.1 * rng.normal(size=(NODES, 2)), rng.normal(size=(NODES, 2))
    anchor = None
    if hinges:
        anchor = np.full((NODES, 2), np.nan)
        anchor[1] = HINGE
        arm = position[1] - HINGE
        velocity[1] = 2.0 * np.array([-arm[1], arm[0]])
        anchor = jnp.asarray(anchor)
    states = jnp.asarray(position), jnp.asarray(velocity)
    node_types = np.arange(NODES) == 0
    kind = np.eye(2)[node_types.astype(int)]
    if hinges:
        kind = np.hstack([kind, np.zeros_like(kind)])
        kind[1] = [0, 0, 1, 0]
    holds = [1.0, 0.4, 0.0, 1.0, 0.0, 0.7], [0.0, 0.6, 0.0, 0.0, 0.0, 0.0]
    weight = np.stack([np.zeros(6), *holds], axis=-1)  # no edge only touches
    geometry = jitted_geometry(*states, jnp.asarray(PAIRS).T, DT, 0.08, None, anchor)
    # Nothing comes nearer, so that no contact is too early to act.
    geometry = dataclasses.replace(geometry, approach=jnp.zeros(len(PAIRS)))
    local = LocalInput(
        position=states[0],
        velocity=states[1],
        node_type=jnp.asarray(kind),
        actuated=jnp.asarray(node_types, float),
        node_features=jnp.asarray(np.hstack([kind, rng.uniform(size=(NODES, 1))])),
        edge_features=jnp.zeros((2, len(PAIRS), 0)),
        weight=jnp.asarray(weight),
        geometry=geometry,
        anchor=anchor,
        nodes=nodes_of(NODES),
        control_displacement=None,
    )
    return local, jnp.asarray(rng.normal(size=(TYPES, 2, len(PAIRS), WIDTH)))


@eqx.filter_jit
def _parameters(head, local, message, step) -> SpringMassDamper:
    return head(local, jnp.zeros((NODES, 0)), message, step)


def parameters(head, local, message, theta=0.6) -> SpringMassDamper:
    return _parameters(head, local, message, Step(jnp.asarray(theta), DT, 2))


@eqx.filter_jit
def moved(found: SpringMassDamper, local: LocalInput, control, theta=0.6):
    linear = ThetaMethod(theta, learned=False)(found, DT)
    return linear(local.position, local.velocity, jnp.array(control))


@eqx.filter_jit
def linearized(found: SpringMassDamper, theta: float) -> LinearDynamics:
    return ThetaMethod(theta, learned=False)(found, DT)


@eqx.filter_jit
def by_hand(head: CoupledHead, local: LocalInput, message, theta: float):
    """The network that the head's own networks describe, solved."""
    out = jax.vmap(jax.vmap(head.edge))(message[:, 0] + message[:, 1])
    weight, softplus = local.weight.T, jax.nn.softplus
    start = jnp.array([5.0, 5.0, 0.0])[:, None]  # a touch, a rigid bond, and one half as rigid
    hold = 0.999 * jnp.sum(weight * jax.nn.sigmoid(out[..., 0] + start), axis=0)
    network = ContactSolver(
        mass=jnp.exp(5 * local.node_type @ head.log_mass),
        ground_damper=softplus(jax.vmap(head.ground)(local.node_features)[:, 0] - 6),
        damper=hold / (1 - hold),
        spring=jnp.sum(weight * jnp.array([0, 0, 1])[:, None] * softplus(out[..., 1] - 6), axis=0),
        rest_length=jnp.sum(weight * softplus(out[..., 2]), axis=0) * LENGTH,
        displacing_fraction=(local.geometry.fraction_after_impact - theta) * (1.0 - weight[2]),
    )
    gain = (5 * local.node_type @ head.gain_root) ** 2
    return network, network.solve(local.velocity, gain, local.geometry, DT, 2)


@pytest.mark.parametrize(
    "theta",
    [pytest.param(0.5, marks=pytest.mark.slow), pytest.param(0.6, marks=pytest.mark.slow), 1.0],
)
def test_the_linear_step_is_that_of_the_network(theta: float) -> None:
    head, (local, message) = random_head(), inputs()
    found = parameters(head, local, message, theta)
    _, motion = by_hand(head, local, message, theta)
    changed = motion.velocity_change + DT * motion.response @ CONTROL
    position, velocity = moved(found, local, CONTROL, theta)
    way = DT * (local.velocity + theta * changed) + motion.impact_displacement
    np.testing.assert_allclose(velocity, local.velocity + changed, atol=1e-4)
    np.testing.assert_allclose(position, local.position + way, atol=1e-5)
    assert (
        np.abs(motion.velocity_change).max() > 0.3
        and np.abs(motion.impact_displacement).max() > 1e-3
    )


@pytest.mark.parametrize("theta", [0.5, 1.0])
def test_a_nodes_own_step_is_stable_and_does_not_overshoot(theta: float) -> None:
    found = parameters(random_head(), *inputs(), theta)
    A = linearized(found, theta).A
    assert np.all(found.damping_rate >= 0) and not np.any(found.stiffness_rate)
    assert np.all((A[..., 1, 1] >= 0) & (A[..., 1, 1] <= 1)), "what is kept of a node's velocity"
    assert A[..., 1, 1].min() < 0.7, "the struck ones keep little"


def without_ground(head: CoupledHead) -> CoupledHead:
    return eqx.tree_at(lambda head: head.ground.layers[-1].bias, head, jnp.array([-60.0]))


def test_the_order_of_an_edges_nodes_does_not_matter() -> None:
    head, (local, message) = random_head(), inputs()
    assert_same(*(parameters(head, local, way) for way in (message, message[:, ::-1])), rtol=1e-9)


def test_a_hinged_body_stays_on_its_circle() -> None:
    head, (local, message) = random_head(node_types=4), inputs(hinges=True)
    found = parameters(head, local, message)
    position, _ = moved(found, local, [0.0, 0.0])
    radius = np.linalg.norm(local.position[1] - HINGE)
    assert np.linalg.norm(position[1] - HINGE) == pytest.approx(radius, abs=1e-7)
    assert found.stiffness_rate[1, 0] > 0
    # The springs of hinge_constraint leave alone what the control does to velocities.
    _, motion = by_hand(head, local, message, 0.6)
    B = linearized(found, 0.6).B
    np.testing.assert_allclose(B[..., 1, :] / DT, motion.response, rtol=1e-6, atol=1e-9)


def test_a_lone_hinged_body_rotates_about_its_hinge() -> None:
    head, (local, message) = without_ground(random_head(node_types=4)), inputs(hinges=True)
    local = dataclasses.replace(local, weight=0 * local.weight)
    position, velocity = moved(parameters(head, local, message, 0.5), local, [0.0, 0.0], 0.5)
    angle = 2.0 * DT
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    arm = np.asarray(local.position[1]) - HINGE
    # Of the third order in the angle.
    np.testing.assert_allclose(position[1] - HINGE, turn @ arm, atol=angle**3 * np.hypot(*arm))
    error = np.linalg.norm(velocity[1] - turn @ local.velocity[1])
    assert error < angle**3 * np.linalg.norm(local.velocity[1])


def touching(velocity, gap: float = 0.0) -> tuple[CoupledHead, LocalInput, jax.Array]:
    """Nodes 0 and 1 touch, along x, or are a ``gap`` [m] from it; the others are elsewhere.

    All edges hold or touch rigidly.
    """
    head, (local, message) = without_ground(random_head()), inputs()
    head = eqx.tree_at(lambda head: head.edge.layers[-1].bias, head, jnp.array([60.0, -60.0, 0.0]))
    position = jnp.array([[0.0, 0.0], [0.08 + gap, 0.0], [3.0, 0.0], [0.0, 3.0]])
    velocity = jnp.zeros((NODES, 2)).at[0].set(jnp.array(velocity))
    geometry = jitted_geometry(position, velocity, jnp.asarray(PAIRS).T, DT, 0.08, None, None)
    weight = jnp.zeros((len(PAIRS), TYPES)).at[0, 0].set(1.0)
    local = dataclasses.replace(
        local, position=position, velocity=velocity, geometry=geometry, weight=weight
    )
    return head, local, message


def test_a_touch_pushes_along_its_normal_alone() -> None:
    head, local, message = touching([1.0, 0.5])
    mass = np.exp(5 * np.asarray(local.node_type @ head.log_mass))
    _, velocity = moved(parameters(head, local, message), local, [0.0, 0.0])
    common = mass[0] / (mass[0] + mass[1])
    # The normal is that of the middle of the step: the bodies slide by 0.5 m/s along each other.
    normal = np.array([0.08, -0.5 * DT * 0.5])
    along = (normal[0] + 0.5 * normal[1]) * normal / (normal @ normal)
    expected = np.zeros((NODES, 2))
    expected[0], expected[1] = [1.0, 0.5] - (1.0 - common) * along, common * along
    np.testing.assert_allclose(velocity, expected, atol=5e-3)
    held = dataclasses.replace(local, weight=local.weight[:, ::-1])
    _, velocity = moved(parameters(head, held, message), held, [0.0, 0.0])
    np.testing.assert_allclose(velocity[:2], common * np.array([[1.0, 0.5]] * 2), atol=5e-3)


def test_a_touch_never_pulls() -> None:
    head, local, message = touching([-1.0, 0.5])
    _, velocity = moved(parameters(head, local, message), local, [0.0, 0.0])
    np.testing.assert_allclose(velocity, local.velocity, atol=1e-6)


def test_the_sensitivity_to_the_control_is_without_touches() -> None:
    head, local, message = touching([1.0, 0.0])
    free = dataclasses.replace(local, weight=0 * local.weight)
    touches, apart = (linearized(parameters(head, each, message), 0.6) for each in (local, free))
    np.testing.assert_allclose(touches.control_sensitivity, apart.B[..., 0, :], rtol=1e-9)
    assert (
        np.abs(touches.B[..., 0, :] - apart.B[..., 0, :]).max()
        > 0.1 * np.abs(apart.B[..., 0, :]).max()
    )


@pytest.mark.parametrize(("speed", "acts"), [(1.0, True), (0.3, False)])
def test_a_contact_that_is_predicted_too_early_has_no_effect(speed, acts) -> None:
    """Bodies 2 cm apart, which meet in the step at 1 m/s and not at 0.3 m/s."""
    head, local, message = touching([speed, 0.0], gap=0.02)
    local = dataclasses.replace(local, weight=local.weight[:, ::-1])  # it holds
    _, velocity = moved(parameters(head, local, message), local, [0.0, 0.0])
    assert (abs(float(velocity[1, 0])) > 0.1) == acts
    if not acts:
        np.testing.assert_array_equal(velocity, local.velocity)


@pytest.mark.parametrize(("kind", "has_spring"), [(0, False), (1, False), (2, True)])
def test_only_soft_bonds_have_springs(kind, has_spring) -> None:
    """At rest, 2 cm farther apart than a contact."""
    head, local, message = touching([0.0, 0.0], gap=0.02)
    head = eqx.tree_at(lambda head: head.edge.layers[-1].bias, head, jnp.array([60.0, 20.0, 0.0]))
    local = dataclasses.replace(local, weight=jnp.roll(local.weight, kind, axis=1))
    _, velocity = moved(parameters(head, local, message), local, [0.0, 0.0])
    assert (float(jnp.abs(velocity).max()) > 1e-3) == has_spring
    if not has_spring:
        np.testing.assert_allclose(velocity, 0.0, atol=1e-12)
