"""The held-out error, by which the best model is chosen, beside baselines; and dead networks.

Bodies that rest within a window are predicted exactly by a model that has learned nothing, and so
would dilute a mean. The error is therefore over the bodies that move. Dead networks show in units
that react to nothing, and in errors that equal constant velocity.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.graph import edge_count
from contactgraph.bodies.message_passing import EdgeNetwork, MessagePassing
from contactgraph.data.windows import moving_bodies
from contactgraph.inference.contact_belief import ContactBelief, nothing_active
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.batch import Window, WindowSource
from contactgraph.train.filter_loss import corrected_beliefs
from contactgraph.train.judged_steps import JudgedSteps, with_window_masses
from contactgraph.train.loss import chunked_vmap, objective_of, predict_window

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

    windows: Window
    counted: Bool[Array, "B N"]
    moving: bool = eqx.field(static=True)
    """Whether the bodies that move are counted; else all are, because none moves."""
    before: Window | None = None
    """The steps before each window, whose motion corrects the belief in its first state. None: the
    first state is the first that is known."""
    every: Window | None = None
    """Whole trajectories, whose motion tells a filter."""
    begins: tuple[Int[Array, " B"], Int[Array, " B"]] | None = None
    """The trajectory, of all of these, and the first state of each window."""

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


def held_out_windows(source: WindowSource, burn: int = 0, judged: int = 0) -> HeldOutWindows:
    """Windows balanced over events as those of training are, the same in every training.

    Of each window that ``source`` draws, the first ``burn`` steps only correct the belief. So many
    whole trajectories are ``judged`` for a filter; those of all windows are among them. Bodies
    that get more than `MOVES_M` away from their first position in a window are counted, static ones
    and padding are not. Where no body moves in any window, all are.
    """
    index = source.draw_indices(_WINDOWS, jax.random.key(0))
    drawn = source.take(index)
    windows = drawn.part(burn, drawn.control.shape[1])
    exists = np.asarray(windows.learned)
    moves = exists & moving_bodies(np.asarray(windows.position))
    moving = bool(moves.any())
    counted = jnp.asarray(moves if moving else exists)
    found = HeldOutWindows(windows, counted, moving, drawn.part(0, burn) if burn else None)
    if not judged:
        return found
    trajectory, start = source.begins(index)
    every = source.whole(jnp.arange(judged)).states
    return replace(found, every=every, begins=(trajectory, start + burn))


def mean_rmse(squared: Float[Array, "B L N"], counted: Bool[Array, "B N"]) -> Float[Array, ""]:
    """Mean over windows of the RMS over steps and counted bodies; windows without one are left out.

    The mean is over roots, so that one grazing contact predicted wrongly does not determine which
    model is best.
    """
    bodies = jnp.sum(counted, axis=1)
    total = jnp.sum(jnp.where(counted[:, None], squared, 0.0), axis=(1, 2))
    root = jnp.sqrt(total / (squared.shape[1] * jnp.maximum(bodies, 1)))
    return jnp.sum(root) / jnp.maximum(jnp.sum(bodies > 0), 1)


def rollout_rmse(
    model: ContactDynamics, held_out: HeldOutWindows, judged: JudgedSteps | None = None
) -> Float[Array, ""]:
    """`mean_rmse` of the positions [m] of windows that are predicted from their first states.

    ``judged`` are the steps of all trajectories; they tell the masses of their bodies, too.
    """

    def squared_error(window: Window, belief: ContactBelief | None) -> Float[Array, "L N"]:
        states = predict_window(model, window, belief)
        return jnp.sum((states.position - window.position[1:]) ** 2, axis=-1)

    windows, before = held_out.windows, held_out.before
    belief = None if before is None else objective_of(model).belief(model, before)
    if judged is not None and held_out.every is not None and held_out.begins is not None:
        trajectory, start = held_out.begins
        along = corrected_beliefs(model, held_out.every, judged)
        belief = jax.tree.map(lambda leaf: leaf[trajectory, start - 1], along)
        masses = jax.tree.map(lambda leaf: leaf[trajectory], judged.masses)
        windows = with_window_masses(windows, masses)
    edges = edge_count(model.neighbor_list, windows.position.shape[-2])
    return mean_rmse(chunked_vmap(squared_error, (windows, belief), edges), held_out.counted)


def has_dead_units(model: ContactDynamics, windows: Window) -> bool:
    """Whether the network that decides about edges gives all near pairs the same message.

    Some layer of it then has no active unit, and no gradient by which it could recover. Where every
    edge is active, it is the network of the local dynamics. False where no two bodies are near,
    where all near pairs are alike, and for inference without a message network.
    """
    if not _networks(model):
        return False
    messages, features = (np.asarray(each, float) for each in _ranges(model, windows))
    lowest, highest = features[:, 0].min(axis=0), features[:, 1].max(axis=0)
    if not np.any(highest - lowest > _SAME_FEATURES):
        return False
    lowest, highest = messages[:, 0].min(axis=0), messages[:, 1].max(axis=0)
    size = max(np.abs(lowest).max(), np.abs(highest).max())
    return bool(np.all(highest - lowest <= _SAME_MESSAGES * size))


def _networks(model: ContactDynamics) -> list[MessagePassing | EdgeNetwork]:
    return model.inference.networks or model.local_dynamics.message_passing.networks


@eqx.filter_jit
def _ranges(
    model: ContactDynamics, windows: Window
) -> tuple[Float[Array, "S 2 W"], Float[Array, "S 2 G"]]:
    """Least and largest message, and edge feature, over the near pairs of each recorded state."""
    batch, states = windows.position.shape[:2]

    still = jnp.zeros(windows.control.shape[-1], windows.control.dtype)
    nothing = nothing_active(model.inference.edge_types)

    def of_state(window: Array, position: Array, velocity: Array) -> tuple[Array, Array]:
        nodes = jax.tree.map(lambda leaf: leaf[window], windows.nodes)
        graph = model.encode(position, velocity, still, nodes, nothing)
        near = graph.weight > 0
        weight, ends = near.astype(position.dtype), graph.geometry.edge_index
        node, edge, inference = graph.node_features, graph.edge_features, model.inference
        if inference.networks:
            seen = inference.edge_inputs(edge, graph.geometry, nodes, still)
            messages = [inference.embed(node, seen, weight, ends)[None]]
        else:
            messages = [each(node, edge, weight, ends)[1] for each in _networks(model)]

        def extremes(values: Array) -> Array:
            def least(values: Array) -> Array:
                near_values = jnp.where(near[:, None], values, jnp.inf)
                return jnp.min(near_values, axis=(0, 1), initial=jnp.inf)

            return jnp.stack([least(values), -least(-values)])

        return extremes(jnp.concatenate(messages, axis=-1)), extremes(graph.edge_features)

    window = jnp.repeat(jnp.arange(batch), states)
    flat = (leaf.reshape(-1, *leaf.shape[2:]) for leaf in (windows.position, windows.velocity))
    edges = edge_count(model.neighbor_list, windows.position.shape[-2])
    return chunked_vmap(of_state, (window, *flat), edges)


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
