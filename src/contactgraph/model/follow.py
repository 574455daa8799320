"""Along a recorded run, step by step: what is believed, and how each step is linear."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.belief import ContactBelief, ContactSensor, correct
from contactgraph.model.linear_dynamics import LinearDynamics
from contactgraph.model.push import held_response, in_types_of, pushed, response_of
from contactgraph.model.recording import Recording
from contactgraph.model.state import ModelState
from contactgraph.model.step_model import StepModel


class FollowedRun(eqx.Module):
    """What is believed along a run, from its past alone, and the dynamics that rest on it."""

    now: ContactBelief
    """[T+1, E, K] about the step that led to each state, corrected by the contacts measured."""
    coming: ContactBelief
    """[T+1, E, K] predicted from each state about the step that follows it."""
    dynamics: LinearDynamics
    """[T+1, N, D, ...] of the step that follows each state; under no control after the last."""


def follow_run(model: StepModel, run: Recording, sensor: ContactSensor) -> FollowedRun:
    """Goes along a run: every step is predicted, then the belief corrected by its contacts."""

    Carry = tuple[ContactBelief, Float[Array, "N D U"]]

    def follow(carry: Carry, step: tuple[Array, Array, Array, Array]) -> tuple[Carry, FollowedRun]:
        predicted, response = carry
        position, velocity, contact, control = step
        now = correct(predicted, contact, sensor)
        state = pushed(ModelState(position, velocity, now), response, control)
        linear, coming = model.linear_step(state, run.nodes)
        coming = in_types_of(coming, predicted)
        return (coming, response_of(linear, response)), FollowedRun(now, coming, linear)

    first = model.initial_belief(run.position[0], run.velocity[0], run.nodes)
    begin = ModelState(run.position[0], run.velocity[0], first)
    # No control follows the last state.
    control = jnp.concatenate([run.control, jnp.zeros_like(run.control[:1])])
    steps = run.position, run.velocity, run.contact, control
    return jax.lax.scan(follow, (first, held_response(model, begin, run.nodes)), steps)[1]
