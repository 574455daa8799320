"""The filter: corrections of a predicted belief by an observation; along recorded trajectories."""

import dataclasses
import math
from typing import Any

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
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.dynamics.local_dynamics import LinearDynamics
from contactgraph.inference.contact_belief import ContactBelief, ContactSensor, cast_like, correct
from contactgraph.inference.features import turn_length_of
from contactgraph.inference.motion_noise import Motion, MotionNoise
from contactgraph.model.body_mass import MassBelief, correct_masses, first_masses, with_masses
from contactgraph.model.motion_likelihood import check_motion_model, correct_by_motion
from contactgraph.model.step import ModelState, StepModel


def check_fit(model: Any, scene: Scene, control_size: int, other: str) -> None:
    """Raises `InvalidInputError` where a scene or its control do not suit the model.

    ``other`` names what does not, e.g. ``"the data"``. Only models with `Features`, such as a
    `ContactDynamics`, declare what they are for.
    """
    if not hasattr(model, "features"):
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
    if model.features.turn_length is not None and not scene.polygons:
        raise InvalidInputError(
            f"the model is for bodies that turn, but {other} has no polygons, their outlines"
        )
    if model.features.hinges is True and not scene.hinged.any():
        raise InvalidInputError(
            f"the model is for bodies on hinges, but {other} has no anchor, the position of "
            "each hinge"
        )
    if model.features.hinges is False and scene.hinged.any():
        raise InvalidInputError(
            f"the model has no hinges, but {other} has an anchor; train a model on such data"
        )


def check_controls(model: Any, scene: Scene, control_size: int, other: str) -> None:
    """Raises `InvalidInputError` where the model's control does not reach a degree of freedom.

    Component d of the control moves degree of freedom d of every actuated node, and further ones
    move nothing. Free matrices (`FreeLinearDynamics`) map any control to any motion.
    """
    aligned = getattr(getattr(model, "local_dynamics", None), "axis_aligned", False)
    if control_size < scene.dimension and scene.actuated.any() and aligned:
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
    batch = pad_trajectories(
        (trajectory,),
        node_capacity,
        steps,
        contacts=contacts,
        turn_length=turn_length_of(model),
    )
    return on_device(batch.at(0), dtype_of(model))


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


class FilterState(eqx.Module):
    """What is known between two observations."""

    before: ModelState
    """The last observation, NaN before the first, and the belief about the step that led there,
    corrected by all that was observed."""
    control: Float[Array, " U"]
    """N, of the step since."""
    predicted: ContactBelief
    """About that step."""
    masses: MassBelief | None
    """By the motion so far. None: bodies of a type weigh alike."""


def first_filter_state(
    model: StepModel,
    nodes: Nodes,
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    control: Float[Array, " U"],
) -> FilterState:
    """Before the observation of this first state: the model's first belief about it."""
    belief = model.initial_belief(position, velocity, nodes)
    nan = jnp.full_like(position, jnp.nan)
    return FilterState(ModelState(nan, nan, belief), control, belief, first_masses(model, nodes))


def update(
    model: StepModel,
    state: FilterState,
    observed: Motion,
    contact: Float[Array, " E"],
    control: Float[Array, " U"],
    nodes: Nodes,
    sensor: ContactSensor,
    noise: MotionNoise | None,
) -> FilterState:
    """Corrects the predicted belief by motion, then by contact, then the masses by motion.

    ``control`` [N] acted in the step since the last observation. In the result it is to be replaced
    by that of the next step, and the belief by the one predicted for that step.
    """
    before, belief = state.before, state.predicted
    nodes = with_masses(nodes, state.masses)
    if noise is not None:
        judge = check_motion_model(model)
        belief = correct_by_motion(judge, belief, before, control, observed, nodes, noise)
    belief = correct(belief, contact, sensor)
    masses = state.masses
    masses = correct_masses(model, masses, before, belief, control, observed, nodes, noise)
    return FilterState(ModelState(*observed, belief), control, belief, masses)


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
    sensor, nodes = sensor.as_current, trajectory.nodes

    def follow(
        before: FilterState, step: tuple[Array, Array, Array, Array]
    ) -> tuple[FilterState, FilteredTrajectory]:
        position, velocity, contact, control = step
        observed, made = (position, velocity), before.control
        after = update(model, before, observed, contact, made, nodes, sensor, motion_noise)
        state, heavy = after.before, with_masses(nodes, after.masses)
        linear, prior = model.linear_step(state, control, heavy)
        prior = cast_like(prior, before.predicted)
        followed = FilteredTrajectory(state.belief, prior, linear, after.masses)
        return dataclasses.replace(after, predicted=prior, control=control), followed

    # No control follows the last state.
    control = jnp.concatenate([trajectory.control, jnp.zeros_like(trajectory.control[:1])])
    contact = trajectory.contact
    if contact is None:
        shape = len(trajectory.position), *nodes.candidate.shape
        contact = jnp.full(shape, jnp.nan, trajectory.position.dtype)
    position, velocity = trajectory.position[0], trajectory.velocity[0]
    first = first_filter_state(model, nodes, position, velocity, control[0])
    observed = trajectory.position, trajectory.velocity, contact, control
    return jax.lax.scan(follow, first, observed)[1]
