"""A cost as an episode needs it: about some nodes, in an order that may change on the way."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from contactgraph.control import Cost, QuadraticCost, chain_cost
from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost


class SceneCost(Cost, Protocol):
    """A cost that finds its place in a scene. `contactgraph.control.LearnedCost` is one."""

    @property
    def order(self) -> tuple[int, ...]:
        """The nodes it is about, from the actuated one to the one that is taken to the goal."""

    def in_scene(self, scene: Scene) -> "SceneCost":
        """About this scene and its goal; raises `InvalidInputError` where it does not fit."""

    def among(self, nodes: Sequence[int]) -> "SceneCost":
        """The same with its nodes in another order."""


@dataclass(frozen=True, eq=False)
class TaskCost:
    """A task's own cost."""

    terms: ChainCost
    control_size: int
    """U"""
    order: tuple[int, ...]
    goal: np.ndarray | None = None
    """[D] m"""

    @classmethod
    def of(cls, terms: ChainCost, control_size: int) -> "TaskCost":
        """Before the scene is known."""
        return cls(terms, control_size, terms.chain)

    def in_scene(self, scene: Scene) -> "TaskCost":
        """With the scene's goal."""
        if scene.goal is None:
            raise InvalidInputError("the scene has no goal; a plan needs one")
        return replace(self, order=self.terms.chain, goal=scene.goal)

    def among(self, nodes: Sequence[int]) -> "TaskCost":
        """Along the chain in another order."""
        return replace(self, order=tuple(nodes))

    def quadratic(self, node_count: int) -> QuadraticCost:
        """The chain's cost; the goal must be known."""
        if self.goal is None:
            raise InvalidInputError("the task's cost has no goal yet; place it in a scene")
        return chain_cost(
            self.order,
            self.terms.pick_weights,
            self.terms.goal_weights,
            self.terms.control_weight,
            self.goal,
            node_count,
            self.control_size,
        )
