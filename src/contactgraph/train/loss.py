"""What training minimises: the terms by name."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from contactgraph.model.belief import ContactBelief
from contactgraph.model.contact_dynamics import ContactDynamics, Percept
from contactgraph.model.linear_dynamics import LinearDynamics
from contactgraph.model.state import ModelState
from contactgraph.train.batch import Window

_Result = TypeVar("_Result")
_SMALLEST = 1e-6
_LARGE = 200
"""Edges times steps from which on a window is work enough by itself: one fits a core's cache."""
_ROLLOUT_POSITION = 0.5
"""Weight of a rollout's position errors: they add up over its steps, velocity errors do not."""


class LossTerms(eqx.Module):
    """The parts of the loss, or their weights."""

    prediction: Float[Array, ""] | float = 1.0
    """Mean norm of the one-step error of a node's state, in units of velocity, m/s."""
    squared: Float[Array, ""] | float = 1.0
    """Mean square of the same, (m/s)^2: what rules is the rare large error, a missed impact."""
    rollout: Float[Array, ""] | float = 0.3
    """Mean norm of the error when a whole window is predicted from its first state, m/s."""
    prior: Float[Array, ""] | float = 0.05
    """Mean KL divergence of the belief from the distance prior, nat an edge."""

    def total(self, weights: "LossTerms") -> Float[Array, ""]:
        """The weighted sum."""
        return jnp.asarray(
            self.prediction * weights.prediction
            + self.squared * weights.squared
            + self.rollout * weights.rollout
            + self.prior * weights.prior
        )


def window_loss(
    model: ContactDynamics,
    windows: Window,
    key: PRNGKeyArray,
    with_rollout: bool,
    devices: int = 1,
) -> LossTerms:
    """Loss terms over a batch of windows (every leaf of `windows` has a leading axis B).

    One-step prediction from every recorded state and KL to the prior: paper, eq. (3). Position
    errors are divided by dt, so that both halves of a state weigh alike. The rollout term costs a
    pass through time; without it the term is 0. ``devices`` is over how many the windows are split.
    """
    keys = jax.random.split(key, windows.control.shape[0])
    error, nodes, divergence, edges = _each_window(
        model, lambda w, k: _teacher_forced(model, w, k), devices, windows, keys
    )
    rollout = jnp.zeros(())
    if with_rollout:
        moved = _each_window(model, lambda w: _rolled_out(model, w), devices, windows)
        rollout = _mean(moved, nodes)
    return LossTerms(
        prediction=_mean(jnp.sqrt(error + _SMALLEST), nodes),
        squared=_mean(error, nodes),
        rollout=rollout,
        prior=_mean(divergence, edges),
    )


def _mean(values: Array, mask: Array) -> Array:
    return jnp.sum(jnp.where(mask, values, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


def _teacher_forced(
    model: ContactDynamics, window: Window, key: PRNGKeyArray
) -> tuple[Array, Array, Array, Array]:
    """Squared error [L, N] and who counts, KL divergence [L, E] and which edges count."""
    position, velocity = window.position, window.velocity
    percept, prior, belief = _believed(model, window, _pushes(model, window))

    def predict(
        percept: Percept, belief: ContactBelief, x: Array, v: Array, u: Array, key: PRNGKeyArray
    ) -> tuple[Array, Array]:
        return _linear(model, window, percept, belief, x, v, key)(x, v, u)

    keys = jax.random.split(key, window.control.shape[0])
    next_position, next_velocity = _each(
        model, predict, percept, belief, position[:-1], velocity[:-1], window.control, keys
    )
    error = jnp.sum(((next_position - position[1:]) / model.dt) ** 2, axis=-1)
    error = error + jnp.sum((next_velocity - velocity[1:]) ** 2, axis=-1)
    p = jnp.clip(belief.type_probability, _SMALLEST, 1.0)
    q = jnp.clip(prior.type_probability, _SMALLEST, 1.0)
    divergence = jnp.sum(p * (jnp.log(p) - jnp.log(q)), axis=-1)
    counts = jnp.broadcast_to(window.nodes.mask, error.shape)
    return error, counts, divergence, percept.weight > 0


def _pushes(model: ContactDynamics, window: Window) -> Float[Array, "L N D"]:
    """How far each control alone moves each node in its step, m; see `contactgraph.model.pushed`.

    From a first pass that knows of no push. Nothing learns through it.
    """
    position, velocity = window.position[:-1], window.velocity[:-1]
    percept, _, belief = _believed(model, window, None)
    response = _each(
        model,
        lambda *step: _linear(model, window, *step).B[..., 0, :],
        *(percept, belief, position, velocity),
    )
    before = jnp.concatenate([response[:1], response[:-1]])
    push = jnp.sum(before * window.control[:, None, None, :], axis=-1)
    return jax.lax.stop_gradient(push)


def _believed(
    model: ContactDynamics, window: Window, push: Float[Array, "L N D"] | None
) -> tuple[Percept, ContactBelief, ContactBelief]:
    """Percept, prior and belief about every step of a window, from the recorded states."""
    percept = _each(
        model,
        lambda x, v, p: model.perceive(x, v, window.nodes, p),
        *(window.position[:-1], window.velocity[:-1], push),
    )
    prior = jax.vmap(model.prior_belief)(percept)

    def advance(belief: ContactBelief, percept: Percept) -> tuple[ContactBelief, ContactBelief]:
        belief = model.predict_belief(belief, percept)
        return belief, belief

    first = jax.tree.map(lambda leaf: leaf[0], prior)
    return percept, prior, jax.lax.scan(advance, first, percept)[1]


def _each(model: ContactDynamics, function: Callable[..., _Result], *given: PyTree) -> _Result:
    """The function of every step of a window, stacked.

    In scenes large enough for neighbour lists one after the other, and anew for the gradient: a
    step is work enough then, and the temporaries of all of them at once would fill the memory.
    """
    if model.neighbours is None:
        return jax.vmap(function)(*given)
    return _in_turn(function, given)


def _each_window(
    model: ContactDynamics,
    function: Callable[..., _Result],
    devices: int,
    windows: Window,
    *given: PyTree,
) -> _Result:
    """The function of every window, stacked; of large windows one after the other on a device."""
    nodes, steps = windows.position.shape[-2], windows.control.shape[1]
    if model.neighbours is None and steps * nodes * (nodes - 1) // 2 < _LARGE:
        return jax.vmap(function)(windows, *given)
    if devices == 1:
        return _in_turn(function, (windows, *given))
    rounds = jax.tree.map(
        lambda leaf: jnp.swapaxes(leaf.reshape(devices, -1, *leaf.shape[1:]), 0, 1),
        (windows, *given),
    )
    found = _in_turn(jax.vmap(function), rounds)
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1).reshape(-1, *leaf.shape[2:]), found)


def _in_turn(function: Callable[..., _Result], given: PyTree) -> _Result:
    """One after the other, and anew for the gradient, so that nothing large is kept for it."""
    return jax.lax.map(jax.checkpoint(lambda one: function(*one)), given)


def _linear(
    model: ContactDynamics,
    window: Window,
    percept: Percept,
    belief: ContactBelief,
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    key: PRNGKeyArray | None = None,
) -> LinearDynamics:
    local = model.local_input(percept, belief, position, velocity, window.nodes, key)
    return model.local_dynamics(local, model.dt, model.control_size)


def predict_window(model: ContactDynamics, window: Window) -> ModelState:
    """All states of a window, ``[L, …]``, predicted from its first state and its controls."""
    position, velocity = window.position[0], window.velocity[0]
    belief = model.initial_belief(position, velocity, window.nodes)
    return model.rollout(ModelState(position, velocity, belief), window.control, window.nodes)


def _rolled_out(model: ContactDynamics, window: Window) -> Float[Array, "L N"]:
    states = predict_window(model, window)
    position_error = _ROLLOUT_POSITION * (states.position - window.position[1:]) / model.dt
    velocity_error = states.velocity - window.velocity[1:]
    return jnp.sqrt(jnp.sum(position_error**2 + velocity_error**2, axis=-1) + _SMALLEST)


def rollout_rmse(model: ContactDynamics, windows: Window) -> Float[Array, ""]:
    """Mean over windows, each predicted from its first state, of its RMS position error [m].

    A mean of roots, not a root of means: one graze that is called the wrong way must not decide
    which model is the best.
    """

    def rmse(window: Window) -> Float[Array, ""]:
        states = predict_window(model, window)
        squared = jnp.sum((states.position - window.position[1:]) ** 2, axis=-1)
        counts = jnp.broadcast_to(window.nodes.mask, squared.shape)
        return jnp.sqrt(_mean(squared, counts))

    return jnp.mean(_each(model, rmse, windows))
