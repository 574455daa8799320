"""Model predictive control beside a robot's loop."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from contactgraph.control import ILQR, MPC, ControlLimits, MPCState
from contactgraph.data import InvalidInputError, Scene
from contactgraph.evaluate.mpc_policy import SceneCost
from contactgraph.model import ContactDynamics, ContactSensor, MotionNoise, scene_nodes
from contactgraph.model.filter import check_fit
from contactgraph_franka.loop import EpisodeStart, FeedbackLaw, TimedObservation
from contactgraph_franka.loop.plan_feedback import plan_feedback

_SHARES = np.array([0.5, 0.5, np.sqrt(0.5)])
"""Of the largest force, along each axis: their squares add up to 1, so that no plan asks for more
than the limits let pass. Upwards there is most, since what is held has weight."""


class MPCPlanner:
    """A `contactgraph_franka.loop.Planner`: plans in every step of the model, if it has the time.

    Beliefs are carried along every moment, as the model predicts them and as measured contacts and,
    with a ``motion_noise``, observed motion correct them. Where planning took longer than a step,
    the moments that passed are followed, and the plan is made from the last one.
    """

    def __init__(
        self,
        model: ContactDynamics,
        scene: Scene,
        cost: SceneCost,
        max_force: float,
        *,
        horizon: int = 50,
        iterations: int = 5,
        sensor: ContactSensor | None = None,
        motion_noise: MotionNoise | None = None,
    ) -> None:
        """``scene`` in three dimensions is that of all runs; each has its own goal.

        ``max_force`` N is the length of the longest force that the robot's limits let pass: plans
        keep to a box in it. ``sensor`` None: what measures contacts hardly ever lies.
        Raises `InvalidInputError` where the parts do not fit, or a number is out of range.
        """
        if not max_force > 0.0:
            raise InvalidInputError(f"max_force must be positive, found {max_force}")
        check_fit(model, scene, scene.dimension, "the robot")
        if scene.dimension != len(_SHARES):
            raise InvalidInputError(f"the robot moves in 3 dimensions, found {scene.dimension}")
        bound = jnp.asarray(max_force * _SHARES)
        ilqr = ILQR(horizon=horizon, iterations=iterations, limits=ControlLimits(-bound, bound))
        # So that no tick plans but those that are told to.
        self._every = horizon
        self._mpc = MPC(
            model,
            ilqr,
            ContactSensor() if sensor is None else sensor,
            replan_every=horizon,
            motion_noise=motion_noise,
        )
        self._scene, self._cost = scene, cost
        self._state: MPCState | None = None
        self.interval = float(scene.dt)
        """s: the model's step."""

    def begin(self, start: EpisodeStart) -> None:
        """See `contactgraph_franka.loop.Planner`. Compiles, where that has not been done."""
        scene = replace(self._scene, goal=start.goal)
        nodes = scene_nodes(scene, scene.node_count)
        observation = start.reading.observation(start.goal)
        self._state = self._mpc.reset(observation, nodes, self._cost.in_scene(scene))

    def plan(self, moments: Sequence[TimedObservation]) -> FeedbackLaw | None:
        """See `contactgraph_franka.loop.Planner`."""
        if self._state is None:
            raise InvalidInputError("call begin(start) first")
        for moment in moments:
            due = self._every if moment is moments[-1] else 0
            memory = replace(self._state.memory, steps_since_plan=jnp.asarray(due, jnp.int32))
            state = replace(self._state, memory=memory)
            observed = {"position": moment.reading.position, "velocity": moment.reading.velocity}
            plan, self._state = self._mpc.step(
                observed, moment.reading.contact, state, moment.applied
            )
        if not plan.outcome.solved:
            return None
        return plan_feedback(plan, self.interval, self._scene.node_count)
