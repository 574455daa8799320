"""Steps and rollouts of any locally linear model under given controls."""

import dataclasses
from collections.abc import Callable
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from contactgraph.model.contact_belief import ContactBelief, cast_like
from contactgraph.model.types import LinearDynamics, ModelState, Nodes


class _LinearModel(Protocol):
    def linear_step(
        self, state: ModelState, nodes: Nodes
    ) -> tuple[LinearDynamics, ContactBelief]: ...


@eqx.filter_jit
def _linear_step(
    model: _LinearModel, state: ModelState, nodes: Nodes
) -> tuple[LinearDynamics, ContactBelief]:
    """Traced once, however often a program takes a step."""
    return model.linear_step(state, nodes)


def control_sensitivity(
    model: _LinearModel, state: ModelState, nodes: Nodes
) -> Float[Array, "N D W"]:
    """Displacement of each node by what drives it, if only the present contacts are active.

    A force of 10 N moves a body of 1 kg by 14 mm in a step of 0.05 s, which decides whether it
    touches another within the step. So a model is given the displacement by the step's control
    alone: the control times the sensitivity of the step before, in which no new contact acts.
    """
    unforced = dataclasses.replace(state, control_displacement=jnp.zeros_like(state.velocity))
    present = nodes._replace(candidate=_present_contacts(state, nodes))
    linear, _ = _linear_step(model, unforced, present)
    return linear.control_sensitivity.astype(state.position.dtype)


def _present_contacts(state: ModelState, nodes: Nodes) -> Bool[Array, " E"]:
    belief = state.belief.over(None, nodes.candidate.shape[0])
    return nodes.candidate & (belief.holding > 0.5)


def drive(
    model: _LinearModel,
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    control: Float[Array, " U"],
    nodes: Nodes,
) -> Float[Array, " W"]:
    """What moves bodies under a control: the control itself, or a model's own `drive`."""
    own = getattr(model, "drive", None)
    return control if own is None else own(position, velocity, control, nodes)


def no_sensitivity(
    model: _LinearModel, state: ModelState, control: Float[Array, " U"], nodes: Nodes
) -> Float[Array, "N D W"]:
    """Zeros of the shape of `LinearDynamics.control_sensitivity`."""
    driving = drive(model, state.position, state.velocity, control, nodes)
    return jnp.zeros((*state.position.shape, *driving.shape), state.position.dtype)


def with_control_displacement(
    model: _LinearModel,
    state: ModelState,
    sensitivity: Float[Array, "N D W"],
    control: Float[Array, " U"],
    nodes: Nodes,
) -> ModelState:
    """The state with the displacement of each node by the next step's control, and its command."""
    driving = drive(model, state.position, state.velocity, control, nodes)
    displacement = jnp.sum(sensitivity * driving, axis=-1).astype(state.velocity.dtype)
    command = control.astype(state.velocity.dtype)
    return dataclasses.replace(state, control_displacement=displacement, command=command)


def take_step(
    model: _LinearModel,
    state: ModelState,
    sensitivity: Float[Array, "N D W"],
    control: Float[Array, " U"],
    nodes: Nodes,
) -> tuple[ModelState, Float[Array, "N D W"], LinearDynamics]:
    """One step under a control [N]: the next state, its sensitivity, and the step's dynamics.

    States keep their floating types: a float32 model may be given states in float64.
    """
    informed = with_control_displacement(model, state, sensitivity, control, nodes)
    linear, belief = _linear_step(model, informed, nodes)
    position, velocity = linear(state.position, state.velocity, control)
    after = ModelState(
        position=position.astype(state.position.dtype),
        velocity=velocity.astype(state.velocity.dtype),
        belief=cast_like(belief, state.belief),
    )
    if linear.turn_length is not None or linear.pins is not None:
        # The same step, of a linear model: turns in space do not add up, and pins bend paths.
        plain = dataclasses.replace(linear, turn_length=None, pins=None)
        moved = plain(state.position, state.velocity, control)
        off = jnp.stack([position - moved[0], velocity - moved[1]], axis=-1)
        linear = dataclasses.replace(plain, offset=linear.offset + off)
    return after, linear.control_sensitivity.astype(sensitivity.dtype), linear


def rollout(
    model: _LinearModel,
    state: ModelState,
    controls: Float[Array, "H U"],
    nodes: Nodes,
    output: Callable[[ModelState, LinearDynamics], PyTree] = lambda after, linear: after,
    checkpoint: bool = False,
) -> PyTree:
    """``output`` of each next state and the dynamics that led to it, ``[H, …]``, in one scan.

    With ``checkpoint`` gradients recompute each step. The `control_sensitivity` of the first state
    is computed as iteration 0 of the scan, so that the step and its derivative are compiled once.
    """
    present = _present_contacts(state, nodes)
    Carry = tuple[ModelState, Float[Array, "N D W"]]

    def step(carry: Carry, inputs: tuple[Array, Array]) -> tuple[Carry, PyTree]:
        before, sensitivity = carry
        control, is_first = inputs
        candidate = jnp.where(is_first, present, nodes.candidate)
        acting = nodes._replace(candidate=candidate)
        after, sensitivity, linear = take_step(model, before, sensitivity, control, acting)
        after = jax.tree.map(lambda old, new: jnp.where(is_first, old, new), before, after)
        return (after, sensitivity), output(after, linear)

    unknown = no_sensitivity(model, state, jnp.zeros_like(controls[0]), nodes)
    is_first = jnp.arange(controls.shape[0] + 1) == 0
    inputs = jnp.concatenate([jnp.zeros_like(controls[:1]), controls]), is_first
    _, outputs = jax.lax.scan(
        jax.checkpoint(step) if checkpoint else step, (state, unknown), inputs
    )
    return jax.tree.map(lambda leaf: leaf[1:], outputs)
