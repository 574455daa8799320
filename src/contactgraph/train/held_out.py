"""The held-out error, by which the best model is chosen, beside baselines; and dead networks.

Bodies that rest within a window are predicted exactly by a model that has learned nothing, and so
would dilute a mean. The error is therefore over the bodies that move. Dead networks show in units
that react to nothing, and in errors that equal constant velocity.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.graph import edge_count
from contactgraph.bodies.message_passing import EdgeNetwork, MessagePassing
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.data.windows import moving_bodies
from contactgraph.inference.contact_belief import ContactBelief, nothing_active
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.step import ModelState
from contactgraph.train.batch import WindowSource, chunked_vmap, map_steps

_WINDOWS = 256
_SAME_FEATURES = 1e-2
"""Range of edge features below which the pairs are too much alike to tell anything."""
_SAME_MESSAGES = 1e-6
"""Range of messages, relative to their size, that is rounding."""
_SHARE = 0.5
"""Part of the training from which on an error equal to constant velocity ends it."""
_TOLERANCE = 1e-3
"""Relative difference of errors that counts as none."""
_UNIFORM = 1e-3
"""Error of constant velocity, relative to standing still, below which motion is uniform."""


@dataclass(frozen=True)
class HeldOutBaselines:
    """Errors without a model, on the same windows and over the same bodies as the held-out error.

    A model is of use only where its error is less than both.
    """

    constant_velocity_rmse_m: float
    """Every body keeps the velocity of the window's first state."""
    standing_still_rmse_m: float
    """Every body keeps the position of the window's first state."""
    moving: bool
    """Whether the errors are over the bodies that move; False where no body does: over all."""

    def in_lengths(self, length: float) -> "HeldOutBaselines":
        """These errors, found in units of ``length`` data units, in these."""
        moves, rests = self.constant_velocity_rmse_m, self.standing_still_rmse_m
        return HeldOutBaselines(length * moves, length * rests, self.moving)


class HeldOutWindows(eqx.Module):
    """A fixed set of ``B`` windows of held-out trajectories, and the bodies that count in them."""

    windows: TrajectoryBatch[Array]
    counted: Bool[Array, "B N"]
    moving: bool = eqx.field(static=True)
    """Whether the bodies that move are counted; else all are, because none moves."""
    source: WindowSource
    """Of the whole trajectories, whose motion before a window tells the belief in its first state;
    its windows have ``burn`` steps more, at the beginning."""
    trajectory: Int[Array, " B"]
    """Of each window, in the source."""
    start: Int[Array, " B"]
    """First state of each window of the source."""
    burn: int = eqx.field(static=True)

    def baselines(self, dt: float) -> HeldOutBaselines:
        """The errors of constant velocity and of standing still; steps of ``dt`` [s]."""
        position = np.asarray(self.windows.position, float)
        velocity = np.asarray(self.windows.velocity, float)
        elapsed = dt * np.arange(1, position.shape[1])[:, None, None]

        def rmse(predicted: np.ndarray) -> float:
            squared = jnp.asarray(np.sum((predicted - position[:, 1:]) ** 2, axis=-1), float)
            return float(mean_rmse(squared, self.counted))

        first = position[:, :1]
        return HeldOutBaselines(rmse(first + elapsed * velocity[:, :1]), rmse(first), self.moving)


def held_out_windows(source: WindowSource, burn: int = 0) -> HeldOutWindows:
    """Windows balanced over events as those of training are, the same in every training.

    The first ``burn`` steps of each window that ``source`` draws come before it. Bodies that get
    more than `MOVES_M` away from their first position in a window are counted, static ones and
    padding are not. Where no body moves in any window, all are.
    """
    trajectory, start = source.draw_starts(_WINDOWS, jax.random.key(0))
    windows = steps_between(source.take(trajectory, start), burn, source.length)
    exists = np.asarray(windows.nodes.mobile)
    moves = exists & moving_bodies(np.asarray(windows.position))
    moving = bool(moves.any())
    counted = jnp.asarray(moves if moving else exists)
    return HeldOutWindows(windows, counted, moving, source, trajectory, start, burn)


def steps_between(windows: TrajectoryBatch[Array], begin: int, end: int) -> TrajectoryBatch[Array]:
    """The steps ``begin`` to ``end`` of a batch of windows."""
    return windows._replace(
        position=windows.position[:, begin : end + 1],
        velocity=windows.velocity[:, begin : end + 1],
        control=windows.control[:, begin:end],
        steps=jnp.full_like(windows.steps, end - begin),
    )


def mean_rmse(squared: Float[Array, "B L N"], counted: Bool[Array, "B N"]) -> Float[Array, ""]:
    """Mean over windows of the RMS over steps and counted bodies; windows without one are left out.

    The mean is over roots, so that one grazing contact predicted wrongly does not determine which
    model is best.
    """
    bodies = jnp.sum(counted, axis=1)
    total = jnp.sum(jnp.where(counted[:, None], squared, 0.0), axis=(1, 2))
    root = jnp.sqrt(total / (squared.shape[1] * jnp.maximum(bodies, 1)))
    return jnp.sum(root) / jnp.maximum(jnp.sum(bodies > 0), 1)


def predict_window(
    model: ContactDynamics, window: TrajectoryBatch[Array], belief: ContactBelief
) -> ModelState:
    """All states of a window, ``[L, …]``, predicted from its first state, the belief in it, and
    its controls."""
    first = ModelState(window.position[0], window.velocity[0], belief)
    return model.rollout(first, window.control, window.nodes)


def rollout_rmse(
    model: ContactDynamics,
    windows: TrajectoryBatch[Array],
    belief: ContactBelief,
    counted: Bool[Array, "B N"],
) -> Float[Array, ""]:
    """`mean_rmse` of the positions [m] of windows that are predicted from their first states, in
    which the beliefs are these."""

    def squared_error(window: TrajectoryBatch[Array], belief: ContactBelief) -> Float[Array, "L N"]:
        states = predict_window(model, window, belief)
        return jnp.sum((states.position - window.position[1:]) ** 2, axis=-1)

    edges = edge_count(model.neighbor_list, windows.position.shape[-2])
    return mean_rmse(chunked_vmap(squared_error, windows, belief, edges=edges), counted)


def has_dead_units(model: ContactDynamics, windows: TrajectoryBatch[Array]) -> bool:
    """Whether the network that decides about edges gives all near pairs the same message.

    Some layer of it then has no active unit, and no gradient by which it could recover. Where every
    edge is active, it is the network of the local dynamics. False where no two bodies are near,
    where all near pairs are alike, and for inference without a message network.
    """
    if not _networks(model):
        return False
    messages, features = (np.asarray(each, float) for each in _ranges(model, windows))
    if not np.any(features[1] - features[0] > _SAME_FEATURES):
        return False
    size = np.abs(messages).max()
    return bool(np.all(messages[1] - messages[0] <= _SAME_MESSAGES * size))


def _networks(model: ContactDynamics) -> list[MessagePassing | EdgeNetwork]:
    learns = jax.tree.leaves(eqx.filter(model.inference, eqx.is_inexact_array))
    return (model.inference if learns else model.local_dynamics.message_passing).networks


@eqx.filter_jit
def _ranges(
    model: ContactDynamics, windows: TrajectoryBatch[Array]
) -> tuple[Float[Array, "2 W"], Float[Array, "2 G"]]:
    """Least and largest message, and edge feature, over the near pairs of all recorded states."""
    batch, states, count = windows.position.shape[:3]
    still = jnp.zeros(windows.control.shape[-1], windows.control.dtype)
    nothing = nothing_active(model.inference.edge_types)

    def of_state(window: Array, position: Array, velocity: Array) -> tuple[Array, Array]:
        nodes = jax.tree.map(lambda leaf: leaf[window], windows.nodes)
        graph = model.encode(position, velocity, still, nodes, nothing)
        near = graph.weight > 0
        weight, ends = near.astype(position.dtype), graph.geometry.edge_index
        node, edge, inference = graph.node_features, graph.edge_features, model.inference
        if inference.networks:
            messages = [inference.embed(node, edge, weight, ends)[None]]
        else:
            messages = [each(node, edge, weight, ends)[1] for each in _networks(model)]

        def extremes(values: Array) -> Array:
            """The least of the near pairs' values, and of their negatives."""
            both = jnp.where(near[:, None], jnp.stack([values, -values]), jnp.inf)
            return jnp.min(both, axis=(1, 2), initial=jnp.inf)

        return extremes(jnp.concatenate(messages, axis=-1)), extremes(graph.edge_features)

    window = jnp.repeat(jnp.arange(batch)[:, None], states, axis=1)
    edges = edge_count(model.neighbor_list, count)
    found = map_steps(of_state, window, windows.position, windows.velocity, edges=edges)
    sign = jnp.array([[1.0], [-1.0]])
    return jax.tree.map(lambda each: sign * jnp.min(each, axis=(0, 1)), found)


def equals_constant_velocity(
    error: float, best: float, baselines: HeldOutBaselines, done: float
) -> bool:
    """Whether the held-out error equals constant velocity and never was better, in time to judge.

    ``error`` and ``best`` are the present and the least held-out error [m], ``done`` is the part of
    the training that is over. False before half of the training, and for data of bodies that do
    move uniformly.
    """
    expected = baselines.constant_velocity_rmse_m
    if done < _SHARE or not expected > _UNIFORM * baselines.standing_still_rmse_m:
        return False
    margin = _TOLERANCE * expected
    return abs(error - expected) <= margin and best >= expected - margin
