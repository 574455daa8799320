"""Whole tasks, planned once: a closed loop in the model is the start of a long plan."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import StickyBodies, nodes_of, state_of

from contactgraph.control import ILQR, AffinePolicy, ControlLimits, RecedingILQR, chain_cost
from contactgraph.data import InvalidInputError

H = 60
LIMITS = ControlLimits(jnp.full(2, -10.0), jnp.full(2, 10.0))
PLANNER = RecedingILQR(H, 5, LIMITS, swept_dt=0.05, segment=16, stride=4)
NODES = nodes_of(2, 2)
GOAL = np.array([0.3, -0.8])
COST = chain_cost((0, 1), [3.0, 3.0, 0.2, 0.2], [50.0, 50.0, 1.0, 1.0], 0.01, GOAL, 2)
BEGIN = state_of([[-0.7, 0.2], [0.4, 0.3]], np.zeros((2, 2)))


IDLE = AffinePolicy(jnp.zeros((H, 2, 2, 2, 2)), jnp.zeros((H, 2)))


@eqx.filter_jit
def planned(planner, guess):
    return planner.solve(StickyBodies(), BEGIN, NODES, COST, guess)


def solve(planner, guess=IDLE):
    return planned(planner, guess)


def test_a_long_plan_makes_the_contact_that_plain_ilqr_does_not_find() -> None:
    """Plain iLQR leaves the body more than 0.5 m from its goal."""
    found = solve(PLANNER)
    assert np.linalg.norm(np.asarray(found.states)[-1, 1, 0] - GOAL) < 0.05
    assert found.controls.shape == (H, 2)


def test_the_guess_is_improved_too() -> None:
    best = solve(PLANNER)
    going_on = AffinePolicy(jnp.zeros_like(best.policy.K), best.controls)
    again = solve(PLANNER, going_on)
    assert again.cost <= (1.0 + 1e-5) * best.cost


def test_bounds_contain_the_rollouts_of_short_plans() -> None:
    """`ActiveSetMPC` relies on them: what a short plan comes near may change the whole one."""
    plan = solve(PLANNER)
    lower, upper = (np.asarray(each) for each in (plan.swept.lower, plan.swept.upper))
    short = ILQR(16, 5, LIMITS, swept_dt=0.05)
    first = solve(short, jax.tree.map(lambda leaf: leaf[:16], IDLE))
    ours = [np.asarray(each) for each in (first.swept.lower, first.swept.upper)]
    assert lower.shape == (5, H, 2, 2)
    assert np.all(lower[:, :16] <= ours[0] + 1e-6) and np.all(upper[:, :16] >= ours[1] - 1e-6)
    moved = np.asarray(plan.states)[:-1, :, 0]
    assert np.all(lower.min(axis=0) <= moved + 1e-6) and np.all(upper.max(axis=0) >= moved - 1e-6)


@pytest.mark.parametrize(("segment", "stride"), [(16, 7), (70, 5), (10, 20), (10, 0)])
def test_what_is_refused(segment: int, stride: int) -> None:
    with pytest.raises(InvalidInputError, match="stride must be 1 to segment"):
        replace(PLANNER, segment=segment, stride=stride)
