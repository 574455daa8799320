"""Rollouts of a policy through a model, with the linearisation and bounds of the motion."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.control.box_qp import AffinePolicy, ControlLimits
from contactgraph.control.contact_cost import ContactCost
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.lqr import block_dynamics, block_state
from contactgraph.control.plan import Plan
from contactgraph.control.riccati import LQRProblem
from contactgraph.model import (
    ContactBelief,
    LinearDynamics,
    ModelState,
    Nodes,
    StepModel,
    control_displacement,
    take_step,
)


class Rollout(eqx.Module):
    """``H`` predicted steps. The dynamics and ``x`` are those of the ``M`` nodes with a cost."""

    position: Float[Array, "H+1 N D"]
    velocity: Float[Array, "H+1 N D"]
    beliefs: ContactBelief
    """[H, E, K]"""
    x: Float[Array, "H+1 m"]
    """`block_state` of the M nodes, ``m = 2MD``."""
    controls: Float[Array, "H U"]
    dynamics: LinearDynamics
    """[H, M, D, …]"""

    @property
    def states(self) -> Float[Array, "H+1 N 2 D"]:
        """Position and velocity of each node."""
        return jnp.stack([self.position, self.velocity], axis=2)

    def finite(self) -> Array:
        """Whether every predicted number is."""
        motion = jnp.all(jnp.isfinite(self.position)) & jnp.all(jnp.isfinite(self.velocity))
        return motion & jnp.all(jnp.isfinite(self.controls))

    def problem(
        self, part: QuadraticCost, node_ids: Int[Array, " M"], contacts: tuple[ContactCost, ...]
    ) -> LQRProblem:
        """The problem with the dynamics along it; ``part`` is the cost on its ``x``."""
        Q, R, goal = part.over(self.controls.shape[0])
        q = -jnp.einsum("tij,tj->ti", Q, goal)
        for each in contacts:
            more = each.expanded(self.states, self.beliefs, node_ids)
            Q, q = Q + more[0], q + more[1]
        A, B, offset = block_dynamics(self.dynamics)
        r = jnp.zeros(R.shape[:-1], R.dtype)
        return LQRProblem(A=A, B=B, offset=offset, Q=Q, R=R, q=q, r=r)


def roll_out(
    model: StepModel,
    begin: ModelState,
    nodes: Nodes,
    policy: AffinePolicy,
    limits: ControlLimits | None,
    node_ids: Int[Array, " M"],
) -> Rollout:
    """Follow a policy on ``block_state`` for H steps through the model, in one scan.

    Each step's dynamics know the step's own control, since contact within the step depends on it:
    otherwise a plan would count on a contact that its own braking prevents.
    """

    def step(state: ModelState, stage: AffinePolicy) -> tuple[ModelState, Rollout]:
        x = block_state(state.position, state.velocity, node_ids)
        u = stage(x, limits)
        after, linear = take_step(model, state, u, nodes)
        part = jax.tree.map(lambda block: block[node_ids].astype(x.dtype), linear)
        return after, Rollout(after.position, after.velocity, after.belief, x, u, part)

    last, steps = jax.lax.scan(step, begin, policy)
    return Rollout(
        position=jnp.concatenate([begin.position[None], steps.position]),
        velocity=jnp.concatenate([begin.velocity[None], steps.velocity]),
        beliefs=steps.beliefs,
        x=jnp.concatenate([steps.x, block_state(last.position, last.velocity, node_ids)[None]]),
        controls=steps.controls,
        dynamics=steps.dynamics,
    )


class SweptBounds(eqx.Module):
    """Boxes around all positions of a node in each step of a plan.

    They contain the positions that `contactgraph.bodies.geometry` uses: the start of the step, its
    end without contact, and its predicted end. The box of a hinged body contains the whole bar.
    """

    lower: Float[Array, "H N D"]
    """m"""
    upper: Float[Array, "H N D"]
    """m"""

    @classmethod
    def of(
        cls,
        model: StepModel,
        begin: ModelState,
        plan: Plan,
        nodes: Nodes,
        dt: float,
    ) -> "SweptBounds":
        """Of a plan from ``begin`` on, in steps of ``dt`` [s]."""
        states = plan.states
        position, velocity = states[:-1, :, 0], states[:-1, :, 1]
        belief = jax.tree.map(
            lambda first, later: jnp.concatenate([first[None], later[:-1]]),
            *(begin.belief, plan.beliefs),
        )
        driven = jax.vmap(partial(control_displacement, model), in_axes=(0, 0, None))(
            ModelState(position, velocity, belief), plan.controls, nodes
        )
        # A parabola lies within its ends and the point where its tangents meet.
        middle = position + 0.5 * dt * velocity
        unhindered = position + dt * velocity + driven
        positions = [position, middle, unhindered, states[1:, :, 0]]
        if nodes.anchor is not None:
            anchor, hinged = jnp.nan_to_num(nodes.anchor), nodes.hinged[:, None]
            ends = [jnp.where(hinged, 2.0 * each - anchor, each) for each in positions]
            positions = [*ends, jnp.where(hinged, anchor, positions[0])]
        stacked = jnp.stack(positions)
        known = jnp.isfinite(stacked)
        lower = jnp.min(jnp.where(known, stacked, jnp.inf), axis=0)
        return cls(lower, jnp.max(jnp.where(known, stacked, -jnp.inf), axis=0))
