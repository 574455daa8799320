"""What training minimises: the terms by name."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from contactgraph.model.contact_belief import ContactBelief
from contactgraph.model.contact_dynamics import ContactDynamics, EncodedGraph
from contactgraph.model.neighbor_list import edge_count
from contactgraph.model.types import LinearDynamics, ModelState, Nodes
from contactgraph.train.batch import Window
from contactgraph.train.chunked_vmap import chunked_vmap

_Result = TypeVar("_Result")
_SMALLEST = 1e-6
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
    error, divergence, weight = _teacher_forced(_Steps(model, windows, devices), key)
    nodes = jnp.broadcast_to(windows.nodes.mask[:, None], error.shape)
    return LossTerms(
        prediction=_mean(jnp.sqrt(error + _SMALLEST), nodes),
        squared=_mean(error, nodes),
        rollout=rollout_loss(model, windows, devices) if with_rollout else jnp.zeros(()),
        prior=_mean(divergence, weight > 0),
    )


def rollout_loss(model: ContactDynamics, windows: Window, devices: int = 1) -> Float[Array, ""]:
    """`LossTerms.rollout` over a batch of windows, of which it is all that goes through time."""
    edges = edge_count(model.neighbor_list, windows.position.shape[-2])
    missed = chunked_vmap(partial(_rolled_out, model), (windows,), edges, devices)
    return _mean(missed, jnp.broadcast_to(windows.nodes.mask[:, None], missed.shape))


def _mean(values: Array, mask: Array) -> Array:
    return jnp.sum(jnp.where(mask, values, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


@dataclass(frozen=True)
class _Steps:
    """All steps of all windows, each by itself."""

    model: ContactDynamics
    windows: Window
    devices: int

    @property
    def length(self) -> int:
        """L"""
        return self.windows.control.shape[1]

    @property
    def edges(self) -> int:
        """Of a step."""
        return edge_count(self.model.neighbor_list, self.windows.position.shape[-2])

    def each(self, function: Callable[..., _Result], *given: PyTree) -> _Result:
        """The function of every step's nodes, position, velocity and what is ``given`` of it
        [B, L, ...], stacked alike."""
        windows, count = self.windows, self.windows.control.shape[0]
        given = windows.position[:, :-1], windows.velocity[:, :-1], *given

        def of_step(window: Array, given: PyTree) -> _Result:
            return function(jax.tree.map(lambda leaf: leaf[window], windows.nodes), *given)

        flat = jax.tree.map(lambda leaf: leaf.reshape(count * self.length, *leaf.shape[2:]), given)
        window = jnp.repeat(jnp.arange(count), self.length)
        found = chunked_vmap(of_step, (window, flat), self.edges, self.devices)
        return jax.tree.map(lambda leaf: leaf.reshape(count, self.length, *leaf.shape[1:]), found)


def _teacher_forced(
    steps: _Steps, key: PRNGKeyArray
) -> tuple[Float[Array, "B L N"], Float[Array, "B L E"], Float[Array, "B L E"]]:
    """Squared error, KL divergence and weight of edges, of every step from its recorded state."""
    windows, dt = steps.windows, steps.model.dt
    percept, prior, belief = _believed(steps, _pushes(steps))

    def missed(
        nodes: Nodes,
        x: Array,
        v: Array,
        percept: EncodedGraph,
        belief: ContactBelief,
        u: Array,
        then: tuple[Array, Array],
        key: PRNGKeyArray,
    ) -> Array:
        position, velocity = _linear(steps.model, nodes, x, v, percept, belief, key)(x, v, u)
        missed = jnp.sum(((position - then[0]) / dt) ** 2, axis=-1)
        return missed + jnp.sum((velocity - then[1]) ** 2, axis=-1)

    then = windows.position[:, 1:], windows.velocity[:, 1:]
    keys = jax.random.split(key, windows.control.shape[:2])
    error = steps.each(missed, percept, belief, windows.control, then, keys)
    p = jnp.clip(belief.type_probability, _SMALLEST, 1.0)
    q = jnp.clip(prior.type_probability, _SMALLEST, 1.0)
    return error, jnp.sum(p * (jnp.log(p) - jnp.log(q)), axis=-1), percept.weight


def _pushes(steps: _Steps) -> Float[Array, "B L N D"]:
    """How far each control alone moves each node in its step, m.

    From a first pass that knows of no push. Nothing learns through it.
    """
    percept, _, belief = _believed(steps, None)

    def response(
        nodes: Nodes, x: Array, v: Array, percept: EncodedGraph, belief: ContactBelief
    ) -> Array:
        return _linear(steps.model, nodes, x, v, percept, belief).B[..., 0, :]

    found = jax.lax.stop_gradient(steps.each(response, percept, belief))
    before = jnp.concatenate([found[:, :1], found[:, :-1]], axis=1)
    return jnp.sum(before * steps.windows.control[:, :, None, None, :], axis=-1)


def _believed(
    steps: _Steps, control_displacement: Float[Array, "B L N D"] | None
) -> tuple[EncodedGraph, ContactBelief, ContactBelief]:
    """EncodedGraph, prior and belief about every step, from the recorded states."""
    model = steps.model
    percept = steps.each(
        lambda nodes, x, v, displacement: model.encode(x, v, nodes, displacement),
        control_displacement,
    )
    prior = jax.vmap(jax.vmap(model.prior_belief))(percept)

    def take_step(
        belief: ContactBelief, percept: EncodedGraph
    ) -> tuple[ContactBelief, ContactBelief]:
        belief = model.predict_belief(belief, percept)
        return belief, belief

    def along(prior: ContactBelief, percept: EncodedGraph) -> ContactBelief:
        first = jax.tree.map(lambda leaf: leaf[0], prior)
        return jax.lax.scan(take_step, first, percept)[1]

    return percept, prior, jax.vmap(along)(prior, percept)


def _linear(
    model: ContactDynamics,
    nodes: Nodes,
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    percept: EncodedGraph,
    belief: ContactBelief,
    key: PRNGKeyArray | None = None,
) -> LinearDynamics:
    local = model.local_input(percept, belief, position, velocity, nodes, key)
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

    edges = edge_count(model.neighbor_list, windows.position.shape[-2])
    return jnp.mean(chunked_vmap(rmse, (windows,), edges))
