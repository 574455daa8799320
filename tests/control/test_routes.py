"""Plans from several routes: round what stands in the way, and never worse than going on."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import StickyBodies, nodes_of, state_of

from contactgraph.control import (
    AffinePolicy,
    ControlLimits,
    MultiStartILQR,
    Routes,
    chain_cost,
    keep_clear,
)
from contactgraph.control.proposals.routes import FreeMotion, _place_of_least_cost
from contactgraph.data import InvalidInputError, Scene
from contactgraph.model import (
    ModelState,
    load_model,
    scene_nodes,
    shipped_model,
    take_step,
)

H, DT, GAP = 18, 0.05, 0.11
LIMITS = ControlLimits(jnp.full(2, -10.0), jnp.full(2, 10.0))
PLANNER = MultiStartILQR(H, 6, LIMITS, proposals=(Routes(3),))
NAMES = ("gripper", "target", "other")
SCENE = Scene(NAMES, ("gripper", "object", "object"), np.arange(3) == 0, DT)
GOAL = np.array([0.0, 0.9])
COST = chain_cost((0, 1), [3.0, 3.0, 0.2, 0.2], [50.0, 50.0, 1.0, 1.0], 0.01, GOAL, 3)
CLEAR = replace(COST, contacts=(keep_clear([(0, 2), (1, 2)], GAP, 1e4),))
NODES = scene_nodes(SCENE)


@cache
def model():
    return load_model(shipped_model("pickup")).model


def state(*position) -> ModelState:
    at = jnp.asarray(np.array(position), jnp.zeros(()).dtype)
    still = jnp.zeros_like(at)
    return ModelState(at, still, model().initial_belief(at, still, NODES))


IDLE = AffinePolicy(jnp.zeros((H, 2, 3, 2, 2)), jnp.zeros((H, 2)))


@eqx.filter_jit
def planned(planner, begin, cost, guess):
    return planner.solve(model(), begin, NODES, cost, guess)


def solve(planner, begin, cost=CLEAR, guess=IDLE):
    return planned(planner, begin, cost, guess)


BEHIND = state([-0.4, 0.0], [0.1, 0.0], [-0.15, 0.01])
"""The other body stands before the target."""


def test_it_goes_round_a_body_that_stands_in_the_way() -> None:
    """Plain iLQR stops before it."""
    found = solve(PLANNER, BEHIND)
    hand, target, other = np.moveaxis(np.asarray(found.states)[:, :, 0], 1, 0)
    assert np.min(np.linalg.norm(hand - other, axis=1)) > GAP - 0.005
    assert np.linalg.norm(hand[-1] - target[-1]) < 0.1
    np.testing.assert_allclose(other, np.broadcast_to(other[0], other.shape), atol=1e-4)
    at_no_cost = replace(CLEAR, contacts=(keep_clear([(0, 2), (1, 2)], GAP, 0.0),))
    free = solve(PLANNER, BEHIND, at_no_cost)
    assert np.min(np.linalg.norm(np.asarray(free.states)[:, 0, 0] - other, axis=1)) < 0.09


def test_of_many_routes_the_best_after_one_rollout_go_on() -> None:
    many = MultiStartILQR(H, 6, LIMITS, proposals=(Routes(11),))
    found, few = solve(many, BEHIND), solve(PLANNER, BEHIND)
    hand, _, other = np.moveaxis(np.asarray(found.states)[:, :, 0], 1, 0)
    assert np.min(np.linalg.norm(hand - other, axis=1)) > GAP - 0.005
    assert found.cost < 1.1 * few.cost
    # All make one rollout, eight a second one, and two the other four at most.
    assert 12 + 8 + 2 <= int(found.iterations) <= 12 + 8 + 2 * 4
    assert 4 * 2 + 2 <= int(few.iterations) <= 4 * 2 + 2 * 4


def test_the_running_plan_is_always_among_the_routes() -> None:
    best = solve(PLANNER, BEHIND)
    going_on = AffinePolicy(jnp.zeros_like(best.policy.K), best.controls)
    again = solve(PLANNER, BEHIND, CLEAR, going_on)
    assert again.cost <= (1.0 + 1e-5) * best.cost


def test_the_place_of_least_cost_is_that_of_all_that_is_joined() -> None:
    place = np.array([[-0.4, 0.0], [0.1, 0.0], [0.5, 0.5]])
    apart = np.asarray(_place_of_least_cost(state_of(place, 0 * place), COST))
    np.testing.assert_allclose(apart[0], place[1] - place[0], atol=1e-4)
    held = state_of(place, 0 * place, [1.0, 0.0, 0.0])
    together = np.asarray(_place_of_least_cost(held, COST))
    np.testing.assert_allclose(together[:2], np.broadcast_to(GOAL - place[1], (2, 2)), atol=1e-4)
    np.testing.assert_allclose(together[2], 0.0, atol=1e-6)
    through_another = state_of(place, 0 * place, [0.0, 1.0, 1.0])
    chained = np.asarray(_place_of_least_cost(through_another, COST))
    np.testing.assert_allclose(chained, np.broadcast_to(GOAL - place[1], (3, 2)), atol=1e-4)


def test_the_control_of_a_wanted_velocity_gives_it() -> None:
    free = eqx.filter_jit(FreeMotion.of)(model(), BEHIND, NODES, 1.0)
    wanted = jnp.array([0.05, -0.03])
    x = jnp.stack([BEHIND.position[0], BEHIND.velocity[0]], axis=-1)
    control = free.inverse[0] @ (wanted - free.offset[0] - jnp.sum(free.A[0] * x, axis=-1))

    @eqx.filter_jit
    def step(model):
        return take_step(model, BEHIND, control, NODES)

    after = step(model())[0]
    np.testing.assert_allclose(after.velocity[0], wanted, atol=2e-3)


def test_what_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="routes must be 1 or more, found 0"):
        Routes(0)
    still = state_of(np.zeros((2, 2)), np.zeros((2, 2)))
    two = chain_cost((0, 1), np.ones(4), np.ones(4), 1.0, np.zeros(2), 2)
    with pytest.raises(InvalidInputError, match="routes need a ContactDynamics, found Sticky"):
        PLANNER.solve(StickyBodies(), still, nodes_of(2, 2), two)
