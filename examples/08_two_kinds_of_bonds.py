"""Edge types learned without labels: a rigid bond and a soft one, between look-alikes.

Usage: python examples/08_two_kinds_of_bonds.py [RUN DATA]

With a trained model and a dataset of `bonds`, it only compares the two.
"""

import itertools
import sys

import equinox as eqx
import jax
import numpy as np

from contactgraph.cli.models import stored_model
from contactgraph.data import (
    Dataset,
    pad_trajectories,
    pair_indices,
    read_trajectories,
    split_by_trajectory,
)
from contactgraph.envs import BondsTask, HandlingPolicy
from contactgraph.evaluate import collect
from contactgraph.model import ContactSensor, ModelConfig, hidden_markov_filter, motion_noise
from contactgraph.model.filter import filter_trajectory, on_device
from contactgraph.train import TrainConfig, fit, initial_state


def recorded(episodes, seed):
    policies = [HandlingPolicy(press=0.3) for _ in range(episodes)]
    return Dataset(tuple(collect([BondsTask], policies, episodes, seed)))


if len(sys.argv) > 1:
    model, unseen = stored_model(sys.argv[1]), read_trajectories(sys.argv[2])
else:
    unseen = recorded(6, seed=1000)
    train, held_out = split_by_trajectory(recorded(16, seed=0), 0.15, 0)
    shape = ModelConfig(2, 2, unseen.dt, 0.08, width=16, edge_types=4)
    config = TrainConfig(
        steps=150, check_every=150, batch_size=16, window_length=4, rollout_from=1.0
    )  # no rollout loss, as in the first example
    fresh = hidden_markov_filter(shape, key=jax.random.key(0))
    model = fit(initial_state(fresh, config, 0), train, held_out, config).model


@eqx.filter_jit
def types_by_motion(model, trajectory):
    """[T+1, E, K] after each step, of its motion and all before; no contact is measured."""
    filtered = filter_trajectory(model, trajectory, ContactSensor(), motion_noise(model))
    return filtered.posterior.type_probability


counts = np.zeros((3, model.inference.edge_types), int)
batch = on_device(pad_trajectories(unseen, contacts=False), np.float32)
for index, trajectory in enumerate(unseen):
    types = np.argmax(types_by_motion(model, batch.at(index)), axis=-1)
    soft = {int(node) for node in trajectory.scene.metadata["soft"].split()}
    for edge, (first, second) in enumerate(pair_indices(trajectory.scene.node_count)):
        holds = trajectory.holding[1:, first, second]
        bond = np.where(holds, 2 if second in soft else 1, 0)
        np.add.at(counts, (bond, types[1:, edge]), 1)

print("steps by true bond (rows) and learned type, 0 free, 1 touch, 2.. hold:")
for name, row in zip(("none", "rigid", "soft"), counts, strict=True):
    print(f"{name:>6s} {' '.join(f'{count:6d}' for count in row)}")
held = counts[1:]
pairs = itertools.permutations(range(1, held.shape[1]), 2)
rigid, soft = max(pairs, key=lambda pair: held[0, pair[0]] + held[1, pair[1]])
right = (held[0, rigid] + held[1, soft]) / held.sum()
print(f"type {rigid} is the rigid bond, {soft} the soft one: right in {100 * right:.0f} % of steps")
