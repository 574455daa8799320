"""Predicting a policy's future: states, controls and, for free, the linearisation along them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.control.box_qp import ControlLimits
from contactgraph.control.lqr import AffinePolicy
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
    """m; how far each step's control alone moves each node: see `with_control_displacement`."""
    dynamics: LinearDynamics
    """[H, M, D, …]"""

    def finite(self) -> Array:
        """Whether every predicted number is."""
        motion = jnp.all(jnp.isfinite(self.position)) & jnp.all(jnp.isfinite(self.velocity))
        return motion & jnp.all(jnp.isfinite(self.controls))


def block_state(
    position: Float[Array, "N D"], velocity: Float[Array, "N D"], involved: Int[Array, " M"]
) -> Float[Array, " m"]:
    """All positions of the M nodes, then all their velocities: `block_form`'s order of states.

    `block_index` leads back to `stack_state`.
    """
    return jnp.stack([position[involved], velocity[involved]]).reshape(-1)


def block_index(involved: Int[Array, " M"], dimension: int) -> Int[Array, " m"]:
    """Where the entries of `block_state` are in `stack_state`'s vector of all nodes."""
    part = jnp.arange(2)[:, None, None]
    return ((2 * involved[:, None] + part) * dimension + jnp.arange(dimension)).reshape(-1)


def in_blocks(
    dynamics: LinearDynamics,
) -> tuple[Float[Array, "H 2 2 k"], Float[Array, "H m U"], Float[Array, "H m"]]:
    """``A, B, offset`` of [H, M, D, …] dynamics, as `block_form` takes them; ``k = MD``."""
    horizon, U = dynamics.B.shape[0], dynamics.B.shape[-1]
    A = jnp.moveaxis(dynamics.A.reshape(horizon, -1, 2, 2), 1, -1)
    B = jnp.moveaxis(dynamics.B.reshape(horizon, -1, 2, U), 2, 1)
    offset = jnp.moveaxis(dynamics.offset.reshape(horizon, -1, 2), 2, 1)
    return A, B.reshape(horizon, -1, U), offset.reshape(horizon, -1)


def roll_out(
    model: StepModel,
    begin: tuple[ModelState, Float[Array, "N D U"]],
    nodes: Nodes,
    policy: AffinePolicy,
    limits: ControlLimits | None,
    involved: Int[Array, " M"],
) -> Rollout:
    """Follow a policy on ``block_state`` for H steps through the model, in one scan.

    It begins with a state and its `control_sensitivity`.
    Whether bodies touch within a step depends on the step's own control. A planner to which the
    model did not say so would count on a touch that its own braking prevents.
    """

    def step(
        carry: tuple[ModelState, Float[Array, "N D U"]], stage: AffinePolicy
    ) -> tuple[tuple[ModelState, Float[Array, "N D U"]], Rollout]:
        state, response = carry
        x = block_state(state.position, state.velocity, involved)
        # A sum rather than a product with K: it fuses with what is around it.
        u = jnp.sum(stage.K * x, axis=-1) + stage.k
        u = u if limits is None else limits(u)
        control_displacement = jnp.sum(response * u, axis=-1)
        after, response, linear = take_step(model, state, response, u, nodes)
        part = jax.tree.map(lambda block: block[involved].astype(x.dtype), linear)
        told = Rollout(
            after.position, after.velocity, after.belief, x, u, control_displacement, part
        )
        return (after, response), told

    start, _ = begin
    (last, _), steps = jax.lax.scan(step, begin, policy)
    return Rollout(
        position=jnp.concatenate([start.position[None], steps.position]),
        velocity=jnp.concatenate([start.velocity[None], steps.velocity]),
        beliefs=steps.beliefs,
        x=jnp.concatenate([steps.x, block_state(last.position, last.velocity, involved)[None]]),
        controls=steps.controls,
        control_displacement=steps.control_displacement,
        dynamics=steps.dynamics,
    )
