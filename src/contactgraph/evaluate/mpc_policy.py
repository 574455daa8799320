"""The model predictive controller as a policy in a task, with a cost for the task's scene."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from contactgraph.control import MPC, ActiveSetMPC, Cost, MPCState, Plan, QuadraticCost, chain_cost
from contactgraph.data import InvalidInputError, Scene, joined, pair_indices
from contactgraph.envs.contract import ChainCost, Feedback, Observation
from contactgraph.evaluate.plan_tracking import (
    EpisodeRecord,
    edge_probabilities,
    plan_feedback,
    planned_positions,
)
from contactgraph.evaluate.sensor_faults import FaultySensor, ObservationNoise, SensorFaults
from contactgraph.model import ContactBelief, Nodes, scene_nodes


class SceneCost(Cost, Protocol):
    """A cost that can be applied to a scene, such as `contactgraph.control.LearnedCost`."""

    @property
    def order(self) -> tuple[int, ...]:
        """The nodes of the cost, from the actuated one to the one that is moved to the goal."""

    def in_scene(self, scene: Scene) -> "SceneCost":
        """The cost for this scene and its goal; raises `InvalidInputError` if it does not fit."""

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
    placed: bool = False
    """Whether the chain's last node lies at the goal: see `ChainCost.placed_radius`."""
    turns: bool = False
    """Whether states include angles, so that the cost of the angle counts."""
    angle: float = 0.0
    """rad; the one that is equal to `ChainCost.goal_angle` and nearest to the node's own."""
    current_terms: Callable[[], ChainCost] | None = None
    """The terms in the scene that the task was reset to last; None: ``terms`` in every scene."""

    @classmethod
    def of(
        cls,
        terms: ChainCost,
        control_size: int,
        current_terms: Callable[[], ChainCost] | None = None,
        turns: bool = False,
    ) -> "TaskCost":
        """The cost before its scene is known."""
        turns = turns and terms.goal_angle is not None
        return cls(terms, control_size, terms.chain, turns=turns, current_terms=current_terms)

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
        """The cost where the nodes are as observed."""
        last, angle = self.order[-1], self.angle
        away = np.linalg.norm(observation["position"][last] - self.goal)
        placed = bool(away < self.terms.placed_radius)
        if self.turns and np.isfinite(observation["orientation"][last, 0]):
            assert self.terms.goal_angle is not None
            missing = self.terms.goal_angle - observation["orientation"][last, 0]
            angle = float(self.terms.goal_angle - 2.0 * np.pi * np.round(missing / (2.0 * np.pi)))
        if placed == self.placed and angle == self.angle:
            return self
        return replace(self, placed=placed, angle=angle)

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
        if not self.turns:
            return cost
        return cost.with_angle(self.order[-1], self.angle, self.terms.angle_weight, node_count)


_EXACT = SensorFaults()
_NOISELESS = ObservationNoise()


@dataclass(frozen=True, eq=False)
class _Step:
    """Record of one control step."""

    plan_ms: float
    plan: Plan
    position: np.ndarray
    velocity: np.ndarray
    estimated: ContactBelief
    node_ids: np.ndarray
    """Nodes of ``estimated``."""


class MPCPolicy:
    """A `contactgraph.envs.Policy`: plans with a cost about some nodes and the scene's goal.

    Scenes are padded to a capacity of nodes, so that another number of objects recompiles
    nothing; a scene above it raises the capacity, and compiles once more, unless only part of it is
    active (`ActiveSetMPC`). Compilation precedes an episode's first control step and is not part
    of its time.
    """

    def __init__(
        self,
        mpc: MPC | ActiveSetMPC,
        cost: SceneCost,
        node_capacity: int = 0,
        faults: SensorFaults = _EXACT,
        measured: bool = True,
        noise: ObservationNoise = _NOISELESS,
        nodes_of: Callable[[Scene, int], Nodes] = scene_nodes,
    ) -> None:
        """``node_capacity``: 0 for the first scene's.

        Where a task observes holding, the contacts that the controller observes are the pairs that
        hold each other, since an edge of the model joins nodes that move together. ``faults``
        corrupts the contacts that the controller observes; without ``measured`` it observes none.
        ``noise`` is added to the motion that it plans from, not to the motion that feedback within
        a step uses. ``nodes_of`` gives the nodes of a scene, padded to a capacity.
        """
        self._mpc = mpc
        self._cost = cost
        self._scene_cost = cost
        self._chain = self._order = cost.order
        self._capacity = node_capacity
        self._faults = faults
        self._measured = measured
        self._noise = noise
        self._noise_rng = noise.begin(0)
        self._nodes_of = nodes_of
        self._sensor: FaultySensor | None = None
        self._scene: Scene | None = None
        self._state: Any = None
        self._steps: list[_Step] = []
        self._applied: np.ndarray | None = None
        self._holds = False
        """Whether the scene's contacts are the pairs that hold each other."""

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode in ``scene``; ``seed`` is that of sensor faults and noise.

        Raises `InvalidInputError` where cost and scene do not fit, for example without a goal.
        """
        self._scene_cost = self._cost.in_scene(scene)
        self._chain = self._order = self._scene_cost.order
        self._capacity = max(self._capacity, scene.node_count)
        self._scene, self._state, self._steps = scene, None, []
        self._applied = None
        self._sensor = self._faults.begin(scene, seed)
        self._noise_rng = self._noise.begin(seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[U]`` N for the coming step."""
        observation = self._noise.observed(observation, self._noise_rng)
        if self._state is None:
            if self._scene is None:
                raise InvalidInputError("call reset(scene, seed) first")
            nodes = self._nodes_of(self._scene, self._capacity)
            self._state = self._mpc.reset(observation, nodes, self._scene_cost)
        contacts = self._contacts(observation)
        self._holds = "holding" in observation
        begin = time.perf_counter()
        plan, self._state = self._mpc.step(
            observation,
            contacts,
            self._state,
            self._applied,
            cost=self._changed_cost(observation),
        )
        control = np.asarray(plan.controls[0], dtype=np.float64)  # waits for the plan
        took = time.perf_counter() - begin
        motion = np.array(observation["position"]), np.array(observation["velocity"])
        estimated = self._state.last.belief, self._state.node_ids
        self._steps.append(_Step(1e3 * took, plan, *motion, *estimated))
        self._applied = None
        return control

    def applied(self, control: np.ndarray) -> None:
        """Receives the mean control ``[U]`` N that the task applied since the last call."""
        self._applied = np.asarray(control)

    def feedback(self) -> Feedback:
        """The feedback of the plan's first step; raises before the first control step."""
        if self._scene is None or not self._steps:
            raise InvalidInputError("no feedback: the policy has made no step since reset")
        feedback = plan_feedback(
            self._steps[-1].plan, self._scene.dt, self._capacity, self._scene.dimension
        )
        return partial(feedback.within, 0)

    def record(self) -> EpisodeRecord:
        """Plans and beliefs since `reset`. Raises `InvalidInputError` before the first step."""
        if self._scene is None or not self._steps:
            raise InvalidInputError("nothing to record: the policy has made no step since reset")
        count, dt = self._scene.node_count, self._scene.dt
        probabilities = partial(edge_probabilities, count=count, holds=self._holds)
        return EpisodeRecord(
            plan_ms=np.array([each.plan_ms for each in self._steps]),
            status=np.array([int(each.plan.status) for each in self._steps]),
            plan=np.stack(
                [
                    planned_positions(each.plan, each.position, each.velocity, dt)
                    for each in self._steps
                ]
            ),
            plan_belief=np.stack(
                [
                    probabilities(each.plan.beliefs, np.asarray(each.plan.node_ids))
                    for each in self._steps
                ]
            ),
            estimated=np.stack(
                [probabilities(each.estimated, each.node_ids) for each in self._steps]
            ),
        )

    def _contacts(self, observation: Observation) -> np.ndarray | None:
        if not self._measured or self._sensor is None:
            return None
        return self._sensor(observation.get("holding", observation["contact"]))

    def _changed_cost(self, observation: Observation) -> SceneCost | None:
        """The cost where the nodes are as observed; None: it is that of the last step."""
        before, order = self._scene_cost, self._order
        if isinstance(before, TaskCost):
            self._scene_cost = before.seeing(observation)
        self._order = self._grasped_first(self._state)
        if self._scene_cost is before and self._order == order:
            return None
        return self._scene_cost.among(self._order)

    def _grasped_first(self, state: MPCState) -> tuple[int, ...]:
        """The nodes of the cost with the grasped ones before those still to be picked up.

        Without it a node that is picked up out of turn stays in the chain between two others that
        pull at it, and nothing further is picked up.
        """
        order = self._chain
        if len(order) < 3:
            return order
        node_ids = state.node_ids.tolist()
        believed = state.belief.holding if self._holds else state.belief.probability
        active = pair_indices(len(node_ids))[np.asarray(believed) > 0.5]
        contact = np.zeros((len(node_ids), len(node_ids)), dtype=bool)
        contact[active[:, 0], active[:, 1]] = contact[active[:, 1], active[:, 0]] = True
        grasped = joined(contact[None])[0, node_ids.index(order[0])] > 0
        return tuple(
            sorted(order, key=lambda node: (not grasped[node_ids.index(node)], order.index(node)))
        )
