"""MPC that infers contacts from motion: with the applied control, and only on request."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import Clock, StickyBodies, nodes_of

from contactgraph.control import ILQR, MPC, PlanStatus, chain_cost
from contactgraph.data import InvalidInputError
from contactgraph.model import MotionNoise, load_model, motion_noise, shipped_model

COST = chain_cost((0, 1), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, (0.5, 0.4), node_count=2)
PUSH = np.array([4.0, 0.0])
DT = 0.05
WIDER = 0.09  # m; 1 cm beyond the model's contact distance


def observed(speeds, position=(0.0, WIDER)) -> dict[str, np.ndarray]:
    place, velocity = np.zeros((2, 2)), np.zeros((2, 2))
    place[:, 0], velocity[:, 0] = position, speeds
    return {"position": place, "velocity": velocity}


@pytest.fixture(scope="module")
def model():
    return load_model(shipped_model("pickup")).model


CLOCK = Clock()


@pytest.fixture(scope="module")
def inferring(model) -> MPC:
    return MPC(model, ILQR(3, 1), motion_noise=motion_noise(model), deadline=0.01, clock=CLOCK)


def after_a_push(mpc: MPC, speeds, applied, contacts=None):
    """State after 4 N for a step, along the row, have left the bodies with these speeds."""
    state = mpc.reset(observed([0.0, 0.0]), nodes_of(2, 2), COST)
    _, state = mpc.step(observed([0.0, 0.0]), None, state)
    moved = np.array([0.0, WIDER]) + 0.6 * DT * np.array(speeds)
    return mpc.step(observed(speeds, moved), contacts, state, applied)[1]


def test_the_applied_control_matters(inferring) -> None:
    # Half the plan's force on one body, or all of it on two: the same motion of the first.
    still, moved = (observed(speeds, (0.0, 0.0798)) for speeds in ([0.0, 0.0], [0.1, 0.1]))
    state = inferring.reset(still, nodes_of(2, 2), COST)
    plan, state = inferring.step(still, None, state)
    planned = np.asarray(plan.controls[0], float)
    with_control = inferring.step(moved, None, state, planned)[1]
    default = inferring.step(moved, None, state)[1]
    np.testing.assert_array_equal(
        with_control.last.belief.probability, default.last.belief.probability
    )
    other = inferring.step(moved, None, state, PUSH)[1]
    assert other.last.belief.probability[0] != with_control.last.belief.probability[0]


def test_after_a_late_step_the_control_is_that_of_the_plan_that_was_returned(inferring) -> None:
    state = inferring.reset(observed([0.0, 0.0]), nodes_of(2, 2), COST)
    _, state = inferring.step(observed([0.0, 0.0]), None, state)
    CLOCK.period = 0.02
    late, after = inferring.step(observed([0.1, 0.1]), None, state)
    CLOCK.period = 0.0
    assert late.outcome == PlanStatus.DEADLINE_MISSED
    np.testing.assert_array_equal(after.carry.filter.control, late.controls[0])
    assert np.any(late.controls[0] != after.plan.controls[0])


def test_both_sources_count(inferring) -> None:
    half_sure = [0.115, 0.085]  # m/s; neither one body moved nor two
    contact, none = np.ones((2, 2)), np.zeros((2, 2))
    by_motion, up, down = (
        float(after_a_push(inferring, half_sure, PUSH, said).last.belief.probability[0])
        for said in (None, contact, none)
    )
    assert down < by_motion < up


def test_a_bad_observation_judges_neither_of_its_steps(inferring) -> None:
    state = after_a_push(inferring, [0.1, 0.1], PUSH)
    blind = observed([np.nan, 0.1])
    for observation in (blind, observed([0.5, 0.0])):
        carried = state.belief.probability
        _, state = inferring.step(observation, None, state, PUSH)
        np.testing.assert_array_equal(state.last.belief.probability, carried)
    _, state = inferring.step(observed([0.7, 0.0]), None, state, PUSH)
    assert np.all(np.isfinite(state.last.belief.probability))


def test_without_it_nothing_but_measured_contacts_counts(model) -> None:
    mpc = MPC(model, ILQR(3, 1))
    state = mpc.reset(observed([0.0, 0.0]), nodes_of(2, 2), COST)
    _, state = mpc.step(observed([0.0, 0.0]), None, state)
    plan, after = mpc.step(observed([0.1, 0.1]), None, state)
    # Independent of earlier observations and controls.
    carry = eqx.tree_at(lambda m: m.filter.before.position, state.carry, replace_fn=jnp.ones_like)
    forgetful = replace(state, carry=carry)
    other, _ = mpc.step(observed([0.1, 0.1]), None, forgetful, PUSH)
    assert eqx.tree_equal(plan, other)
    np.testing.assert_array_equal(after.last.belief.probability, state.belief.probability)


def test_arguments(inferring) -> None:
    state = inferring.reset(observed([0.0, 0.0]), nodes_of(2, 2), COST)
    with pytest.raises(InvalidInputError, match=r"applied must have shape \(2,\).*found \(3,\)"):
        inferring.step(observed([0.0, 0.0]), None, state, np.zeros(3))
    with pytest.raises(
        InvalidInputError, match=r"motion_noise: the model must be a ContactDynamics.*StickyBodies"
    ):
        MPC(StickyBodies(), ILQR(3, 1), motion_noise=MotionNoise())
