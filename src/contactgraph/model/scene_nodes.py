"""A scene's nodes as the model takes them."""

import jax.numpy as jnp
import numpy as np

from contactgraph.data import InvalidInputError, Scene, candidate_pairs
from contactgraph.model.state import Nodes


def scene_nodes(scene: Scene, node_capacity: int | None = None) -> Nodes:
    """The nodes of a scene, padded to ``node_capacity`` (default: no padding).

    Raises `InvalidInputError` where the scene has more nodes.
    """
    count = scene.node_count
    capacity = count if node_capacity is None else node_capacity
    if capacity < count:
        raise InvalidInputError(f"node_capacity must be at least {count}, found {capacity}")
    exists = np.arange(capacity) < count
    candidate = candidate_pairs(scene, capacity)
    actuated = np.zeros(capacity, dtype=bool)
    actuated[:count] = scene.actuated
    anchor = None
    if scene.anchor is not None and scene.has_hinges:
        anchor = np.full((capacity, scene.dimension), np.nan)
        anchor[:count] = scene.anchor
    return Nodes(
        actuated=jnp.asarray(actuated),
        mask=jnp.asarray(exists),
        candidate=jnp.asarray(candidate),
        anchor=None if anchor is None else jnp.asarray(anchor),
    )
