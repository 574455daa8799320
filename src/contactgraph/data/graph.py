"""Layout of the contact graph: pairs of nodes, ids of edges, candidate edges of a scene."""

from typing import Any

import numpy as np

from contactgraph.data.trajectory import Scene


def pair_count(node_count: Any) -> Any:
    """Number ``E = N(N-1)/2`` of unordered pairs of ``N`` nodes; an integer or integer array."""
    return node_count * (node_count - 1) // 2


def pair_indices(node_count: int) -> np.ndarray:
    """[E, 2] the unordered pairs ``(i, j)``, ``i < j``, of ``N`` nodes; row e is the edge of id e.

    Contact is symmetric, so an edge carries one belief; messages pass along it in both directions.
    Ordered by the larger index first, so that a scene's edges are a prefix of those of any
    larger capacity.
    """
    second, first = np.tril_indices(node_count, k=-1)
    return np.stack([first, second], axis=1)


def edge_id(first: Any, second: Any) -> Any:
    """The row in `pair_indices` of the nodes ``first < second``, for any number of nodes.

    Both are integers, or integer arrays of NumPy or JAX.
    """
    return second * (second - 1) // 2 + first


def candidate_pairs(scene: Scene, node_capacity: int) -> np.ndarray:
    """[E] bool: which of the pairs of ``node_capacity`` nodes are candidate edges of a scene.

    A pair listed in either direction is one; a pair with padding is none. The capacity must be at
    least the scene's number of nodes.
    """
    pairs = pair_indices(node_capacity)
    candidate = pairs[:, 1] < scene.node_count  # the larger index of the two
    if scene.candidate_edges is not None:
        listed = np.zeros((node_capacity, node_capacity), dtype=bool)
        listed[scene.candidate_edges[:, 0], scene.candidate_edges[:, 1]] = True
        candidate &= (listed | listed.T)[pairs[:, 0], pairs[:, 1]]
    return candidate


def joined(contact: np.ndarray) -> np.ndarray:
    """[S, N, N] float, 1 where two nodes are the same or connected by contacts, else 0.

    ``contact``: [S, N, N] bool, symmetric.
    """
    count = contact.shape[-1]
    connected = (contact | np.eye(count, dtype=bool)).astype(np.float64)
    length = 1
    while length < count:
        connected = np.minimum(connected @ connected, 1.0)
        length *= 2
    return connected
