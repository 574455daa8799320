"""A cost that also keeps the bodies of a task clear of all others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from contactgraph.control import ContactCost, QuadraticCost, avoid, keep_clear
from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.evaluate.task_cost import SceneCost

CLEARANCE = 0.03
"""m; least gap between surfaces."""
WEIGHT = 1e4
"""1/m^2; of what is missing of the gap."""
TOUCH_WEIGHT = 10.0
"""Of a step in which a body that is to be avoided is believed to be touched."""


@dataclass(frozen=True, eq=False)
class AvoidingCost:
    """Another cost, and one of coming near bodies that it is not about; of a scene once in it."""

    cost: SceneCost
    clearance: float = CLEARANCE
    """m"""
    weight: float = WEIGHT
    """1/m^2"""
    touch_weight: float = TOUCH_WEIGHT
    candidates: tuple[int, ...] = ()
    """Bodies that may be touched, beside those of the cost."""
    contacts: tuple[ContactCost, ...] = ()

    @property
    def order(self) -> tuple[int, ...]:
        """The nodes of the other cost."""
        return self.cost.order

    def in_scene(self, scene: Scene) -> "AvoidingCost":
        """For this scene; where there is a clearance, its bodies must be round: see `SceneCost`."""
        known = scene.radius is not None and bool(np.all(np.isfinite(scene.radius)))
        if self.clearance > 0.0 and not known:
            raise InvalidInputError(
                "a clearance from bodies needs their radius, which the scene has not; with a "
                "clearance of 0 they are not touched as far as the model believes"
            )
        cost = self.cost.in_scene(scene)
        handled = tuple(dict.fromkeys((*cost.order, *self.candidates)))
        others = [node for node in range(scene.node_count) if node not in handled]
        pairs = np.array([(one, other) for one in handled for other in others], int)
        pairs = pairs.reshape(-1, 2)
        if not len(pairs):
            return replace(self, cost=cost, contacts=())
        dimension = scene.dimension
        contacts: tuple[ContactCost, ...] = (avoid(pairs, self.touch_weight, dimension),)
        if self.clearance > 0.0:
            assert scene.radius is not None
            gap = scene.radius[pairs].sum(axis=1) + self.clearance
            contacts += (keep_clear(pairs, gap, self.weight, dimension),)
        return replace(self, cost=cost, contacts=contacts)

    def among(self, nodes: Sequence[int]) -> "AvoidingCost":
        """See `SceneCost`."""
        return replace(self, cost=self.cost.among(nodes))

    def seeing(self, observation: Observation) -> "AvoidingCost":
        """See `SceneCost`."""
        cost = self.cost.seeing(observation)
        return self if cost is self.cost else replace(self, cost=cost)

    def quadratic(self, node_count: int) -> QuadraticCost:
        """The other cost, with what is to be avoided."""
        cost = self.cost.quadratic(node_count)
        return replace(cost, contacts=(*cost.contacts, *self.contacts))
