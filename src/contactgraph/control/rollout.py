"""Rollouts of a policy through a model, with the linearisation along them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.control.box_qp import AffinePolicy, ControlLimits
from contactgraph.control.lqr import block_state
from contactgraph.model import (
    ContactBelief,
    LinearDynamics,
    ModelState,
    Nodes,
    StepModel,
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
    control_displacement: Float[Array, "H N D"]
    """m; displacement of each node by the step's control alone: see `with_control_displacement`."""
    dynamics: LinearDynamics
    """[H, M, D, …]"""

    def finite(self) -> Array:
        """Whether every predicted number is."""
        motion = jnp.all(jnp.isfinite(self.position)) & jnp.all(jnp.isfinite(self.velocity))
        return motion & jnp.all(jnp.isfinite(self.controls))


def roll_out(
    model: StepModel,
    begin: tuple[ModelState, Float[Array, "N D U"]],
    nodes: Nodes,
    policy: AffinePolicy,
    limits: ControlLimits | None,
    node_ids: Int[Array, " M"],
) -> Rollout:
    """Follow a policy on ``block_state`` for H steps through the model, in one scan.

    It begins with a state and its `control_sensitivity`. Each step's dynamics know the step's own
    control, since contact within the step depends on it: otherwise a plan would count on a contact
    that its own braking prevents.
    """

    def step(
        carry: tuple[ModelState, Float[Array, "N D U"]], stage: AffinePolicy
    ) -> tuple[tuple[ModelState, Float[Array, "N D U"]], Rollout]:
        state, response = carry
        x = block_state(state.position, state.velocity, node_ids)
        u = stage(x, limits)
        control_displacement = jnp.sum(response * u, axis=-1)
        after, response, linear = take_step(model, state, response, u, nodes)
        part = jax.tree.map(lambda block: block[node_ids].astype(x.dtype), linear)
        made = Rollout(
            after.position, after.velocity, after.belief, x, u, control_displacement, part
        )
        return (after, response), made

    start, _ = begin
    (last, _), steps = jax.lax.scan(step, begin, policy)
    return Rollout(
        position=jnp.concatenate([start.position[None], steps.position]),
        velocity=jnp.concatenate([start.velocity[None], steps.velocity]),
        beliefs=steps.beliefs,
        x=jnp.concatenate([steps.x, block_state(last.position, last.velocity, node_ids)[None]]),
        controls=steps.controls,
        control_displacement=steps.control_displacement,
        dynamics=steps.dynamics,
    )
