"""A cost that also keeps the bodies of a task clear of all others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from contactgraph.control import DistanceCost, QuadraticCost, avoid
from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.evaluate.task_cost import SceneCost

CLEARANCE = 0.03
"""m; least gap between surfaces."""
WEIGHT = 1e4
"""1/m^2; of what is missing of the gap."""


@dataclass(frozen=True, eq=False)
class AvoidingCost:
    """Another cost, and one of coming near bodies that it is not about; of a scene once in it."""

    cost: SceneCost
    clearance: float = CLEARANCE
    """m"""
    weight: float = WEIGHT
    """1/m^2"""
    distances: DistanceCost | None = None

    @property
    def order(self) -> tuple[int, ...]:
        """The nodes of the other cost."""
        return self.cost.order

    def in_scene(self, scene: Scene) -> "AvoidingCost":
        """For this scene, whose bodies must be round; see `SceneCost`."""
        cost = self.cost.in_scene(scene)
        if scene.radius is None or not np.all(np.isfinite(scene.radius)):
            raise InvalidInputError("bodies to be avoided need a radius, which the scene has not")
        others = [node for node in range(scene.node_count) if node not in cost.order]
        pairs = np.array([(one, other) for one in cost.order for other in others], int)
        pairs = pairs.reshape(-1, 2)
        gap = scene.radius[pairs].sum(axis=1) + self.clearance
        dimension = len(scene.goal) if scene.goal is not None else 2
        distances = avoid(pairs, gap, self.weight, scene.dt, dimension)
        return replace(self, cost=cost, distances=distances if len(pairs) else None)

    def among(self, nodes: Sequence[int]) -> "AvoidingCost":
        """See `SceneCost`."""
        return replace(self, cost=self.cost.among(nodes))

    def seeing(self, observation: Observation) -> "AvoidingCost":
        """See `SceneCost`."""
        cost = self.cost.seeing(observation)
        return self if cost is self.cost else replace(self, cost=cost)

    def quadratic(self, node_count: int) -> QuadraticCost:
        """The other cost, with the distances."""
        return replace(self.cost.quadratic(node_count), distances=self.distances)
