"""Training of the interaction network, for a given time, on rollouts of recorded windows."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from contactgraph.data import Dataset, Trajectory, TrajectoryBatch, split_by_trajectory
from contactgraph.data.turns import generalized_coordinates
from contactgraph.evaluate.interaction_network import InteractionNetwork
from contactgraph.evaluate.network_inputs import (
    NetworkWindows,
    SceneInputs,
    input_scales,
    network_windows,
    scene_inputs,
)

_CHUNK = 50
"""Optimiser steps a call; the time is looked at in between."""
_BATCH = 32
_RATE = 5e-3
_HELD_OUT = 0.1
_CHECKED = 128
_STARTS = 64
"""Predictions are padded to multiples of this many starts, which limits compilations."""


@dataclass(frozen=True, eq=False)
class FittedNetwork:
    """A trained network, which predicts as a `Baseline`."""

    network: InteractionNetwork
    types: tuple[str, ...]
    seconds: float
    """Time of training, compilation included."""
    steps: int
    """Optimiser steps."""

    def __call__(self, trajectory: Trajectory, steps: int) -> np.ndarray:
        """[S, H, N, D] m: the predictions; with a last column of angles, rad, if bodies turn."""
        scene = scene_inputs(
            trajectory.scene, trajectory.control_size, self.types, trajectory.scene.node_count
        )
        starts = trajectory.steps - steps + 1
        ahead = np.arange(starts + -starts % _STARTS).clip(max=starts - 1)
        controls = trajectory.control[ahead[:, None] + np.arange(steps)]
        length = self.network.scales.turn_length
        turning = trajectory.orientation, trajectory.angular_velocity
        states = generalized_coordinates(length, trajectory.position, trajectory.velocity, *turning)
        arrays = (*(np.nan_to_num(each[ahead]) for each in states), controls)
        found = _rollouts(self.network, scene, *(jnp.asarray(each, jnp.float32) for each in arrays))
        predicted = np.array(found[:starts], np.float64)
        if length is not None:
            predicted[..., -1] /= length
        return predicted


@eqx.filter_jit
def _rollouts(
    network: InteractionNetwork,
    scene: SceneInputs,
    position: Array,
    velocity: Array,
    control: Array,
) -> Array:
    return jax.vmap(network.rollout, (None, 0, 0, 0))(scene, position, velocity, control)[0]


def fit_interaction_network(
    dataset: Dataset,
    seconds: float,
    least_steps: int,
    seed: int = 0,
    clock: Callable[[], float] = time.monotonic,
) -> FittedNetwork:
    """Train for ``seconds``, compilation included, and keep what is best on held-out windows.

    Training goes on until ``least_steps`` are made, so that a busy machine does not weaken the
    network. The rate falls along a cosine.
    """
    began = clock()
    train, held_out = split_by_trajectory(dataset, _HELD_OUT, seed)
    types = tuple(sorted({name for each in dataset for name in each.scene.node_type}))
    windows, checked = network_windows(train, types), network_windows(held_out, types)
    checks = checked.draw(_CHECKED, jax.random.key(1))
    scales = input_scales(dataset)
    network = InteractionNetwork(
        dataset.dimension,
        dataset.control_size,
        windows.scenes.features.shape[-1],
        scales,
        jax.random.key(seed),
    )
    params, static = eqx.partition(network, eqx.is_inexact_array)
    optimiser = _optimiser().init(params)
    best, best_error, steps, spent, done = params, np.inf, 0, 0.0, 0.0
    while done < 1.0:
        rate = _RATE * 0.5 * (1.0 + np.cos(np.pi * done))
        params, optimiser, error = _advance(
            params, static, optimiser, windows, checks, jnp.asarray(rate), jnp.asarray(steps)
        )
        if float(error) < best_error:
            best, best_error = params, float(error)
        steps, spent = steps + _CHUNK, clock() - began
        done = min(spent / seconds, steps / least_steps)
    return FittedNetwork(eqx.combine(best, static), types, spent, steps)


def _optimiser() -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())


@eqx.filter_jit
def _advance(
    params: InteractionNetwork,
    static: InteractionNetwork,
    optimiser_state: optax.OptState,
    windows: NetworkWindows,
    checks: tuple[TrajectoryBatch[Array], SceneInputs],
    rate: Float[Array, ""],
    first: Int[Array, ""],
) -> tuple[InteractionNetwork, optax.OptState, Float[Array, ""]]:
    """`_CHUNK` steps of Adam, then the held-out error, m."""

    def step(carry: tuple, number: Array) -> tuple[tuple, None]:
        params, state = carry
        key = jax.random.fold_in(jax.random.key(0), number)
        drawn = windows.draw(_BATCH, key)
        gradient = jax.grad(lambda params: _errors(eqx.combine(params, static), *drawn)[0])(params)
        updates, state = _optimiser().update(gradient, state)
        updates = jax.tree.map(lambda leaf: -rate * leaf, updates)
        return (optax.apply_updates(params, updates), state), None

    numbers = first + jnp.arange(_CHUNK)
    (params, state), _ = jax.lax.scan(step, (params, optimiser_state), numbers)
    return params, state, _errors(eqx.combine(params, static), *checks)[1]


def _errors(
    network: InteractionNetwork, windows: TrajectoryBatch[Array], scenes: SceneInputs
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The loss over rollouts, and the root mean square position error, m."""
    position, velocity = jax.vmap(network.rollout)(
        scenes, windows.position[:, 0], windows.velocity[:, 0], windows.control
    )
    counted = scenes.movable[:, None]
    off = jnp.sum((position - windows.position[:, 1:]) ** 2, axis=-1)
    wrong = jnp.sum((velocity - windows.velocity[:, 1:]) ** 2, axis=-1)
    scales = network.scales
    scaled = off / scales.dt**2 + wrong
    loss = jnp.mean(scaled / scales.speed_change**2, where=counted)
    return loss, jnp.sqrt(jnp.mean(off, where=counted))
