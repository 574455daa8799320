"""The baselines that are fitted to training data: least squares and an interaction network.

The network is trained for a given time, on rollouts of recorded windows.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Nodes,
    Trajectory,
    TrajectoryBatch,
    pad_trajectories,
    split_by_trajectory,
)
from contactgraph.data.turns import generalized_coordinates
from contactgraph.evaluate.interaction_network import InputScales, InteractionNetwork
from contactgraph.evaluate.least_squares import LeastSquares, fit_least_squares
from contactgraph.identify import scene_facts
from contactgraph.identify.shapes import with_turning
from contactgraph.model import scene_nodes
from contactgraph.train import TrainConfig
from contactgraph.train.batch import (
    WindowSource,
    add_distractor,
    has_resting_bodies,
    window_source,
)

_OPTIMISER = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
_CHUNK = 50
"""Optimiser steps a call; the time is looked at in between."""
_BATCH = 32
_RATE = 5e-3
_HELD_OUT = 0.1
_CHECKED = 128
_STARTS = 64
"""Predictions are padded to multiples of this many starts, which limits compilations."""
_WINDOW = 8
"""Steps of a rollout in training."""
_FARTHEST = 12.0
"""Greatest distance of a distractor, in least distances: a network has no cutoff, and where it has
seen distractors near by only, those far away disturb it."""


class NetworkWindows(eqx.Module):
    """Windows to draw, with distractors, as the training of our model draws them."""

    source: WindowSource
    distractors: int = eqx.field(static=True)
    nearest: float = eqx.field(static=True)
    """Least distance of a distractor from other bodies, m."""

    def draw(self, count: int, key: PRNGKeyArray) -> TrajectoryBatch[Array]:
        """``count`` windows."""
        draw_key, *place_keys = jax.random.split(key, 1 + self.distractors)
        windows = self.source.draw(count, draw_key)
        for place_key in place_keys:
            windows = add_distractor(windows, self.nearest, _FARTHEST * self.nearest, place_key)
        return windows


def network_windows(dataset: Dataset) -> NetworkWindows:
    """The windows of a dataset."""
    batch = pad_trajectories(dataset, contacts=False, turn_length=turn_length(dataset))
    length = min(_WINDOW, int(batch.steps.max()))
    return NetworkWindows(
        source=window_source(batch, length, TrainConfig().event_fraction),
        distractors=TrainConfig().bystanders if has_resting_bodies(batch) else 0,
        nearest=1.03 * scene_facts(dataset).config.contact_distance,
    )


def turn_length(dataset: Dataset) -> float | None:
    """Length by which the network counts angles, m; None: no body turns in the plane."""
    told = scene_facts(dataset).config
    return with_turning(told, dataset).turn_length if dataset.dimension == 2 else None


def input_scales(dataset: Dataset) -> InputScales:
    """Root mean squares over all trajectories, bodies and steps."""
    position = np.concatenate([each.position.reshape(-1) for each in dataset])
    velocity = np.concatenate([each.velocity.reshape(-1) for each in dataset])
    change = np.concatenate([np.diff(each.velocity, axis=0).reshape(-1) for each in dataset])
    control = np.concatenate([each.control for each in dataset])

    def size(values: np.ndarray) -> float:
        found = float(np.sqrt(np.mean(values**2)))
        return found if found > 0.0 else 1.0

    return InputScales(
        contact_distance=scene_facts(dataset).config.contact_distance,
        position=size(position),
        speed=size(velocity),
        speed_change=size(change),
        control=tuple(size(each) for each in control.T),
        dt=dataset.dt,
        turn_length=turn_length(dataset),
    )


@dataclass(frozen=True, eq=False)
class FittedNetwork:
    """A trained network, which predicts as a `Baseline`."""

    network: InteractionNetwork
    seconds: float
    """Time of training, compilation included."""
    steps: int
    """Optimiser steps."""

    def __call__(self, trajectory: Trajectory, steps: int) -> np.ndarray:
        """[S, H, N, D] m: the predictions; with a last column of angles, rad, if bodies turn."""
        starts = trajectory.steps - steps + 1
        ahead = np.arange(starts + -starts % _STARTS).clip(max=starts - 1)
        controls = trajectory.control[ahead[:, None] + np.arange(steps)]
        length = self.network.scales.turn_length
        turning = trajectory.orientation, trajectory.angular_velocity
        states = generalized_coordinates(length, trajectory.position, trajectory.velocity, *turning)
        arrays = (*(np.nan_to_num(each[ahead]) for each in states), controls)
        nodes = scene_nodes(trajectory.scene)
        found = _rollouts(self.network, nodes, *(jnp.asarray(each, jnp.float32) for each in arrays))
        predicted = np.array(found[:starts], np.float64)
        if length is not None:
            predicted[..., -1] /= length
        return predicted


@eqx.filter_jit
def _rollouts(network: InteractionNetwork, nodes: Nodes, *windows: Array) -> Array:
    return jax.vmap(network.rollout, (None, 0, 0, 0))(nodes, *windows)[0]


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
    windows, checked = network_windows(train), network_windows(held_out)
    checks = checked.draw(_CHECKED, jax.random.key(1))
    scales = input_scales(dataset)
    network = InteractionNetwork(dataset.dimension, types, scales, jax.random.key(seed))
    params, static = eqx.partition(network, eqx.is_inexact_array)
    optimiser = _OPTIMISER.init(params)
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
    return FittedNetwork(eqx.combine(best, static), spent, steps)


@eqx.filter_jit
def _advance(
    params: InteractionNetwork,
    static: InteractionNetwork,
    optimiser_state: optax.OptState,
    windows: NetworkWindows,
    checks: TrajectoryBatch[Array],
    rate: Float[Array, ""],
    first: Int[Array, ""],
) -> tuple[InteractionNetwork, optax.OptState, Float[Array, ""]]:
    """`_CHUNK` steps of Adam, then the held-out error, m."""

    def step(carry: tuple, number: Array) -> tuple[tuple, None]:
        params, state = carry
        key = jax.random.fold_in(jax.random.key(0), number)
        drawn = windows.draw(_BATCH, key)
        gradient = jax.grad(lambda params: _errors(eqx.combine(params, static), drawn)[0])(params)
        updates, state = _OPTIMISER.update(gradient, state)
        updates = jax.tree.map(lambda leaf: -rate * leaf, updates)
        return (optax.apply_updates(params, updates), state), None

    numbers = first + jnp.arange(_CHUNK)
    (params, state), _ = jax.lax.scan(step, (params, optimiser_state), numbers)
    return params, state, _errors(eqx.combine(params, static), checks)[1]


def _errors(
    network: InteractionNetwork, windows: TrajectoryBatch[Array]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The loss over rollouts, and the root mean square position error, m."""
    position, velocity = jax.vmap(network.rollout)(
        windows.nodes, windows.position[:, 0], windows.velocity[:, 0], windows.control
    )
    counted = windows.nodes.mobile[:, None]
    off = jnp.sum((position - windows.position[:, 1:]) ** 2, axis=-1)
    wrong = jnp.sum((velocity - windows.velocity[:, 1:]) ** 2, axis=-1)
    scales = network.scales
    scaled = off / scales.dt**2 + wrong
    loss = jnp.mean(scaled / scales.speed_change**2, where=counted)
    return loss, jnp.sqrt(jnp.mean(off, where=counted))


def fit_baselines(
    train: Dataset, test: Dataset, seconds: float, least_steps: int
) -> tuple[LeastSquares, FittedNetwork]:
    """Both fitted to ``train``, the network for ``seconds`` and ``least_steps`` of its optimiser.

    Raises `InvalidInputError` where the two datasets differ in dimension, control size or time
    step, or where ``train`` has fewer than two trajectories.
    """
    for name in ("dimension", "control_size", "dt"):
        found, wanted = getattr(train, name), getattr(test, name)
        if abs(found - wanted) > 1e-6 * wanted:
            raise InvalidInputError(
                f"training data of baselines must have the {name} of the test data, {wanted:g}, "
                f"found {found:g}"
            )
    return fit_least_squares(train), fit_interaction_network(train, seconds, least_steps)
