"""The model predictive controller as a policy in a task, and the record of an episode."""

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np

from contactgraph.control import MPC, ContactCost, MPCState, Plan, QuadraticCost
from contactgraph.data import InvalidInputError, Scene, edge_id, joined, pair_indices
from contactgraph.data.dataset import far_origin, scene_about
from contactgraph.envs.contract import Feedback, Observation
from contactgraph.feedback import PlanFeedback
from contactgraph.model import ContactBelief, scene_nodes
from contactgraph.policies.sensor_faults import ObservationNoise, SensorFault, SensorFaults
from contactgraph.policies.task_cost import CandidateTrials, SceneCost, avoid_others

EXACT = SensorFaults()
NOISELESS = ObservationNoise()


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
    active (`contactgraph.control.ActiveSetMPC`). Compilation precedes an episode's first control
    step and is not part of its time.
    """

    def __init__(
        self,
        mpc: MPC,
        cost: SceneCost,
        node_capacity: int = 0,
        faults: SensorFault = EXACT,
        measured: bool = True,
        noise: ObservationNoise = NOISELESS,
        candidates: tuple[int, ...] = (),
        clearance: float | None = None,
    ) -> None:
        """``node_capacity``: 0 for the first scene's.

        Where a task observes holding, the contacts that the controller observes are the pairs that
        hold each other, since an edge of the model joins nodes that move together. ``faults``
        corrupts the contacts that the controller observes; without ``measured`` it observes none.
        ``noise`` is added to the motion that it plans from, not to the motion that feedback within
        a step uses. ``candidates``: see `ChainCost`. ``clearance`` [m] of the cost's nodes and the
        candidates from all others: see `avoid_others`; None: they may touch.
        """
        self.mpc = mpc
        self._cost = cost
        self._candidates, self._clearance = candidates, clearance
        self._capacity = node_capacity
        self._faults = faults
        self._measured = measured
        self._noise = noise
        self._scene: Scene | None = None
        self._state: Any = None
        self._steps: list[_Step] = []

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode in ``scene``; ``seed`` is that of sensor faults and noise.

        Raises `InvalidInputError` where cost and scene do not fit, for example without a goal, or
        without radii where there is a clearance.
        """
        self._scene_cost = self._cost.in_scene(scene)
        self._chain = self._order = self._scene_cost.order
        self._trials = CandidateTrials(self._order[0], self._candidates)
        self._avoided: tuple[ContactCost, ...] = ()
        if self._clearance is not None:
            handled = (*self._order, *self._candidates)
            self._avoided = avoid_others(scene, handled, self._clearance)
        self._capacity = max(self._capacity, scene.node_count)
        self._scene, self._state, self._steps = scene, None, []
        self._applied: np.ndarray | None = None
        self._origin: np.ndarray | float = 0.0
        """[D] m, about which plans are made."""
        self._sensor = self._faults.begin(scene, seed) if self._measured else None
        self._noise_rng = self._noise.begin(seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[U]`` N for the coming step."""
        if self._scene is None:
            raise InvalidInputError("call reset(scene, seed) first")
        observation = self._noise.observed(observation, self._noise_rng)
        origin = far_origin(self._scene, observation["position"]) if self._state is None else None
        if origin is not None:  # plans are about a point near the bodies
            self._origin, self._scene = origin, scene_about(self._scene, origin)
            self._scene_cost = self._cost.in_scene(self._scene)
        places = observation.keys() & {"position", "goal"}
        moved = {name: observation[name] - self._origin for name in places}
        observation = {**observation, **moved}
        if self._state is None:
            nodes = scene_nodes(self._scene, self._capacity)
            self._state = self.mpc.reset(observation, nodes, self._cost_of(self._order))
        contacts = self._contacts(observation)
        self._holds = "holding" in observation
        """Whether the scene's contacts are the pairs that hold each other."""
        begin = time.perf_counter()
        plan, self._state = self.mpc.step(
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
        scene, origin = self._scene, self._origin
        feedback = plan_feedback(self._steps[-1].plan, scene.dt, self._capacity, scene.dimension)
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
        plans = [planned_positions(s.plan, s.position, s.velocity, dt) for s in self._steps]
        return EpisodeRecord(
            plan_ms=np.array([each.plan_ms for each in self._steps]),
            status=np.array([int(each.plan.status) for each in self._steps]),
            plan=np.stack(plans) + self._origin,
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

    def _changed_cost(self, observation: Observation) -> QuadraticCost | None:
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

    def _cost_of(self, order: tuple[int, ...]) -> QuadraticCost:
        """The cost along these nodes, and of touching others and candidates that were given up."""
        cost, avoided = self._scene_cost.among(order).quadratic(self._capacity), self._avoided
        if self._candidates and self._scene is not None:
            avoided += (self._trials.avoided(self._scene.dimension),)
        return replace(cost, contacts=(*cost.contacts, *avoided)) if avoided else cost

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
    of freedom a node. Neither limits nor observations that are not finite are checked.
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
