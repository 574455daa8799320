"""Plans, their statuses, and the interface of a planner."""

from dataclasses import replace
from enum import IntEnum
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from contactgraph.control.box_qp import AffinePolicy, ControlLimits
from contactgraph.control.cost import QuadraticCost
from contactgraph.model import ContactBelief, ModelState, Nodes, StepModel


class PlanStatus(IntEnum):
    """The origin of a plan; `message` is a sentence for the user."""

    CONVERGED = 0
    ITERATION_LIMIT = 1
    NO_DESCENT = 2
    NOT_FINITE = 3
    PLAN_REUSED = 4
    DEADLINE_MISSED = 5
    BAD_OBSERVATION = 6

    @property
    def message(self) -> str:
        """A sentence for the user."""
        return _MESSAGES[self]

    @property
    def solved(self) -> bool:
        """Whether the plan was made for the present observation."""
        return self in (PlanStatus.CONVERGED, PlanStatus.ITERATION_LIMIT, PlanStatus.NO_DESCENT)


_MESSAGES = {
    PlanStatus.CONVERGED: "Converged: no further decrease of the cost is expected.",
    PlanStatus.ITERATION_LIMIT: "Stopped at the iteration limit; the best plan so far is used.",
    PlanStatus.NO_DESCENT: "No step lowered the cost any more; the best plan so far is used.",
    PlanStatus.NOT_FINITE: "The model's prediction was not finite; the previous plan is used.",
    PlanStatus.PLAN_REUSED: "Not replanned in this step: the previous plan's feedback was used.",
    PlanStatus.DEADLINE_MISSED: "Planning missed the deadline; the previous plan is used.",
    PlanStatus.BAD_OBSERVATION: "The observation was not finite; the previous plan is used.",
}


class Plan(eqx.Module):
    """``H`` steps ahead. Step ``t`` leads from ``states[t]`` to ``states[t+1]``."""

    states: Float[Array, "H+1 N 2 D"]
    """Position m and velocity m/s of each node."""
    controls: Float[Array, "H U"]
    """N; finite and within the limits, whatever the status."""
    policy: AffinePolicy
    """Feedback around the plan, K [H, U, N, 2, D]: gives ``controls[t]`` at ``states[t]``."""
    beliefs: ContactBelief
    """[H, E, K] belief t is about step t."""
    cost: Float[Array, ""]
    """Of the states and controls above, as predicted when the plan was made."""
    status: Int[Array, ""]
    """A `PlanStatus`; see `outcome`."""
    iterations: Int[Array, ""]
    """Rollouts of the model that the plan took."""
    node_ids: Int[Array, " N"]
    """The scene's nodes that the plan is about, in their order; -1 for padding."""

    def __repr__(self) -> str:
        sizes = f"states{list(np.shape(self.states))}, controls{list(np.shape(self.controls))}"
        if isinstance(self.status, jax.core.Tracer) or np.size(self.status) != 1:
            return f"Plan({sizes})"
        return f"Plan({sizes}, {self.outcome.name}, cost {float(self.cost):.4g})"

    @property
    def outcome(self) -> PlanStatus:
        """The status as an enumeration, outside compiled functions."""
        return PlanStatus(int(self.status))

    def with_status(self, status: PlanStatus) -> "Plan":
        """The same plan under another status."""
        return replace(self, status=jnp.asarray(status, dtype=self.status.dtype))


class Planner(Protocol):
    """The interface that `MPC` asks of a planner, a pytree such as an `equinox.Module`.

    `ILQR` is one; ``examples/extend_planner_mppi.py`` has another.
    """

    @property
    def horizon(self) -> int:
        """H, steps of a plan."""
        ...

    @property
    def limits(self) -> ControlLimits | None:
        """Bounds on every control, N. None: unbounded."""
        ...

    def solve(
        self,
        model: StepModel,
        state: ModelState,
        nodes: Nodes,
        cost: QuadraticCost,
        guess: AffinePolicy | None = None,
    ) -> Plan:
        """A plan from a state; ``guess`` is the previous plan's policy, shifted. Is compiled.

        With the status NOT_FINITE nothing else of the plan is used.
        """
        ...


def shift_plan(plan: Plan) -> Plan:
    """The plan from its second step on.

    The new last step applies no force and holds the last predicted state: a plan followed to its
    end without any observation ends in zero control (or the nearest that limits allow, which is
    the caller's to enforce).
    """

    def last_repeated(values: Array) -> Array:
        return jnp.concatenate([values[1:], values[-1:]])

    def last_zero(values: Array) -> Array:
        return jnp.concatenate([values[1:], jnp.zeros_like(values[-1:])])

    return replace(
        plan,
        states=last_repeated(plan.states),
        controls=last_zero(plan.controls),
        policy=jax.tree.map(last_zero, plan.policy),
        beliefs=jax.tree.map(last_repeated, plan.beliefs),
    )
