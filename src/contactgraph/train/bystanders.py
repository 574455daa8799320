"""Bodies at rest, put into recorded windows out of touch: what a scene may hold besides.

Runs with two bodies show no third that merely stands by. That one out of reach of all others
changes nothing is what the model assumes anyway (its prior is distance); saying so in the data
costs no recording.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from contactgraph.data.padding import PaddedRuns
from contactgraph.model.state import Nodes
from contactgraph.train.batch import Window

_TRIES = 8
_REST = 1e-6
"""Speed, m/s, below which a body rests."""


def bodies_rest(runs: PaddedRuns) -> bool:
    """Whether free bodies that nothing actuates are ever seen at rest.

    Where they never are (they fall, or flow, or hang on hinges) a resting bystander would be a lie.
    """
    if runs.anchor is not None:
        return False
    speed = np.linalg.norm(runs.velocity[:, :-1], axis=-1)
    exists = runs.node_mask[:, None, :] & runs.step_mask[:, :, None]
    return bool(np.any((speed < _REST) & exists & ~runs.actuated[:, None, :]))


def add_bystander(
    windows: Window,
    nearest: Float[Array, ""] | float,
    farthest: Float[Array, ""] | float,
    key: PRNGKeyArray,
) -> Window:
    """Every window of a batch with one more node, at rest, not actuated.

    It stands `nearest` to `farthest` [m] from some body at some step, and never nearer than
    `nearest` to any, not even between two states. Where several tries find no such place the
    node is masked out.
    """
    batch, states, count, dimension = windows.position.shape
    keys = jax.random.split(key, batch)
    place, found = jax.vmap(
        lambda position, mask, key: _place(position, mask, nearest, farthest, key)
    )(windows.position, windows.nodes.mask, keys)
    position = jnp.broadcast_to(place[:, None, None, :], (batch, states, 1, dimension))
    edges = jnp.ones((batch, count), bool)
    return dataclasses.replace(
        windows,
        position=jnp.concatenate([windows.position, position], axis=2),
        velocity=jnp.concatenate([windows.velocity, jnp.zeros_like(position)], axis=2),
        nodes=Nodes(
            actuated=jnp.concatenate([windows.nodes.actuated, jnp.zeros((batch, 1), bool)], 1),
            mask=jnp.concatenate([windows.nodes.mask, found[:, None]], axis=1),
            # `pair_indices` lists the pairs of a new last node after all others.
            candidate=jnp.concatenate([windows.nodes.candidate, edges], axis=1),
        ),
    )


def _place(
    position: Float[Array, "L N D"],
    mask: Array,
    nearest: Float[Array, ""] | float,
    farthest: Float[Array, ""] | float,
    key: PRNGKeyArray,
) -> tuple[Float[Array, " D"], Array]:
    """A place for one bystander [m], and whether it keeps its distance."""
    node_key, step_key, direction_key, radius_key = jax.random.split(key, 4)
    node = jax.random.categorical(node_key, jnp.where(mask, 0.0, -jnp.inf), shape=(_TRIES,))
    step = jax.random.randint(step_key, (_TRIES,), 0, position.shape[0])
    direction = jax.random.normal(direction_key, (_TRIES, position.shape[-1]))
    direction = direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)
    radius = jax.random.uniform(radius_key, (_TRIES, 1), minval=nearest, maxval=farthest)
    places = position[step, node] + radius * direction
    distance = _distance_to_paths(places, position)
    clear = jnp.min(jnp.where(mask, distance, jnp.inf), axis=(1, 2)) >= nearest
    return places[jnp.argmax(clear)], jnp.any(clear)


def _distance_to_paths(
    places: Float[Array, "tries D"], position: Float[Array, "L N D"]
) -> Float[Array, "tries L-1 N"]:
    """How near every node comes to each place on its straight way from state to state, m."""
    begin, way = position[:-1], position[1:] - position[:-1]
    reach = places[:, None, None] - begin
    length = jnp.maximum(jnp.sum(way**2, axis=-1), _REST**2)
    part = jnp.clip(jnp.sum(reach * way, axis=-1) / length, 0.0, 1.0)
    return jnp.linalg.norm(reach - part[..., None] * way, axis=-1)
