"""Plans and beliefs of a controller in an episode, in the scene's own layout."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from contactgraph.control import Plan
from contactgraph.data import edge_id, pair_indices
from contactgraph.feedback import PlanFeedback
from contactgraph.model import ContactBelief


@dataclass(frozen=True, eq=False)
class EpisodeRecord:
    """The controller's plans and beliefs in one episode of ``T`` steps.

    Edges are in `pair_indices`' order.
    """

    plan_ms: np.ndarray
    """[T] ms: time of each control step (correct, plan, return)."""
    status: np.ndarray
    """[T] int: `PlanStatus` of each plan."""
    plan: np.ndarray
    """[T, H+1, N, D] m: every node's positions in the plan made at each step."""
    plan_belief: np.ndarray
    """[T, H, E] probability that each edge is active in each step of that plan."""
    estimated: np.ndarray
    """[T, E] the same for the step that led to each observation, corrected by the observation."""


@runtime_checkable
class RecordingPolicy(Protocol):
    """A policy that plans, and tells what it planned and believed."""

    def record(self) -> EpisodeRecord:
        """Of the episode since `reset`."""


def planned_positions(
    plan: Plan, position: np.ndarray, velocity: np.ndarray, dt: float
) -> np.ndarray:
    """[H+1, N, D] m: every node's positions in the plan, at steps of ``dt`` s.

    Nodes that are not active keep the observed ``position`` m and ``velocity`` m/s, [N, D].
    """
    node_ids, slots = _present(plan, len(position))
    states = np.asarray(plan.states, np.float64)
    ahead = dt * np.arange(len(states))[:, None, None]
    whole = position + ahead * velocity
    whole[:, node_ids] = states[:, slots, 0, : position.shape[1]]
    return whole


def plan_feedback(plan: Plan, dt: float, capacity: int, dimension: int) -> PlanFeedback:
    """The feedback along a plan with steps of ``dt`` s, padded to a ``capacity`` of nodes.

    It does not depend on nodes that are not active, nor on turns, but on D = ``dimension`` degrees
    of freedom a node.
    """
    node_ids, slots = _present(plan, capacity)
    states, gains = np.asarray(plan.states, float), np.asarray(plan.policy.K, float)
    states, gains = states[..., :dimension], gains[..., :dimension]
    all_states = np.zeros((len(states), capacity, *states.shape[2:]))
    all_gains = np.zeros((*gains.shape[:2], capacity, *gains.shape[3:]))
    all_states[:, node_ids], all_gains[:, :, node_ids] = states[:, slots], gains[:, :, slots]
    return PlanFeedback(all_states, np.asarray(plan.controls, float), all_gains, dt)


def edge_probabilities(
    belief: ContactBelief, node_ids: np.ndarray, count: int, holds: bool = False
) -> np.ndarray:
    """[..., E] that each edge of a scene of ``count`` nodes is active; with ``holds``, holds.

    ``belief`` is about the nodes ``node_ids``, -1 for padding. Edges of other nodes are beyond the
    model's cutoff from all that matters, and taken to be inactive.
    """
    probability = np.asarray(belief.holding if holds else belief.contact, np.float64)
    first, second = node_ids[pair_indices(len(node_ids))].T
    known = (first >= 0) & (second >= 0) & (first < count) & (second < count)
    first, second = first[known], second[known]
    whole = np.zeros((*probability.shape[:-1], count * (count - 1) // 2))
    whole[..., edge_id(first, second)] = probability[..., known]
    return whole


def _present(plan: Plan, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The active ones of the first ``count`` nodes of the scene, and their slots in the plan."""
    node_ids = np.asarray(plan.node_ids)
    slots = np.flatnonzero((node_ids >= 0) & (node_ids < count))
    return node_ids[slots], slots
