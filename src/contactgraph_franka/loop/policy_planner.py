"""A task's policy, such as a scripted expert, beside a robot's loop."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from contactgraph.data import Scene
from contactgraph.envs.contract import Policy
from contactgraph_franka.loop import HeldForce, Moment, Start

_HELD_STEPS = 5
"""After so many steps without a new force, the last one is over."""


class PolicyPlanner:
    """A `contactgraph_franka.loop.Planner` that asks a policy in every step of a scene."""

    def __init__(self, policy: Policy, scene: Scene) -> None:
        """``scene`` is that of all runs; each has its own goal."""
        self._policy, self._scene = policy, scene
        self.interval = float(scene.dt)
        """s"""

    def begin(self, start: Start) -> None:
        """See `contactgraph_franka.loop.Planner`."""
        self._goal = start.goal
        self._policy.reset(replace(self._scene, goal=start.goal), start.seed)

    def plan(self, moments: Sequence[Moment]) -> HeldForce:
        """See `contactgraph_franka.loop.Planner`. Policies count steps, so they hear of each."""
        forces = [self._policy(moment.reading.observation(self._goal)) for moment in moments]
        return HeldForce(np.asarray(forces[-1], dtype=np.float64), _HELD_STEPS * self.interval)
