"""Trains the same model on one device and on several.

Run as a program, because the number of devices is settled before JAX starts. Prints that number,
how far training moved the parameters, how far apart the two ends are, and their held-out errors.
"""

import sys
from pathlib import Path

import jax
import numpy as np
from training import split

from contactgraph.model import PRESETS, ContactDynamics, ModelConfig
from contactgraph.model.io import module_arrays
from contactgraph.train import FitState, TrainConfig, fit, initial_state

CONFIG = TrainConfig(steps=12, batch_size=8, window_length=3, rollout_from=1.0, bystanders=0)


def first_model() -> ContactDynamics:
    return PRESETS["ours-recurrent"](ModelConfig(2, 2, 0.05, 0.1), key=jax.random.key(0))


def trained(devices: list[jax.Device], path: Path) -> FitState:
    state = initial_state(first_model(), CONFIG, 0)
    return fit(state, *split(path), CONFIG, devices=devices).state


def main() -> None:
    one = trained([], Path(sys.argv[1]))
    state = trained(jax.local_devices(), Path(sys.argv[1]))
    (devices,) = {len(leaf.devices()) for leaf in jax.tree.leaves(state.optimiser)}
    moved = _apart(first_model(), one.model)
    print(devices, moved, _apart(one.model, state.model), abs(one.best_error - state.best_error))


def _apart(one: ContactDynamics, other: ContactDynamics) -> float:
    ours, theirs = module_arrays(one), module_arrays(other)
    return max(float(np.abs(ours[name] - theirs[name]).max()) for name in ours)


if __name__ == "__main__":
    main()
