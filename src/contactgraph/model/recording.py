"""A recorded run as the model takes it: on the device, padded."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.data import Trajectory, pair_indices
from contactgraph.model.scene_nodes import scene_nodes
from contactgraph.model.state import Nodes


class Recording(eqx.Module):
    """A run on the device, padded to capacities of ``T`` steps and ``N`` nodes."""

    position: Float[Array, "T+1 N D"]
    velocity: Float[Array, "T+1 N D"]
    control: Float[Array, "T U"]
    contact: Float[Array, "T+1 E"]
    """1 touching, 0 not, NaN not measured."""
    nodes: Nodes


def recording(
    run: Trajectory, steps: int, node_capacity: int, dtype: np.dtype, measured: bool
) -> Recording:
    """Pads a run with zeros to ``steps`` and ``node_capacity``.

    Without ``measured``, or where the run has no contacts, none count as measured.
    """
    count = run.scene.node_count
    pairs = pair_indices(count)
    edges = node_capacity * (node_capacity - 1) // 2
    position = np.zeros((steps + 1, node_capacity, run.scene.dimension), dtype)
    velocity = np.zeros_like(position)
    control = np.zeros((steps, run.control_size), dtype)
    contact = np.full((steps + 1, edges), np.nan, dtype)
    position[: run.steps + 1, :count] = run.position
    velocity[: run.steps + 1, :count] = run.velocity
    control[: run.steps] = run.control
    if measured and run.contact is not None:
        # The edges of fewer nodes come first in the order of any capacity.
        contact[: run.steps + 1, : len(pairs)] = run.contact[:, pairs[:, 0], pairs[:, 1]]
    return Recording(
        jnp.asarray(position),
        jnp.asarray(velocity),
        jnp.asarray(control),
        jnp.asarray(contact),
        scene_nodes(run.scene, node_capacity),
    )


def number_type(model: object) -> np.dtype:
    """The floating type of the model's weights; JAX's default where it has none."""
    for leaf in jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array)):
        return np.dtype(leaf.dtype)
    return np.dtype(jax.dtypes.canonicalize_dtype(np.float64))
