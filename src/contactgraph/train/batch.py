"""Windows of the runs as arrays on the device, drawn at random inside the compiled loop."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.data.windows import Windows
from contactgraph.model.types import Nodes

_RUNS = 256


class Window(eqx.Module):
    """``L`` steps of a run, or a batch of such with a leading axis.

    Holds no contact labels: training cannot see them.
    """

    position: Float[Array, "*B L+1 N D"]
    """m"""
    velocity: Float[Array, "*B L+1 N D"]
    """m/s"""
    control: Float[Array, "*B L U"]
    """N"""
    nodes: Nodes


class WindowSource(eqx.Module):
    """All runs, and how often each window is to be drawn."""

    position: Float[Array, "R T+1 N D"]
    velocity: Float[Array, "R T+1 N D"]
    control: Float[Array, "R T U"]
    nodes: Nodes
    run: Int[Array, " W"]
    start: Int[Array, " W"]
    cumulative: Float[Array, " W"]
    length: int = eqx.field(static=True)

    def draw(self, count: int, key: PRNGKeyArray) -> Window:
        """`count` windows drawn with the windows' probabilities."""
        uniform = jax.random.uniform(key, (count,))
        drawn = jnp.searchsorted(self.cumulative, uniform * self.cumulative[-1], side="right")
        return self.take(jnp.minimum(drawn, self.run.shape[0] - 1))

    def take(self, window: Int[Array, " B"]) -> Window:
        """The windows of these numbers."""
        run, start = self.run[window], self.start[window]
        states = start[:, None] + jnp.arange(self.length + 1)
        steps = states[:, :-1]
        return Window(
            position=self.position[run[:, None], states],
            velocity=self.velocity[run[:, None], states],
            control=self.control[run[:, None], steps],
            nodes=jax.tree.map(lambda leaf: leaf[run], self.nodes),
        )


def window_source(runs: TrajectoryBatch, windows: Windows) -> WindowSource:
    """Put runs and windows on the device.

    Runs are padded to a multiple of `_RUNS`, and windows as if every run had the longest one's:
    compiling a training takes longer than many a training, and like this another number of runs
    compiles nothing anew. Padding has no probability.
    """
    count, steps = runs.control.shape[:2]
    more_runs = -count % _RUNS
    most = (count + more_runs) * (steps - windows.length + 1)

    def padded(values: np.ndarray, dtype: DTypeLike) -> Array:
        # What is there is repeated: even a draw that rounding leads astray is a real one.
        return jnp.asarray(np.take(values, np.arange(count + more_runs) % count, axis=0), dtype)

    drawn = np.arange(most) % len(windows.run)
    cumulative = np.ones(most)
    cumulative[: len(windows.run)] = windows.probability.cumsum() / windows.probability.sum()
    return WindowSource(
        position=padded(runs.position, jnp.float32),
        velocity=padded(runs.velocity, jnp.float32),
        control=padded(runs.control, jnp.float32),
        nodes=Nodes(
            actuated=padded(runs.actuated, bool),
            mask=padded(runs.node_mask, bool),
            candidate=padded(runs.candidate, bool),
            anchor=None if runs.anchor is None else padded(runs.anchor, jnp.float32),
        ),
        run=jnp.asarray(windows.run[drawn]),
        start=jnp.asarray(windows.start[drawn]),
        cumulative=jnp.asarray(cumulative, jnp.float32),
        length=windows.length,
    )


Tree = TypeVar("Tree")

_WINDOWS = "windows"


@dataclass(frozen=True)
class BatchSplit:
    """Devices in a row. XLA adds up what they find, once a step, for the gradient."""

    mesh: Mesh

    def parted(self, batch: Tree) -> Tree:
        """Every array's leading axis, which is the windows', is split over the devices."""
        return eqx.filter_shard(batch, NamedSharding(self.mesh, PartitionSpec(_WINDOWS)))

    def everywhere(self, tree: Tree) -> Tree:
        """Every device has all of it."""
        return eqx.filter_shard(tree, NamedSharding(self.mesh, PartitionSpec()))


def batch_split(devices: Sequence[jax.Device], batch_size: int) -> BatchSplit | None:
    """None for fewer than two devices: nothing is split.

    Raises `InvalidInputError` where the windows of a batch do not come out even.
    """
    if len(devices) < 2:
        return None
    if batch_size % len(devices):
        raise InvalidInputError(
            f"a batch of {batch_size} windows cannot be split evenly over {len(devices)} devices"
        )
    return BatchSplit(Mesh(np.asarray(devices), (_WINDOWS,)))


_TRIES = 8
_REST = 1e-6
"""Speed, m/s, below which a body rests."""


def has_resting_bodies(runs: TrajectoryBatch) -> bool:
    """Whether free bodies that nothing actuates are ever seen at rest.

    Where they never are (they fall, or flow, or hang on hinges) a resting bystander would be a lie.
    """
    if runs.anchor is not None:
        return False
    speed = np.linalg.norm(runs.velocity[:, :-1], axis=-1)
    exists = runs.node_mask[:, None, :] & runs.step_mask[:, :, None]
    return bool(np.any((speed < _REST) & exists & ~runs.actuated[:, None, :]))


def add_distractor(
    windows: Window,
    nearest: Float[Array, ""] | float,
    farthest: Float[Array, ""] | float,
    key: PRNGKeyArray,
) -> Window:
    """Every window of a batch with one more node, at rest, not actuated.

    It stands `nearest` to `farthest` [m] from some body at some step, and never nearer than
    `nearest` to any, not even between two states. Where several tries find no such place the
    node is masked out.
    """
    batch, states, count, dimension = windows.position.shape
    keys = jax.random.split(key, batch)
    place, found = jax.vmap(
        lambda position, mask, key: _place(position, mask, nearest, farthest, key)
    )(windows.position, windows.nodes.mask, keys)
    position = jnp.broadcast_to(place[:, None, None, :], (batch, states, 1, dimension))
    edges = jnp.ones((batch, count), bool)
    return dataclasses.replace(
        windows,
        position=jnp.concatenate([windows.position, position], axis=2),
        velocity=jnp.concatenate([windows.velocity, jnp.zeros_like(position)], axis=2),
        nodes=Nodes(
            actuated=jnp.concatenate([windows.nodes.actuated, jnp.zeros((batch, 1), bool)], 1),
            mask=jnp.concatenate([windows.nodes.mask, found[:, None]], axis=1),
            # `pair_indices` lists the pairs of a new last node after all others.
            candidate=jnp.concatenate([windows.nodes.candidate, edges], axis=1),
        ),
    )


def _place(
    position: Float[Array, "L N D"],
    mask: Array,
    nearest: Float[Array, ""] | float,
    farthest: Float[Array, ""] | float,
    key: PRNGKeyArray,
) -> tuple[Float[Array, " D"], Array]:
    """A place for one bystander [m], and whether it keeps its distance."""
    node_key, step_key, direction_key, radius_key = jax.random.split(key, 4)
    node = jax.random.categorical(node_key, jnp.where(mask, 0.0, -jnp.inf), shape=(_TRIES,))
    step = jax.random.randint(step_key, (_TRIES,), 0, position.shape[0])
    direction = jax.random.normal(direction_key, (_TRIES, position.shape[-1]))
    direction = direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)
    radius = jax.random.uniform(radius_key, (_TRIES, 1), minval=nearest, maxval=farthest)
    places = position[step, node] + radius * direction
    distance = _distance_to_paths(places, position)
    clear = jnp.min(jnp.where(mask, distance, jnp.inf), axis=(1, 2)) >= nearest
    return places[jnp.argmax(clear)], jnp.any(clear)


def _distance_to_paths(
    places: Float[Array, "tries D"], position: Float[Array, "L N D"]
) -> Float[Array, "tries L-1 N"]:
    """How near every node comes to each place on its straight way from state to state, m."""
    begin, way = position[:-1], position[1:] - position[:-1]
    reach = places[:, None, None] - begin
    length = jnp.maximum(jnp.sum(way**2, axis=-1), _REST**2)
    part = jnp.clip(jnp.sum(reach * way, axis=-1) / length, 0.0, 1.0)
    return jnp.linalg.norm(reach - part[..., None] * way, axis=-1)
