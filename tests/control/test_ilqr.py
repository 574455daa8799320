"""iLQR: the cost never rises, the status is honest, limits hold, padding changes nothing."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import (
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
from contactgraph.model import ModelState, stack_state, two_type_belief

LIMITS = ControlLimits(jnp.full(2, -8.0), jnp.full(2, 8.0))


@eqx.filter_jit
def compiled(ilqr, model, state, nodes, cost, guess):
    return ilqr.solve(model, state, nodes, cost, guess)


def solve(ilqr, model, state, nodes, cost, guess=None):
    """One compilation whether there is a guess or not."""
    guess = ilqr.zero_policy(2 * state.position.size, cost) if guess is None else guess
    return compiled(ilqr, model, state, nodes, cost, guess)


def replay(model, state, nodes, controls):
    """The states that controls lead to, and the beliefs, by stepping the model one by one."""

    def advance(state, control):
        linear, belief = model.linear_step(state, nodes)
        state = ModelState(*linear(state.position, state.velocity, control), belief)
        return state, state

    _, after = jax.lax.scan(advance, state, controls)
    everything = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), state, after)
    return stack_state(everything.position, everything.velocity)


def random_task(key):
    """A random nonlinear model that also switches, with a random cost; 3 nodes in the plane."""
    keys = jax.random.split(key, 9)
    model = RandomModel(
        2.0 * jax.random.normal(keys[0], (4, 3, 2)),
        2.0 * jax.random.normal(keys[1], (3, 2, 2)),
        5.0 * jax.random.uniform(keys[2]),
    )
    root = jax.random.normal(keys[3], (12, 12)) / 3.0
    root_R = 0.3 * jax.random.normal(keys[4], (2, 2))
    cost = QuadraticCost(
        root @ root.T, root_R @ root_R.T + 0.01 * jnp.eye(2), jax.random.normal(keys[5], (12,))
    )
    state = ModelState(
        jax.random.normal(keys[6], (3, 2)),
        jax.random.normal(keys[7], (3, 2)),
        two_type_belief(jnp.zeros(3)),
    )
    guess = AffinePolicy(jnp.zeros((12, 2, 12)), jax.random.normal(keys[8], (12, 2)))
    return model, cost, state, guess


@pytest.mark.parametrize("limits", [None, ControlLimits(-0.5 * jnp.ones(2), 2.0 * jnp.ones(2))])
def test_cost_never_rises_over_200_random_problems(limits):
    nodes = nodes_of(3, 3)

    def costs_of(key):
        model, cost, state, guess = random_task(key)
        guessed = guess.k if limits is None else limits(guess.k)
        costs = [cost(replay(model, state, nodes, guessed), guessed)]
        for iterations in (3, 12):
            plan = ILQR(12, iterations, limits).solve(model, state, nodes, cost, guess)
            costs.append(plan.cost)
        return costs, plan, cost(replay(model, state, nodes, plan.controls), plan.controls)

    keys = jax.random.split(jax.random.key(0), 200)
    # One after the other, as in use: side by side all would wait for the slowest.
    costs, plan, replayed = jax.jit(lambda keys: jax.lax.map(costs_of, keys))(keys)
    costs = np.stack(costs)
    assert np.all(np.isfinite(costs))
    assert np.all(costs[1] <= costs[0] * (1 + 1e-5))
    assert np.all(costs[2] <= costs[1])
    assert np.mean(costs[2] < 0.9 * costs[0]) > 0.7
    # The cost that is claimed is the cost that the model gives for these controls.
    np.testing.assert_allclose(plan.cost, replayed, rtol=2e-3)
    statuses = set(np.asarray(plan.status).tolist())
    assert statuses <= {0, 1, 2}
    assert PlanStatus.CONVERGED in statuses and PlanStatus.ITERATION_LIMIT in statuses


def test_converged_means_that_another_solve_gains_nothing():
    nodes = nodes_of(3, 3)
    ilqr = ILQR(12, 30)

    def again(key):
        model, cost, state, guess = random_task(key)
        first = ilqr.solve(model, state, nodes, cost, guess)
        return first, ilqr.solve(model, state, nodes, cost, first.policy)

    keys = jax.random.split(jax.random.key(1), 60)
    first, second = jax.jit(lambda keys: jax.lax.map(again, keys))(keys)
    converged = np.asarray(first.status) == PlanStatus.CONVERGED
    assert converged.sum() > 10
    gain = (first.cost - second.cost) / first.cost
    assert np.all(np.asarray(gain)[converged] < 2e-4)
    assert np.all(np.asarray(second.iterations)[converged] <= 3)


def test_on_linear_dynamics_one_step_reaches_the_lqr_optimum():
    class Springs(eqx.Module):
        def linear_step(self, state, nodes):
            one = jnp.ones_like(state.position)
            return blocks(-0.1 * one, 0.9 * one, 0.05 * jnp.stack([one, -one], -1), one), (
                state.belief
            )

    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    cost = QuadraticCost(jnp.asarray(root @ root.T), jnp.eye(2), jnp.asarray(rng.normal(size=4)))
    state, nodes, H = state_of([[0.3], [-1.0]], [[0.0], [1.0]]), nodes_of(2, 2), 20
    plan = solve(ILQR(H, 10), Springs(), state, nodes, cost)
    A, B, offset = (
        jnp.broadcast_to(part, (H, *part.shape))
        for part in Springs().linear_step(state, nodes)[0].stacked()
    )
    Q, R, goal = cost.over(H)
    slope = -jnp.einsum("tij,tj->ti", Q, goal)
    policy, value = solve_lqr(LQRProblem(A, B, offset, Q, R, slope, jnp.zeros((H, 2))))
    first = jax.tree.map(lambda leaf: leaf[0], value)
    x = stack_state(state.position, state.velocity)
    optimum = first(x) + jnp.einsum("ti,tij,tj->", goal, Q, goal)
    np.testing.assert_allclose(plan.cost, optimum, rtol=1e-4)
    np.testing.assert_allclose(plan.policy.K, policy.K, rtol=1e-3, atol=1e-4)
    assert plan.outcome == PlanStatus.CONVERGED and int(plan.iterations) == 2


def test_pendulum_comes_upright():
    cost = QuadraticCost(jnp.diag(jnp.asarray([5.0, 0.1])), 0.01 * jnp.eye(1), jnp.zeros(2))
    plan = solve(ILQR(60, 60), Pendulum(), state_of([[2.5]], [[0.0]]), nodes_of(1, 1), cost)
    assert abs(float(plan.states[-1, 0])) < 0.05
    nothing = solve(ILQR(60, 1), Pendulum(), state_of([[2.5]], [[0.0]]), nodes_of(1, 1), cost)
    assert nothing.outcome == PlanStatus.ITERATION_LIMIT
    assert plan.cost < 0.5 * nothing.cost


def pickup(count: int, capacity: int):
    rng = np.random.default_rng(4)
    position = np.zeros((capacity, 2))
    position[:count] = rng.uniform(2.0, 3.0, (count, 2))
    position[:2] = [[-0.4, -0.1], [0.1, 0.1]]
    cost = chain_cost(
        [0, 1], [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, [0.5, 0.4], node_count=capacity
    )
    state = state_of(position, np.zeros((capacity, 2)))
    return state, nodes_of(count, capacity), cost


def test_plans_through_contact_within_limits():
    state, nodes, cost = pickup(3, 3)
    ilqr = ILQR(40, 20, LIMITS)
    plan = solve(ilqr, StickyBodies(), state, nodes, cost)
    assert np.all(np.abs(plan.controls) <= 8.0)
    assert np.any(np.abs(plan.controls) == 8.0), "a limit that binds nowhere tests nothing"
    # The object was at rest at (0.1, 0.1): only through contact can it get to the goal.
    assert np.linalg.norm(np.asarray(plan.states[-1, 4:6]) - [0.5, 0.4]) < 0.05
    np.testing.assert_allclose(
        plan.states, replay(StickyBodies(), state, nodes, plan.controls), atol=1e-4
    )
    touched = np.asarray(plan.beliefs.probability[:, 0]) > 0.5
    assert not touched[0] and touched[-1]
    assert plan.policy.K.shape == (40, 2, 12)
    followed = np.einsum("tui,ti->tu", plan.policy.K, plan.states[:-1]) + plan.policy.k
    np.testing.assert_allclose(followed, plan.controls, atol=1e-3)


def test_padding_and_naming_the_involved_nodes_change_nothing():
    tight = solve(ILQR(40, 20, LIMITS), StickyBodies(), *pickup(3, 3))
    for every_node in (False, True):
        state, nodes, cost = pickup(3, 7)
        if every_node:
            cost = dataclasses.replace(cost, involved=None)
        padded = solve(ILQR(40, 20, LIMITS), StickyBodies(), state, nodes, cost)
        np.testing.assert_allclose(padded.controls, tight.controls, atol=1e-4)
        np.testing.assert_allclose(padded.states[:, :12], tight.states, atol=1e-5)
        assert not np.any(padded.policy.K[:, :, 12:])


def test_a_warm_start_saves_iterations():
    arguments = StickyBodies(), *pickup(3, 3)
    cold = solve(ILQR(40, 20, LIMITS), *arguments)
    warm = solve(ILQR(40, 20, LIMITS), *arguments, cold.policy)
    assert int(warm.iterations) < int(cold.iterations)
    assert warm.cost <= cold.cost * (1 + 1e-5)


def test_a_model_without_an_answer_is_told():
    cost = chain_cost([0], [1] * 4, [1] * 4, 0.01, [1.0, 0.0], node_count=1)
    limits = ControlLimits(jnp.full(2, 0.5), jnp.full(2, 2.0))
    state = state_of([[0.0, 0.0]], [[0.0, 0.0]])
    plan = solve(ILQR(10, 10, limits), Broken(), state, nodes_of(1, 1), cost)
    assert plan.outcome == PlanStatus.NOT_FINITE
    assert "not finite" in plan.outcome.message
    np.testing.assert_array_equal(plan.controls, 0.5)
    assert np.all(np.isfinite(plan.policy.K))


def test_a_guess_without_an_answer_is_dropped_and_trials_into_nan_are_rejected():
    cost = chain_cost([0], [1] * 4, [50, 50, 0, 0], 0.01, [0.3, 0.0], node_count=1)
    state = state_of([[0.0, 0.0]], [[0.0, 0.0]])
    guess = AffinePolicy(jnp.zeros((20, 2, 4)), jnp.full((20, 2), jnp.nan))
    plan = solve(ILQR(20, 20), Broken(edge=0.25), state, nodes_of(1, 1), cost, guess)
    assert plan.outcome in (PlanStatus.NO_DESCENT, PlanStatus.ITERATION_LIMIT)
    assert np.all(np.isfinite(plan.controls)) and np.all(np.isfinite(plan.states))
    assert np.max(plan.states[:-1, 0]) <= 0.25
    at_rest = solve(ILQR(20, 1), Broken(edge=0.25), state, nodes_of(1, 1), cost)
    assert plan.cost < at_rest.cost
