"""One tick of model predictive control, as a pure function: what `MPC` compiles."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.ilqr import ILQR
from contactgraph.control.lqr import AffinePolicy
from contactgraph.control.mpc_state import Memory, Seen
from contactgraph.control.plan import Plan, PlanStatus, shift_plan
from contactgraph.control.swept_bounds import SweptBounds
from contactgraph.model import (
    ContactBelief,
    ContactSensor,
    InteractionCutoff,
    ModelState,
    MotionNoise,
    Nodes,
    StepModel,
    check_motion_model,
    correct,
    correct_by_motion,
    stack_state,
)


class Controller(eqx.Module):
    """The parts that a tick needs."""

    model: StepModel
    ilqr: ILQR
    sensor: ContactSensor
    motion_noise: MotionNoise | None
    """None: motion does not correct beliefs."""
    replan_every: int = eqx.field(static=True)
    """Ticks from plan to plan; in between the running plan's feedback acts."""
    locality: InteractionCutoff | None = eqx.field(static=True)
    """None: everyone may matter to everyone, so where plans lead is not looked at."""

    def first_memory(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        nodes: Nodes,
        cost: QuadraticCost,
        who: Int[Array, " N"],
    ) -> Memory:
        """Before any tick, without a plan. ``who``: see `Plan`."""
        belief = self.model.initial_belief(position, velocity, nodes)
        horizon, control_size, size = self.ilqr.horizon, cost.control_size, 2 * position.size
        no_controls = jnp.zeros((horizon, control_size))
        nothing = jnp.full_like(position, jnp.nan)
        return Memory(
            belief=belief,
            plan=Plan(
                states=jnp.zeros((horizon + 1, size)),
                controls=no_controls,
                policy=AffinePolicy(jnp.zeros((horizon, control_size, size)), no_controls),
                beliefs=jax.tree.map(lambda v: jnp.broadcast_to(v, (horizon, *v.shape)), belief),
                cost=jnp.zeros(()),
                status=jnp.asarray(PlanStatus.NOT_FINITE, jnp.int32),
                iterations=jnp.zeros((), jnp.int32),
                who=who,
            ),
            steps_since_plan=jnp.asarray(self.replan_every, jnp.int32),
            seen=Seen(
                position=nothing,
                velocity=nothing,
                belief=belief,
                told=jnp.zeros(nodes.candidate.shape),
                control=jnp.zeros(control_size),
            ),
            fresh=jnp.ones((), bool),
            swept=None
            if self.locality is None
            else SweptBounds.nowhere(self.ilqr.iterations, horizon, position),
        )

    def tick(
        self,
        nodes: Nodes,
        cost: QuadraticCost,
        memory: Memory,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        contact: Float[Array, " E"],
        applied: Float[Array, " U"],
    ) -> Memory:
        """Correct the belief, then plan, or follow the running plan where that is called for.

        ``applied``: the control [N] of the step just made; NaN where it was the last plan's.
        """
        mask = nodes.mask[:, None]
        # What padding holds must not matter, not even where it is NaN.
        position = jnp.where(mask, position, 0.0)
        velocity = jnp.where(mask, velocity, 0.0)
        usable = jnp.all(jnp.isfinite(position)) & jnp.all(jnp.isfinite(velocity))
        running = self.running_plan(memory)
        predicted, told = self._seen_to_move(nodes, memory, position, velocity, applied)
        belief = correct(predicted, contact, self.sensor)
        now = ModelState(position, velocity, belief)
        due = memory.steps_since_plan >= self.replan_every

        def keep() -> tuple[Plan, SweptBounds | None]:
            return running.with_status(PlanStatus.BAD_OBSERVATION), memory.swept

        def follow() -> tuple[Plan, SweptBounds | None]:
            swept = memory.swept
            if swept is not None and self.locality is not None:
                drifted = position + self.locality.dt * velocity
                swept = swept.also_at([position, drifted], nodes)
            return self._followed(running, now, nodes), swept

        def replan() -> tuple[Plan, SweptBounds | None]:
            plan, swept = self._planned(now, nodes, cost, running)
            kept = running.with_status(PlanStatus.NOT_FINITE)
            failed = plan.status == PlanStatus.NOT_FINITE
            return jax.tree.map(lambda new, old: jnp.where(failed, old, new), plan, kept), swept

        if self.replan_every == 1:
            plan, swept = jax.lax.cond(usable, replan, keep)
        else:
            branch = jnp.where(usable, jnp.where(due, 2, 1), 0)
            plan, swept = jax.lax.switch(branch, [keep, follow, replan])
        planned = plan.status <= PlanStatus.NO_DESCENT
        return Memory(
            belief=jax.tree.map(lambda value: value[0], plan.beliefs),
            plan=plan,
            steps_since_plan=jnp.where(planned, 1, memory.steps_since_plan + 1),
            seen=Seen(position, velocity, belief, told, plan.controls[0]),
            fresh=jnp.zeros((), bool),
            swept=swept,
        )

    def running_plan(self, memory: Memory) -> Plan:
        """The last plan, from the present on."""
        last, fresh = memory.plan, memory.fresh
        plan = jax.tree.map(lambda old, new: jnp.where(fresh, old, new), last, shift_plan(last))
        if self.ilqr.limits is None:
            return plan
        # Limits that exclude zero, or were tightened since, bind the old plan too.
        return eqx.tree_at(lambda p: p.controls, plan, self.ilqr.limits(plan.controls))

    def _planned(
        self, now: ModelState, nodes: Nodes, cost: QuadraticCost, running: Plan
    ) -> tuple[Plan, SweptBounds | None]:
        """A new plan, and where the search for it led, if that is of interest."""
        problem = self.model, now, nodes, cost, running.policy
        swept: SweptBounds | None = None
        if self.locality is None:
            plan = self.ilqr.solve(*problem)
        else:
            plan, swept = self.ilqr.search(*problem, self.locality.dt)
        return eqx.tree_at(lambda p: p.who, plan, running.who), swept

    def _seen_to_move(
        self,
        nodes: Nodes,
        memory: Memory,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        applied: Float[Array, " U"],
    ) -> tuple[ContactBelief, Float[Array, " E"]]:
        """The belief about the step just made, before contacts measured: as carried, or, where
        motion is to correct it, predicted anew under the control applied, and corrected. And what
        motion has told."""
        if self.motion_noise is None:
            return memory.belief, memory.seen.told
        seen = memory.seen
        return correct_by_motion(
            check_motion_model(self.model),
            memory.belief,
            ModelState(seen.position, seen.velocity, seen.belief),
            seen.told,
            jnp.where(jnp.isfinite(applied), applied, seen.control),
            (position, velocity),
            nodes,
            self.motion_noise,
        )

    def _followed(self, running: Plan, now: ModelState, nodes: Nodes) -> Plan:
        """The running plan with its feedback on what was observed, and the belief it implies."""
        x = stack_state(now.position, now.velocity)
        control = running.policy.K[0] @ x + running.policy.k[0]
        control = jnp.where(jnp.isfinite(control), control, running.controls[0])
        control = control if self.ilqr.limits is None else self.ilqr.limits(control)
        _, belief = self.model.linear_step(now, nodes)
        beliefs = jax.tree.map(
            lambda old, new: old.at[0].set(jnp.where(jnp.isfinite(new), new, old[0])),
            running.beliefs,
            belief,
        )
        followed = running.with_status(PlanStatus.PLAN_REUSED)
        return eqx.tree_at(
            lambda plan: (plan.states, plan.controls, plan.beliefs),
            followed,
            (running.states.at[0].set(x), running.controls.at[0].set(control), beliefs),
        )
