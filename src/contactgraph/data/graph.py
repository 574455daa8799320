"""The graph's layout: which nodes an edge joins."""

import numpy as np


def pair_indices(node_count: int) -> np.ndarray:
    """[E, 2] the unordered pairs ``(i, j)``, ``i < j``, of ``N`` nodes, ``E = N(N-1)/2``.

    Contact is symmetric, so an edge carries one belief; messages pass along it both ways.
    Ordered by the larger index first, so that a scene's edges are a prefix of those of any
    larger capacity.
    """
    second, first = np.tril_indices(node_count, k=-1)
    return np.stack([first, second], axis=1)
