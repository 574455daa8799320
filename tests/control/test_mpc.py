"""MPC: belief, warm start, deadline, bad input, and one compilation for all inputs."""

import dataclasses
import math
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import Broken, Clock, StickyBodies, nodes_of

from contactgraph.control import (
    ILQR,
    MPC,
    AffinePolicy,
    ControlLimits,
    MPCState,
    Plan,
    PlanStatus,
    chain_cost,
    shift_plan,
)
from contactgraph.data import InvalidInputError
from contactgraph.model import LinearDynamics, ModelState, two_type_belief

CAPACITY, HORIZON, LARGEST = 4, 16, 8.0
LIMITS = ControlLimits(jnp.full(2, -LARGEST), jnp.full(2, LARGEST))


class Counted(eqx.Module):
    """Counts how often a model is traced: every compilation calls it in Python."""

    model: StickyBodies
    calls: list = eqx.field(static=True)

    def initial_belief(self, position, velocity, nodes):
        return self.model.initial_belief(position, velocity, nodes)

    def linear_step(self, state, control, nodes) -> tuple[LinearDynamics, object]:
        self.calls.append(1)
        return self.model.linear_step(state, control, nodes)


def scene(count=3, shift=0.0):
    position = np.array([[-0.4, -0.1], [0.1, 0.1], [2.0, 2.0], [3.0, 2.0]])[:count] + shift
    return {"position": position, "velocity": np.zeros((count, 2)), "goal": np.zeros(2)}


def cost_to(goal=(0.5, 0.4), chain=(0, 1)):
    return chain_cost(chain, [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, goal, node_count=CAPACITY)


@pytest.fixture(scope="module")
def counted():
    """A controller that all tests share, with the count of its model's traces and its clock."""
    calls: list = []
    clock = Clock()
    model = Counted(StickyBodies(), calls)
    mpc = MPC(model, ILQR(HORIZON, 12, LIMITS), deadline=0.01, clock=clock)
    mpc.reset(scene(), nodes_of(3, CAPACITY), cost_to())
    return mpc, calls, clock


@pytest.fixture
def mpc(counted):
    counted[2].period = 0.0
    return counted[0]


@pytest.fixture
def start(mpc):
    return mpc.reset(scene(), nodes_of(3, CAPACITY), cost_to())


def advance(observation, control, nodes, probability):
    position, velocity = (jnp.asarray(observation[k]) for k in ("position", "velocity"))
    state = ModelState(position, velocity, two_type_belief(probability))
    linear, belief = StickyBodies().linear_step(state, control, nodes)
    position, velocity = linear(position, velocity, control)
    return {"position": position, "velocity": velocity}, belief.probability


def test_closed_loop_brings_the_object_to_the_goal(mpc):
    observation, nodes = scene(CAPACITY), nodes_of(CAPACITY, CAPACITY)
    state = mpc.reset(observation, nodes, cost_to())
    probability = jnp.zeros(6)
    move = jax.jit(advance)
    for _ in range(60):
        contacts = np.zeros((CAPACITY, CAPACITY))
        contacts[0, 1] = contacts[1, 0] = probability[0] > 0.5
        plan, state = mpc.step(observation, contacts, state)
        assert plan.outcome.solved
        assert np.all(np.abs(plan.controls) <= LARGEST)
        motion = {k: observation[k] for k in ("position", "velocity")}
        observation, probability = move(motion, plan.controls[0], nodes, probability)
    distance = np.linalg.norm(np.asarray(observation["position"][1]) - [0.5, 0.4])
    assert distance < 0.01


def test_changes_within_capacity_do_not_recompile(counted, start):
    mpc, calls, _ = counted
    before = len(calls)
    plan, state = mpc.step(scene(), None, start)
    plan, state = mpc.step(scene(shift=0.1), np.eye(3), state)
    other = mpc.reset(scene(4), nodes_of(4, CAPACITY), cost_to((0.1, -0.3), (1, 3)))
    plan, other = mpc.step(scene(4), np.zeros((4, 4), bool), other)
    fewer = mpc.reset(scene(2), nodes_of(2, CAPACITY), cost_to())
    plan, fewer = mpc.step(scene(2), np.full((2, 2), np.nan), fewer)
    weakly_typed = dataclasses.replace(cost_to(), terminal_weight=jnp.asarray(2.0))
    plan, _ = mpc.step(scene(2), None, mpc.reset(scene(2), nodes_of(2, CAPACITY), weakly_typed))
    plan, _ = mpc.step(scene(2), None, fewer, cost=cost_to((-0.2, 0.6)))
    assert plan.outcome.solved
    assert len(calls) == before


def test_goal_changes_the_plan(mpc, start):
    here, _ = mpc.step(scene(), None, start)
    there, _ = mpc.step(scene(), None, start, cost=cost_to((-0.5, 0.4), (0, 2)))
    assert np.max(np.abs(here.controls[0] - there.controls[0])) > 0.1


def half_sure(start: MPCState) -> MPCState:
    """The same, with this belief about every pair."""
    belief = two_type_belief(jnp.full(6, 0.3))
    known = dataclasses.replace(start.carry.filter, predicted=belief)
    return dataclasses.replace(start, carry=dataclasses.replace(start.carry, filter=known))


def test_a_measured_contact_corrects_the_belief_and_changes_the_plan(mpc, start):
    # Both stand 0.15 m apart: out of the model's reach, so that only the sensor can know.
    observation = scene()
    observation["position"][0] = [-0.05, 0.1]
    touching = np.zeros((3, 3))
    touching[0, 1] = touching[1, 0] = 1.0
    believing = half_sure(start)
    plans = {}
    for name, contacts in (("none", np.zeros((3, 3))), ("touch", touching), ("unknown", None)):
        plans[name], after = mpc.step(observation, contacts, believing)
        np.testing.assert_array_equal(after.belief.probability, plans[name].beliefs.probability[0])
    assert plans["touch"].beliefs.probability[0, 0] > 0.9
    assert plans["none"].beliefs.probability[0, 0] < 0.1
    assert np.max(np.abs(plans["touch"].controls - plans["none"].controls)) > 0.1
    np.testing.assert_allclose(plans["unknown"].controls, plans["none"].controls, atol=1e-4)


def test_contacts_may_be_measured_in_part(mpc, start):
    believing = half_sure(start)
    contacts = np.full((3, 3), np.nan)
    contacts[0, 1] = 1.0  # the other direction stays unmeasured
    plan, _ = mpc.step(scene(), contacts, believing)
    assert plan.beliefs.probability[0, 0] > 0.9 and np.all(np.isfinite(plan.controls))
    contacts[0, 1] = np.inf
    plan, _ = mpc.step(scene(), contacts, believing)
    assert plan.beliefs.probability[0, 0] < 0.1 and np.all(np.isfinite(plan.controls))


@pytest.mark.parametrize(
    ("name", "bad"),
    [("position", np.nan), ("position", -np.inf), ("velocity", np.inf), ("velocity", 1e39)],
)
def test_a_bad_observation_gives_the_shifted_plan(mpc, start, name, bad):
    plan, state = mpc.step(scene(), None, start)
    observation = scene()
    observation[name][1, 0] = bad
    with np.errstate(over="ignore"):
        kept, after = mpc.step(observation, np.full((3, 3), bad), state)
    assert kept.outcome == PlanStatus.BAD_OBSERVATION
    np.testing.assert_array_equal(kept.controls[:-1], plan.controls[1:])
    np.testing.assert_array_equal(kept.controls[-1], 0.0)
    np.testing.assert_array_equal(after.belief.probability, plan.beliefs.probability[1])
    # Blind for longer than the plan: no force. Sighted again: a plan of its own.
    for _ in range(HORIZON):
        with np.errstate(over="ignore"):
            kept, after = mpc.step(observation, None, after)
    np.testing.assert_array_equal(kept.controls, 0.0)
    plan, _ = mpc.step(scene(), None, after)
    assert plan.outcome.solved


def test_padding_may_hold_anything(mpc, start):
    padded = scene(CAPACITY, shift=0.05)
    padded["position"][3], padded["velocity"][3] = np.nan, np.inf
    expected, _ = mpc.step(scene(3, shift=0.05), None, start)
    found, _ = mpc.step(padded, None, start)
    assert found.outcome.solved
    np.testing.assert_array_equal(found.controls, expected.controls)


def test_a_huge_observation_gives_the_shifted_plan(mpc, start):
    plan, state = mpc.step(scene(), None, start)
    observation = scene()
    observation["position"][0] = 1e30
    kept, _ = mpc.step(observation, None, state)
    assert kept.outcome == PlanStatus.NOT_FINITE
    assert np.all(np.isfinite(kept.controls))
    np.testing.assert_array_equal(kept.controls, shift_plan(plan).controls)


def test_a_late_plan_is_replaced_by_the_shifted_one_and_starts_the_next(counted, start):
    mpc, _, clock = counted
    clock.period = 0.009
    plan, state = mpc.step(scene(), None, start)
    assert plan.outcome.solved
    clock.period = 0.011
    moved = scene(shift=0.3)
    late, after = mpc.step(moved, None, state)
    assert late.outcome == PlanStatus.DEADLINE_MISSED and "deadline" in late.outcome.message
    np.testing.assert_array_equal(late.controls, shift_plan(plan).controls)
    clock.period = 0.0
    in_time, _ = mpc.step(moved, None, state)
    np.testing.assert_array_equal(after.plan.controls, in_time.controls)


def test_the_last_plan_is_the_guess(mpc, start):
    first, state = mpc.step(scene(), None, start)
    motion = {k: v for k, v in scene(CAPACITY).items() if k != "goal"}
    moved, _ = advance(motion, first.controls[0], nodes_of(3, CAPACITY), jnp.zeros(6))
    warm, _ = mpc.step(moved, None, state)
    nothing = jax.tree.map(lambda leaf: jnp.zeros_like(leaf), state.plan)
    cold = dataclasses.replace(state, carry=dataclasses.replace(state.carry, plan=nothing))
    again, _ = mpc.step(moved, None, cold)
    assert int(warm.iterations) < int(again.iterations)


def test_between_plans_the_feedback_acts():
    mpc = MPC(StickyBodies(), ILQR(HORIZON, 12, LIMITS), replan_every=3)
    state = mpc.reset(scene(), nodes_of(3, CAPACITY), cost_to())
    made, later = [], state
    for _ in range(7):
        plan, later = mpc.step(scene(), None, later)
        made.append(plan.outcome.solved)
    assert made == [True, False, False] * 2 + [True]
    plan, state = mpc.step(scene(), None, state)
    assert plan.outcome.solved
    touching = np.zeros((3, 3))
    touching[0, 1] = touching[1, 0] = 1.0
    observation = scene(CAPACITY, shift=-0.03)
    followed, state = mpc.step(observation, touching, state)
    assert followed.outcome == PlanStatus.PLAN_REUSED
    x = np.stack([observation["position"], observation["velocity"]], 1)
    x[3] = 0.0  # padding
    expected = np.tensordot(plan.policy.K[1], x, 3) + plan.policy.k[1]
    expected = np.clip(expected, -LARGEST, LARGEST)
    np.testing.assert_allclose(followed.controls[0], expected, atol=1e-4)
    assert np.max(np.abs(followed.controls[0] - plan.controls[1])) > 0.01
    assert state.belief.probability[0] > 0.9  # predicted from the corrected belief
    bad = scene()
    bad["position"][0] = np.nan
    at_once, _ = mpc.step(scene(), None, state, replan=True)
    assert at_once.outcome.solved
    followed, state = mpc.step(scene(), None, state)
    assert followed.outcome == PlanStatus.PLAN_REUSED
    plan, state = mpc.step(bad, None, state)
    assert plan.outcome == PlanStatus.BAD_OBSERVATION
    reused, _ = mpc.step(scene(), None, state, replan=False)
    assert reused.outcome == PlanStatus.PLAN_REUSED
    plan, state = mpc.step(scene(), None, state)
    assert plan.outcome.solved


def test_a_shifted_plan_ends_at_rest():
    rng = np.random.default_rng(0)
    H, U, state = 3, 2, (2, 2, 1)
    plan = Plan(
        states=jnp.asarray(rng.normal(size=(H + 1, *state))),
        controls=jnp.asarray(rng.normal(size=(H, U))),
        policy=AffinePolicy(
            jnp.asarray(rng.normal(size=(H, U, *state))), jnp.asarray(rng.normal(size=(H, U)))
        ),
        beliefs=two_type_belief(jnp.asarray(rng.uniform(size=(H, 1)))),
        cost=jnp.asarray(7.0),
        status=jnp.asarray(2),
        iterations=jnp.asarray(5),
        node_ids=jnp.arange(2),
    )
    shifted = shift_plan(plan)
    for name in ("states", "beliefs.type_probability"):
        before, after = (operator.attrgetter(name)(each) for each in (plan, shifted))
        np.testing.assert_array_equal(after, np.concatenate([before[1:], before[-1:]]))
    for name in ("controls", "policy.K", "policy.k"):
        before, after = (operator.attrgetter(name)(each) for each in (plan, shifted))
        np.testing.assert_array_equal(after[:-1], before[1:])
        assert not np.any(after[-1])
    kept = [(each.cost, each.status, each.iterations, each.node_ids) for each in (plan, shifted)]
    assert eqx.tree_equal(*kept)


def test_a_broken_model_never_comes_out_as_a_control():
    mpc = MPC(Broken(), ILQR(HORIZON, 4, LIMITS))
    state = mpc.reset(scene(), nodes_of(3, CAPACITY), cost_to())
    for _ in range(3):
        plan, state = mpc.step(scene(), None, state)
        assert plan.outcome == PlanStatus.NOT_FINITE
        np.testing.assert_array_equal(plan.controls, 0.0)


def test_mistakes_are_named(mpc, start):
    def step(observation, contacts=None):
        return lambda: mpc.step(observation, contacts, start)

    bad = scene()
    bad["velocity"][0] = np.nan
    ilqr = ILQR(HORIZON)
    mistakes = {
        "position must have shape \\(n, 2\\) with n <= 4": step(
            {"position": np.zeros((5, 2)), "velocity": np.zeros((5, 2))}
        ),
        "must have position and velocity, found \\['goal'\\]": step({"goal": np.zeros(2)}),
        "contacts must have shape \\(n, n\\) with n <= 4": step(scene(), np.zeros((3, 2))),
        "velocity must be finite": lambda: mpc.reset(bad, nodes_of(3, CAPACITY), cost_to()),
        "2ND entries for the capacity N = 3": lambda: mpc.reset(scene(), nodes_of(3, 3), cost_to()),
        "replan=False needs a replan_every above 1": lambda: mpc.step(
            scene(), None, start, replan=False
        ),
        "replan_every must be 1 to the horizon": lambda: MPC(StickyBodies(), ilqr, replan_every=0),
        "deadline must be positive": lambda: MPC(StickyBodies(), ilqr, deadline=math.nan),
    }
    for message, call in mistakes.items():
        with pytest.raises(InvalidInputError, match=message):
            call()


def test_every_status_has_a_message():
    assert all(status.message.endswith(".") for status in PlanStatus)


class WithSwitch(StickyBodies):
    """A third component of the control moves nothing."""

    def linear_step(self, state, control, nodes):
        linear, belief = super().linear_step(state, control, nodes)
        B = jnp.concatenate([linear.B, jnp.zeros_like(linear.B[..., :1])], axis=-1)
        return dataclasses.replace(linear, B=B), belief


def test_a_switch_stays_at_the_limit_nearest_to_off_and_changes_no_force(mpc):
    lowest = 0.25
    limits = ControlLimits(
        jnp.array([-LARGEST, -LARGEST, lowest]), jnp.array([LARGEST, LARGEST, 1.0])
    )
    cost = chain_cost(
        (0, 1), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, (0.5, 0.4), CAPACITY, control_size=3
    )
    switched = MPC(WithSwitch(), ILQR(HORIZON, 12, limits), clock=lambda: 0.0)
    plan, _ = switched.step(scene(), None, switched.reset(scene(), nodes_of(3, CAPACITY), cost))
    forces, _ = mpc.step(scene(), None, mpc.reset(scene(), nodes_of(3, CAPACITY), cost_to()))
    assert plan.outcome.solved and forces.outcome.solved
    np.testing.assert_array_equal(plan.controls[:, 2], lowest)
    np.testing.assert_allclose(plan.controls[:, :2], forces.controls, atol=1e-3)
    assert np.abs(forces.controls).max() > 1.0
