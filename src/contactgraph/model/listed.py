"""A model for large scenes: the same one, with room for the near pairs of such a scene."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.neighbours import NeighbourLists, candidates, longest_ways
from contactgraph.model.reach import Reach
from contactgraph.model.state import Nodes


def with_neighbour_lists(
    model: ContactDynamics,
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    nodes: Nodes,
    spare: float = 1.5,
    group: int | None = 16,
) -> ContactDynamics:
    """The model with lists that have room for `spare` times what this scene needs.

    Its predictions are those of `model`, but for rounding, as long as the scene does not get much
    denser or faster; then they are NaN, and lists must be made anew. `group`: see
    `NeighbourLists`. Raises `InvalidInputError` where the model's reach has no end.
    """
    # Refuses what has no end before that is asked for.
    listed = dataclasses.replace(model, neighbours=NeighbourLists(1, 1, group))
    assert isinstance(model.reach, Reach)
    way = longest_ways(position, velocity, None, nodes.anchor, model.dt)
    fullest = int(candidates(position, way, nodes.mask, model.reach.far, 1).fullest)
    found = candidates(position, way, nodes.mask, model.reach.far, fullest)
    sizes = [int(np.ceil(spare * max(1, int(size)))) for size in (jnp.sum(found.near), fullest)]
    return dataclasses.replace(listed, neighbours=NeighbourLists(*sizes, group))
