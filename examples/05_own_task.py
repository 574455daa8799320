"""A task of your own: a Gymnasium environment that keeps the contract, controlled by the model.

Usage: python examples/05_own_task.py
"""

import gymnasium
import numpy as np

from contactgraph.data import Scene
from contactgraph.envs import ChainCost, check_task
from contactgraph.evaluate import control_task
from contactgraph.model import load_model, shipped_model
from contactgraph.policies import task_policy

DT, STEPS, SUBSTEPS, REACH, MAX_FORCE = 0.05, 120, 10, 0.08, 10.0  # s, -, -, m, N


class Fetch(gymnasium.Env):
    """A cart fetches a box that sticks to it. Box2D is not needed: this is all the physics."""

    max_steps = STEPS
    action_space = gymnasium.spaces.Box(-MAX_FORCE, MAX_FORCE, (2,), np.float64)
    observation_space = gymnasium.spaces.Dict(
        position=gymnasium.spaces.Box(-np.inf, np.inf, (2, 2), np.float64),
        velocity=gymnasium.spaces.Box(-np.inf, np.inf, (2, 2), np.float64),
        contact=gymnasium.spaces.MultiBinary((2, 2)),
        goal=gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float64),
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._steps, self._held = 0, False
        self._x = np.array([[0.0, 0.0], self.np_random.uniform([0.3, -0.2], [0.5, 0.2])])
        self._v = np.zeros((2, 2))
        self._goal = self.np_random.uniform([0.6, -0.6], [0.9, 0.6])
        types = ("gripper", "object")  # of the model that is to control it
        names, actuated = ("cart", "box"), np.array([True, False])
        self.scene = Scene(names, types, actuated, dt=DT, goal=self._goal)
        return self._observation(), {}

    def step(self, action):
        force = np.clip(action, self.action_space.low, self.action_space.high)
        for _ in range(SUBSTEPS):
            self._v[0] += force * DT / SUBSTEPS / (2.0 if self._held else 1.0)  # 1 kg each
            if np.linalg.norm(self._x[0] - self._x[1]) <= REACH and not self._held:
                self._held, self._v[:] = True, self._v.mean(axis=0)  # momentum is kept
            self._v[1] = self._v[0] if self._held else 0.0
            self._x = self._x + self._v * DT / SUBSTEPS
        self._steps += 1
        reward = -np.linalg.norm(self._x[1] - self._goal)
        return self._observation(), float(reward), False, self._steps == STEPS, {}

    def success(self):
        return bool(np.linalg.norm(self._x[1] - self._goal) < 0.05)

    def cost_terms(self):
        return ChainCost((0, 1), [3.0, 3.0, 0.2, 0.2], [50.0, 50.0, 1.0, 1.0], control_weight=0.01)

    def _observation(self):
        contact = np.array([[0, self._held], [self._held, 0]], dtype=np.int8)
        motion = {"position": self._x.copy(), "velocity": self._v.copy()}
        return {**motion, "contact": contact, "goal": self._goal.copy()}


check_task(Fetch)  # an error states the first violation, if any
print("Fetch keeps the contract")

# The shipped model was trained on another simulator, but with the same type of contact.
model = load_model(shipped_model("pickup")).model
task = Fetch()
metrics = control_task(task_policy(model, task), task, episodes=5, seed=0).metrics
print(f"success: {metrics.success_rate:.0%} of {metrics.episodes} episodes")
print(f"speed at contact: {metrics.contact_speed_m_s:.2f} m/s")
print(f"control step: {metrics.plan_ms_p50:.1f} ms median")
