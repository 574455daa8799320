"""A control loop through contact by hand: observe, plan, act, with a disturbance.

Usage: python examples/03_control.py
"""

import jax.numpy as jnp
import numpy as np

from contactgraph.control import ILQR, MPC, ControlLimits, chain_cost
from contactgraph.envs import PickupTask
from contactgraph.model import load_model, scene_nodes, shipped_model

GRIPPER, TARGET = 0, 1

model = load_model(shipped_model("pickup")).model
task = PickupTask(distractors=3)
observation, _ = task.reset(seed=7)

# The cost of a step: gripper to target, target to goal, little force.
cost = chain_cost(
    chain=[GRIPPER, TARGET],
    pick_weights=[3.0, 3.0, 0.2, 0.2],  # position (1/m^2), then velocity (s^2/m^2)
    goal_weights=[50.0, 50.0, 1.0, 1.0],
    control_weight=0.01,
    goal=observation["goal"],
    node_count=task.scene.node_count,
)
limits = ControlLimits(jnp.array([-10.0, -10.0]), jnp.array([10.0, 10.0]))  # N
mpc = MPC(model, ILQR(horizon=20, limits=limits))
state = mpc.reset(observation, scene_nodes(task.scene), cost)  # compiles, so that no step has to

held = False
for t in range(task.max_steps):
    contacts = observation["contact"].astype(float)
    if t % 3:
        contacts[:] = np.nan  # a slow sensor: in between, the model predicts the belief
    plan, state = mpc.step(observation, contacts, state)
    force = np.asarray(plan.controls)[0]
    gust = np.array([6.0, -6.0]) if 100 <= t < 110 else np.zeros(2)  # unknown to the model
    observation, *_ = task.step(force + gust)

    if observation["contact"][GRIPPER, TARGET] and not held:
        held = True
        speed = np.linalg.norm(observation["velocity"][GRIPPER])
        print(f"{t * model.dt:5.2f} s  touch, at {speed:.2f} m/s")
    if t % 20 == 0 or t == 110:
        error = np.linalg.norm(observation["position"][TARGET] - observation["goal"])
        belief = float(plan.beliefs.probability[0, 0])  # edge 0 joins nodes 0 and 1
        print(
            f"{t * model.dt:5.2f} s  target {error:.3f} m from the goal, "
            f"belief in the grasp {belief:.2f}, {plan.outcome.name.lower()}"
        )

print("success" if task.success() else "failure")
