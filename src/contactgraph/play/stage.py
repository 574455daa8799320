"""A stage: a task under a compiled controller, ready for episodes that a hand disturbs."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.data import InvalidInputError, Scene, pair_indices
from contactgraph.dynamics.local_dynamics import SpringMassDamperDynamics
from contactgraph.envs.contract import DisturbableTask, Feedback, Observation, Task
from contactgraph.model import ContactDynamics, ModelState, MotionNoise, Nodes, with_masses
from contactgraph.play.wishes import StageChoice
from contactgraph.policies import (
    MPCPolicy,
    PlannerFactory,
    Planning,
    SensorFaults,
    switches_of,
    task_policy,
)

EPISODE_S = 60.0
"""Least duration of an episode, s, where the task itself does not end it sooner."""
WRONG = 0.3
"""Share of readings of a broken sensor that are false alarms, or misses, at every step."""
_ROOM = 12
"""Nodes that a stage is compiled for, at least, once bodies are added or removed."""
_FAULTS = {"broken": SensorFaults(false_alarm_rate=WRONG, miss_rate=WRONG)}
_STIFFNESS, _DAMPING = 64.0, 12.0
"""Of the spring from a pulled body to the hand, in units of its mass, 1/s^2 and 1/s."""
_LARGEST_PULL = 30.0
"""Of the hand, m/s^2."""


@dataclass(frozen=True, eq=False)
class StageParts:
    """All that a `StageChoice` names."""

    model: ContactDynamics
    task: Task
    motion_noise: MotionNoise | None
    planner: PlannerFactory | None = None
    """None: iLQR."""


class HandPolicy:
    """A `contactgraph.envs.Policy`: the controller, but for a switch that a hand may operate."""

    def __init__(self, controller: MPCPolicy) -> None:
        self.controller = controller
        self.switch: float | None = None
        """0 or 1 by hand; None: by the plan."""
        self._switches: list[int] = []

    def reset(self, scene: Scene, seed: int) -> None:
        """See `MPCPolicy.reset`."""
        self._switches = list(switches_of(scene))
        self.controller.reset(scene, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[U]`` N for the coming step."""
        control = self.controller(observation)
        if self.switch is not None:
            control = control.copy()
            control[self._switches] = self.switch
        return control

    def applied(self, control: np.ndarray) -> None:
        """See `MPCPolicy.applied`."""
        self.controller.applied(control)

    def feedback(self) -> Feedback:
        """See `MPCPolicy.feedback`."""
        return self.controller.feedback()

    def sense(self, sensor: str) -> None:
        """Breaks, blinds or mends the contact sensor; see `contactgraph.play.wishes.SENSORS`."""
        self.controller.sense(_FAULTS.get(sensor, SensorFaults()), sensor != "blind")


class Stage:
    """A task, its policy, and what is known of both; `warm_up` compiles."""

    def __init__(
        self, choice: StageChoice, parts: StageParts, seed: int, before: "Stage | None" = None
    ) -> None:
        """``before``: the present stage, whose compiled controller serves another number of bodies.

        Raises `InvalidInputError` where model and task do not fit.
        """
        self.choice, self.parts, task = choice, parts, parts.task
        observation, _ = task.reset(seed=seed)
        task.max_steps = max(task.max_steps, round(EPISODE_S / task.scene.dt))
        grown = before is not None and self.same_program(before)
        self._room = task.scene.node_count
        if grown and before is not None:
            self._room = max(self._room, before._room, _ROOM)
        made = task_policy(
            parts.model,
            task,
            Planning(planner=parts.planner),
            seed=seed,
            motion_noise=parts.motion_noise,
            node_capacity=self._room,
        )
        if grown and before is not None:
            made.mpc = before.policy.controller.mpc  # which need not be compiled again
        self.policy: HandPolicy = HandPolicy(made)
        self._observation = observation

    @property
    def task(self) -> Task:
        """The task."""
        return self.parts.task

    @property
    def disturbable(self) -> bool:
        """Whether its goal can be moved, and bodies be pulled."""
        return isinstance(self.task, DisturbableTask)

    def same_program(self, other: "Stage") -> bool:
        """Whether both have the same model and task, and so the same compiled controller."""
        one, another = self.choice, other.choice
        return (one.model, one.task) == (another.model, another.task)

    def agrees(self, other: "Stage") -> bool:
        """Whether episodes of both can be in one dataset."""
        spaces = self.task.action_space, other.task.action_space
        one, another = self.task.scene, other.task.scene
        same = (one.dt, one.dimension) == (another.dt, another.dimension)
        return same and spaces[0].shape == spaces[1].shape

    def warm_up(self) -> None:
        """Compiles, by a control step that nothing comes of."""
        self.policy.reset(self.task.scene, 0)
        self.policy(self._observation)
        self.policy.controller.latest()
        self.inverse_mass()

    def inverse_mass(self) -> np.ndarray | None:
        """[N, D] 1/kg of every body as inferred in the last step; NaN for bodies beyond the plan's.

        None where the model has none.
        """
        model, state = self.parts.model, self.policy.controller.state
        if state is None or not isinstance(model.local_dynamics, SpringMassDamperDynamics):
            return None
        ids, nodes = state.node_ids, with_masses(state.nodes, state.carry.filter.masses)
        found = np.asarray(_inverse_mass(model, state.last, nodes))
        scene = self.task.scene
        whole = np.full((scene.node_count, scene.dimension), np.nan)
        there = (ids >= 0) & (ids < len(whole))
        whole[ids[there]] = found[there, : scene.dimension]
        return whole

    def check_place(self, place: np.ndarray, node: int = 0) -> DisturbableTask:
        """The task, where ``place`` and ``node`` are in its scene; else `InvalidInputError`."""
        if not isinstance(self.task, DisturbableTask):
            raise InvalidInputError(f"{self.choice.task}: goal and bodies cannot be moved by hand")
        scene = self.task.scene
        if node >= scene.node_count or len(place) != scene.dimension:
            raise InvalidInputError(
                f"nodes are 0 to {scene.node_count - 1}, and places have {scene.dimension} numbers"
            )
        return self.task

    def pull(self, observation: Observation, node: int, to: np.ndarray) -> None:
        """Pulls a body to a place during the next step, as by a damped spring."""
        scene = self.task.scene
        mass = 1.0 if scene.mass is None else float(scene.mass[node])
        wanted = _STIFFNESS * (to - observation["position"][node])
        wanted = wanted - _DAMPING * observation["velocity"][node]
        wanted *= min(1.0, _LARGEST_PULL / max(float(np.linalg.norm(wanted)), 1e-9))
        if not scene.actuated[node]:
            wanted = wanted - scene.gravity
        force = np.zeros((scene.node_count, scene.dimension))
        force[node] = mass * wanted
        self.check_place(to, node).disturb(force)

    def labels(self, observation: Observation) -> np.ndarray:
        """[E] bool: the edges that exist in truth, as the model means them; see `MPCPolicy`."""
        first, second = pair_indices(self.task.scene.node_count).T
        contact = observation.get("holding", observation["contact"])
        return np.asarray(contact[first, second]).astype(bool)


@dataclass(frozen=True, eq=False)
class BuiltStage:
    """A stage that is compiled, or the reason why there is none."""

    stage: Stage | None
    reason: str = ""


def build_stage(make: Callable[[], Stage], built: Callable[[BuiltStage], None]) -> None:
    """Makes and compiles a stage in a thread of its own, which hands it over."""

    def build() -> None:
        try:
            stage = make()
            stage.warm_up()
            found = BuiltStage(stage)
        except Exception as error:  # told on the page: a model of the user's may raise any
            reason = str(error) if isinstance(error, InvalidInputError) else repr(error)
            found = BuiltStage(None, " ".join(reason.split()))
        built(found)

    # No daemon, as the session is: a process that ends within XLA's compiler aborts.
    threading.Thread(target=build, name="compile", daemon=False).start()


@eqx.filter_jit
def _inverse_mass(model: ContactDynamics, state: ModelState, nodes: Nodes) -> Float[Array, "N D"]:
    control = jnp.zeros(model.control_size, state.velocity.dtype)
    return model.parameters(state, control, nodes).inverse_mass
