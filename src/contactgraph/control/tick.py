"""One tick of model predictive control, as a pure function: what `MPC` compiles."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.ilqr import ILQR
from contactgraph.control.lqr import LQRPolicy
from contactgraph.control.mpc_state import MPCState, Seen
from contactgraph.control.plan import Plan, PlanStatus, shift_plan
from contactgraph.control.swept import Swept
from contactgraph.model import (
    ContactBelief,
    ContactSensor,
    Locality,
    ModelState,
    MotionNoise,
    Nodes,
    StepModel,
    correct,
    correct_by_motion,
    judging_motion,
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
    locality: Locality | None = eqx.field(static=True)
    """None: everyone may matter to everyone, so where plans lead is not looked at."""

    def first_state(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        nodes: Nodes,
        cost: QuadraticCost,
    ) -> MPCState:
        """Before any tick, without a plan."""
        belief = self.model.initial_belief(position, velocity, nodes)
        horizon, control_size = self.ilqr.horizon, cost.control_size
        plan = Plan(
            states=jnp.zeros((horizon + 1, 2 * position.size)),
            controls=jnp.zeros((horizon, control_size)),
            policy=LQRPolicy(
                jnp.zeros((horizon, control_size, 2 * position.size)),
                jnp.zeros((horizon, control_size)),
            ),
            beliefs=jax.tree.map(lambda v: jnp.broadcast_to(v, (horizon, *v.shape)), belief),
            cost=jnp.zeros(()),
            status=jnp.asarray(PlanStatus.NOT_FINITE, jnp.int32),
            iterations=jnp.zeros((), jnp.int32),
            who=jnp.arange(len(position), dtype=jnp.int32),
        )
        nothing = jnp.full_like(position, jnp.nan)
        return MPCState(
            nodes=nodes,
            cost=cost,
            belief=belief,
            plan=plan,
            unplanned=jnp.asarray(self.replan_every, jnp.int32),
            seen=Seen(
                position=nothing,
                velocity=nothing,
                belief=belief,
                told=jnp.zeros(nodes.candidate.shape),
                control=jnp.zeros(control_size),
            ),
            fresh=jnp.ones((), bool),
            swept=None if self.locality is None else Swept.nowhere(horizon, position),
        )

    def tick(
        self,
        state: MPCState,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        contact: Float[Array, " E"],
        applied: Float[Array, " U"],
    ) -> tuple[Plan, MPCState]:
        """Correct the belief, then plan, or follow the running plan where that is called for.

        ``applied``: the control [N] of the step just made; NaN where it was the last plan's.
        """
        mask = state.nodes.mask[:, None]
        # What padding holds must not matter, not even where it is NaN.
        position = jnp.where(mask, position, 0.0)
        velocity = jnp.where(mask, velocity, 0.0)
        usable = jnp.all(jnp.isfinite(position)) & jnp.all(jnp.isfinite(velocity))
        running = self.running_plan(state)
        predicted, told = self._seen_to_move(state, position, velocity, applied)
        belief = correct(predicted, contact, self.sensor)
        now = ModelState(position, velocity, belief)
        due = state.unplanned >= self.replan_every

        def keep() -> tuple[Plan, Swept | None]:
            return running.with_status(PlanStatus.BAD_OBSERVATION), state.swept

        def follow() -> tuple[Plan, Swept | None]:
            swept = state.swept
            if swept is not None:
                swept = swept.and_at([position], state.nodes)
            return self._followed(running, now, state), swept

        def replan() -> tuple[Plan, Swept | None]:
            plan, swept = self._planned(now, state, running.policy)
            kept = running.with_status(PlanStatus.NOT_FINITE)
            failed = plan.status == PlanStatus.NOT_FINITE
            return jax.tree.map(lambda new, old: jnp.where(failed, old, new), plan, kept), swept

        if self.replan_every == 1:
            plan, swept = jax.lax.cond(usable, replan, keep)
        else:
            branch = jnp.where(usable, jnp.where(due, 2, 1), 0)
            plan, swept = jax.lax.switch(branch, [keep, follow, replan])
        planned = plan.status <= PlanStatus.NO_DESCENT
        after = MPCState(
            nodes=state.nodes,
            cost=state.cost,
            belief=jax.tree.map(lambda value: value[0], plan.beliefs),
            plan=plan,
            unplanned=jnp.where(planned, 1, state.unplanned + 1),
            seen=Seen(position, velocity, belief, told, plan.controls[0]),
            fresh=jnp.zeros((), bool),
            swept=swept,
        )
        return plan, after

    def running_plan(self, state: MPCState) -> Plan:
        """The last plan, from the present on."""
        shifted = shift_plan(state.plan)
        plan = jax.tree.map(lambda old, new: jnp.where(state.fresh, old, new), state.plan, shifted)
        if self.ilqr.limits is None:
            return plan
        # Limits that exclude zero, or were tightened since, bind the old plan too.
        return eqx.tree_at(lambda p: p.controls, plan, self.ilqr.limits(plan.controls))

    def _planned(
        self, now: ModelState, state: MPCState, guess: LQRPolicy
    ) -> tuple[Plan, Swept | None]:
        """A new plan, and where the search for it led, if that is of interest."""
        problem = self.model, now, state.nodes, state.cost, guess
        swept: Swept | None = None
        if self.locality is None:
            plan = self.ilqr.solve(*problem)
        else:
            plan, swept = self.ilqr.search(*problem, self.locality.dt)
        return eqx.tree_at(lambda p: p.who, plan, state.plan.who), swept

    def _seen_to_move(
        self,
        state: MPCState,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        applied: Float[Array, " U"],
    ) -> tuple[ContactBelief, Float[Array, " E"]]:
        """The belief about the step just made, before contacts measured: as carried, or, where
        motion is to correct it, predicted anew under the control applied, and corrected. And what
        motion has told."""
        if self.motion_noise is None:
            return state.belief, state.seen.told
        seen = state.seen
        return correct_by_motion(
            judging_motion(self.model),
            state.belief,
            ModelState(seen.position, seen.velocity, seen.belief),
            seen.told,
            jnp.where(jnp.isfinite(applied), applied, seen.control),
            (position, velocity),
            state.nodes,
            self.motion_noise,
        )

    def _followed(self, running: Plan, now: ModelState, state: MPCState) -> Plan:
        """The running plan with its feedback on what was observed, and the belief it implies."""
        x = stack_state(now.position, now.velocity)
        control = running.policy.K[0] @ x + running.policy.k[0]
        control = jnp.where(jnp.isfinite(control), control, running.controls[0])
        control = control if self.ilqr.limits is None else self.ilqr.limits(control)
        _, belief = self.model.linear_step(now, state.nodes)
        beliefs = jax.tree.map(
            lambda old, new: old.at[0].set(jnp.where(jnp.isfinite(new), new, old[0])),
            running.beliefs,
            belief,
        )
        followed = running.with_status(PlanStatus.FOLLOWED)
        return eqx.tree_at(
            lambda plan: (plan.states, plan.controls, plan.beliefs),
            followed,
            (running.states.at[0].set(x), running.controls.at[0].set(control), beliefs),
        )
