"""The filter: corrections of a predicted belief by an observation; along trajectories."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.data.trajectory_batch import Nodes, TrajectoryBatch
from contactgraph.dynamics.local_dynamics import LinearDynamics
from contactgraph.inference.contact_belief import ContactBelief, ContactSensor, cast_like, correct
from contactgraph.inference.motion_noise import Motion, MotionNoise
from contactgraph.model.body_mass import MassBelief, correct_masses, first_masses, with_masses
from contactgraph.model.motion_likelihood import check_motion_model, correct_by_motion
from contactgraph.model.step import ModelState, StepModel


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
