"""Learn a cost from five demonstrations of one goal, and use it for other goals.

Usage: python examples/07_learn_cost.py [FOLDER]
"""

import sys
import tempfile
from functools import partial
from pathlib import Path

from contactgraph.control import CostLearningConfig, cost_terms, learn_cost, read_cost, write_cost
from contactgraph.data import Dataset
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import collect, control_task
from contactgraph.model import load_model, shipped_model
from contactgraph.policies import task_policy

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
model = load_model(shipped_model("pickup")).model

# Demonstrations are an expert's episodes without noise. They share the goal and the target's
# position; the positions of gripper and distractors differ.
factory = partial(PickupTask, distractors=2, fixed_seed=3)
demonstrations = Dataset(tuple(collect([factory], [PickupExpert(noise=0.0)], 5, seed=0)))

# Few steps: the default, 400, lowers the loss slightly further.
cost = learn_cost(model, demonstrations, CostLearningConfig(steps=100))
for each in cost.task_nodes:
    print(f"{each.name:13s} {'kept' if each.kept else 'dropped':8s} {each.reason}")
loss = cost.imitation_loss
print(f"imitation loss {loss[0]:.3f} at the beginning, {loss[-50:].mean():.3f} in the end")
for term in cost_terms(cost):
    print(f"{term.name:17s} 1 m costs as much as {term.position:.1f} N", end=", ")
    print(f"1 m/s as much as {term.velocity:.1f} N")

# A cost is stored as a readable JSON file.
write_cost(folder / "cost.json", cost, {"demonstrations": len(demonstrations), "seed": 0})
cost = read_cost(folder / "cost.json")

# The cost identifies its nodes by name in new scenes: other goals and target positions, more
# distractors.
task = PickupTask(distractors=5)
metrics = control_task(task_policy(model, task, cost=cost), task, 3, seed=1).metrics
print(f"new goals: {100 * metrics.success_rate:.0f} % of {metrics.episodes}")
