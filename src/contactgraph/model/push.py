"""What a step's own control does to who touches whom within the step.

A force of 10 N moves a body of 1 kg by 14 mm in a step of 0.05 s: that decides whether it touches
another within it. So a model is told the push of every control, which is the control times what
it did to positions in the step before: contacts that come about in a step do not push in it.
"""

import dataclasses
from typing import Protocol

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

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
    believed = state.belief.over(None, nodes.candidate.shape[0])
    holds = nodes.candidate & (believed.probability > 0.5)
    unpushed = dataclasses.replace(state, push=jnp.zeros_like(state.velocity))
    linear, _ = _linear_step(model, unpushed, dataclasses.replace(nodes, candidate=holds))
    return response_of(linear, state.position)


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


def in_type_of(belief: ContactBelief, other: ContactBelief) -> ContactBelief:
    """The belief in the number type of another, which may be about other edges."""
    types = belief.type_probability.astype(other.type_probability.dtype)
    return dataclasses.replace(belief, type_probability=types)
