"""One control step of model predictive control, as pure functions that `MPC` compiles."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.control.box_qp import AffinePolicy
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.host import Measured, loop_options, placed
from contactgraph.control.plan import Plan, Planner, PlanStatus, shift_plan
from contactgraph.control.program_store import stored
from contactgraph.control.rollout import SweptBounds
from contactgraph.model import (
    ContactSensor,
    ModelState,
    MotionNoise,
    Nodes,
    StepModel,
    with_masses,
)
from contactgraph.model.filter import FilterState, first_filter_state, update


class MPCCarry(eqx.Module):
    """Arrays that one compiled control step hands to the next."""

    filter: FilterState
    """Its belief is about the step that leads to the next observation."""
    plan: Plan
    """The last plan, as of the last observation."""
    steps_since_plan: Int[Array, ""]
    is_first: Bool[Array, ""]
    """True until the first step, whose plan starts at its own observation, not before."""
    swept: SweptBounds | None = None
    """Of the plan; None where they are not asked for."""


class MPCConfig(eqx.Module):
    """The parts of a control step; the methods are pure and compiled by `MPC`."""

    model: StepModel
    planner: Planner
    sensor: ContactSensor
    motion_noise: MotionNoise | None
    """None: motion does not correct beliefs."""
    replan_every: int = eqx.field(static=True)
    """Control steps from plan to plan; in between the last plan's feedback acts."""
    swept_dt: float | None = eqx.field(static=True, default=None)
    """Length of the model's step, s, where the bounds of a plan are asked for."""

    def first_carry(
        self,
        nodes: Nodes,
        cost: QuadraticCost,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        node_ids: Int[Array, " N"],
    ) -> MPCCarry:
        """Before any control step: the model's first belief, and a plan without forces."""
        H, U, state = self.planner.horizon, cost.control_size, (len(position), 2, position.shape[1])
        first = first_filter_state(self.model, nodes, position, velocity, jnp.zeros(U))
        belief = first.predicted
        plan = Plan(
            states=jnp.zeros((H + 1, *state)),
            controls=jnp.zeros((H, U)),
            policy=AffinePolicy(jnp.zeros((H, U, *state)), jnp.zeros((H, U))),
            beliefs=jax.tree.map(lambda v: jnp.broadcast_to(v, (H, *v.shape)), belief),
            cost=jnp.zeros(()),
            status=jnp.asarray(PlanStatus.NOT_FINITE, jnp.int32),
            iterations=jnp.zeros((), jnp.int32),
            node_ids=node_ids,
        )
        return MPCCarry(
            filter=first,
            plan=plan,
            steps_since_plan=jnp.asarray(self.replan_every, jnp.int32),
            is_first=jnp.ones((), bool),
            swept=self._swept(first.before, plan, nodes),
        )

    def step(
        self,
        nodes: Nodes,
        cost: QuadraticCost,
        carry: MPCCarry,
        seen: Measured,
    ) -> MPCCarry:
        """Correct the belief, then make a plan, or reuse the previous one where that is due."""
        # Padding must not matter, not even where it is NaN.
        position = jnp.where(nodes.mask[:, None], seen.position, 0.0)
        velocity = jnp.where(nodes.mask[:, None], seen.velocity, 0.0)
        usable = jnp.all(jnp.isfinite(position)) & jnp.all(jnp.isfinite(velocity))
        regular = carry.steps_since_plan >= self.replan_every
        due = jnp.where(seen.replan < 0, regular, seen.replan > 0)
        previous = self.previous_plan(carry)
        control = jnp.where(jnp.isfinite(seen.applied), seen.applied, carry.filter.control)
        motion, noise = (position, velocity), self.motion_noise
        known = update(
            self.model, carry.filter, motion, seen.contact, control, nodes, self.sensor, noise
        )
        nodes = with_masses(nodes, known.masses)
        now = known.before

        if self.replan_every == 1:
            # A plan is made even from a bad observation, which is rare, and then not used.
            plan = self.planner.solve(self.model, now, nodes, cost, previous.policy)
        else:
            plan = jax.lax.cond(
                due & usable,
                lambda: self.planner.solve(self.model, now, nodes, cost, previous.policy),
                lambda: self._reused(previous, now, nodes),
            )
        failed = plan.status == PlanStatus.NOT_FINITE
        plan = replace(plan, node_ids=previous.node_ids)
        plan = _where(failed, previous.with_status(PlanStatus.NOT_FINITE), plan)
        plan = _where(usable, plan, previous.with_status(PlanStatus.BAD_OBSERVATION))
        solved = plan.status <= PlanStatus.NO_DESCENT
        predicted = jax.tree.map(lambda value: value[0], plan.beliefs)
        return MPCCarry(
            filter=replace(known, predicted=predicted, control=plan.controls[0]),
            plan=plan,
            steps_since_plan=jnp.where(solved, 1, carry.steps_since_plan + 1),
            is_first=jnp.zeros((), bool),
            swept=self._swept(now, plan, nodes),
        )

    def _swept(self, begin: ModelState, plan: Plan, nodes: Nodes) -> SweptBounds | None:
        if self.swept_dt is None:
            return None
        return SweptBounds.of(self.model, begin, plan, nodes, self.swept_dt)

    def previous_plan(self, carry: MPCCarry, status: Int[Array, ""] | None = None) -> Plan:
        """The last plan from the present on; under ``status``, where one is given."""
        last, is_first = carry.plan, carry.is_first
        shifted = shift_plan(last)
        plan = jax.tree.map(lambda old, new: jnp.where(is_first, old, new), last, shifted)
        if self.planner.limits is not None:
            # Limits that exclude zero, or were tightened since, bind the old plan too.
            plan = replace(plan, controls=self.planner.limits(plan.controls))
        return plan if status is None else replace(plan, status=status)

    def _reused(self, previous: Plan, now: ModelState, nodes: Nodes) -> Plan:
        """The previous plan with its feedback on the observation, and the belief it implies."""
        x = jnp.stack([now.position, now.velocity], axis=1)
        control = jax.tree.map(lambda of_step: of_step[0], previous.policy)(x)
        control = jnp.where(jnp.isfinite(control), control, previous.controls[0])
        control = control if self.planner.limits is None else self.planner.limits(control)
        _, belief = self.model.linear_step(now, control, nodes)
        return replace(
            previous.with_status(PlanStatus.PLAN_REUSED),
            states=previous.states.at[0].set(x),
            controls=previous.controls.at[0].set(control),
            beliefs=jax.tree.map(
                lambda old, new: old.at[0].set(jnp.where(jnp.isfinite(new), new, old[0])),
                previous.beliefs,
                belief,
            ),
        )


def _where(condition: Bool[Array, ""], plan: Plan, otherwise: Plan) -> Plan:
    return jax.tree.map(lambda one, other: jnp.where(condition, one, other), plan, otherwise)


def jit_step(method: Callable, config: MPCConfig, like: int | None = None) -> Callable:
    """A method of `MPCConfig`, compiled; ``like``: the argument that its result is like, if any.

    The config's arrays are arguments of the compiled function: as constants they would be folded.
    In a flat tuple they are dispatched faster than in their tree.
    """
    dynamic, static = eqx.partition(config, eqx.is_array)
    leaves, treedef = jax.tree.flatten(dynamic)
    leaves = placed(leaves)

    def call(leaves: tuple, *inputs: Any) -> Any:
        rebuilt = eqx.combine(jax.tree.unflatten(treedef, leaves), static)
        return method(rebuilt, *inputs)

    after_leaves = None if like is None else like + 1
    traced = stored(call, (method, static), after_leaves)
    return partial(jax.jit(traced, compiler_options=loop_options()), tuple(leaves))
