"""Scenes of any number of objects at one density, and a model with lists for them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.data import pair_indices
from contactgraph.model import ContactDynamics, NeighborList, Nodes

_SPACING = 0.15
"""m; of a grid on which objects stand, each moved by up to a third of it: a tenth of them touch."""
_SPEED = 0.2
"""m/s"""


def crowd(count: int, seed: int = 0) -> tuple[jax.Array, jax.Array, Nodes]:
    """Positions [m] and velocities [m/s] of objects; the first is actuated."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:count]
    position = _SPACING * (grid + rng.uniform(-1 / 3, 1 / 3, grid.shape))
    velocity = _SPEED * rng.normal(size=grid.shape)
    nodes = Nodes(
        actuated=jnp.arange(count) == 0,
        mask=jnp.ones(count, bool),
        candidate=jnp.ones(len(pair_indices(count)), bool),
    )
    return jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32), nodes


def listing(model: ContactDynamics, count: int) -> ContactDynamics:
    """The same model with lists of about 1.5 times what is near in such a scene."""
    return replace(model, neighbor_list=NeighborList(max_edges=5 * count, cell_capacity=12))
