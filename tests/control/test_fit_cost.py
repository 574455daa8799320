"""The hidden cost of LQR experts is recovered up to its scale."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.control import (
    BeliefCost,
    CostLearningConfig,
    lqr_trajectory,
    tracking_problem,
)
from contactgraph.control.cost_learner import fit_cost
from contactgraph.control.demonstrations import Demonstrations
from contactgraph.control.learned_cost import isotropic_axes
from contactgraph.data import InvalidInputError
from contactgraph.model import ContactBelief

RUNS, HORIZON, N, U = 24, 12, 4, 2
STARTS = np.array([(trajectory, 0) for trajectory in range(RUNS)])


def no_contacts() -> BeliefCost:
    return BeliefCost(jnp.zeros((0, 2), int), jnp.zeros(0), 2, jnp.zeros(0, int))


def hidden_expert(seed: int) -> tuple[Demonstrations, np.ndarray, np.ndarray]:
    """Optimal runs of a random system from random states to random goals, and their Q and R."""
    rng = np.random.default_rng(seed)
    A = np.eye(N) + 0.2 * rng.normal(size=(N, N))
    A = A / max(1.0, np.abs(np.linalg.eigvals(A)).max())
    B = rng.normal(size=(N, U))
    root, control_root = rng.normal(size=(N, N)), np.eye(U) + 0.3 * rng.normal(size=(U, U))
    R = control_root @ control_root.T
    scale = U / np.trace(R)
    Q, R = scale * (root @ root.T) / N, scale * R
    offset = 0.1 * rng.normal(size=(RUNS, HORIZON, N))
    goal, start = rng.normal(size=(RUNS, N)), rng.normal(size=(RUNS, N))
    A, B = np.tile(A, (RUNS, HORIZON, 1, 1)), np.tile(B, (RUNS, HORIZON, 1, 1))
    A, B, offset, goal, start = map(jnp.asarray, (A, B, offset, goal, start))

    @jax.jit
    @jax.vmap
    def optimal(A, B, offset, goal, start):
        problem = tracking_problem(A, B, offset, jnp.asarray(Q), jnp.asarray(R), goal)
        return lqr_trajectory(problem, start)

    trajectories = optimal(A, B, offset, goal, start)
    beliefs = ContactBelief(jnp.zeros((RUNS, HORIZON + 1, 0, 2)))
    found = trajectories.states, trajectories.controls
    return Demonstrations(A, B, offset, *found, goal, beliefs), Q, R


@pytest.mark.parametrize(
    ("seed", "steps"),
    [(0, 3000), *(pytest.param(seed, 20_000, marks=pytest.mark.slow) for seed in (1, 2, 3))],
)
def test_a_hidden_cost_is_recovered(double_precision, seed, steps):
    data, Q, R = hidden_expert(seed)
    recipe = CostLearningConfig(
        horizon=HORIZON,
        steps=steps,
        batch=RUNS,
        learning_rate=0.1,
        discount=1.0,
        prior_weight=0.0,
    )
    found_Q, found_R, _, loss = fit_cost(
        data, STARTS, isotropic_axes(np.zeros(2)), no_contacts(), recipe
    )
    assert loss[-1] < 1e-9 * loss[0]
    assert np.abs(found_Q - Q).max() < 1e-4 * np.abs(Q).max()
    assert np.abs(found_R - R).max() < 1e-4
    assert np.trace(found_R) == pytest.approx(U)
    assert np.array_equal(found_Q, found_Q.T) and np.linalg.eigvalsh(found_Q)[0] > -1e-12


@pytest.mark.slow
def test_the_same_seed_gives_the_same_cost_and_progress_is_reported():
    data, _, _ = hidden_expert(0)
    recipe = CostLearningConfig(horizon=HORIZON, steps=100, batch=8)
    steps: list[int] = []
    *one, losses = fit_cost(
        data,
        STARTS,
        isotropic_axes(np.zeros(2)),
        no_contacts(),
        recipe,
        3,
        on_step=lambda step, loss: steps.append(step),
    )
    *other, _ = fit_cost(data, STARTS, isotropic_axes(np.zeros(2)), no_contacts(), recipe, 3)
    assert steps == [50, 100] and losses.shape == (100,)
    assert all(map(np.array_equal, one, other))
    assert np.mean(losses[-10:]) < np.mean(losses[:10])


def test_lost_definiteness_stops_with_the_step_and_the_eigenvalue():
    data, _, _ = hidden_expert(0)
    recipe = CostLearningConfig(horizon=HORIZON, steps=50, batch=8, learning_rate=1e30)
    message = r"stopped at step \d+: [QR]'s smallest eigenvalue is .*; a smaller learning rate"
    with pytest.raises(InvalidInputError, match=message):
        fit_cost(data, STARTS, isotropic_axes(np.zeros(2)), no_contacts(), recipe)


def test_demonstrations_without_a_control_are_refused():
    data, _, _ = hidden_expert(0)
    still = replace(data, controls=jnp.zeros_like(data.controls))
    with pytest.raises(InvalidInputError, match="control never changes from 0"):
        fit_cost(
            still,
            STARTS,
            isotropic_axes(np.zeros(2)),
            no_contacts(),
            CostLearningConfig(horizon=HORIZON),
        )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("horizon", 0),
        ("steps", 0),
        ("batch", 0),
        ("learning_rate", 0.0),
        ("discount", 1.5),
        ("prior_weight", -1.0),
    ],
)
def test_recipes_out_of_range_are_refused(name, value):
    with pytest.raises(InvalidInputError, match=name):
        CostLearningConfig(**{name: value})
