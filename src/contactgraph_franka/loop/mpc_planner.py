"""Model predictive control as a planner of the robot's loop."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np

from contactgraph.control import ILQR, MPC, ActiveSetMPC, ControlLimits, MPCState
from contactgraph.data import InvalidInputError, Scene
from contactgraph.model import ContactDynamics, ContactSensor, MotionNoise, scene_nodes
from contactgraph.model.scene import check_fit
from contactgraph.policies import PlannerFactory, SceneCost
from contactgraph.policies.mpc_policy import plan_feedback
from contactgraph_franka.loop import EpisodeStart, PlanFeedback, TimedObservation

_SHARES = np.array([0.5, 0.5, np.sqrt(0.5)])
"""Bounds of a plan's force along each axis, as shares of the largest force. Their squares add up
to 1, so that every plan is within the limits. The largest is upwards, against the weight."""


class MPCPlanner:
    """A `Planner` that plans in every step of the model, if there is time.

    Beliefs are updated at every observation: predicted by the model, corrected by measured contacts
    and, with a ``motion_noise``, by observed motion. Where planning took longer than a step, the
    skipped observations update the belief, and the plan is made from the last one.
    """

    def __init__(
        self,
        model: ContactDynamics,
        scene: Scene,
        cost: SceneCost,
        max_force: float,
        *,
        horizon: int = 50,
        planner: PlannerFactory | None = None,
        motion_noise: MotionNoise | None = None,
    ) -> None:
        """``scene``, in three dimensions, is that of all episodes; each has its own goal.

        ``max_force`` N is the largest force on the hand that the robot's limits permit: plans keep
        to a box inside it. ``planner`` None: iLQR.
        Raises `InvalidInputError` where the parts do not fit, or a number is out of range.
        """
        if not max_force > 0.0:
            raise InvalidInputError(f"max_force must be positive, found {max_force}")
        check_fit(model, scene, scene.dimension, "the robot")
        if scene.dimension != len(_SHARES):
            raise InvalidInputError(f"the robot moves in 3 dimensions, found {scene.dimension}")
        bound = jnp.asarray(max_force * _SHARES)
        make, limits = planner or partial(ILQR, iterations=5), ControlLimits(-bound, bound)
        mpc = MPC(
            model,
            make(horizon=horizon, limits=limits),
            ContactSensor(0.01, 0.01),
            replan_every=horizon,
            motion_noise=motion_noise,
        )
        self._mpc = ActiveSetMPC(mpc)
        self._scene, self._cost = scene, cost
        self._state: MPCState | None = None
        self.interval = float(scene.dt)
        """s: the model's step."""

    def reset(self, start: EpisodeStart) -> None:
        """See `Planner`. Compiles on the first call."""
        scene = replace(self._scene, goal=start.goal)
        nodes = scene_nodes(scene, scene.node_count)
        observation = start.reading.observation(start.goal)
        self._state = self._mpc.reset(observation, nodes, self._cost.in_scene(scene))

    def plan(self, observations: Sequence[TimedObservation]) -> PlanFeedback | None:
        """See `Planner`."""
        if self._state is None:
            raise InvalidInputError("call reset(start) first")
        for each in observations:
            observed = {"position": each.reading.position, "velocity": each.reading.velocity}
            plan, self._state = self._mpc.step(
                observed,
                each.reading.contact,
                self._state,
                each.applied,
                replan=each is observations[-1],
            )
        if not plan.outcome.solved:
            return None
        return plan_feedback(plan, self.interval, self._scene.node_count, self._scene.dimension)
