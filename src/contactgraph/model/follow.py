"""Along a recorded run, step by step: what is believed, and how each step is linear."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.belief import ContactBelief, ContactSensor, correct
from contactgraph.model.linear_dynamics import LinearDynamics
from contactgraph.model.motion_evidence import correct_by_motion, judging_motion
from contactgraph.model.motion_noise import MotionNoise
from contactgraph.model.push import held_response, in_type_of, pushed, response_of
from contactgraph.model.recording import Recording
from contactgraph.model.state import ModelState
from contactgraph.model.step_model import StepModel


class FollowedRun(eqx.Module):
    """What is believed along a run, from its past alone, and the dynamics that rest on it."""

    now: ContactBelief
    """[T+1, E, K] about the step that led to each state, corrected by the contacts measured,
    and by the motion seen in that step where it is to."""
    coming: ContactBelief
    """[T+1, E, K] predicted from each state about the step that follows it."""
    dynamics: LinearDynamics
    """[T+1, N, D, ...] of the step that follows each state; under no control after the last."""


class _Carry(eqx.Module):
    """What is carried from state to state."""

    before: ModelState
    """The last state, its belief corrected."""
    control: Float[Array, " U"]
    """N, of the step since."""
    told: Float[Array, " E"]
    """By motion: see `MotionEvidence`."""
    predicted: ContactBelief
    """About that step."""
    response: Float[Array, "N D U"]


def follow_run(
    model: StepModel,
    run: Recording,
    sensor: ContactSensor,
    motion_noise: MotionNoise | None = None,
) -> FollowedRun:
    """Goes along a run: every step is predicted, then the belief corrected by its contacts.

    With a ``motion_noise`` the motion seen corrects it, too: see `judging_motion` for what raises.
    """

    def follow(
        carry: _Carry, step: tuple[Array, Array, Array, Array]
    ) -> tuple[_Carry, FollowedRun]:
        position, velocity, contact, control = step
        predicted, told = carry.predicted, carry.told
        if motion_noise is not None:
            predicted, told = correct_by_motion(
                judging_motion(model),
                predicted,
                carry.before,
                told,
                carry.control,
                (position, velocity),
                run.nodes,
                motion_noise,
            )
        now = correct(predicted, contact, sensor)
        here = ModelState(position, velocity, now)
        linear, coming = model.linear_step(pushed(here, carry.response, control), run.nodes)
        coming = in_type_of(coming, predicted)
        response = response_of(linear, carry.response)
        after = _Carry(here, control, told, coming, response)
        return after, FollowedRun(now, coming, linear)

    first = model.initial_belief(run.position[0], run.velocity[0], run.nodes)
    begin = ModelState(run.position[0], run.velocity[0], first)
    # No control follows the last state.
    control = jnp.concatenate([run.control, jnp.zeros_like(run.control[:1])])
    steps = run.position, run.velocity, run.contact, control
    carry = _Carry(
        # Nothing was seen before the first state.
        before=dataclasses.replace(begin, velocity=jnp.full_like(begin.velocity, jnp.nan)),
        control=control[0],
        told=jnp.zeros(run.nodes.candidate.shape, begin.velocity.dtype),
        predicted=first,
        response=held_response(model, begin, run.nodes),
    )
    return jax.lax.scan(follow, carry, steps)[1]
