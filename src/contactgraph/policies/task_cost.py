"""Costs for the scene of an episode: the contract, and a task's own cost."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from contactgraph.control import (
    ContactCost,
    Cost,
    QuadraticCost,
    avoid,
    chain_cost,
    keep_clear,
)
from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Observation

_IN_VAIN_S = 0.5
"""Time of trying a candidate in vain after which another one's turn comes, s."""
_STILL = 0.02
"""m/s, up to which a body does not move."""
_GIVEN_UP_WEIGHT = 100.0
"""Of a step in which a candidate that was given up is believed to be touched: what holds the
gripper, and is known to be heavy, is torn off by a plan only if that pays."""
_THERE = 0.1
"""m from the goal, up to which a body may rest there."""
_CLEARANCE_WEIGHT = 1e4
"""1/m^2; of what is missing of the gap."""
_TOUCH_WEIGHT = 10.0
"""Of a step in which a body that is to be avoided is believed to be touched."""


class SceneCost(Cost, Protocol):
    """A cost that can be applied to a scene, such as `contactgraph.control.LearnedCost`."""

    @property
    def order(self) -> tuple[int, ...]:
        """The nodes of the cost, from the actuated one to the one that is moved to the goal."""

    def in_scene(self, scene: Scene) -> "SceneCost":
        """The cost for this scene and its goal; raises `InvalidInputError` if it does not fit."""

    def among(self, nodes: Sequence[int]) -> "SceneCost":
        """The same with its nodes in another order, or another candidate in the last place."""

    def seeing(self, observation: Observation) -> "SceneCost":
        """The cost where the nodes are as observed; itself, if nothing changes."""


@dataclass(frozen=True, eq=False)
class TaskCost:
    """A task's own cost; without a goal before `in_scene`."""

    terms: ChainCost
    control_size: int
    """U"""
    current_terms: Callable[[], ChainCost] | None = None
    """The terms in the scene that the task was reset to last; None: ``terms`` in every scene."""
    turns: bool = False
    """Whether states include angles, so that the cost of the angle counts."""
    order: tuple[int, ...] = ()
    goal: np.ndarray | None = None
    """[D] m"""
    placed: bool = False
    """Whether the chain's last node lies at the goal: see `ChainCost.placed_radius`."""
    angle: float = 0.0
    """rad; the one that is equal to `ChainCost.goal_angle` and nearest to the node's own."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "order", self.order or self.terms.chain)

    def in_scene(self, scene: Scene) -> "TaskCost":
        """The cost with the scene's goal."""
        if scene.goal is None:
            raise InvalidInputError("the scene has no goal; a plan needs one")
        terms = self.terms if self.current_terms is None else self.current_terms()
        return replace(self, terms=terms, order=terms.chain, goal=scene.goal)

    def among(self, nodes: Sequence[int]) -> "TaskCost":
        """The cost along the chain in another order."""
        return replace(self, order=tuple(nodes))

    def seeing(self, observation: Observation) -> "TaskCost":
        """The cost where the nodes and the goal are as observed."""
        last, angle, goal, wanted = self.order[-1], self.angle, self.goal, self.terms.goal_angle
        if "goal" in observation and not np.array_equal(observation["goal"], np.asarray(goal)):
            goal = np.asarray(observation["goal"])
        away = np.linalg.norm(observation["position"][last] - goal)
        placed = bool(away < self.terms.placed_radius)
        if self.turns and wanted is not None and np.isfinite(observation["orientation"][last, 0]):
            missing = wanted - observation["orientation"][last, 0]
            angle = float(wanted - 2.0 * np.pi * np.round(missing / (2.0 * np.pi)))
        if placed == self.placed and angle == self.angle and goal is self.goal:
            return self
        return replace(self, placed=placed, angle=angle, goal=goal)

    def quadratic(self, node_count: int) -> QuadraticCost:
        """The chain's cost; the goal must be known."""
        if self.goal is None:
            raise InvalidInputError("the task's cost has no goal yet; use in_scene first")
        cost = chain_cost(
            self.order,
            self.terms.pick_weights * (not self.placed),
            self.terms.goal_weights,
            self.terms.control_weight,
            self.goal,
            node_count,
            self.control_size,
            self.terms.command_weight,
            self.terms.terminal_weight,
        )
        if not self.turns or self.terms.goal_angle is None:
            return cost
        return cost.with_angle(self.order[-1], self.angle, self.terms.angle_weight, node_count)


def avoid_others(
    scene: Scene, handled: Sequence[int], clearance: float, weight: float = _CLEARANCE_WEIGHT
) -> tuple[ContactCost, ...]:
    """Costs of touching bodies other than the ``handled`` ones, and of coming too near to them.

    ``clearance`` [m] is between surfaces; ``weight`` [1/m^2] is that of what is missing of it.
    Raises `InvalidInputError` where there is a clearance and the scene's bodies are not all round.
    """
    known = scene.radius is not None and bool(np.all(np.isfinite(scene.radius)))
    if clearance > 0.0 and not known:
        raise InvalidInputError(
            "a clearance from bodies needs their radius, which the scene has not; with a "
            "clearance of 0 they are not touched as far as the model believes"
        )
    own = tuple(dict.fromkeys(handled))
    others = [node for node in range(scene.node_count) if node not in own]
    pairs = np.array([(one, other) for one in own for other in others], int).reshape(-1, 2)
    if not len(pairs):
        return ()
    touching = avoid(pairs, _TOUCH_WEIGHT, scene.dimension)
    if clearance <= 0.0:
        return (touching,)
    assert scene.radius is not None
    gap = scene.radius[pairs].sum(axis=1) + clearance
    return touching, keep_clear(pairs, gap, weight, scene.dimension)


class CandidateTrials:
    """The candidate that plans are about; remembers for how long each has been tried in vain.

    That is the time in contact without a hold, or in a hold at rest more than 0.1 m from the goal,
    since it last moved in a hold. A candidate is given up, and avoided, after half a second of it,
    as long as there is one that was tried for less. Before that one that is held comes first, then
    the present one, then the nearest.
    """

    def __init__(self, hand: int, candidates: Sequence[int]) -> None:
        """``hand``: the first node of the cost."""
        self._hand = hand
        self._present: int | None = None
        self._in_vain = dict.fromkeys(candidates, 0.0)

    def choose(
        self, observation: Observation, contact: np.ndarray, holding: np.ndarray, dt: float
    ) -> int:
        """The candidate for the coming plan, ``dt`` s after the last one.

        ``contact`` and ``holding`` are what is believed of the first node and every node [N], bool.
        """
        position, goal = observation["position"], observation["goal"]
        away = np.linalg.norm(position - position[self._hand], axis=-1)
        missing = np.linalg.norm(position - goal, axis=-1)
        moves = np.linalg.norm(observation["velocity"], axis=-1) > _STILL
        for node in self._in_vain:
            if holding[node] and moves[node]:
                self._in_vain[node] = 0.0
            elif contact[node] and not (holding[node] and missing[node] < _THERE):
                self._in_vain[node] += dt

        def rank(node: int) -> tuple[int, bool, bool, float]:
            other = self._present is not None and node != self._present
            return self._rounds(node), not holding[node], other, float(away[node])

        self._present = min(self._in_vain, key=rank)
        return self._present

    def avoided(self, dimension: int) -> ContactCost:
        """What touching the candidates costs that have been given up; of the same shapes always."""
        pairs = [(self._hand, node) for node in self._in_vain]
        given_up = [self._rounds(node) > 0 and node != self._present for node in self._in_vain]
        return avoid(pairs, _GIVEN_UP_WEIGHT * np.array(given_up), dimension)

    def _rounds(self, node: int) -> int:
        """Times that it has been tried in vain."""
        return int(self._in_vain[node] / _IN_VAIN_S + 1e-9)
