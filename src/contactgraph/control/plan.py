"""What a planner answers with: data, also when it failed."""

from enum import IntEnum

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.control.lqr import AffinePolicy
from contactgraph.model import ContactBelief


class PlanStatus(IntEnum):
    """How a plan came about; `message` says it in words."""

    CONVERGED = 0
    ITERATION_LIMIT = 1
    NO_DESCENT = 2
    NOT_FINITE = 3
    PLAN_REUSED = 4
    DEADLINE_MISSED = 5
    BAD_OBSERVATION = 6
    CAPACITY_EXCEEDED = 7

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
    PlanStatus.ITERATION_LIMIT: "Stopped at the iteration limit; the best plan found is used.",
    PlanStatus.NO_DESCENT: "No step lowered the cost any more; the best plan found is used.",
    PlanStatus.NOT_FINITE: "The model's prediction was not finite; the previous plan is used.",
    PlanStatus.PLAN_REUSED: "Not replanned in this tick: the running plan's feedback was used.",
    PlanStatus.DEADLINE_MISSED: "Planning missed the deadline; the previous plan is used.",
    PlanStatus.BAD_OBSERVATION: "The observation was not finite; the previous plan is used.",
    PlanStatus.CAPACITY_EXCEEDED: (
        "More nodes are in play than the limit allows; the previous plan is used."
    ),
}


class Plan(eqx.Module):
    """``H`` steps ahead. Step ``t`` leads from ``states[t]`` to ``states[t+1]``."""

    states: Float[Array, "H+1 n"]
    """`stack_state`'s vectors, m and m/s."""
    controls: Float[Array, "H U"]
    """N; finite and within the limits, whatever the status."""
    policy: AffinePolicy
    """Feedback around the plan: gives ``controls[t]`` at ``states[t]``."""
    beliefs: ContactBelief
    """[H, E, K] belief t is about step t."""
    cost: Float[Array, ""]
    """Of the states and controls above, as predicted when the plan was made."""
    status: Int[Array, ""]
    """A `PlanStatus`; see `outcome`."""
    iterations: Int[Array, ""]
    """Rollouts of the model that the plan took."""
    who: Int[Array, " N"]
    """Which of the scene's nodes the plan is about, in their order; -1 for padding."""

    @property
    def outcome(self) -> PlanStatus:
        """The status as an enumeration, outside compiled functions."""
        return PlanStatus(int(self.status))

    def with_status(self, status: PlanStatus) -> "Plan":
        """The same plan under another status."""
        return eqx.tree_at(
            lambda plan: plan.status, self, jnp.asarray(status, dtype=self.status.dtype)
        )


def shift_plan(plan: Plan) -> Plan:
    """The plan from its second step on.

    The new last step applies no force and holds the last predicted state: whoever follows a plan
    to its end without news comes to rest under zero control (or the nearest that limits allow,
    which is the caller's to enforce).
    """

    def onward(values: Array) -> Array:
        return jnp.concatenate([values[1:], values[-1:]])

    def ending_in_zero(values: Array) -> Array:
        return jnp.concatenate([values[1:], jnp.zeros_like(values[-1:])])

    return Plan(
        states=onward(plan.states),
        controls=ending_in_zero(plan.controls),
        policy=jax.tree.map(ending_in_zero, plan.policy),
        beliefs=jax.tree.map(onward, plan.beliefs),
        cost=plan.cost,
        status=plan.status,
        iterations=plan.iterations,
        who=plan.who,
    )
