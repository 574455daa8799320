"""State of a model, and steps and rollouts of any locally linear model under given controls."""

from collections.abc import Callable
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from contactgraph.data.trajectory_batch import Nodes
from contactgraph.dynamics.local_dynamics import LinearDynamics
from contactgraph.inference.contact_belief import ContactBelief, cast_like


class ModelState(eqx.Module):
    """State of the scene, and the belief about its contacts."""

    position: Float[Array, "N D"]
    """m"""
    velocity: Float[Array, "N D"]
    """m/s"""
    belief: ContactBelief
    """About the step that led to this state; the next belief is predicted from it."""


class StepModel(Protocol):
    """A locally linear model of one step, which any planner or evaluation can use.

    It must be a pytree (an `equinox.Module` is), so that its weights can be passed to compiled
    functions.
    """

    def linear_step(
        self, state: ModelState, control: Float[Array, " U"], nodes: Nodes
    ) -> tuple[LinearDynamics, ContactBelief]:
        """The dynamics of the next step, linear about this state and control, and the belief that
        they assume."""
        ...

    def initial_belief(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> ContactBelief:
        """The belief before the first observation."""
        ...


@eqx.filter_jit
def _linear_step(
    model: StepModel, state: ModelState, control: Float[Array, " U"], nodes: Nodes
) -> tuple[LinearDynamics, ContactBelief]:
    """Traced once, however often a program takes a step."""
    return model.linear_step(state, control, nodes)


def take_step(
    model: StepModel, state: ModelState, control: Float[Array, " U"], nodes: Nodes
) -> tuple[ModelState, LinearDynamics]:
    """One step under a control [N]: the next state, and the dynamics about this state and control.

    States keep their floating types: a float32 model may be given states in float64.
    """
    linear, belief = _linear_step(model, state, control, nodes)
    position, velocity = linear(state.position, state.velocity, control)
    after = ModelState(
        position=position.astype(state.position.dtype),
        velocity=velocity.astype(state.velocity.dtype),
        belief=cast_like(belief, state.belief),
    )
    return after, linear


def control_displacement(
    model: object, state: ModelState, control: Float[Array, " U"], nodes: Nodes
) -> Float[Array, "N D"]:
    """m; how far the control alone moves each node in a step; 0 where the model does not tell."""
    own = getattr(model, "control_displacement", lambda *step: None)
    found = own(state, control, nodes)
    return jnp.zeros_like(state.position) if found is None else found


def rollout(
    model: StepModel,
    state: ModelState,
    controls: Float[Array, "H U"],
    nodes: Nodes,
    output: Callable[[ModelState, LinearDynamics], PyTree] = lambda after, linear: after,
    checkpoint: bool = False,
) -> PyTree:
    """``output`` of each next state and the dynamics that led to it, ``[H, …]``, in one scan.

    With ``checkpoint`` gradients recompute each step.
    """

    def step(before: ModelState, control: Float[Array, " U"]) -> tuple[ModelState, PyTree]:
        after, linear = take_step(model, before, control, nodes)
        return after, output(after, linear)

    return jax.lax.scan(jax.checkpoint(step) if checkpoint else step, state, controls)[1]
