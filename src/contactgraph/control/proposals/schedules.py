"""Starts that differ in the schedule of a switch: when a held component has which of two values.

A switch acts on which edges hold, not on a force, so the linear dynamics have no column for it and
no derivative of the cost tells when to operate it. So plans of several schedules are compared: the
running one, always on, always off, and one change at some step, with the running plan's forces.
A switch has no values between its limits: what is rolled out, what is returned and what a task does
are the same.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from contactgraph.control.box_qp import AffinePolicy
from contactgraph.control.ilqr import PlanningProblem
from contactgraph.control.multi_start import Starts
from contactgraph.data.errors import InvalidInputError


class ConstantSchedule(eqx.Module):
    """A switch is on, or off, at all steps; the start leaps (`Starts.leap`)."""

    switch: int = eqx.field(static=True)
    """Component of the control."""
    on: bool = eqx.field(static=True)

    def __call__(self, problem: PlanningProblem) -> Starts:
        """One start."""
        return _scheduled(
            problem, self.switch, np.full((1, problem.planner.horizon), self.on), True
        )


class ChangingSchedules(eqx.Module):
    """A switch changes once, at one of a few steps that are evenly spread over the horizon."""

    switch: int = eqx.field(static=True)
    """Component of the control."""
    changes: int = eqx.field(static=True, default=3)
    """Steps at which it may change, 1 or more."""

    def __call__(self, problem: PlanningProblem) -> Starts:
        """Two starts for each of the steps. Raises `InvalidInputError` where they do not fit."""
        horizon = problem.planner.horizon
        if not 1 <= self.changes < horizon:
            raise InvalidInputError(
                f"changes must be 1 to below the horizon ({horizon}), found {self.changes}"
            )
        steps = np.linspace(0, horizon, self.changes + 2)[1:-1].round().astype(int)
        after = np.arange(horizon) >= steps[:, None]
        return _scheduled(problem, self.switch, np.concatenate([after, ~after]), False)


def _scheduled(problem: PlanningProblem, switch: int, on: np.ndarray, leap: bool) -> Starts:
    """The guess, with the switch ``on`` [S, H] bool."""
    limits, guess = problem.planner.limits, problem.guess
    if switch not in problem.planner.held or limits is None:
        raise InvalidInputError(f"a switch must be held and have limits, found component {switch}")
    value = jnp.where(on.T, limits.upper[switch], limits.lower[switch])
    k = jnp.repeat(guess.k[..., None], len(on), axis=-1)
    K = jnp.repeat(guess.K[..., None], len(on), axis=-1)
    return Starts(AffinePolicy(K, k.at[:, switch].set(value.astype(k.dtype))), leap)
