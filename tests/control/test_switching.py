"""Switches of a control: the schedule of the lowest true cost, two values, forces by iLQR."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import DT, Apart, blocks, nodes_of, state_of

from contactgraph.control import (
    ILQR,
    MPC,
    ActiveSetMPC,
    AffinePolicy,
    ChangingSchedules,
    ConstantSchedule,
    ControlLimits,
    MultiStartILQR,
    QuadraticCost,
)
from contactgraph.data import InvalidInputError
from contactgraph.model import two_type_belief

H = 12
LIMITS = ControlLimits(np.array([-10.0, 0.0]), np.array([10.0, 1.0]))
NODES = nodes_of(2, 2)
REST = state_of([[0.0], [0.0]], [[0.0], [0.0]])
SCHEDULES = ConstantSchedule(1, False), ConstantSchedule(1, True), ChangingSchedules(1)
PLANNER = MultiStartILQR(H, 5, LIMITS, proposals=SCHEDULES, held=(1,))


class Clutch(Apart):
    """A force moves body 0 of 1 kg; body 1 of 1 kg goes with it in steps whose command is on."""

    def linear_step(self, state, control, nodes):
        on = control[1]
        v = state.velocity[:, 0]
        jump = on * (0.5 * (v[0] + v[1]) - v)
        share = jnp.stack([1.0 - 0.5 * on, 0.5 * on])
        B2 = DT * jnp.stack([share, jnp.zeros(2)], axis=-1)[:, None]
        zero = jnp.zeros((2, 1))
        belief = two_type_belief(jnp.full(nodes.candidate.shape, 0.9 * on + 0.05))
        return blocks(zero, zero + 1.0, B2, jump[:, None]), belief


def cost(first, second, switch=1e-3, dtype=float):
    """Targets of both bodies with their weights, each [H+1] or a number; of velocities 0.01."""
    rows = np.zeros((H + 1, 4)), np.zeros((H + 1, 4))
    for node, (target, weight) in enumerate((first, second)):
        rows[0][:, 2 * node], rows[1][:, 2 * node] = target, weight
        rows[1][:, 2 * node + 1] = 0.01
    Q = np.stack([np.diag(each) for each in rows[1]])
    return QuadraticCost(jnp.asarray(Q), jnp.diag(jnp.array([1e-3, switch])), jnp.asarray(rows[0]))


@eqx.filter_jit
def solve(planner, state, cost, guess):
    return planner.solve(Clutch(), state, NODES, cost, guess)


@eqx.filter_jit
def solve_fixed(planner, state, cost, guess):
    """The forces for the guess's own schedule."""
    return ILQR.solve(planner, Clutch(), state, NODES, cost, guess)


def guess_of(schedule, force=0.0):
    k = np.stack([np.full(H, force), np.broadcast_to(schedule, H)], axis=1)
    return AffinePolicy(jnp.zeros((H, 2, 2, 2, 1)), jnp.asarray(k, jnp.zeros(()).dtype))


OFF = guess_of(0.0)
BOTH_GO = cost((0.5, 1.0), (0.5, 10.0))
ONE_GOES = cost((0.5, 1.0), (0.0, 10.0))
LATE = np.arange(H + 1) > H // 2
CHANGES = cost((np.where(LATE, -1.0, 0.6), 1.0), (0.6, 3.0))
"""Together to 0.6 m, and then the first one back alone."""


def test_the_switch_is_on_where_that_costs_less_and_off_where_it_does_not():
    carried, left = solve(PLANNER, REST, BOTH_GO, OFF), solve(PLANNER, REST, ONE_GOES, OFF)
    assert np.all(carried.controls[:, 1] == 1.0) and np.all(left.controls[:, 1] == 0.0)
    assert abs(carried.states[-1, 1, 0, 0] - 0.5) < 0.1
    assert abs(left.states[-1, 0, 0, 0] - 0.5) < 0.1 and left.states[-1, 1, 0, 0] == 0.0
    # From a plan that had it on, too: the running schedule is given up.
    again = solve(PLANNER, REST, ONE_GOES, guess_of(1.0))
    assert np.all(again.controls[:, 1] == 0.0)


def test_a_schedule_that_changes_within_the_plan_is_found():
    plan = solve(PLANNER, REST, CHANGES, OFF)
    switch = np.asarray(plan.controls[:, 1])
    assert switch[0] == 1.0 and switch[-1] == 0.0 and np.sum(np.diff(switch) != 0) == 1


@pytest.mark.parametrize("wanted", [BOTH_GO, ONE_GOES, CHANGES])
def test_the_plan_is_that_of_the_lowest_true_cost(wanted):
    plan = solve(PLANNER, REST, wanted, OFF)
    fixed = [solve_fixed(PLANNER, REST, wanted, guess_of(each)) for each in (0.0, 1.0)]
    assert float(plan.cost) <= min(float(each.cost) for each in fixed) * (1 + 1e-6)
    # The cost is that of the rollout under the plan's controls.
    state, states = REST, [jnp.stack([REST.position, REST.velocity], 1)]
    for u in plan.controls:
        linear, _ = Clutch().linear_step(state, u, NODES)
        state = state_of(*linear(state.position, state.velocity, u))
        states.append(jnp.stack([state.position, state.velocity], 1))
    np.testing.assert_allclose(jnp.stack(states), plan.states, atol=1e-5)
    np.testing.assert_allclose(wanted(plan.states, plan.controls), plan.cost, rtol=1e-5)


def test_with_its_schedule_given_the_forces_are_those_of_a_problem_without_a_switch():
    plan = solve(PLANNER, REST, BOTH_GO, OFF)

    class On(Clutch):
        def linear_step(self, state, control, nodes):
            linear, belief = super().linear_step(state, jnp.ones(2), nodes)
            return eqx.tree_at(lambda d: d.B, linear, linear.B[..., :1]), belief

    alone = eqx.tree_at(lambda c: c.R, BOTH_GO, BOTH_GO.R[:1, :1])
    ilqr = ILQR(H, 5, ControlLimits(LIMITS.lower[:1], LIMITS.upper[:1]))
    expected = jax.jit(lambda: ilqr.solve(On(), REST, NODES, alone))()
    np.testing.assert_allclose(plan.controls[:, :1], expected.controls, atol=1e-3)
    np.testing.assert_allclose(plan.cost, expected.cost + H * 1e-3, rtol=1e-4)


def test_a_switch_has_two_values_and_no_feedback():
    gains = AffinePolicy(OFF.K + 1.0, OFF.k)
    plan = solve(PLANNER, REST, CHANGES, gains)
    assert set(np.unique(plan.controls[:, 1])) <= {0.0, 1.0}
    assert not np.any(plan.policy.K[:, 1])
    np.testing.assert_array_equal(plan.policy.k[:, 1], plan.controls[:, 1])
    # A shifted plan ends in zero control, which is no change of the switch.
    shifted = guess_of(1.0)
    shifted = AffinePolicy(shifted.K, shifted.k.at[-1].set(0.0))
    assert np.all(solve(PLANNER, REST, INDIFFERENT, shifted).controls[:, 1] == 1.0)


CHEAP = cost((0.0, 0.0), (0.0, 0.0), switch=1e-9)
INDIFFERENT = eqx.tree_at(lambda c: c.R, CHEAP, jnp.diag(jnp.array([1e-3, 0.0])))


def test_of_plans_that_cost_the_same_the_running_one_stays():
    schedule = (np.arange(H) < 5).astype(float)
    plan = solve(PLANNER, REST, INDIFFERENT, guess_of(np.zeros(H)))
    assert np.all(plan.controls[:, 1] == 0.0)
    plan = solve(PLANNER, REST, INDIFFERENT, guess_of(schedule))
    np.testing.assert_array_equal(plan.controls[:, 1], schedule)


def test_a_cost_of_switching_keeps_a_switch_as_it_is_where_a_change_would_hardly_pay():
    off, on = solve_fixed(PLANNER, REST, BOTH_GO, OFF), solve(PLANNER, REST, BOTH_GO, OFF)
    gained = float(off.cost - on.cost)
    careful = replace(PLANNER, switching_cost=gained)
    for scale, expected in ((1.1, 1.0), (0.9, 0.0)):
        weights = scale * BOTH_GO.Q, scale * BOTH_GO.R
        scaled = eqx.tree_at(lambda c: (c.Q, c.R), BOTH_GO, weights)
        assert np.all(solve(careful, REST, scaled, OFF).controls[:, 1] == expected)
        # It is on already: nothing is switched on.
        assert np.all(solve(careful, REST, scaled, guess_of(1.0)).controls[:, 1] == 1.0)
    # To switch off costs as much.
    cheap = cost((0.0, 0.0), (0.0, 0.0), switch=0.5 * gained / H)
    assert np.all(solve(careful, REST, cheap, guess_of(1.0)).controls[:, 1] == 1.0)
    assert np.all(solve(PLANNER, REST, cheap, guess_of(1.0)).controls[:, 1] == 0.0)


def test_the_active_set_gives_the_same_controls():
    observation = {"position": np.zeros((2, 1)), "velocity": np.zeros((2, 1))}
    controls = []
    whole = MPC(Clutch(), PLANNER)
    for mpc in (whole, ActiveSetMPC(whole)):
        state = mpc.reset(observation, NODES, BOTH_GO)
        plan, _ = mpc.step(observation, None, state)
        controls.append(np.asarray(plan.controls))
    np.testing.assert_allclose(*controls, atol=1e-6)
    assert controls[0][0, 1] == 1.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"proposals": (ChangingSchedules(1, 12),)}, r"changes must be 1 to below the horizon"),
        ({"held": ()}, "a switch must be held and have limits, found component 1"),
        ({"limits": None}, r"limits must have an entry for each of the held components \(1,\)"),
        ({"held": (2,)}, r"limits must have an entry for each"),
    ],
)
def test_a_planner_without_a_switch_or_its_limits_is_refused(options, message):
    with pytest.raises(InvalidInputError, match=message):
        solve(replace(PLANNER, **options), REST, CHANGES, OFF)
