"""Whole tasks, planned once: a closed loop in the model is the start of a long plan."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import StickyBodies, nodes_of, state_of

from contactgraph.control import AffinePolicy, ControlLimits, MultiStartILQR, ShortPlans, chain_cost
from contactgraph.data import InvalidInputError

H = 60
LIMITS = ControlLimits(jnp.full(2, -10.0), jnp.full(2, 10.0))
PLANNER = MultiStartILQR(H, 5, LIMITS, proposals=(ShortPlans(16, 4),))
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


@pytest.mark.parametrize(("segment", "stride"), [(16, 7), (70, 5), (10, 20), (10, 0), (0, None)])
def test_what_is_refused(segment: int, stride: int | None) -> None:
    with pytest.raises(InvalidInputError, match="stride must be 1 to segment"):
        solve(replace(PLANNER, proposals=(ShortPlans(segment, stride),)))
