"""Costs and control of bodies that turn."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.control import ILQR, MPC, ControlLimits, PlanStatus, chain_cost
from contactgraph.control.proposals.approach import level_reach
from contactgraph.data import InvalidInputError, Scene, generalized_coordinates
from contactgraph.envs.contract import ChainCost
from contactgraph.model import ActuationFit, ContactDynamics, ModelConfig, ours, scene_nodes
from contactgraph.policies import TaskCost

UNIT, GOAL_ANGLE = 0.05, 0.4
PICK, GOAL = [3.0, 3.0, 0.2, 0.2], [50.0, 50.0, 1.0, 1.0]
BOX = np.array([[-0.08, -0.02], [0.08, -0.02], [0.08, 0.02], [-0.08, 0.02]])
SERVO = ActuationFit(100.0 * np.eye(2), np.zeros(2), stiffness=100.0, damping=20.0, residual=0.0)
CONFIG = ModelConfig(
    2,
    2,
    0.1,
    0.03,
    width=4,
    node_types=("bar", "hand"),
    actuation={"hand": SERVO},
    slowing={"bar": (0.5, 50.0)},
    averaged=True,
    turn_length=UNIT,
    inertia={"bar": 1.0},
    learned_contact_distance=False,
)
SCENE = Scene(
    ("hand", "bar"),
    ("hand", "bar"),
    np.array([True, False]),
    0.1,
    control_kind=("position", "position"),
    polygons=(BOX,),
    polygon_of=np.array([1]),
)
HAND, BAR = np.array([0.06, -0.04]), np.zeros(2)


@cache
def model() -> ContactDynamics:
    return ours(CONFIG, key=jax.random.key(0))


def observation(**changes) -> dict[str, np.ndarray]:
    still = np.zeros((2, 2))
    turn, rate = np.array([[np.nan], [0.0]]), np.array([[np.nan], [0.0]])
    found = {
        "position": np.stack([HAND, BAR]),
        "velocity": still,
        "orientation": turn,
        "angular_velocity": rate,
    }
    return found | changes


def cost(weight: float = 1.0, angle: float = GOAL_ANGLE):
    plain = chain_cost([0, 1], np.zeros(4), np.array(GOAL) / 100.0, 1e-4, BAR, node_count=2)
    return plain.with_angle(1, angle, weight, 2)


def test_a_cost_in_radians_is_the_same_in_the_coordinates_of_a_model() -> None:
    rng = np.random.default_rng(0)
    position, velocity, controls = rng.normal(size=(3, 4, 2, 2))
    turn, rate = rng.normal(size=(2, 4, 2, 1))
    plain = chain_cost([0, 1], PICK, GOAL, 0.01, [0.3, -0.2], node_count=2)
    states = jnp.asarray(np.stack([position, velocity], axis=2))
    expected = plain(states, controls[:3, 0]) + 2.5 * np.sum((turn[:, 1] - GOAL_ANGLE) ** 2)
    turned = jax.tree.map(np.asarray, plain.with_angle(1, GOAL_ANGLE, 2.5, 2))
    fitted = turned.fitted(model(), 2, np)
    both = np.stack(generalized_coordinates(UNIT, position, velocity, turn, rate), axis=2)
    np.testing.assert_allclose(fitted(jnp.asarray(both), controls[:3, 0]), expected, rtol=1e-5)
    again = fitted.fitted(model(), 2, np)
    np.testing.assert_array_equal(again.Q, fitted.Q)
    np.testing.assert_array_equal(again.goal, fitted.goal)
    alone = plain.fitted(model(), 2)(jnp.asarray(both), controls[:3, 0])
    np.testing.assert_allclose(alone, plain(states, controls[:3, 0]), rtol=1e-5)


def test_a_plan_turns_a_bar_to_the_angle_of_the_cost() -> None:
    """The hand stands below the bar's right half, on which it must push up."""
    limits = ControlLimits(jnp.full(2, -1.0), jnp.full(2, 1.0))
    mpc = MPC(model(), ILQR(horizon=6, iterations=8, limits=limits))
    nodes = scene_nodes(SCENE)
    state = mpc.reset(observation(), nodes, cost())
    plan, _ = mpc.step(observation(), None, state)
    turned = np.asarray(plan.states)[:, 1, 0, 2] / UNIT
    assert turned[-1] > 0.5 * GOAL_ANGLE
    assert np.asarray(plan.states).shape == (7, 2, 2, 3)

    # The angle of a disc does not matter, that of a bar does.
    bad = observation(orientation=np.array([[np.nan], [np.nan]]))
    assert mpc.step(bad, None, state)[0].outcome == PlanStatus.BAD_OBSERVATION
    spun = observation(orientation=np.array([[7.0], [0.0]]))
    np.testing.assert_array_equal(mpc.step(spun, None, state)[0].controls, plan.controls)
    lacking = {name: observation()[name] for name in ("position", "velocity")}
    with pytest.raises(InvalidInputError, match="must have position and velocity and orientation"):
        mpc.step(lacking, None, state)


def test_a_task_s_angle_is_the_nearest_of_the_equal_ones() -> None:
    terms = ChainCost((0, 1), PICK, GOAL, 0.01, goal_angle=GOAL_ANGLE, angle_weight=2.0)
    scene = dataclasses.replace(SCENE, goal=np.array([0.1, 0.2]))
    at = TaskCost(terms, 2, turns=True).in_scene(scene)
    for angle, nearest in ((0.5, 0.4), (6.0, 0.4 + 2.0 * np.pi), (-20.0, 0.4 - 6.0 * np.pi)):
        seen = at.seeing(observation(orientation=np.array([[np.nan], [angle]])))
        quadratic = seen.quadratic(2)
        np.testing.assert_allclose(quadratic.goal.reshape(2, 2, 3)[1, 0, 2], nearest, rtol=1e-6)
        assert quadratic.Q[8, 8] == 2.0
    # A model that does not turn plans without the angle.
    assert TaskCost(terms, 2).in_scene(scene).quadratic(2).goal.shape == (8,)


def test_outlines_reach_across_gravity_and_not_for_a_model_of_bodies_that_do_not_turn() -> None:
    nodes, corner = scene_nodes(SCENE), float(np.hypot(0.08, 0.02))
    falling = scene_nodes(dataclasses.replace(SCENE, gravity=np.array([0.0, -9.81])))
    upright = np.array([[*HAND, 0.0], [*BAR, 0.5 * np.pi * UNIT]])
    for given, turn, expected in ((nodes, 0.0, corner), (falling, 0.0, 0.08), (falling, 1.0, 0.02)):
        position = jnp.asarray(upright * np.array([1.0, 1.0, turn]))
        np.testing.assert_allclose(level_reach(given, position, UNIT), [0.0, expected], atol=1e-6)
    np.testing.assert_array_equal(level_reach(nodes, jnp.asarray(upright[:, :2]), None), 0.0)
