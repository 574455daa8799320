"""The graph's layout: which nodes an edge joins, and which edges there could be."""

import numpy as np

from contactgraph.data.trajectory import Scene


def pair_indices(node_count: int) -> np.ndarray:
    """[E, 2] the unordered pairs ``(i, j)``, ``i < j``, of ``N`` nodes, ``E = N(N-1)/2``.

    Contact is symmetric, so an edge carries one belief; messages pass along it both ways.
    Ordered by the larger index first, so that a scene's edges are a prefix of those of any
    larger capacity.
    """
    second, first = np.tril_indices(node_count, k=-1)
    return np.stack([first, second], axis=1)


def edge_index(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Which edge joins the nodes ``first < second``: its place in the order of `pair_indices`,
    whatever the number of nodes."""
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
    """[S, N, N] float 0 or 1: who is joined to whom, directly or through others, or is the same.

    ``contact``: [S, N, N] bool, symmetric.
    """
    count = contact.shape[-1]
    reach = (contact | np.eye(count, dtype=bool)).astype(np.float64)
    length = 1
    while length < count:
        reach = np.minimum(reach @ reach, 1.0)
        length *= 2
    return reach
