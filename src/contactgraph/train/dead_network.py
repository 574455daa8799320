"""Detection of dead networks: units that react to nothing, errors that equal constant velocity."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import AllEdges, TransitionEdges
from contactgraph.model.message_passing import EdgeNetwork, MessagePassing
from contactgraph.model.neighbor_list import edge_count
from contactgraph.train.batch import Window
from contactgraph.train.held_out import HeldOutBaselines
from contactgraph.train.loss import chunked_vmap

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
    if isinstance(model.inference, AllEdges):
        return model.local_dynamics.message_passing.types
    network = getattr(model.inference, "message_passing", None)
    return [] if network is None else [network]


@eqx.filter_jit
def _ranges(
    model: ContactDynamics, windows: Window
) -> tuple[Float[Array, "S 2 W"], Float[Array, "S 2 G"]]:
    """Least and largest message, and edge feature, over the near pairs of each recorded state."""
    batch, states = windows.position.shape[:2]

    def of_state(window: Array, position: Array, velocity: Array) -> tuple[Array, Array]:
        nodes = jax.tree.map(lambda leaf: leaf[window], windows.nodes)
        graph = model.encode(position, velocity, nodes)
        near = graph.weight > 0
        inputs = graph.node_features, graph.edge_features, near.astype(position.dtype)
        if isinstance(model.inference, TransitionEdges):  # its embedding is the message itself
            messages = [jnp.stack([graph.embedding, graph.embedding])]
        else:
            networks = _networks(model)
            messages = [network(*inputs, graph.geometry.edge_index)[1] for network in networks]

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
