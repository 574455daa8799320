"""Filtering of recorded trajectories: predict and correct the belief step by step."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.data import (
    InvalidInputError,
    Scene,
    Trajectory,
    TrajectoryBatch,
    pad_trajectories,
)
from contactgraph.model.body_mass import MassBelief, correct_masses, first_masses, with_masses
from contactgraph.model.contact_belief import ContactBelief, ContactSensor, cast_like, correct
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.features import turn_length_of
from contactgraph.model.local_dynamics import FreeLinearDynamics
from contactgraph.model.motion_likelihood import MotionNoise, check_motion_model, correct_by_motion
from contactgraph.model.rollout import control_sensitivity, with_control_displacement
from contactgraph.model.types import LinearDynamics, ModelState, StepModel


def check_fit(model: object, scene: Scene, control_size: int, other: str) -> None:
    """Raises `InvalidInputError` where a scene or its control do not suit the model.

    ``other`` names what does not, e.g. ``"the data"``. Only a `ContactDynamics` declares what it is
    for.
    """
    if not isinstance(model, ContactDynamics):
        return
    if model.neighbor_list is not None:
        raise InvalidInputError(
            f"beliefs about {other} are over all pairs, so the model must have no neighbor list "
            "(neighbor_list=None)"
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
    check_controls(model, scene, control_size, other)
    unknown = sorted(set(scene.node_type) - set(model.features.types))
    if model.features.types and unknown:
        raise InvalidInputError(
            f"{other} has nodes of type {', '.join(unknown)}, which the model does not know; it "
            f"knows {', '.join(model.features.types)}"
        )
    if model.features.turn_length is not None and scene.polygons is None:
        raise InvalidInputError(
            f"the model is for bodies that turn, but {other} has no polygons, their outlines"
        )
    if model.features.hinges and not scene.has_hinges:
        raise InvalidInputError(
            f"the model is for bodies on hinges, but {other} has no anchor, the position of "
            "each hinge"
        )
    if scene.has_hinges and not model.features.hinges:
        raise InvalidInputError(
            f"the model has no hinges, but {other} has an anchor; train a model on such data"
        )


def check_controls(model: object, scene: Scene, control_size: int, other: str) -> None:
    """Raises `InvalidInputError` where the model's control does not reach a degree of freedom.

    Component d of the control moves degree of freedom d of every actuated node, and further ones
    move nothing. Free matrices (`FreeLinearDynamics`) map any control to any motion.
    """
    if not isinstance(model, ContactDynamics):
        return
    free = isinstance(model.local_dynamics, FreeLinearDynamics)
    if control_size < scene.dimension and scene.actuated.any() and not free:
        raise InvalidInputError(
            f"{other} has actuated nodes, but control size U {control_size}; it must be at least "
            f"D = {scene.dimension}, because component d of the control moves degree of freedom d "
            "(zeros where there is no drive), or no node may be actuated"
        )


def on_device(batch: TrajectoryBatch[np.ndarray], dtype: np.dtype) -> TrajectoryBatch[Array]:
    """The same trajectories as JAX arrays; floating-point numbers have the type ``dtype``."""

    def moved(leaf: np.ndarray) -> Array:
        return jnp.asarray(leaf, dtype if np.issubdtype(leaf.dtype, np.floating) else None)

    return jax.tree.map(moved, batch)


def trajectory_for(
    model: object,
    trajectory: Trajectory,
    node_capacity: int | None = None,
    steps: int | None = None,
    contacts: bool = True,
) -> TrajectoryBatch[Array]:
    """One trajectory in the coordinates of the model, without a batch axis: `pad_trajectories`."""
    size = node_capacity, steps, contacts, turn_length_of(model)
    return on_device(pad_trajectories((trajectory,), *size).at(0), dtype_of(model))


def dtype_of(model: object) -> np.dtype:
    """The floating type of the model's weights; JAX's default where it has none."""
    for leaf in jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array)):
        return np.dtype(leaf.dtype)
    return np.dtype(jax.dtypes.canonicalize_dtype(np.float64))


class FilteredTrajectory(eqx.Module):
    """Beliefs along a trajectory, each from its past alone, and the dynamics that assume them."""

    posterior: ContactBelief
    """[T+1, E, K] about the step that led to each state, corrected by the measured contacts and,
    if asked for, by the motion in that step."""
    prior: ContactBelief
    """[T+1, E, K] about the step that follows each state, predicted from it."""
    dynamics: LinearDynamics
    """[T+1, N, D, ...] of the step that follows each state; under no control after the last."""
    masses: MassBelief | None
    """[T+1, N] by the motion up to each state. None: bodies of a type weigh alike."""


class _Carry(eqx.Module):
    """The part of the filter that is carried from state to state."""

    before: ModelState
    """The last state, with its corrected belief."""
    control: Float[Array, " U"]
    """N, of the step since."""
    motion_log_odds: Float[Array, " E"]
    """See `MotionEvidence`."""
    predicted: ContactBelief
    """About that step."""
    sensitivity: Float[Array, "N D W"]
    masses: MassBelief | None


def filter_trajectory(
    model: StepModel,
    trajectory: TrajectoryBatch[Array],
    sensor: ContactSensor,
    motion_noise: MotionNoise | None = None,
) -> FilteredTrajectory:
    """Predicts every step of a trajectory, then corrects the belief by the measured contacts.

    ``trajectory`` has no batch axis; contacts that are NaN, or left out, correct nothing. Late
    reports count as current ones, as in MPC: see `ContactSensor.as_current`. With a
    ``motion_noise`` the motion corrects the belief, too: see `check_motion_model` for what that
    raises.
    """
    sensor = sensor.as_current

    def follow(
        carry: _Carry, step: tuple[Array, Array, Array, Array]
    ) -> tuple[_Carry, FilteredTrajectory]:
        position, velocity, contact, control = step
        predicted, log_odds, masses = carry.predicted, carry.motion_log_odds, carry.masses
        before, nodes = carry.before, with_masses(trajectory.nodes, masses)
        made = carry.control, (position, velocity), nodes
        if motion_noise is not None:
            judge, given = check_motion_model(model), (*made, motion_noise)
            predicted, log_odds = correct_by_motion(judge, predicted, before, log_odds, *given)
        state = ModelState(position, velocity, correct(predicted, contact, sensor))
        masses = correct_masses(model, masses, before, state.belief, *made, motion_noise)
        nodes = with_masses(nodes, masses)
        informed = with_control_displacement(model, state, carry.sensitivity, control, nodes)
        linear, prior = model.linear_step(informed, nodes)
        prior = cast_like(prior, predicted)
        sensitivity = linear.control_sensitivity.astype(carry.sensitivity.dtype)
        after = _Carry(state, control, log_odds, prior, sensitivity, masses)
        return after, FilteredTrajectory(state.belief, prior, linear, masses)

    initial = model.initial_belief(trajectory.position[0], trajectory.velocity[0], trajectory.nodes)
    first = ModelState(trajectory.position[0], trajectory.velocity[0], initial)
    # No control follows the last state.
    control = jnp.concatenate([trajectory.control, jnp.zeros_like(trajectory.control[:1])])
    contact = trajectory.contact
    if contact is None:
        shape = len(trajectory.position), *trajectory.nodes.candidate.shape
        contact = jnp.full(shape, jnp.nan, trajectory.position.dtype)
    carry = _Carry(
        # No state was observed before the first.
        before=dataclasses.replace(first, velocity=jnp.full_like(first.velocity, jnp.nan)),
        control=control[0],
        motion_log_odds=jnp.zeros(trajectory.nodes.candidate.shape, first.velocity.dtype),
        predicted=initial,
        sensitivity=control_sensitivity(model, first, trajectory.nodes),
        masses=first_masses(model, trajectory.nodes),
    )
    observed = trajectory.position, trajectory.velocity, contact, control
    return jax.lax.scan(follow, carry, observed)[1]
