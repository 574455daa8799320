"""The terms that training minimises, by name, over batches of windows."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from contactgraph.bodies.geometry import Meeting
from contactgraph.bodies.graph import EncodedGraph, edge_count
from contactgraph.dynamics.local_dynamics import LinearDynamics
from contactgraph.inference.contact_belief import ContactBelief, nothing_active
from contactgraph.inference.motion_noise import Motion
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.step import ModelState
from contactgraph.train.batch import Window, WindowSource

_Result = TypeVar("_Result")

_EDGES = 200
"""Edges per chunk: with networks of width 32, 64 to 200 took the least time."""


def chunked_vmap(
    function: Callable[..., _Result], given: tuple[PyTree, ...], edges: int, devices: int = 1
) -> _Result:
    """The function of every item, stacked; every leaf of `given` has the items as leading axis.

    Where all items, with so many `edges` each, exceed the cache, the chunks run one after another,
    and gradients recompute each chunk instead of storing its temporaries. Each of several `devices`
    computes an equal part of the items, in their order.
    """
    count = jax.tree.leaves(given)[0].shape[0] // devices
    rounds = -(-count * edges // _EDGES)
    if rounds <= 1 or count == 1:
        return jax.vmap(function)(*given)
    chunk = -(-count // min(rounds, count))
    rounds = -(-count // chunk)
    # The last chunk is filled up with its last item.
    filled = np.minimum(np.arange(rounds * chunk), count - 1)

    def split(leaf: Array) -> Array:
        leaf = leaf.reshape(devices, count, *leaf.shape[1:])
        leaf = leaf if len(filled) == count else leaf[:, filled]
        leaf = leaf.reshape(devices, rounds, chunk, *leaf.shape[2:]).swapaxes(0, 1)
        return leaf.reshape(rounds, devices * chunk, *leaf.shape[3:])

    def joined(leaf: Array) -> Array:
        leaf = leaf.reshape(rounds, devices, chunk, *leaf.shape[2:]).swapaxes(0, 1)
        leaf = leaf.reshape(devices, rounds * chunk, *leaf.shape[3:])[:, :count]
        return leaf.reshape(devices * count, *leaf.shape[2:])

    each = jax.checkpoint(lambda chunk: jax.vmap(function)(*chunk))
    return jax.tree.map(joined, jax.lax.map(each, jax.tree.map(split, given)))


_SMALLEST = 1e-6
_ROLLOUT_POSITION = 0.5
"""Weight of a rollout's position errors, which add up over its steps, unlike velocity errors."""


class LossTerms(eqx.Module):
    """The terms of the loss, or their weights."""

    prediction: Float[Array, ""] | float = 1.0
    """Mean norm of the one-step error of a node's state, in units of velocity, m/s."""
    squared: Float[Array, ""] | float = 1.0
    """Mean square of the same, (m/s)^2; dominated by the rare large error, a missed impact."""
    rollout: Float[Array, ""] | float = 0.3
    """Mean norm of the error when a whole window is predicted from its first state, m/s."""
    prior: Float[Array, ""] | float = 0.05
    """Mean KL divergence of the belief from the distance prior, nat per edge."""
    likelihood: Float[Array, ""] | float = 1.0
    """Mean negative log-likelihood of the motion under a filter, nat per edge."""
    noise: Float[Array, ""] | float = 1.0
    """Mean score of the prediction noise: see `PredictionNoise`."""

    def total(self, weights: "LossTerms") -> Float[Array, ""]:
        """The weighted sum."""
        return jnp.asarray(
            self.prediction * weights.prediction
            + self.squared * weights.squared
            + self.rollout * weights.rollout
            + self.prior * weights.prior
            + self.likelihood * weights.likelihood
            + self.noise * weights.noise
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
    errors are divided by dt, so that both halves of a state weigh alike; static bodies do not
    count. The rollout term costs a pass through time; without it the term is 0. The windows are
    split over ``devices``.
    """
    error, divergence, weight = _teacher_forced(WindowSteps(model, windows, devices), key)
    nodes = jnp.broadcast_to(windows.learned[:, None], error.shape)
    return LossTerms(
        prediction=masked_mean(jnp.sqrt(error + _SMALLEST), nodes),
        squared=masked_mean(error, nodes),
        rollout=rollout_loss(model, windows, devices) if with_rollout else jnp.zeros(()),
        prior=masked_mean(divergence, weight > 0),
        likelihood=jnp.zeros(()),
        noise=jnp.zeros(()),
    )


class Objective:
    """What training minimises of a model; this one the errors of windows, as in the paper.

    A model with another objective names it by an attribute ``objective``.
    """

    rolls_out = True
    """Whether the errors of rollouts, `rollout_loss`, are a further term."""
    burn = 0
    """Steps before each held-out window that tell the belief in its first state."""

    def terms(
        self,
        model: ContactDynamics,
        windows: Window,
        source: WindowSource,
        key: PRNGKeyArray,
        devices: int,
    ) -> LossTerms:
        """The terms but that of rollouts, over a batch of ``windows`` of the ``source``."""
        return window_loss(model, windows, key, False, devices)

    def belief(self, model: ContactDynamics, before: Window) -> ContactBelief | None:
        """The beliefs [B, ...] after steps ``before`` windows. None: they tell nothing."""
        return None


def objective_of(model: object) -> Objective:
    """The model's own objective, else that of windows."""
    return getattr(model, "objective", Objective())


def rollout_loss(model: ContactDynamics, windows: Window, devices: int = 1) -> Float[Array, ""]:
    """`LossTerms.rollout` over a batch of windows, the only term that depends on whole rollouts."""
    edges = edge_count(model.neighbor_list, windows.position.shape[-2])
    error = chunked_vmap(partial(_rollout_error, model), (windows,), edges, devices)
    return masked_mean(error, jnp.broadcast_to(windows.learned[:, None], error.shape))


def masked_mean(values: Array, mask: Array) -> Array:
    """Mean of the values where the mask is true; 0 where it never is."""
    return jnp.sum(jnp.where(mask, values, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


@dataclass(frozen=True)
class WindowSteps:
    """All steps of all windows, for computations on each step by itself."""

    model: ContactDynamics
    windows: Window
    devices: int

    def each(self, function: Callable[..., _Result], *given: PyTree) -> _Result:
        """The function of every step's arguments ``given`` [B, L, ...], stacked in the same way."""
        batch, length = self.windows.control.shape[:2]
        flat = jax.tree.map(lambda leaf: leaf.reshape(batch * length, *leaf.shape[2:]), given)
        edges = edge_count(self.model.neighbor_list, self.windows.position.shape[-2])
        results = chunked_vmap(function, flat, edges, self.devices)
        return jax.tree.map(lambda leaf: leaf.reshape(batch, length, *leaf.shape[1:]), results)

    @property
    def after(self) -> tuple[Float[Array, "B L N D"], Float[Array, "B L N D"]]:
        """Position [m] and velocity [m/s] that every step leads to."""
        return self.windows.position[:, 1:], self.windows.velocity[:, 1:]

    def encode(self, before: ContactBelief | None, meeting: Meeting | None = None) -> EncodedGraph:
        """Stage 1 of every step, from the recorded states; ``before`` [B, L, ...]: the beliefs in
        these, None: nothing is active. ``meeting``: see `JudgedSteps`."""
        windows, (batch, length) = self.windows, self.windows.control.shape[:2]
        window = jnp.repeat(jnp.arange(batch)[:, None], length, axis=1)
        nothing = nothing_active(self.model.inference.edge_types)

        def encode(
            window: Array,
            x: Array,
            v: Array,
            control: Array,
            before: ContactBelief | None,
            meeting: Meeting | None,
        ) -> EncodedGraph:
            nodes = jax.tree.map(lambda leaf: leaf[window], windows.nodes)
            before = nothing if before is None else before
            return self.model.encode(x, v, control, nodes, before, meeting)

        states = windows.position[:, :-1], windows.velocity[:, :-1], windows.control
        return self.each(encode, window, *states, before, meeting)

    def predict_beliefs(self, graph: EncodedGraph) -> tuple[ContactBelief, ContactBelief]:
        """Prior and, by stage 2 in a scan over time, predicted belief of every step."""
        prior = jax.vmap(jax.vmap(self.model.prior_belief))(graph)

        def predict(
            belief: ContactBelief, graph: EncodedGraph
        ) -> tuple[ContactBelief, ContactBelief]:
            belief = self.model.predict_belief(belief, graph)
            return belief, belief

        def along(prior: ContactBelief, graph: EncodedGraph) -> ContactBelief:
            first = jax.tree.map(lambda leaf: leaf[0], prior)
            return jax.lax.scan(predict, first, graph)[1]

        return prior, jax.vmap(along)(prior, graph)


def _teacher_forced(
    steps: WindowSteps, key: PRNGKeyArray
) -> tuple[Float[Array, "B L N"], Float[Array, "B L E"], Float[Array, "B L E"]]:
    """Squared error, KL divergence and edge weights of every step from its recorded state."""
    model, windows = steps.model, steps.windows
    graph = steps.encode(None)
    prior, belief = steps.predict_beliefs(graph)
    if graph.control_displacement is not None:  # The control moves what is held in a state.
        held = jax.tree.map(
            lambda first, each: jnp.concatenate([first[:, :1], each[:, :-1]], axis=1), prior, belief
        )
        graph = steps.encode(jax.lax.stop_gradient(held))
        prior, belief = steps.predict_beliefs(graph)

    def squared_error(
        graph: EncodedGraph, belief: ContactBelief, after: Motion, key: PRNGKeyArray
    ) -> Array:
        linear = model.linearize(model.cut_edges(graph, belief, key))
        return squared_state_error(model, linear, graph, after)

    keys = jax.random.split(key, windows.control.shape[:2])
    error = steps.each(squared_error, graph, belief, steps.after, keys)
    p = jnp.clip(belief.type_probability, _SMALLEST, 1.0)
    q = jnp.clip(prior.type_probability, _SMALLEST, 1.0)
    return error, jnp.sum(p * (jnp.log(p) - jnp.log(q)), axis=-1), graph.weight


def squared_state_error(
    model: ContactDynamics,
    linear: LinearDynamics,
    graph: EncodedGraph,
    after: Motion,
) -> Float[Array, " N"]:
    """Squared error of each node after a step; the position's divided by dt, (m/s)^2."""
    position, velocity = linear(graph.bodies.position, graph.bodies.velocity, graph.control)
    error = jnp.sum(((position - after[0]) / model.dt) ** 2, axis=-1)
    return error + jnp.sum((velocity - after[1]) ** 2, axis=-1)


def predict_window(
    model: ContactDynamics, window: Window, belief: ContactBelief | None = None
) -> ModelState:
    """All states of a window, ``[L, …]``, predicted from its first state and its controls.

    ``belief`` is the one in the first state; None: nothing is known before it.
    """
    position, velocity = window.position[0], window.velocity[0]
    if belief is None:
        belief = model.initial_belief(position, velocity, window.nodes)
    return model.rollout(ModelState(position, velocity, belief), window.control, window.nodes)


def _rollout_error(model: ContactDynamics, window: Window) -> Float[Array, "L N"]:
    states = predict_window(model, window)
    return rollout_error(model, states.position, states.velocity, window)


def rollout_error(
    model: ContactDynamics,
    position: Float[Array, "L N D"],
    velocity: Float[Array, "L N D"],
    window: Window,
) -> Float[Array, "L N"]:
    """Norm of the error of each predicted state of a window, m/s."""
    position_error = _ROLLOUT_POSITION * (position - window.position[1:]) / model.dt
    velocity_error = velocity - window.velocity[1:]
    return jnp.sqrt(jnp.sum(position_error**2 + velocity_error**2, axis=-1) + _SMALLEST)
