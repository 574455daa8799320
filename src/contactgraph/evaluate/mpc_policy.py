"""A cost as an episode needs it: about some nodes, in an order that may change on the way."""

import time
from collections.abc import Sequence
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
from contactgraph.model import ContactBelief, scene_nodes


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


_EXACT = SensorFaults()
_CLEAR = ObservationNoise()


@dataclass(frozen=True, eq=False)
class _Tick:
    plan_ms: float
    plan: Plan
    position: np.ndarray
    velocity: np.ndarray
    found: ContactBelief
    found_among: np.ndarray


class MPCPolicy:
    """A `contactgraph.envs.Policy`: plans with a cost about some nodes and the scene's goal.

    Scenes are padded to a capacity of nodes, so that another number of objects recompiles
    nothing; a scene above it raises the capacity, and compiles once more, unless only part of it is
    active (`ActiveSetMPC`). Compiling is done before an episode's first tick and is not part of its
    time.
    """

    def __init__(
        self,
        mpc: MPC | ActiveSetMPC,
        cost: SceneCost,
        node_capacity: int = 0,
        faults: SensorFaults = _EXACT,
        measured: bool = True,
        noise: ObservationNoise = _CLEAR,
    ) -> None:
        """``node_capacity``: 0 for the first scene's.

        ``faults``: how the observed contacts are spoiled before the controller sees them. Without
        ``measured`` it sees none. ``noise`` is on the motion that it plans from; feedback within a
        step is about motion as it is.
        """
        self._mpc = mpc
        self._cost = cost
        self._placed = cost
        self._chain = self._order = cost.order
        self._capacity = node_capacity
        self._faults = faults
        self._measured = measured
        self._noise = noise
        self._noise_rng = noise.begin(0)
        self._sensor: FaultySensor | None = None
        self._scene: Scene | None = None
        self._state: Any = None
        self._ticks: list[_Tick] = []
        self._applied: np.ndarray | None = None

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode in ``scene``; only the sensors' faults are random.

        Raises `InvalidInputError` where cost and scene do not fit, for want of a goal, say.
        """
        self._placed = self._cost.in_scene(scene)
        self._chain = self._order = self._placed.order
        self._capacity = max(self._capacity, scene.node_count)
        self._scene, self._state, self._ticks = scene, None, []
        self._applied = None
        self._sensor = self._faults.begin(scene, seed)
        self._noise_rng = self._noise.begin(seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[U]`` N for the coming step."""
        observation = self._noise.observed(observation, self._noise_rng)
        if self._state is None:
            self._state = self._begin(observation)
        contacts = self._contacts(observation)
        begin = time.perf_counter()
        plan, self._state = self._mpc.step(
            observation,
            contacts,
            self._state,
            self._applied,
            cost=self._reordered(self._state),
        )
        control = np.asarray(plan.controls[0], dtype=np.float64)  # waits for the plan
        took = time.perf_counter() - begin
        seen = np.array(observation["position"]), np.array(observation["velocity"])
        found = self._state.last.belief, self._state.node_ids
        self._ticks.append(_Tick(1e3 * took, plan, *seen, *found))
        self._applied = None
        return control

    def applied(self, control: np.ndarray) -> None:
        """Told what the task applied ``[U]`` N, on its mean, in the step after the last call."""
        self._applied = np.asarray(control)

    def feedback(self) -> Feedback:
        """The plan's feedback about where its first step leads; raises before the first tick."""
        if self._scene is None or not self._ticks:
            raise InvalidInputError("no feedback: the policy has made no step since reset")
        law = plan_feedback(self._ticks[-1].plan, self._scene.dt, self._capacity)
        return partial(law.within, 0)

    def record(self) -> EpisodeRecord:
        """What was thought since `reset`. Raises `InvalidInputError` before the first tick."""
        if self._scene is None or not self._ticks:
            raise InvalidInputError("nothing to record: the policy has made no step since reset")
        count, dt = self._scene.node_count, self._scene.dt
        return EpisodeRecord(
            plan_ms=np.array([tick.plan_ms for tick in self._ticks]),
            status=np.array([int(tick.plan.status) for tick in self._ticks]),
            plan=np.stack(
                [
                    planned_positions(each.plan, each.position, each.velocity, dt)
                    for each in self._ticks
                ]
            ),
            plan_belief=np.stack(
                [
                    edge_probabilities(each.plan.beliefs, np.asarray(each.plan.node_ids), count)
                    for each in self._ticks
                ]
            ),
            found=np.stack(
                [edge_probabilities(each.found, each.found_among, count) for each in self._ticks]
            ),
        )

    def _contacts(self, observation: Observation) -> np.ndarray | None:
        if not self._measured or self._sensor is None:
            return None
        return self._sensor(observation["contact"])

    def _begin(self, observation: Observation) -> MPCState:
        if self._scene is None:
            raise InvalidInputError("call reset(scene, seed) first")
        nodes = scene_nodes(self._scene, self._capacity)
        return self._mpc.reset(observation, nodes, self._placed)

    def _reordered(self, state: MPCState) -> SceneCost | None:
        """The cost with the grasped nodes before those still to be picked up; None: no change.

        Without it a node that is picked up out of turn stays in the chain between two others that
        pull at it, and nothing further is picked up.
        """
        order = self._chain
        if len(order) < 3:
            return None
        node_ids = state.node_ids.tolist()
        active = pair_indices(len(node_ids))[np.asarray(state.belief.probability) > 0.5]
        contact = np.zeros((len(node_ids), len(node_ids)), dtype=bool)
        contact[active[:, 0], active[:, 1]] = contact[active[:, 1], active[:, 0]] = True
        grasped = joined(contact[None])[0, node_ids.index(order[0])] > 0
        onward = tuple(
            sorted(order, key=lambda node: (not grasped[node_ids.index(node)], order.index(node)))
        )
        if onward == self._order:
            return None
        self._order = onward
        return self._placed.among(onward)
