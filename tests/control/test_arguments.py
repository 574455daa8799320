"""A planner's numbers are checked where they enter: right, or refused in a line with the cause."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import Pendulum, nodes_of, state_of

from contactgraph.control import ILQR, ControlLimits, PlanStatus, QuadraticCost
from contactgraph.data import InvalidInputError

PENDULUM = Pendulum(), state_of([[0.3]], [[0.0]]), nodes_of(1, 1)
Q, R, GOAL = np.diag([3.0, 1.0, 2.0, 0.0]), 0.1 * np.eye(2), np.ones(4)


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [
        ([10.0, 10.0], [-10.0, -10.0], "lower <= upper"),
        ([-10.0, np.nan], [10.0, 10.0], "lower <= upper"),
        ([-10.0, -10.0], [10.0, 10.0, 10.0], r"shapes \(2,\) and \(3,\)"),
        (-10.0, 10.0, r"shapes \(\) and \(\)"),
    ],
)
def test_limits_that_leave_no_control_are_refused(lower, upper, message):
    with pytest.raises(InvalidInputError, match=message):
        ControlLimits(lower, upper)


def test_limits_may_be_lists_and_infinite():
    limits = ControlLimits([-1, -np.inf], [1, np.inf])
    np.testing.assert_array_equal(limits(jnp.array([5.0, 5.0])), [1.0, 5.0])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"Q": -Q}, "Q must be positive semi-definite"),
        ({"Q": np.stack([Q, Q, -Q])}, "Q must be positive semi-definite"),
        ({"Q": np.full((4, 4), np.nan)}, "Q must be finite"),
        ({"Q": np.ones(4)}, r"square matrix, found shape \(4,\)"),
        ({"Q": np.eye(3)}, r"must fit the goal \[4\]"),
        ({"R": -R}, "R must be positive definite"),
        ({"R": np.zeros((2, 2))}, "R must be positive definite"),
        ({"R": np.full((2, 2), np.inf)}, "R must be finite"),
        ({"goal": np.array([0.0, 0.0, np.nan, 0.0])}, "goal must be finite"),
        ({"terminal_weight": -1.0}, "terminal_weight must be at least 0"),
    ],
)
def test_costs_without_a_minimum_are_refused(given, message):
    with pytest.raises(InvalidInputError, match=message):
        QuadraticCost(**{"Q": Q, "R": R, "goal": GOAL, **given})


def test_a_semi_definite_cost_in_single_precision_is_accepted():
    """Differences of positions, as `chain_cost` has them, whose rounding makes eigenvalues < 0."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        rows = rng.standard_normal((2, 4)) * 10.0 ** rng.uniform(-4, 4)
        QuadraticCost(Q=(rows.T @ rows).astype(np.float32), R=R, goal=GOAL)


def test_a_triangular_weight_is_its_symmetric_part():
    """``x^T Q x`` is the same for all x."""
    whole = Q + np.eye(4) + 0.5 * (np.eye(4, k=1) + np.eye(4, k=-1))
    found = QuadraticCost(Q=np.triu(whole) + np.triu(whole, 1), R=R, goal=GOAL)
    np.testing.assert_array_equal(found.Q, whole)


def test_arguments_of_other_sizes_are_refused_by_the_planner():
    cost = QuadraticCost(Q=np.eye(2), R=np.eye(1), goal=np.zeros(2))
    limits = ControlLimits([-1.0] * 3, [1.0] * 3)
    with pytest.raises(InvalidInputError, match="limits must be of 1 controls, found 3"):
        ILQR(horizon=2, limits=limits).solve(*PENDULUM, cost)
    for name in ("horizon", "iterations"):
        with pytest.raises(
            InvalidInputError, match=f"{name} must be a whole number of at least 1, found 0"
        ):
            ILQR(**{"horizon": 2, name: 0})


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_cost_without_a_minimum_never_converges(sign):
    """In a traced function the numbers cannot be checked: the status tells."""

    @eqx.filter_jit
    def solve(Q):
        cost = QuadraticCost(Q=Q, R=1e-6 * jnp.eye(1), goal=jnp.zeros(2))
        return ILQR(horizon=3, iterations=20).solve(*PENDULUM, cost)

    plan = solve(sign * jnp.diag(jnp.array([10.0, 0.1])))
    assert (int(plan.status) == PlanStatus.CONVERGED) == (sign > 0)
