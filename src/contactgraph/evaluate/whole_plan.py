"""What a plan about the nodes in play says about the whole scene."""

import numpy as np

from contactgraph.control import Plan
from contactgraph.data import edge_index, pair_indices
from contactgraph.model import ContactBelief


def planned_positions(
    plan: Plan, position: np.ndarray, velocity: np.ndarray, dt: float
) -> np.ndarray:
    """[H+1, N, D] m: where the plan puts every node at steps of ``dt`` s.

    Nodes that are not in play go on as they were observed, at ``position`` m with ``velocity`` m/s,
    [N, D].
    """
    count, dimension = position.shape
    who, slots = present(plan, count)
    states = np.asarray(plan.states, np.float64).reshape(len(plan.states), -1, 2, dimension)
    ahead = dt * np.arange(len(states))[:, None, None]
    whole = position + ahead * velocity
    whole[:, who] = states[:, slots, 0]
    return whole


def edge_probabilities(belief: ContactBelief, who: np.ndarray, count: int) -> np.ndarray:
    """[..., E] that each edge of a scene of ``count`` nodes is active.

    ``belief`` is about the nodes ``who``, -1 for padding. An edge of any other is out of reach of
    all that matters, and taken to be inactive.
    """
    probability = np.asarray(belief.probability, np.float64)
    first, second = who[pair_indices(len(who))].T
    known = (first >= 0) & (second >= 0) & (first < count) & (second < count)
    first, second = first[known], second[known]
    whole = np.zeros((*probability.shape[:-1], count * (count - 1) // 2))
    whole[..., edge_index(first, second)] = probability[..., known]
    return whole


def present(plan: Plan, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Which of the first ``count`` nodes of the scene are in play, and their places in the plan."""
    who = np.asarray(plan.who)
    slots = np.flatnonzero((who >= 0) & (who < count))
    return who[slots], slots
