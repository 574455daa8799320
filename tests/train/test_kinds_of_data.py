"""Every kind of dataset trains by the command's defaults, from first to last step."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import Scene, Trajectory, write_trajectories
from contactgraph.model.io import load_model, module_arrays
from contactgraph.train import RunFolder

STEPS = 24


def discs(seed: int, **changes: object) -> Trajectory:
    """Three discs of radius 0.05 m that bounce in the plane, without control."""
    rng = np.random.default_rng(seed)
    position = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.4]]) + rng.uniform(-0.02, 0.02, (3, 2))
    velocity = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, -0.4]])
    dt, positions, velocities = 0.05, [position], [velocity]
    for _ in range(STEPS):
        velocity = velocity.copy()
        for first, second in ((0, 1), (0, 2), (1, 2)):
            apart = position[second] - position[first]
            normal = apart / np.linalg.norm(apart)
            closing = normal @ (velocity[first] - velocity[second])
            if np.linalg.norm(apart) < 0.1 and closing > 0:
                velocity[first] -= closing * normal
                velocity[second] += closing * normal
        position = position + dt * velocity
        positions.append(position)
        velocities.append(velocity)
    names = ("a", "b", "c")
    scene = Scene(names, ("disc",) * 3, np.zeros(3, bool), dt)
    scene = dataclasses.replace(scene, **changes)
    return Trajectory(scene, np.stack(positions), np.stack(velocities), np.zeros((STEPS, 0)))


def pillar(seed: int) -> Trajectory:
    """The third body of `discs` is static, and stands where the others pass."""
    run = discs(seed, static=np.array([False, False, True]))
    position, velocity = run.position.copy(), run.velocity.copy()
    position[:, 2], velocity[:, 2] = [0.1, 0.1], 0.0
    return dataclasses.replace(run, position=position, velocity=velocity)


def two_or_three(seed: int) -> Trajectory:
    run = discs(seed)
    if seed % 2:
        return run
    scene = Scene(("a", "b"), ("disc",) * 2, np.zeros(2, bool), run.scene.dt)
    return Trajectory(scene, run.position[:, :2], run.velocity[:, :2], run.control)


def servo(seed: int, dimension: int, kinds: tuple[str, ...], dt: float) -> Trajectory:
    """A hand that follows its command and pushes a block along the first axis."""
    rng = np.random.default_rng(seed)
    hand = np.zeros((STEPS + 1, dimension))
    block = np.zeros((STEPS + 1, dimension))
    block[:, 0] = 0.1
    control = rng.uniform(-0.01, 0.03, (STEPS, len(kinds)))
    for step in range(STEPS):
        hand[step + 1] = hand[step] + control[step, :dimension]
        block[step + 1] = block[step]
        block[step + 1, 0] = max(block[step, 0], hand[step + 1, 0] + 0.05)
    position = np.stack([hand, block], axis=1)
    velocity = np.concatenate([np.zeros_like(position[:1]), np.diff(position, axis=0) / dt])
    if kinds[0] == "position":
        control[:, :dimension] += hand[:-1]
    scene = Scene(
        ("hand", "block"),
        ("hand", "block"),
        np.array([True, False]),
        dt,
        dimension=dimension,
        control_kind=kinds,
    )
    return Trajectory(scene, position, velocity, control)


def single(seed: int) -> Trajectory:
    """One body that is pushed about."""
    control = np.random.default_rng(seed).normal(size=(STEPS, 2))
    velocity = np.concatenate([np.zeros((1, 2)), np.cumsum(0.05 * control, axis=0)])
    position = np.cumsum(0.05 * velocity, axis=0)
    scene = Scene(("hand",), ("hand",), np.array([True]), 0.05)
    return Trajectory(scene, position[:, None], velocity[:, None], control)


def at_10_hz(seed: int) -> Trajectory:
    return servo(seed, 2, ("position", "position"), 0.1)


def in_space(seed: int) -> Trajectory:
    return servo(seed, 3, ("displacement", "displacement", "displacement"), 0.04)


def with_a_switch(seed: int) -> Trajectory:
    """A component of the control, beyond the degrees of freedom, that moves nothing."""
    return servo(seed, 3, ("displacement", "displacement", "displacement", "switch"), 0.04)


@pytest.mark.slow
@pytest.mark.parametrize(
    "record",
    [discs, pillar, two_or_three, single, at_10_hz, in_space, with_a_switch],
    ids=lambda record: record.__name__,
)
def test_it_trains_by_the_defaults(record: Callable[[int], Trajectory], tmp_path: Path) -> None:
    data, run = tmp_path / "data.h5", tmp_path / "run"
    write_trajectories(data, [record(seed) for seed in range(5)])
    options = ["--steps", "12", "--batch-size", "4"]
    assert cli.run(["train", str(data), "--out", str(run), *options]) == 0
    (row,) = RunFolder(run).metrics()
    assert all(np.isfinite(value) for value in row.values()) and row["step"] == 12
    weights = module_arrays(load_model(run / "model.safetensors").model)
    assert all(np.isfinite(each).all() for each in weights.values())
