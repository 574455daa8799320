"""The model predictive controller as a policy in a task."""

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from contactgraph.control import MPC, ActiveSetMPC, MPCState, Plan
from contactgraph.data import InvalidInputError, Scene, joined, pair_indices
from contactgraph.data.dataset import far_origin, scene_about
from contactgraph.envs.contract import Feedback, Observation
from contactgraph.model import ContactBelief, scene_nodes
from contactgraph.policies.episode_record import (
    EpisodeRecord,
    edge_probabilities,
    plan_feedback,
    planned_positions,
)
from contactgraph.policies.sensor_faults import ObservationNoise, SensorFault, SensorFaults
from contactgraph.policies.task_cost import AvoidingCost, CandidateTrials, SceneCost

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
        faults: SensorFault = _EXACT,
        measured: bool = True,
        noise: ObservationNoise = _NOISELESS,
        candidates: tuple[int, ...] = (),
    ) -> None:
        """``node_capacity``: 0 for the first scene's.

        Where a task observes holding, the contacts that the controller observes are the pairs that
        hold each other, since an edge of the model joins nodes that move together. ``faults``
        corrupts the contacts that the controller observes; without ``measured`` it observes none.
        ``noise`` is added to the motion that it plans from, not to the motion that feedback within
        a step uses. ``candidates``: see `ChainCost`.
        """
        self._mpc = mpc
        self._cost = cost
        self._scene_cost = cost
        self._chain = self._order = cost.order
        self._candidates = candidates
        self._trials = CandidateTrials(cost.order[0], candidates)
        self._capacity = node_capacity
        self._faults = faults
        self._measured = measured
        self._noise = noise
        self._noise_rng = noise.begin(0)
        self._sensor: Callable[[np.ndarray], np.ndarray] | None = None
        self._scene: Scene | None = None
        self._state: Any = None
        self._steps: list[_Step] = []
        self._applied: np.ndarray | None = None
        self._origin: np.ndarray | None = None
        """[D] m, about which plans are made."""
        self._holds = False
        """Whether the scene's contacts are the pairs that hold each other."""

    def compiled_as(self, other: "MPCPolicy") -> "MPCPolicy":
        """The same with the controller of another policy of equal model and task, which need not
        be compiled again."""
        same = copy.copy(self)
        same._mpc = other._mpc
        return same

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode in ``scene``; ``seed`` is that of sensor faults and noise.

        Raises `InvalidInputError` where cost and scene do not fit, for example without a goal.
        """
        self._scene_cost = self._cost.in_scene(scene)
        self._chain = self._order = self._scene_cost.order
        self._trials = CandidateTrials(self._order[0], self._candidates)
        self._capacity = max(self._capacity, scene.node_count)
        self._scene, self._state, self._steps = scene, None, []
        self._applied = self._origin = None
        self._sensor = self._faults.begin(scene, seed) if self._measured else None
        self._noise_rng = self._noise.begin(seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[U]`` N for the coming step."""
        observation = self._noise.observed(observation, self._noise_rng)
        if self._state is None:
            if self._scene is None:
                raise InvalidInputError("call reset(scene, seed) first")
            self._begin(self._scene, observation["position"])
            observation = self._about_origin(observation)
            nodes = scene_nodes(self._scene, self._capacity)
            self._state = self._mpc.reset(observation, nodes, self._cost_of(self._order))
        else:
            observation = self._about_origin(observation)
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

    def _begin(self, scene: Scene, position: np.ndarray) -> None:
        """Plans are about a point near the bodies where these are far from the origin."""
        self._origin = far_origin(scene, position)
        if self._origin is not None:
            self._scene = scene_about(scene, self._origin)
            self._scene_cost = self._cost.in_scene(self._scene)

    def _about_origin(self, observation: Observation) -> Observation:
        if self._origin is None:
            return observation
        moved = {name: observation[name] - self._origin for name in ("position", "goal")}
        return {**observation, **moved}

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
        origin = 0.0 if self._origin is None else self._origin
        return lambda part, position, velocity: feedback.within(
            0, part, position - origin, velocity
        )

    @property
    def state(self) -> MPCState | None:
        """The controller's, after its last step; None before the first one."""
        return self._state

    def sense(self, faults: SensorFault, measured: bool = True) -> None:
        """Gives the sensor other faults from now on, or takes it away, until `reset`.

        Raises `InvalidInputError` before the first `reset`.
        """
        if self._scene is None:
            raise InvalidInputError("call reset(scene, seed) first")
        self._sensor = faults.begin(self._scene, len(self._steps)) if measured else None

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
            )
            + (0.0 if self._origin is None else self._origin),
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

    def latest(self) -> EpisodeRecord:
        """The `record` of the last step alone; those before it are forgotten."""
        del self._steps[:-1]
        return self.record()

    def _contacts(self, observation: Observation) -> np.ndarray | None:
        if self._sensor is None:
            return None
        return self._sensor(observation.get("holding", observation["contact"]))

    def _changed_cost(self, observation: Observation) -> SceneCost | None:
        """The cost where the nodes are as observed; None: it is that of the last step."""
        before, order = self._scene_cost, self._order
        self._scene_cost = before.seeing(observation)
        if self._candidates:
            self._order = (*self._chain[:-1], self._candidate(observation))
        else:
            self._order = self._grasped_first()
        if self._scene_cost is before and self._order == order:
            return None
        return self._cost_of(self._order)

    def _cost_of(self, order: tuple[int, ...]) -> SceneCost:
        """The cost along these nodes; of candidates it also avoids those that were given up."""
        cost = self._scene_cost.among(order)
        if not self._candidates or self._scene is None:
            return cost
        return AvoidingCost(cost, contacts=(self._trials.avoided(self._scene.dimension),))

    def _believed(self, belief: ContactBelief, holds: bool) -> np.ndarray:
        """[N, N] bool: the pairs of the scene's nodes that touch or, with ``holds``, hold."""
        assert self._scene is not None
        count = self._scene.node_count
        first, second = pair_indices(count).T
        found = np.zeros((count, count), dtype=bool)
        likely = edge_probabilities(belief, self._state.node_ids, count, holds) > 0.5
        found[first, second] = found[second, first] = likely
        return found

    def _candidate(self, observation: Observation) -> int:
        """The one that the plan is to be about, by the beliefs about the step just made."""
        assert self._scene is not None
        belief, hand = self._state.last.belief, self._chain[0]
        touched, held = (self._believed(belief, holds)[hand] for holds in (False, self._holds))
        return self._trials.choose(observation, touched, held, self._scene.dt)

    def _grasped_first(self) -> tuple[int, ...]:
        """The nodes of the cost with the grasped ones before those still to be picked up.

        Without it a node that is picked up out of turn stays in the chain between two others that
        pull at it, and nothing further is picked up.
        """
        order = self._chain
        if len(order) < 3:
            return order
        believed = self._believed(self._state.belief, self._holds)
        grasped = joined(believed[None])[0, order[0]] > 0
        return tuple(sorted(order, key=lambda node: (not grasped[node], order.index(node))))
