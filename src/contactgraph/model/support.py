"""What rests until something that is driven carries it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.geometry import Geometry

_PACE = 5.0
"""How much faster than a network's weights a weight is learned: it is a single number, newtons."""


class Support(eqx.Module):
    """Bodies with weight, on ground that bears them and rubs on them until they are carried.

    A body is carried as far as it is held, directly or through others, by one that is actuated.
    What is carried has its weight and no friction; what is not has friction and no weight. So a
    block on a table rests, and loads the arm that has lifted it. The weight is learned, in size
    and direction: no axis is known to be the vertical.
    """

    weight_root: Float[Array, "kinds D"]
    """Force on a carried node of each kind, N, in `_PACE`."""
    kinds: int = eqx.field(static=True)
    dimension: int = eqx.field(static=True)

    def __init__(self, kinds: int, dimension: int):
        """`kinds`: how many kinds of node there are."""
        # A product, so that its type is not weak: else the first update of training recompiles.
        self.weight_root = 0.0 * jnp.ones((kinds, dimension))
        self.kinds = kinds
        self.dimension = dimension

    def weight(self, kind: Float[Array, "N kinds"]) -> Float[Array, "N D"]:
        """The force on each node while it is carried, N."""
        return _PACE * kind @ self.weight_root


def carried(
    actuated: Float[Array, " N"],
    hold: Float[Array, " E"],
    geometry: Geometry,
    room: int | None = None,
) -> Float[Array, " N"]:
    """How far each node is carried, in [0, 1]: the best chain of holding edges to an actuated one.

    `actuated`: 1 or 0; `hold`: how far each edge holds, in [0, 1). `room`: no more nodes than so
    many hold each other; None: all may.
    """
    count = actuated.shape[0]
    share = actuated.astype(hold.dtype)
    if room is not None:
        ends = jnp.stack([geometry.first, geometry.second])
        for _ in range(room - 1):
            arriving = (hold * share[ends[::-1]]).reshape(-1)
            best = jax.ops.segment_max(arriving, ends.reshape(-1), count)
            share = jnp.maximum(share, best)
        return share
    first, second = geometry.ends(count)
    holds = first.T @ (hold[:, None] * second)
    holds = holds + holds.T
    for _ in range(count - 1):
        share = jnp.maximum(share, jnp.max(holds * share, axis=1))
    return share
