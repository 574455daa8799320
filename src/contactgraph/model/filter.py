"""Whether a model can say anything about a task or about data at all."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.data import InvalidInputError, Scene, TrajectoryBatch
from contactgraph.model.contact_belief import ContactBelief, ContactSensor, correct
from contactgraph.model.contact_dynamics import (
    ContactDynamics,
    cast_like,
    control_sensitivity,
    response_of,
    with_control_displacement,
)
from contactgraph.model.motion_likelihood import MotionNoise, check_motion_model, correct_by_motion
from contactgraph.model.types import LinearDynamics, ModelState, StepModel


def check_fit(model: object, scene: Scene, control_size: int, other: str) -> None:
    """Raises `InvalidInputError` where a scene or its control are not of the kind the model is for.

    ``other`` names what does not fit, e.g. ``"the data"``. Models other than `ContactDynamics` do
    not say what they are for.
    """
    if not isinstance(model, ContactDynamics):
        return
    if model.neighbor_list is not None:
        raise InvalidInputError(
            f"beliefs about {other} are asked for over all pairs, so the model must have no "
            "neighbour lists (neighbor_list=None)"
        )
    for what, found, wanted in (
        ("dimension D", scene.dimension, model.dimension),
        ("control size U", control_size, model.control_size),
    ):
        if found != wanted:
            raise InvalidInputError(
                f"the model is for {what} {wanted}, but {other} has {found}; they must agree"
            )
    if not math.isclose(scene.dt, model.dt, rel_tol=1e-6):
        raise InvalidInputError(
            f"the model is for dt {model.dt:g} s, but {other} has {scene.dt:g} s; they must agree"
        )
    if model.features.hinges and not scene.has_hinges:
        raise InvalidInputError(
            f"the model is for bodies on hinges, but {other} has no anchor; it must say where a "
            "hinge is"
        )
    if scene.has_hinges and not model.features.hinges:
        raise InvalidInputError(
            f"the model knows no hinges, but {other} has an anchor; train one on data that has"
        )


def on_device(batch: TrajectoryBatch[np.ndarray], dtype: np.dtype) -> TrajectoryBatch[Array]:
    """The same trajectories as JAX arrays; numbers have the type ``dtype``."""

    def moved(leaf: np.ndarray) -> Array:
        return jnp.asarray(leaf, dtype if np.issubdtype(leaf.dtype, np.floating) else None)

    return jax.tree.map(moved, batch)


def dtype_of(model: object) -> np.dtype:
    """The floating type of the model's weights; JAX's default where it has none."""
    for leaf in jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array)):
        return np.dtype(leaf.dtype)
    return np.dtype(jax.dtypes.canonicalize_dtype(np.float64))


class FilteredTrajectory(eqx.Module):
    """What is believed along a run, from its past alone, and the dynamics that rest on it."""

    posterior: ContactBelief
    """[T+1, E, K] about the step that led to each state, corrected by the contacts measured,
    and by the motion seen in that step where it is to."""
    prior: ContactBelief
    """[T+1, E, K] predicted from each state about the step that follows it."""
    dynamics: LinearDynamics
    """[T+1, N, D, ...] of the step that follows each state; under no control after the last."""


class _Carry(eqx.Module):
    """What is carried from state to state."""

    before: ModelState
    """The last state, its belief corrected."""
    control: Float[Array, " U"]
    """N, of the step since."""
    motion_log_odds: Float[Array, " E"]
    """By motion: see `MotionEvidence`."""
    predicted: ContactBelief
    """About that step."""
    response: Float[Array, "N D U"]


def filter_trajectory(
    model: StepModel,
    run: TrajectoryBatch[Array],
    sensor: ContactSensor,
    motion_noise: MotionNoise | None = None,
) -> FilteredTrajectory:
    """Goes along a run: every step is predicted, then the belief corrected by its contacts.

    ``run`` has no batch axis; contacts that are NaN, or left out, correct nothing.
    With a ``motion_noise`` the motion corrects it, too: see `check_motion_model` for what raises.
    """

    def follow(
        carry: _Carry, step: tuple[Array, Array, Array, Array]
    ) -> tuple[_Carry, FilteredTrajectory]:
        position, velocity, contact, control = step
        predicted, told = carry.predicted, carry.motion_log_odds
        if motion_noise is not None:
            predicted, told = correct_by_motion(
                check_motion_model(model),
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
        linear, coming = model.linear_step(
            with_control_displacement(here, carry.response, control), run.nodes
        )
        coming = cast_like(coming, predicted)
        response = response_of(linear, carry.response)
        after = _Carry(here, control, told, coming, response)
        return after, FilteredTrajectory(now, coming, linear)

    first = model.initial_belief(run.position[0], run.velocity[0], run.nodes)
    begin = ModelState(run.position[0], run.velocity[0], first)
    # No control follows the last state.
    control = jnp.concatenate([run.control, jnp.zeros_like(run.control[:1])])
    contact = run.contact
    if contact is None:
        shape = len(run.position), *run.nodes.candidate.shape
        contact = jnp.full(shape, jnp.nan, run.position.dtype)
    steps = run.position, run.velocity, contact, control
    carry = _Carry(
        # Nothing was seen before the first state.
        before=dataclasses.replace(begin, velocity=jnp.full_like(begin.velocity, jnp.nan)),
        control=control[0],
        motion_log_odds=jnp.zeros(run.nodes.candidate.shape, begin.velocity.dtype),
        predicted=first,
        response=control_sensitivity(model, begin, run.nodes),
    )
    return jax.lax.scan(follow, carry, steps)[1]
