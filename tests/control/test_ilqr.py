"""iLQR: the cost never rises, the status is honest, limits hold, padding changes nothing.

Every program is compiled once: a solver is a module-level function, a problem without limits has
infinite ones, and a scene with fewer nodes is a mask.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import (
    Apart,
    Broken,
    Pendulum,
    RandomModel,
    StickyBodies,
    blocks,
    nodes_of,
    state_of,
)

from contactgraph.control import (
    ILQR,
    AffinePolicy,
    ControlLimits,
    LQRProblem,
    PlanStatus,
    QuadraticCost,
    chain_cost,
    solve_lqr,
)
from contactgraph.control.ilqr import Progress, _adapted
from contactgraph.control.lqr import Improvement
from contactgraph.control.rollout import Rollout
from contactgraph.model import LinearDynamics, ModelState, two_type_belief

LIMITS = ControlLimits(np.full(2, -8.0), np.full(2, 8.0))
FREE = ControlLimits(np.full(2, -np.inf), np.full(2, np.inf))


@eqx.filter_jit
def solve(ilqr, model, state, nodes, cost, guess):
    return ilqr.solve(model, state, nodes, cost, guess)


def no_force(horizon, nodes, dimension, U=2):
    return AffinePolicy(np.zeros((horizon, U, nodes, 2, dimension)), np.zeros((horizon, U)))


def replay(model, state, nodes, controls):
    """The states that controls lead to, by stepping the model one by one."""

    def advance(state, control):
        linear, belief = model.linear_step(state, control, nodes)
        state = ModelState(*linear(state.position, state.velocity, control), belief)
        return state, state

    _, after = jax.lax.scan(advance, state, controls)
    everything = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), state, after)
    return jnp.stack([everything.position, everything.velocity], axis=2)


def random_tasks(count):
    """Random nonlinear models that also switch, with random costs; 3 nodes in the plane."""
    rng = np.random.default_rng(0)
    normal = rng.standard_normal
    model = RandomModel(
        2.0 * normal((count, 4, 3, 2)),
        2.0 * normal((count, 3, 2, 2)),
        5.0 * rng.uniform(size=count),
    )
    root, root_R = normal((count, 12, 12)) / 3.0, 0.3 * normal((count, 2, 2))
    cost = QuadraticCost(
        root @ np.swapaxes(root, 1, 2),
        root_R @ np.swapaxes(root_R, 1, 2) + 0.01 * np.eye(2),
        normal((count, 12)),
        np.ones(count),
    )
    motion = normal((2, count, 3, 2))
    guess = AffinePolicy(np.zeros((count, 12, 2, 3, 2, 2)), normal((count, 12, 2)))
    return jax.tree.map(jnp.asarray, (model, cost, motion[0], motion[1], guess))


@jax.jit
def solve_twice(tasks, limits):
    """Per task: the guess's cost, two plans (the second from the first), the replayed cost."""
    nodes = nodes_of(3, 3)

    def each(task):
        model, cost, position, velocity, guess = task
        state = ModelState(position, velocity, two_type_belief(jnp.zeros(3)))
        guessed = limits(guess.k)

        def again(guess, _):
            plan = ILQR(12, 12, limits).solve(model, state, nodes, cost, guess)
            return plan.policy, plan

        _, plans = jax.lax.scan(again, guess, None, 2)
        first = jax.tree.map(lambda leaf: leaf[0], plans)
        replayed = replay(model, state, nodes, first.controls)
        guessed_cost = cost(replay(model, state, nodes, guessed), guessed)
        return (guessed_cost, cost(replayed, first.controls)), plans

    # One after the other, as in use: side by side all would wait for the slowest.
    return jax.lax.map(each, tasks)


@pytest.mark.parametrize("limits", [FREE, ControlLimits(np.full(2, -0.5), np.full(2, 2.0))])
def test_random_problems(limits):
    (guessed, replayed), plans = jax.tree.map(np.asarray, solve_twice(random_tasks(100), limits))
    first, second = plans.cost.T
    assert np.all(np.isfinite(first))
    assert np.all(first <= guessed * (1 + 1e-5)) and np.all(second <= first * (1 + 1e-5))
    assert np.mean(first < 0.9 * guessed) > 0.7
    # The cost that is claimed is the cost that the model gives for these controls.
    np.testing.assert_allclose(first, replayed, rtol=2e-3)
    assert np.all(plans.controls >= limits.lower) and np.all(plans.controls <= limits.upper)
    statuses = plans.status[:, 0]
    assert set(statuses.tolist()) <= {0, 1, 2}
    # Converged: another solve gains nothing, and says so at once.
    converged = statuses == PlanStatus.CONVERGED
    assert converged.sum() > 10 and np.any(statuses == PlanStatus.ITERATION_LIMIT)
    assert np.all((first - second)[converged] < 2e-4 * first[converged])
    assert np.all(plans.iterations[converged, 1] <= 3)


def small_search(cost, attempt=0, damping=0.0):
    """A search whose reference, of one node at rest and one step, has this cost."""
    zero = jnp.zeros(())
    dynamics = LinearDynamics(
        jnp.zeros((1, 1, 1, 2, 2)), jnp.zeros((1, 1, 1, 2, 1)), jnp.zeros((1, 1, 1, 2))
    )
    still = jnp.zeros((2, 1, 1))
    reference = Rollout(
        still,
        still,
        two_type_belief(jnp.zeros((1, 0))),
        jnp.zeros((2, 2)),
        jnp.zeros((1, 1)),
        dynamics,
    )
    policy = AffinePolicy(jnp.zeros((1, 1, 2)), jnp.zeros((1, 1)))
    return Progress(
        reference=reference,
        cost=zero + cost,
        improvement=Improvement(policy, policy.k, zero + 100.0),
        trial=policy,
        damping=zero + damping,
        attempt=jnp.asarray(attempt),
        iteration=jnp.asarray(3),
        status=jnp.asarray(-1),
        leap=jnp.zeros((), bool),
    )


def test_a_trial_is_accepted_only_where_it_lowers_the_cost_by_the_armijo_term():
    part = QuadraticCost(jnp.ones((2, 2, 2)), jnp.ones((1, 1, 1)), jnp.zeros((2, 2)))
    ilqr = ILQR(1)
    trial = jax.tree.map(lambda leaf: leaf + 1.0, small_search(1.0).reference)
    judge = jax.jit(
        lambda search, total: ilqr._judge(search, trial, total, (part, jnp.arange(1), ()))
    )
    # Of the expected decrease of 100, 1e-4 is asked for: 0.01 at the full step, 0.005 at the half.
    for attempt, total, accepted in (
        (0, 1.0, False),
        (0, 1.005, False),
        (0, 0.995, False),
        (0, 0.985, True),
        (1, 0.998, False),
        (1, 0.9935, True),
        (0, np.nan, False),
    ):
        after = judge(small_search(1.0, attempt), jnp.asarray(total))
        assert bool(after.reference.x[0, 0] == 1.0) == accepted, (attempt, total)
        assert float(after.cost) == pytest.approx(total if accepted else 1.0)
        assert int(after.attempt) == (0 if accepted else attempt + 1)
    assert float(judge(small_search(np.inf), jnp.asarray(7.0)).cost) == 7.0


def test_damping_falls_after_a_success_and_grows_when_no_step_size_helped():
    table = [
        # accepted, exhausted, damping before and after
        (True, False, 10.0, 1.0),
        (True, False, 0.1, 0.0),
        (False, False, 10.0, 10.0),
        (False, False, 0.0, 0.0),
        (False, True, 10.0, 100.0),
        (False, True, 0.0, 0.1),
    ]
    for accepted, exhausted, before, after in table:
        found = _adapted(jnp.asarray(before), jnp.asarray(accepted), jnp.asarray(exhausted))
        assert float(found) == pytest.approx(after), (accepted, exhausted, before)


class Springs(eqx.Module):
    def linear_step(self, state, control, nodes):
        one = jnp.ones_like(state.position)
        return blocks(-0.1 * one, 0.9 * one, 0.05 * jnp.stack([one, -one], -1), one), state.belief


def test_on_linear_dynamics_one_step_reaches_the_lqr_optimum():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    cost = QuadraticCost(jnp.asarray(root @ root.T), jnp.eye(2), jnp.asarray(rng.normal(size=4)))
    state, nodes, H = state_of([[0.3], [-1.0]], [[0.0], [1.0]]), nodes_of(2, 2), 12
    plan = solve(ILQR(H, 10), Springs(), state, nodes, cost, no_force(H, 2, 1))
    A, B, offset = (
        jnp.broadcast_to(part, (H, *part.shape))
        for part in Springs().linear_step(state, jnp.zeros(1), nodes)[0].stacked()
    )
    Q, R, goal = cost.over(H)
    slope = -jnp.einsum("tij,tj->ti", Q, goal)
    policy, value = jax.jit(solve_lqr)(LQRProblem(A, B, offset, Q, R, slope, jnp.zeros((H, 2))))
    first = jax.tree.map(lambda leaf: leaf[0], value)
    x = jnp.asarray([0.3, 0.0, -1.0, 1.0])
    optimum = first(x) + jnp.einsum("ti,tij,tj->", goal, Q, goal)
    np.testing.assert_allclose(plan.cost, optimum, rtol=1e-4)
    gains = np.reshape(plan.policy.K, (H, 2, 4))
    np.testing.assert_allclose(gains, policy.K, rtol=1e-3, atol=1e-4)
    assert plan.outcome == PlanStatus.CONVERGED and int(plan.iterations) == 2


def test_pendulum_comes_upright():
    cost = QuadraticCost(jnp.diag(jnp.asarray([5.0, 0.1])), 0.01 * jnp.eye(1), jnp.zeros(2))
    state = state_of([[2.5]], [[0.0]])
    plan = solve(ILQR(60, 60), Pendulum(), state, nodes_of(1, 1), cost, no_force(60, 1, 1, 1))
    assert abs(float(plan.states[-1, 0, 0, 0])) < 0.05
    assert plan.outcome.solved


CAPACITY, HORIZON = 4, 40
STICKY = ILQR(HORIZON, 20, LIMITS)


def pickup(count: int, capacity: int):
    rng = np.random.default_rng(4)
    position = np.zeros((capacity, 2))
    position[:count] = rng.uniform(2.0, 3.0, (count, 2))
    position[:2] = [[-0.4, -0.1], [0.1, 0.1]]
    cost = chain_cost(
        [0, 1], [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, [0.5, 0.4], node_count=capacity
    )
    return state_of(position, np.zeros((capacity, 2))), nodes_of(count, capacity), cost


@pytest.fixture(scope="module")
def picked():
    return solve(STICKY, StickyBodies(), *pickup(3, CAPACITY), no_force(HORIZON, CAPACITY, 2))


def test_plans_through_contact_within_limits(picked):
    state, nodes, _ = pickup(3, CAPACITY)
    assert np.all(np.abs(picked.controls) <= 8.0)
    assert np.any(np.abs(picked.controls) == 8.0), "a limit that binds nowhere tests nothing"
    # The object was at rest at (0.1, 0.1): only through contact can it get to the goal.
    assert np.linalg.norm(np.asarray(picked.states[-1, 1, 0]) - [0.5, 0.4]) < 0.05
    replayed = jax.jit(replay)(StickyBodies(), state, nodes, picked.controls)
    np.testing.assert_allclose(picked.states, replayed, atol=1e-4)
    touched = np.asarray(picked.beliefs.probability[:, 0]) > 0.5
    assert not touched[0] and touched[-1]
    assert picked.policy.K.shape == (HORIZON, 2, CAPACITY, 2, 2)
    K, states = np.asarray(picked.policy.K), np.asarray(picked.states[:-1])
    followed = np.einsum("tunpd,tnpd->tu", K, states) + picked.policy.k
    np.testing.assert_allclose(followed, picked.controls, atol=1e-3)


def test_a_control_at_its_bound_has_no_feedback(picked):
    bound = np.abs(np.asarray(picked.controls)) == 8.0
    K = np.asarray(picked.policy.K)
    assert bound.any() and not np.any(K[bound]) and np.all(np.any(K[~bound], axis=(1, 2, 3)))


def test_padding_and_naming_the_nodes_with_a_cost_change_nothing(picked):
    state, nodes, cost = pickup(3, 6)
    everyone = QuadraticCost(cost.Q, cost.R, cost.goal, cost.terminal_weight)
    for about in (cost, everyone):
        padded = solve(STICKY, StickyBodies(), state, nodes, about, no_force(HORIZON, 6, 2))
        np.testing.assert_allclose(padded.controls, picked.controls, atol=1e-4)
        np.testing.assert_allclose(padded.states[:, :3], picked.states[:, :3], atol=1e-5)
        assert not np.any(padded.policy.K[:, :, 3:])


def test_a_warm_start_saves_iterations(picked):
    warm = solve(STICKY, StickyBodies(), *pickup(3, CAPACITY), picked.policy)
    assert int(warm.iterations) < int(picked.iterations)
    assert warm.cost <= picked.cost * (1 + 1e-5)


def of_broken(edge, limits, cost, guess):
    state = state_of([[0.0, 0.0]], [[0.0, 0.0]])
    broken = Broken(edge=jnp.asarray(edge))
    return solve(ILQR(20, 20, limits), broken, state, nodes_of(1, 1), cost, guess)


def test_a_model_without_an_answer_is_reported():
    cost = chain_cost([0], [1] * 4, [1] * 4, 0.01, [1.0, 0.0], node_count=1)
    limits = ControlLimits(np.full(2, 0.5), np.full(2, 2.0))
    plan = of_broken(-1e9, limits, cost, no_force(20, 1, 2))
    assert plan.outcome == PlanStatus.NOT_FINITE
    assert "not finite" in plan.outcome.message
    np.testing.assert_array_equal(plan.controls, 0.5)
    assert np.all(np.isfinite(plan.policy.K))


def test_a_guess_without_an_answer_is_dropped_and_trials_into_nan_are_rejected():
    cost = chain_cost([0], [1] * 4, [50, 50, 0, 0], 0.01, [0.3, 0.0], node_count=1)
    guess = no_force(20, 1, 2)
    plan = of_broken(0.25, FREE, cost, AffinePolicy(guess.K, np.full((20, 2), np.nan)))
    assert plan.outcome in (PlanStatus.NO_DESCENT, PlanStatus.ITERATION_LIMIT)
    assert np.all(np.isfinite(plan.controls)) and np.all(np.isfinite(plan.states))
    assert np.max(plan.states[:-1, 0, 0, 0]) <= 0.25
    assert plan.cost < 21 * 50 * 0.3**2  # at rest


class Slope(Apart):
    """Body 0 of 1 kg, which is thrown back at 3 m/s in every step from beyond -0.3 m."""

    def linear_step(self, state, control, nodes):
        one = jnp.ones_like(state.position)
        back = jnp.where(state.position > -0.3, -3.0, 0.0)
        return blocks(0.0 * one, one, 0.05 * one[..., None] * jnp.eye(2), back), state.belief


def test_a_start_that_leaps_accepts_its_first_trial_whatever_it_costs():
    cost = QuadraticCost(jnp.diag(jnp.array([1.0, 1.0, 0, 0])), 1e-4 * jnp.eye(2), jnp.zeros(4))
    state, one = state_of([[-0.35, -0.5]], [[0.0, 0.0]]), nodes_of(1, 1)
    planner, guess = ILQR(10, 2, LIMITS), jax.tree.map(jnp.asarray, no_force(10, 1, 2))

    @jax.jit
    def searched(leap):
        problem = planner.prepared(Slope(), state, one, cost, guess)
        return planner.search(problem, planner.begun(problem, guess, leap), 2).cost

    stays, leapt = (float(searched(leap)) for leap in (False, True))
    at_rest = 11 * (0.35**2 + 0.5**2)
    assert stays == pytest.approx(at_rest) and at_rest < 0.9 * leapt
