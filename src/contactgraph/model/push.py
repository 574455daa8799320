"""What a step's own control does to who touches whom within the step.

A force of 10 N moves a body of 1 kg by 14 mm in a step of 0.05 s: that decides whether it touches
another within it. So a model is told the push of every control, which is the control times what
it did to positions in the step before: contacts that come about in a step do not push in it.
"""

import dataclasses
from collections.abc import Callable
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from contactgraph.model.belief import ContactBelief
from contactgraph.model.linear_dynamics import LinearDynamics
from contactgraph.model.state import ModelState, Nodes


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


def held_response(model: _LinearModel, state: ModelState, nodes: Nodes) -> Float[Array, "N D U"]:
    """[m/N] How far each node is moved by the control, if only the present contacts hold."""
    unpushed = dataclasses.replace(state, push=jnp.zeros_like(state.velocity))
    held = dataclasses.replace(nodes, candidate=_holding(state, nodes))
    linear, _ = _linear_step(model, unpushed, held)
    return response_of(linear, state.position)


def _holding(state: ModelState, nodes: Nodes) -> Bool[Array, " E"]:
    believed = state.belief.over(None, nodes.candidate.shape[0])
    return nodes.candidate & (believed.probability > 0.5)


def pushed(
    state: ModelState, response: Float[Array, "N D U"], control: Float[Array, " U"]
) -> ModelState:
    """The state, told how far the coming step's control [N] alone moves each node."""
    push = jnp.sum(response * control, axis=-1)
    return dataclasses.replace(state, push=push.astype(state.velocity.dtype))


def response_of(linear: LinearDynamics, like: Array) -> Float[Array, "N D U"]:
    """[m/N] The response in the step after one of these dynamics; of `like`'s number type."""
    return linear.B[..., 0, :].astype(like.dtype)


def advance(
    model: _LinearModel,
    state: ModelState,
    response: Float[Array, "N D U"],
    control: Float[Array, " U"],
    nodes: Nodes,
) -> tuple[ModelState, Float[Array, "N D U"], LinearDynamics]:
    """One step under a control [N]: the next state, the response after it, and the dynamics.

    States keep their number types: a model of float32 may meet states of float64.
    """
    linear, belief = _linear_step(model, pushed(state, response, control), nodes)
    position, velocity = linear(state.position, state.velocity, control)
    after = ModelState(
        position=position.astype(state.position.dtype),
        velocity=velocity.astype(state.velocity.dtype),
        belief=in_type_of(belief, state.belief),
    )
    return after, response_of(linear, response), linear


def following(
    model: _LinearModel,
    state: ModelState,
    controls: Float[Array, "H U"],
    nodes: Nodes,
    wrapped: Callable[[Callable], Callable] | None = None,
) -> ModelState:
    """All states that follow, ``[H, …]``; ``wrapped`` is each step's function, if by something.

    As `advance` from the `held_response` on. That is found by a turn of the same loop before the
    first step, so that a program holds one step and one derivative of it, not two.
    """
    holds = _holding(state, nodes)

    def step(
        carry: tuple[ModelState, Float[Array, "N D U"]], told: tuple[Array, Array]
    ) -> tuple[tuple[ModelState, Float[Array, "N D U"]], ModelState]:
        before, response = carry
        control, begins = told
        candidate = jnp.where(begins, holds, nodes.candidate)
        known = dataclasses.replace(nodes, candidate=candidate)
        after, response, _ = advance(model, before, response, control, known)
        after = jax.tree.map(lambda old, new: jnp.where(begins, old, new), before, after)
        return (after, response), after

    unknown = jnp.zeros((*state.position.shape, controls.shape[-1]), state.position.dtype)
    begins = jnp.arange(controls.shape[0] + 1) == 0
    told = jnp.concatenate([jnp.zeros_like(controls[:1]), controls]), begins
    each = step if wrapped is None else wrapped(step)
    _, states = jax.lax.scan(each, (state, unknown), told)
    return jax.tree.map(lambda leaf: leaf[1:], states)


def in_type_of(belief: ContactBelief, other: ContactBelief) -> ContactBelief:
    """The belief in the number type of another, which may be about other edges."""
    types = belief.type_probability.astype(other.type_probability.dtype)
    return dataclasses.replace(belief, type_probability=types)
