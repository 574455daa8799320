"""Training batches: windows drawn on the device, with distractors, split over devices."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory_batch import PROPERTIES, Nodes, TrajectoryBatch
from contactgraph.data.windows import Windows

Tree = TypeVar("Tree")

_BATCH_MULTIPLE = 256
_PLACEMENT_TRIES = 8
_REST = 1e-6
"""Speed, m/s, below which a body rests."""
_WINDOW_AXIS = "windows"
_OF_TYPE = ("type_id", "half_size", "outlines")
"""Properties that a distractor has of its type."""


class Window(eqx.Module):
    """``L`` steps of a trajectory, or a batch of such windows with a leading axis.

    It holds no contact labels, so training cannot read them.
    """

    position: Float[Array, "*B L+1 N D"]
    """m"""
    velocity: Float[Array, "*B L+1 N D"]
    """m/s"""
    control: Float[Array, "*B L U"]
    """N"""
    nodes: Nodes

    @property
    def learned(self) -> Bool[Array, "*B N"]:
        """The bodies whose motion is learned: those that exist and are not static."""
        return jnp.asarray(self.nodes.mobile)

    def trajectories(self, real: Bool[Array, "B L"]) -> TrajectoryBatch[Array]:
        """A batch of windows as trajectories, whose first steps are ``real``."""
        steps = jnp.sum(real, axis=-1)
        return TrajectoryBatch(self.position, self.velocity, self.control, None, self.nodes, steps)

    def part(self, begin: int, end: int) -> "Window":
        """The steps ``begin`` to ``end`` of a batch of windows."""
        return dataclasses.replace(
            self,
            position=self.position[:, begin : end + 1],
            velocity=self.velocity[:, begin : end + 1],
            control=self.control[:, begin:end],
        )


class WindowSource(eqx.Module):
    """Padded trajectories on the device, and the probability of the window from each state on."""

    trajectories: TrajectoryBatch[Array]
    weight: Float[Array, "B T"]
    """Probability of the window that begins there; 0 where none does."""
    cumulative: Float[Array, " W"]
    """Sum of all probabilities up to each window's, trajectory after trajectory."""
    length: int = eqx.field(static=True)
    """L, steps in a window."""
    reports_touch: bool = eqx.field(static=True, default=True)
    """Whether contacts, where training uses them, are those of bodies that touch; else that hold
    each other."""

    def draw(self, count: int, key: PRNGKeyArray) -> Window:
        """`count` windows drawn with the windows' probabilities."""
        return self.take(self.draw_indices(count, key))

    def draw_indices(self, count: int, key: PRNGKeyArray) -> Int[Array, " B"]:
        """Which windows `draw` takes with this key."""
        return draw_by(self.cumulative, count, key)

    def draw_trajectories(self, count: int, key: PRNGKeyArray) -> "WholeTrajectories":
        """`count` whole trajectories, all equally likely."""
        index = jax.random.randint(key, (count,), 0, self.trajectories.steps.shape[0])
        return self.whole(index)

    def whole(self, index: Int[Array, " B"]) -> "WholeTrajectories":
        """These trajectories."""
        every = self.trajectories
        window = Window(
            position=every.position[index],
            velocity=every.velocity[index],
            control=every.control[index],
            nodes=jax.tree.map(lambda leaf: leaf[index], every.nodes),
        )
        contact = None if every.contact is None else every.contact[index]
        real = jnp.arange(every.control.shape[1]) < every.steps[index, None]
        return WholeTrajectories(window, real, self.weight[index], contact)

    def begins(self, window: Int[Array, " B"]) -> tuple[Int[Array, " B"], Int[Array, " B"]]:
        """The trajectory, and the first state, of the windows of these indices."""
        return jnp.divmod(window, self.weight.shape[1])

    def take(self, window: Int[Array, " B"]) -> Window:
        """The windows of these indices."""
        index, start = self.begins(window)
        states = start[:, None] + jnp.arange(self.length + 1)
        every = self.trajectories
        return Window(
            position=every.position[index[:, None], states],
            velocity=every.velocity[index[:, None], states],
            control=every.control[index[:, None], states[:, :-1]],
            nodes=jax.tree.map(lambda leaf: leaf[index], every.nodes),
        )


def draw_by(cumulative: Float[Array, " W"], count: int, key: PRNGKeyArray) -> Int[Array, " B"]:
    """Indices drawn with probabilities that add up to these sums."""
    uniform = jax.random.uniform(key, (count,))
    drawn = jnp.searchsorted(cumulative, uniform * cumulative[-1], side="right")
    return jnp.minimum(drawn, cumulative.shape[0] - 1)


class WholeTrajectories(eqx.Module):
    """Some trajectories from their first to their last state, on the device."""

    states: Window
    real: Bool[Array, "B T"]
    """Whether a step is one, and no padding."""
    weight: Float[Array, "B T"]
    """`WindowSource.weight`"""
    contact: Float[Array, "B T+1 E"] | None
    """Recorded contacts where training uses them."""


def window_source(
    batch: TrajectoryBatch[np.ndarray],
    windows: Windows,
    contacts: bool = False,
) -> WindowSource:
    """Put trajectories and windows on the device, without contact labels unless ``contacts``.

    The batch is padded to a multiple of `_BATCH_MULTIPLE` trajectories, so that another number of
    trajectories recompiles nothing. Padding repeats real entries and has no probability.
    """
    count, steps = batch.control.shape[:2]
    capacity = count + -count % _BATCH_MULTIPLE

    def repeated(leaf: np.ndarray) -> Array:
        dtype = jnp.float32 if np.issubdtype(leaf.dtype, np.floating) else None
        return jnp.asarray(np.take(leaf, np.arange(capacity) % count, axis=0), dtype)

    weight = np.zeros((capacity, steps))
    weight[windows.trajectory, windows.start] = windows.probability
    cumulative = weight.ravel().cumsum() / windows.probability.sum()
    return WindowSource(
        trajectories=jax.tree.map(repeated, batch if contacts else batch._replace(contact=None)),
        weight=jnp.asarray(weight, jnp.float32),
        cumulative=jnp.asarray(cumulative, jnp.float32),
        length=windows.length,
    )


@dataclass(frozen=True)
class BatchSplit:
    """Data parallelism over a row of devices; XLA sums the gradient over them."""

    mesh: Mesh

    def shard(self, batch: Tree) -> Tree:
        """Split every array's leading axis, the windows, over the devices."""
        return eqx.filter_shard(batch, NamedSharding(self.mesh, PartitionSpec(_WINDOW_AXIS)))

    def replicate(self, tree: Tree) -> Tree:
        """Copy every array to all devices."""
        return eqx.filter_shard(tree, NamedSharding(self.mesh, PartitionSpec()))


def batch_split(devices: Sequence[jax.Device], batch_size: int) -> BatchSplit | None:
    """The split of a batch over the devices; None for fewer than two.

    Raises `InvalidInputError` where the windows of a batch cannot be divided evenly.
    """
    if len(devices) < 2:
        return None
    if batch_size % len(devices):
        raise InvalidInputError(
            f"a batch of {batch_size} windows cannot be split evenly over {len(devices)} devices"
        )
    return BatchSplit(Mesh(np.asarray(devices), (_WINDOW_AXIS,)))


def has_resting_bodies(batch: TrajectoryBatch[np.ndarray]) -> bool:
    """Whether a free body without actuation is at rest in any recorded state, but for static ones.

    A resting distractor would contradict data in which such bodies never rest, because they fall,
    slide or hang on hinges.
    """
    nodes = batch.nodes
    if nodes.anchor is not None:
        return False
    speed = np.linalg.norm(batch.velocity[:, :-1], axis=-1)
    return bool(np.any((speed < _REST) & nodes.passive[:, None, :] & batch.step_mask[:, :, None]))


def add_distractor(
    windows: Window,
    nearest: Float[Array, ""] | float,
    farthest: Float[Array, ""] | float,
    key: PRNGKeyArray,
) -> Window:
    """Add a resting node without actuation to every window of a batch, out of contact.

    Trajectories of two bodies show no third body at rest. The model assumes anyway that a body out
    of contact changes nothing (its prior is distance); the added node says so without recording.

    Its distance [m] is `nearest` to `farthest` from some body at some step, and at least `nearest`
    from every body, also between two states. The node is masked out where several tries find no
    such position.
    """
    batch, states, count, dimension = windows.position.shape
    keys = jax.random.split(key, batch)
    place = windows.position
    if windows.nodes.outlines is not None:
        # An outline lies within a circle about its node, which any turn of it keeps.
        place = place[..., : windows.nodes.outlines.shape[-1]]
        wide = 2.0 * jnp.max(jnp.linalg.norm(windows.nodes.outlines, axis=-1))
        nearest, farthest = nearest + wide, farthest + wide
    drawn, clear = jax.vmap(
        lambda position, mask, key: _distractor_position(position, mask, nearest, farthest, key)
    )(place, windows.nodes.mask, keys)
    drawn = jnp.pad(drawn, ((0, 0), (0, dimension - drawn.shape[1])))
    position = jnp.broadcast_to(drawn[:, None, None, :], (batch, states, 1, dimension))
    edges = jnp.ones((batch, count), bool)
    return dataclasses.replace(
        windows,
        position=jnp.concatenate([windows.position, position], axis=2),
        velocity=jnp.concatenate([windows.velocity, jnp.zeros_like(position)], axis=2),
        nodes=_with_distractor(windows.nodes, clear, edges),
    )


def _with_distractor(nodes: Nodes, exists: Bool[Array, " B"], edges: Bool[Array, "B N"]) -> Nodes:
    """One more node, of the type of the first that is neither actuated nor static."""
    first = jnp.argmax(nodes.passive, axis=1)[:, None]
    # `pair_indices` lists the pairs of a new last node after all others.
    last: dict[str, Array] = {"mask": exists[:, None], "candidate": edges}
    for name, field in PROPERTIES.items():
        values = getattr(nodes, name)
        if values is not None and field.axis[0] == "N":
            last[name] = jnp.full_like(values[:, :1], field.padding)
            if name in _OF_TYPE:
                of_first = first.reshape(-1, *(1,) * (values.ndim - 1))
                last[name] = jnp.take_along_axis(values, of_first, axis=1)
    return nodes._replace(
        **{name: jnp.concatenate([getattr(nodes, name), each], 1) for name, each in last.items()}
    )


def _distractor_position(
    position: Float[Array, "L N D"],
    mask: Array,
    nearest: Float[Array, ""] | float,
    farthest: Float[Array, ""] | float,
    key: PRNGKeyArray,
) -> tuple[Float[Array, " D"], Array]:
    """A position for one distractor [m], and whether it keeps its distance."""
    node_key, step_key, direction_key, radius_key = jax.random.split(key, 4)
    tries = _PLACEMENT_TRIES
    node = jax.random.categorical(node_key, jnp.where(mask, 0.0, -jnp.inf), shape=(tries,))
    step = jax.random.randint(step_key, (tries,), 0, position.shape[0])
    direction = jax.random.normal(direction_key, (tries, position.shape[-1]))
    direction = direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)
    radius = jax.random.uniform(radius_key, (tries, 1), minval=nearest, maxval=farthest)
    points = position[step, node] + radius * direction
    distance = _distance_to_paths(points, position)
    clear = jnp.min(jnp.where(mask, distance, jnp.inf), axis=(1, 2)) >= nearest
    return points[jnp.argmax(clear)], jnp.any(clear)


def _distance_to_paths(
    points: Float[Array, "tries D"], position: Float[Array, "L N D"]
) -> Float[Array, "tries L-1 N"]:
    """Distance of each point to every node's straight path from state to state, m."""
    begin, path = position[:-1], position[1:] - position[:-1]
    offset = points[:, None, None] - begin
    length = jnp.maximum(jnp.sum(path**2, axis=-1), _REST**2)
    fraction = jnp.clip(jnp.sum(offset * path, axis=-1) / length, 0.0, 1.0)
    return jnp.linalg.norm(offset - fraction[..., None] * path, axis=-1)
