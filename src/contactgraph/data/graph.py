"""Layout of the contact graph: pairs of nodes, and ids of edges."""

from typing import Any

import numpy as np


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
