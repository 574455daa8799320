"""One configuration and one split for all tests of training, which then compile one program.

It is the configuration of the fixture `trained`, whose program the compilation cache keeps.
"""

import contextlib
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.data import Dataset, TrajectoryBatch, read_trajectories, split_by_trajectory
from contactgraph.model import PRESETS, ModelConfig, Nodes
from contactgraph.model.io import module_arrays
from contactgraph.train import (
    FitProgress,
    FitResult,
    FitState,
    HeldOutBaselines,
    TrainConfig,
    fit,
    initial_state,
)

CONFIG = TrainConfig(
    steps=12, batch_size=4, window_length=3, rollout_from=0.3, check_every=4, patience=12
)
"""Checks at 4, 8 and 12 steps, the last of them with the rollout term."""

BASELINES = HeldOutBaselines(constant_velocity_rmse_m=2.0, standing_still_rmse_m=3.0, moving=True)


class Enough(Exception):
    """Ends a training after a check."""


def window_of(position, velocity, control, mask: list[bool] | None = None) -> TrajectoryBatch:
    """Windows of states [B, T+1, N, D]: the first body is actuated, all pairs are candidates."""
    batch, _, count, _ = np.shape(position)
    nodes = Nodes(
        actuated=jnp.broadcast_to(jnp.arange(count) == 0, (batch, count)),
        mask=jnp.broadcast_to(jnp.asarray(mask or [True] * count), (batch, count)),
        candidate=jnp.ones((batch, count * (count - 1) // 2), bool),
    )
    states = (jnp.asarray(each, jnp.float32) for each in (position, velocity, control))
    return TrajectoryBatch(*states, None, nodes, jnp.full(batch, np.shape(control)[1]))


def split(path: Path) -> tuple[Dataset, Dataset]:
    return split_by_trajectory(read_trajectories(path), 0.15, 0)


def first_state(seed: int = 0) -> FitState:
    return initial_state(
        PRESETS["ours-recurrent"](ModelConfig(2, 2, 0.05), key=jax.random.key(seed)), CONFIG, seed
    )


def states_until(steps: int, state: FitState, parts: tuple[Dataset, Dataset]) -> FitState:
    """The state at the first check at or after so many steps."""
    states = []

    def on_check(check: FitProgress) -> None:
        states.append(check.state)
        if check.step >= steps:
            raise Enough

    with contextlib.suppress(Enough):
        fit(state, *parts, CONFIG, on_check)
    return states[-1]


def trained_on(
    parts: tuple[Dataset, Dataset],
    state: FitState,
    on_check: Callable[[FitProgress], None] = lambda check: None,
) -> FitResult:
    return fit(state, *parts, CONFIG, on_check)


def assert_bit_equal(found: object, expected: object) -> None:
    ours, theirs = module_arrays(found), module_arrays(expected)
    assert ours.keys() == theirs.keys()
    for name, array in ours.items():
        assert array.dtype == theirs[name].dtype
        np.testing.assert_array_equal(array, theirs[name], err_msg=name)


def bit_equal(first: object, second: object) -> bool:
    ours, theirs = module_arrays(first), module_arrays(second)
    return all(np.array_equal(ours[name], theirs[name]) for name in ours)
