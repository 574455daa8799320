"""The pendulum's swing-up for the benchmarks: one problem, and who can solve it.

A point mass of 1 kg on a massless rod of 1 m, hanging at angle 0, is to stand at pi. State
[angle rad, rate rad/s], control a torque [N m]; `HORIZON` steps of `DT`, semi-implicit Euler as in
crocoddyl's integrator: the rate first, then the angle with the new rate. The cost of a step is
``1.0 (angle - pi)^2 + 0.1 rate^2 + 0.1 torque^2``, of the last state a hundred times its first two
terms. The first guess is no torque.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from comparing import Way

from contactgraph.control import ILQR, QuadraticCost
from contactgraph.model import ContactBelief, LinearDynamics, ModelState, Nodes

HORIZON, DT = 100, 0.03
GRAVITY = 9.81
STATE_WEIGHT = np.array([1.0, 0.1])
CONTROL_WEIGHT = 0.1
LAST = 100.0
GOAL = np.array([np.pi, 0.0])
NEAR = 1e-4
"""A solver is done when its cost is above the least by no more than this part."""
TRIED = (10, 15, 20, 25, 30, 40, 50, 60)
"""Numbers of iterations."""
MANY = 200
"""Iterations after which nothing changes any more."""


@dataclass(frozen=True)
class Solver:
    """Solves the swing-up from several starts [batch, 2] with at most so many iterations."""

    name: str
    prepared: Callable[[np.ndarray, int], Callable[[], Any]]
    """From the starts and the iterations to what is timed."""
    controls: Callable[[Any], np.ndarray]
    """[batch, H] N m, of what that returned."""


def total_cost(starts: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """[batch] The cost of controls [batch, H], the same sum in double precision for everybody."""
    angle, rate = starts.astype(float).T
    total = np.zeros(len(starts))
    for torque in controls.T:
        total += _state_cost(angle, rate) + CONTROL_WEIGHT * torque**2
        rate = rate + DT * (torque - GRAVITY * np.sin(angle))
        angle = angle + DT * rate
    return total + LAST * _state_cost(angle, rate)


def _state_cost(angle: np.ndarray, rate: np.ndarray) -> np.ndarray:
    return STATE_WEIGHT[0] * (angle - GOAL[0]) ** 2 + STATE_WEIGHT[1] * (rate - GOAL[1]) ** 2


def enough_iterations(solver: Solver, starts: np.ndarray, least: np.ndarray) -> int | None:
    """The first number tried with which a solver is within `NEAR` of these costs."""
    for iterations in TRIED:
        controls = solver.controls(solver.prepared(starts, iterations)())
        if np.all(total_cost(starts, controls) <= (1.0 + NEAR) * least):
            return iterations
    return None


def way(solver: Solver, starts: np.ndarray, iterations: int) -> Way:
    """What is timed; the answer is the cost from every start."""

    def cost(returned: Any) -> np.ndarray:
        return total_cost(starts, solver.controls(returned))

    return Way(f"{solver.name}, {iterations} it.", solver.prepared(starts, iterations), cost)


class Pendulum(eqx.Module):
    """The pendulum as `ILQR` takes a model: one node with one degree of freedom, the angle."""

    def linear_step(self, state: ModelState, nodes: Nodes) -> tuple[LinearDynamics, ContactBelief]:
        """The step, linear about the state; exact in the control."""
        angle, rate = state.position[0, 0], state.velocity[0, 0]
        slope = -GRAVITY * jnp.cos(angle)
        fall = -GRAVITY * jnp.sin(angle)
        A = jnp.array([[1.0 + DT**2 * slope, DT], [DT * slope, 1.0]])
        after = jnp.array([angle + DT * (rate + DT * fall), rate + DT * fall])
        offset = after - jnp.sum(A * jnp.array([angle, rate]), axis=-1)
        B = jnp.array([[DT**2], [DT]])
        return LinearDynamics(A[None, None], B[None, None], offset[None, None]), state.belief

    def initial_belief(self, position: jax.Array, velocity: jax.Array, nodes: Nodes) -> Any:
        """About no edges."""
        return ContactBelief(jnp.zeros((0, 2)))


def _planned(starts: np.ndarray, iterations: int) -> Callable[[], Any]:
    ilqr = ILQR(horizon=HORIZON, iterations=iterations, tolerance=0.0, absolute_tolerance=0.0)
    nodes = Nodes(jnp.ones(1, bool), jnp.ones(1, bool), jnp.ones(0, bool))
    cost = QuadraticCost(
        Q=jnp.asarray(np.diag(STATE_WEIGHT)),
        R=jnp.full((1, 1), CONTROL_WEIGHT),
        goal=jnp.asarray(GOAL),
        terminal_weight=jnp.asarray(LAST),
    )
    model, belief = Pendulum(), ContactBelief(jnp.zeros((0, 2)))

    def controls(start: jax.Array) -> jax.Array:
        state = ModelState(start[:1, None], start[1:, None], belief)
        return ilqr.solve(model, state, nodes, cost).controls[:, 0]

    # One start is solved without a batch: that is how a controller calls it.
    placed = jnp.asarray(starts[0] if len(starts) == 1 else starts, jnp.float32)
    solve = jax.jit(controls if len(starts) == 1 else jax.vmap(controls))
    return lambda: jax.block_until_ready(solve(placed))


OURS = Solver("ours", _planned, lambda answer: np.asarray(answer, float).reshape(-1, HORIZON))
