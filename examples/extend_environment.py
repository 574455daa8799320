"""A Gymnasium environment of somebody else becomes a task by a map of its observations and actions.

Usage: python examples/extend_environment.py
or, in this folder: contactgraph collect extend_environment:TableTask --out table.h5
"""

from functools import partial
from pathlib import Path

import gymnasium
import numpy as np

from contactgraph import envs
from contactgraph.evaluate import run_episode


class Table(gymnasium.Env):
    """The environment, in centimetres: a paddle pushes a puck that stops where it is left."""

    observation_space = gymnasium.spaces.Box(-100.0, 100.0, (6,))  # paddle, puck, goal
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))  # 1: the paddle moves by 2 cm

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._paddle = self.np_random.uniform([-40.0, -20.0], [-30.0, 20.0])
        self._puck, self._goal = self.np_random.uniform(-15.0, 15.0, (2, 2))
        return self._observation(), {}

    def step(self, action):
        self._paddle = self._paddle + 2.0 * action
        away = self._puck - self._paddle
        distance = np.linalg.norm(away)
        self._puck = self._paddle + away * max(distance, 5.0) / distance  # 5: both radii
        return self._observation(), -np.linalg.norm(self._puck - self._goal), False, False, {}

    def _observation(self):
        return np.concatenate([self._paddle, self._puck, self._goal]).astype(np.float32)


MAP = Path(__file__).with_suffix(".toml")


class TableTask(envs.AdaptedTask):
    style = envs.PushStyle(clearance=0.07, speed=0.3, lead=0.05, near_enough=0.01)
    fixed_start = demonstrator = partial(envs.PushPolicy, style)
    expert = partial(envs.PushPolicy, style, noise=0.003, variety=0.5)

    def __init__(self):
        super().__init__(
            Table,
            MAP,
            name="table",
            cost=envs.ChainCost((0, 1), np.array([3, 3, 0.2, 0.2]), np.array([50, 50, 1, 1]), 0.01),
            max_steps=200,
            tolerance=0.02,  # m
        )


if __name__ == "__main__":
    envs.check_task(TableTask)
    made = [run_episode(TableTask(), TableTask.fixed_start(), seed) for seed in range(5)]
    successes = sum(each.scene.metadata["success"] for each in made)
    print(f"the table is a task; the fixed start succeeds in {successes} of 5 scenes")
