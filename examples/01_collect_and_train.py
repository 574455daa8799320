"""Record pickups by the scripted expert, train a model, and predict unseen trajectories.

Usage: python examples/01_collect_and_train.py [FOLDER]

A small network and few steps take seconds, most of them for compilation.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import jax

from contactgraph.data import Dataset, split_by_trajectory, strip_contacts
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import collect, evaluate_open_loop
from contactgraph.identify import identify, in_units
from contactgraph.model import ours, save_model
from contactgraph.train import FitProgress, TrainConfig, fit, initial_state

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())

# Twelve episodes for training, and three with distractors, which training does not have.
recorded = Dataset(tuple(collect([PickupTask], [PickupExpert()], episodes=12, seed=0)))
with_distractors = Dataset(
    tuple(collect([lambda: PickupTask(distractors=3)], [PickupExpert()], episodes=3, seed=1))
)
steps = recorded.trajectories[0].steps
print(f"recorded {len(recorded)} episodes of {steps} steps of {recorded.dt} s")

# Training never reads contact labels. Without them it gives the same model, bit for bit.
bare = strip_contacts(recorded)

# Least squares tell the actuation and much else before training, which is in units of its own.
facts = identify(bare)
facts = replace(facts, config=replace(facts.config, width=16))
print(f"bodies touch {100 * facts.in_data.contact_distance:.1f} cm apart")
print(f"gripper: {facts.in_data.actuation['gripper']}")

dataset = in_units(bare, facts.units)
train, held_out = split_by_trajectory(dataset, held_out_fraction=0.2, seed=0)
model = ours(facts.config, key=jax.random.key(0))
config = TrainConfig(
    steps=400,
    check_every=100,
    batch_size=16,
    window_length=4,
    learning_rate=5e-3,
    rollout_from=1.0,  # no rollout loss: it improves the model, but compiles longer
    bystanders=0,
)


def on_check(check: FitProgress) -> None:
    print(f"step {check.step:4d}: held-out error {100 * check.held_out_rmse_m:.2f} cm")


result = fit(initial_state(model, config, seed=0), train, held_out, config, on_check)

trained = facts.in_data_units(result.model, ours)  # in newtons again
metrics = evaluate_open_loop(trained, with_distractors)
own, unmoved = metrics["n_step_rmse_moving_m"], metrics["constant_velocity_rmse_moving_m"]
print(f"half a second ahead, with distractors, bodies that move: {100 * own:.2f} cm")
print(f"  without a model (constant velocity): {100 * unmoved:.2f} cm")
print(f"  the verdict: {metrics['verdict']}")
print(f"  contact edges (F1): {metrics['edge_f1'] or 0.0:.2f}")

training = {"seed": 0, "steps": config.steps}
save_model(folder / "model.safetensors", trained, "ours", facts.in_data, training)
print(f"wrote {folder / 'model.safetensors'}")
