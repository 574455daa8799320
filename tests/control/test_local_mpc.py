"""Ticks among the nodes in play answer what ticks about the whole scene answer."""

import logging
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import nodes_of

from contactgraph.control import ILQR, MPC, ControlLimits, PlanStatus, chain_cost
from contactgraph.data import InvalidInputError, pair_indices
from contactgraph.model import ContactSensor, load_model, shipped_model

CAPACITY, HORIZON = 30, 12
LIMITS = ControlLimits(jnp.full(2, -10.0), jnp.full(2, 10.0))
GOAL = np.array([0.5, 0.6])
GRIPPER, TARGET = np.array([-0.7, -0.5]), np.array([0.1, 0.0])
SEVERAL = (3, 7, 9)


@pytest.fixture(scope="module", autouse=True)
def double_precision():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.fixture(scope="module")
def model(double_precision):
    shipped = load_model(shipped_model("pickup")).model
    return jax.tree.map(lambda v: v.astype(float) if eqx.is_inexact_array(v) else v, shipped)


@pytest.fixture(scope="module")
def local(model) -> MPC:
    return MPC(model, ILQR(HORIZON, 5, LIMITS))


@pytest.fixture(scope="module")
def whole(model) -> MPC:
    # With rates by edge nobody is left out.
    rate = jnp.full(len(pair_indices(CAPACITY)), 0.01)
    return MPC(model, ILQR(HORIZON, 5, LIMITS), ContactSensor(rate, rate))


def cost(goal=GOAL):
    return chain_cost((0, 1), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, goal, CAPACITY)


def scene(count: int, others=(), seed: int = 0) -> dict[str, np.ndarray]:
    """Gripper, target, ``others``, and far from these as many as it takes to ``count``."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(6), np.arange(5)), -1).reshape(-1, 2)
    far = 3.0 + 0.15 * grid + rng.uniform(-0.02, 0.02, grid.shape)
    position = np.array([GRIPPER, TARGET, *others, *far])[:count]
    return {"position": position, "velocity": np.zeros((count, 2))}


def crowd(count: int, seed: int) -> dict[str, np.ndarray]:
    """Bystanders anywhere around the ways, no two bodies within each other."""
    rng = np.random.default_rng(seed)
    placed = [GRIPPER, TARGET]
    while len(placed) < count:
        point = rng.uniform(-2.0, 2.0, 2)
        if min(np.linalg.norm(point - other) for other in placed) > 0.12:
            placed.append(point)
    return {"position": np.array(placed), "velocity": np.zeros((count, 2))}


def both(local: MPC, whole: MPC, seen: dict, steps: int) -> list[np.ndarray]:
    """Drives both through the world as the whole plan has it; who was in play at each step."""
    count = len(seen["position"])
    nodes = nodes_of(count, CAPACITY)
    states = [mpc.reset(seen, nodes, cost()) for mpc in (local, whole)]
    in_play = []
    for _ in range(steps):
        contacts = np.linalg.norm(seen["position"][:, None] - seen["position"], axis=-1) < 0.0805
        plans = []
        for index, mpc in enumerate((local, whole)):
            plan, states[index] = mpc.step(seen, contacts, states[index])
            plans.append(plan)
        found, wanted = plans
        who = np.asarray(found.who)
        inside = who[who >= 0]
        in_play.append(inside)
        np.testing.assert_allclose(found.controls, wanted.controls, atol=1e-7)
        np.testing.assert_allclose(found.cost, wanted.cost, rtol=1e-9)
        assert int(found.iterations) == int(wanted.iterations)
        predicted = np.asarray(wanted.states).reshape(HORIZON + 1, CAPACITY, 2, 2)
        ours = np.asarray(found.states).reshape(HORIZON + 1, len(who), 2, 2)[:, : len(inside)]
        np.testing.assert_allclose(ours, predicted[:, inside], atol=1e-7)
        first, second = pair_indices(len(inside)).T
        edge = inside[second] * (inside[second] - 1) // 2 + inside[first]
        belief = np.asarray(found.beliefs.probability)[:, : len(edge)]
        np.testing.assert_allclose(
            belief, np.asarray(wanted.beliefs.probability)[:, edge], atol=1e-6
        )
        seen = {"position": predicted[1, :count, 0], "velocity": predicted[1, :count, 1]}
    return in_play


@pytest.mark.parametrize("count", [11, 30])
def test_bystanders_far_away_are_left_out_and_change_nothing(local, whole, count):
    for inside in both(local, whole, scene(count, seed=count), 4):
        assert inside.tolist() == [0, 1]


@pytest.mark.parametrize("count", [11, 30])
def test_in_a_crowd_the_answer_is_that_of_all(local, whole, count):
    most = max(len(inside) for inside in both(local, whole, crowd(count, seed=count), 12))
    assert 2 < most < count


def test_a_bystander_in_the_way_is_in_play_and_matters(local, whole):
    between = 0.5 * (GRIPPER + TARGET)
    in_play = both(local, whole, scene(11, others=[between]), 12)
    assert all(2 in inside for inside in in_play)
    nodes = nodes_of(11, CAPACITY)
    plans = []
    for others in ([between], [between + 5.0]):
        seen = scene(11, others)
        plan, state = local.step(seen, None, local.reset(seen, nodes, cost()))
        plans.append(plan)
        assert 2 in plan.who.tolist() or others[0][0] > 3.0
    assert np.max(np.abs(plans[0].controls - plans[1].controls)) > 0.1
