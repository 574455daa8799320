"""From your own arrays to a model: three balls in space that bounce off each other.

Usage: python examples/02_own_data.py [FOLDER]

This example uses none of the tasks: the arrays can come from any simulator or camera.
"""

import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

from contactgraph.data import (
    Scene,
    Trajectory,
    read_trajectories,
    split_by_trajectory,
    write_trajectories,
)
from contactgraph.evaluate import evaluate_open_loop
from contactgraph.model import ModelConfig, ours
from contactgraph.train import TrainConfig, fit, initial_state

DT, STEPS, SUBSTEPS, DIAMETER = 0.02, 100, 20, 0.2  # s, -, -, m
SCENE = Scene(
    node_name=("pusher", "red", "blue"),
    node_type=("pusher", "ball", "ball"),
    actuated=np.array([True, False, False]),
    dt=DT,
    dimension=3,
)


def simulate(rng: np.random.Generator) -> Trajectory:
    """Balls of 1 kg; where two overlap, a spring (500 N/m) and a damper push them apart."""
    x = rng.uniform(-0.2, 0.2, 3) + np.array([[0.0, 0, 0], [0.4, 0, 0], [0.8, 0, 0]])
    v = np.zeros((3, 3))
    u = rng.normal([2.0, 0.0, 0.0], [1.0, 0.1, 0.1], (STEPS, 3))
    states = [(x, v)]
    for t in range(STEPS * SUBSTEPS):
        apart = x[:, None] - x[None, :]  # [N, N, 3]
        distance = np.linalg.norm(apart, axis=-1, keepdims=True) + 1e-9
        push = np.where(distance < DIAMETER, 500.0 * (DIAMETER - distance), 0.0)
        drag = np.where(distance < DIAMETER, 5.0, 0.0) * (v[:, None] - v[None, :])
        force = (push * apart / distance - drag).sum(axis=1)
        force[0] += u[t // SUBSTEPS]
        v = v + force * DT / SUBSTEPS
        x = x + v * DT / SUBSTEPS
        if (t + 1) % SUBSTEPS == 0:
            states.append((x, v))
    position, velocity = (np.stack(each) for each in zip(*states, strict=True))
    return Trajectory(SCENE, position, velocity, u)  # contacts are optional


folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
write_trajectories(folder / "balls.h5", [simulate(np.random.default_rng(i)) for i in range(16)])
dataset = read_trajectories(folder / "balls.h5")  # `contactgraph train` reads it, too
print(f"{folder / 'balls.h5'}: {len(dataset)} trajectories, {dataset.dimension} dimensions")

train, test = split_by_trajectory(dataset, held_out_fraction=0.25, seed=0)
model = ours(ModelConfig(3, 3, DT, contact_distance=DIAMETER, width=16), key=jax.random.key(0))
config = TrainConfig(steps=400, check_every=400, batch_size=16, window_length=4, rollout_from=1.0)
result = fit(initial_state(model, config, seed=0), train, test, config)
metrics = evaluate_open_loop(result.model, test, horizon_s=0.2)
print(f"0.2 s ahead: {1000 * metrics['n_step_rmse_moving_m']:.1f} mm")
print(f"  constant velocity: {1000 * metrics['constant_velocity_rmse_moving_m']:.1f} mm")
