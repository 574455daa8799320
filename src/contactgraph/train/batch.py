"""Training batches: windows drawn on the device, with distractors; in parts, and over devices."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.padding import PROPERTIES
from contactgraph.data.trajectory_batch import Nodes, TrajectoryBatch
from contactgraph.data.windows import window_weights

Tree = TypeVar("Tree")
_Result = TypeVar("_Result")

_BATCH_MULTIPLE = 256
_EDGES = 200
"""Edges per chunk: with networks of width 32, 64 to 200 took the least time."""
_PLACEMENT_TRIES = 8
_REST = 1e-6
"""Speed, m/s, below which a body rests."""
_WINDOW_AXIS = "windows"
_OF_TYPE = ("type_id", "half_size", "outlines")
"""Properties that a distractor has of its type."""


class WindowSource(eqx.Module):
    """Padded trajectories on the device, and the probability of the window from each state on."""

    trajectories: TrajectoryBatch[Array]
    weight: Float[Array, "B T"]
    """Probability of the window that begins there; 0 where none does."""
    cumulative: Float[Array, " W"]
    """Sum of all probabilities up to each window's, trajectory after trajectory."""
    length: int = eqx.field(static=True)
    """L, steps in a window."""

    def draw(self, count: int, key: PRNGKeyArray) -> TrajectoryBatch[Array]:
        """`count` windows drawn with the windows' probabilities."""
        return self.take(*self.draw_starts(count, key))

    def draw_starts(
        self, count: int, key: PRNGKeyArray
    ) -> tuple[Int[Array, " B"], Int[Array, " B"]]:
        """The trajectory, and the first state, of each window that `draw` takes with this key."""
        uniform = jax.random.uniform(key, (count,))
        drawn = jnp.searchsorted(self.cumulative, uniform * self.cumulative[-1], side="right")
        return jnp.divmod(jnp.minimum(drawn, self.cumulative.shape[0] - 1), self.weight.shape[1])

    def take(self, trajectory: Int[Array, " B"], start: Int[Array, " B"]) -> TrajectoryBatch[Array]:
        """These windows, without contact labels, so that training cannot read them."""
        states = start[:, None] + jnp.arange(self.length + 1)
        rows, every = trajectory[:, None], self.trajectories
        return TrajectoryBatch(
            position=every.position[rows, states],
            velocity=every.velocity[rows, states],
            control=every.control[rows, states[:, :-1]],
            contact=None,
            nodes=jax.tree.map(lambda leaf: leaf[trajectory], every.nodes),
            steps=jnp.full_like(start, self.length),
        )

    def some(self, index: Int[Array, " B"]) -> "WindowSource":
        """The windows of these trajectories alone."""
        every, weight = jax.tree.map(lambda leaf: leaf[index], (self.trajectories, self.weight))
        return WindowSource(every, weight, jnp.cumsum(weight.ravel()), self.length)

    def draw_trajectories(self, count: int, key: PRNGKeyArray) -> "WindowSource":
        """The windows of `count` trajectories, all equally likely."""
        return self.some(jax.random.randint(key, (count,), 0, self.weight.shape[0]))


def window_source(
    batch: TrajectoryBatch[np.ndarray], length: int, event_fraction: float
) -> WindowSource:
    """Put trajectories on the device, and find their windows: see `window_weights`.

    The batch is padded to a multiple of `_BATCH_MULTIPLE` trajectories, so that another number of
    trajectories recompiles nothing. Padding repeats real entries and has no probability.
    """
    windows = window_weights(batch, length, event_fraction)
    count, steps = batch.control.shape[:2]
    capacity = count + -count % _BATCH_MULTIPLE

    def repeated(leaf: np.ndarray) -> Array:
        dtype = jnp.float32 if np.issubdtype(leaf.dtype, np.floating) else None
        return jnp.asarray(np.take(leaf, np.arange(capacity) % count, axis=0), dtype)

    weight = np.zeros((capacity, steps))
    weight[windows.trajectory, windows.start] = windows.probability
    cumulative = weight.ravel().cumsum() / windows.probability.sum()
    return WindowSource(
        trajectories=jax.tree.map(repeated, batch),
        weight=jnp.asarray(weight, jnp.float32),
        cumulative=jnp.asarray(cumulative, jnp.float32),
        length=length,
    )


@dataclass(frozen=True)
class BatchSplit:
    """Splits batches over devices; for fewer than two it changes nothing.

    XLA sums the gradient over them.
    """

    devices: tuple[jax.Device, ...] = ()

    @property
    def parts(self) -> int:
        """Number of equal parts of a batch."""
        return max(1, len(self.devices))

    def shard(self, batch: Tree) -> Tree:
        """Split every array's leading axis, the windows, over the devices."""
        return self._placed(batch, PartitionSpec(_WINDOW_AXIS))

    def replicate(self, tree: Tree) -> Tree:
        """Copy every array to all devices."""
        return self._placed(tree, PartitionSpec())

    def _placed(self, tree: Tree, spec: PartitionSpec) -> Tree:
        if self.parts == 1:
            return tree
        mesh = Mesh(np.asarray(self.devices), (_WINDOW_AXIS,))
        return eqx.filter_shard(tree, NamedSharding(mesh, spec))


def batch_split(devices: Sequence[jax.Device], batch_size: int) -> BatchSplit:
    """The split of a batch over the devices.

    Raises `InvalidInputError` where the windows of a batch cannot be divided evenly.
    """
    split = BatchSplit(tuple(devices))
    if batch_size % split.parts:
        raise InvalidInputError(
            f"a batch of {batch_size} windows cannot be split evenly over {len(devices)} devices"
        )
    return split


def chunked_vmap(
    function: Callable[..., _Result], *arguments: PyTree, edges: int, devices: int = 1
) -> _Result:
    """The function of every item, stacked; every leaf of the arguments has the items as first axis.

    Where all items, with so many `edges` each, exceed the cache, the chunks run one after another,
    and gradients recompute each chunk instead of storing its temporaries. Each of several `devices`
    computes an equal part of the items, in their order.
    """
    count = jax.tree.leaves(arguments)[0].shape[0] // devices
    rounds = -(-count * edges // _EDGES)
    if rounds <= 1 or count == 1:
        return jax.vmap(function)(*arguments)
    chunk = -(-count // min(rounds, count))
    rounds = -(-count // chunk)
    # The last chunk is filled up with its last item.
    filled = np.minimum(np.arange(rounds * chunk), count - 1)

    def split(leaf: Array) -> Array:
        leaf = leaf.reshape(devices, count, *leaf.shape[1:])
        leaf = leaf if len(filled) == count else leaf[:, filled]
        leaf = leaf.reshape(devices, rounds, chunk, *leaf.shape[2:]).swapaxes(0, 1)
        return leaf.reshape(rounds, devices * chunk, *leaf.shape[3:])

    def joined(leaf: Array) -> Array:
        leaf = leaf.reshape(rounds, devices, chunk, *leaf.shape[2:]).swapaxes(0, 1)
        leaf = leaf.reshape(devices, rounds * chunk, *leaf.shape[3:])[:, :count]
        return leaf.reshape(devices * count, *leaf.shape[2:])

    each = jax.checkpoint(lambda chunk: jax.vmap(function)(*chunk))
    return jax.tree.map(joined, jax.lax.map(each, jax.tree.map(split, arguments)))


def map_steps(
    function: Callable[..., _Result], *arguments: PyTree, edges: int, devices: int = 1
) -> _Result:
    """`chunked_vmap` over all steps of all windows: arguments and results are [B, L, ...]."""
    batch, length = jax.tree.leaves(arguments)[0].shape[:2]
    flat = jax.tree.map(lambda leaf: leaf.reshape(batch * length, *leaf.shape[2:]), arguments)
    results = chunked_vmap(function, *flat, edges=edges, devices=devices)
    return jax.tree.map(lambda leaf: leaf.reshape(batch, length, *leaf.shape[1:]), results)


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
    windows: TrajectoryBatch[Array],
    nearest: Float[Array, ""] | float,
    farthest: Float[Array, ""] | float,
    key: PRNGKeyArray,
) -> TrajectoryBatch[Array]:
    """Add a resting node without actuation to every window of a batch, out of contact.

    Trajectories of two bodies show no third body at rest. The model assumes anyway that a body out
    of contact changes nothing (its prior is distance); the added node says so without recording.

    Its distance [m] is `nearest` to `farthest` from some body at some step, and at least `nearest`
    from every body, also between two states. The node is masked out where several tries find no
    such position.
    """
    batch, states, _, dimension = windows.position.shape
    keys = jax.random.split(key, batch)
    place = windows.position
    if windows.nodes.outlines is not None:
        # An outline lies within a circle about its node, which any turn of it keeps.
        place = place[..., : windows.nodes.outlines.shape[-1]]
        wide = 2.0 * jnp.max(jnp.linalg.norm(windows.nodes.outlines, axis=-1), initial=0.0)
        nearest, farthest = nearest + wide, farthest + wide
    drawn, clear = jax.vmap(_distractor_position, (0, 0, 0, None, None))(
        place, windows.nodes.mask, keys, nearest, farthest
    )
    drawn = jnp.pad(drawn, ((0, 0), (0, dimension - drawn.shape[1])))
    position = jnp.broadcast_to(drawn[:, None, None, :], (batch, states, 1, dimension))
    return windows._replace(
        position=jnp.concatenate([windows.position, position], axis=2),
        velocity=jnp.concatenate([windows.velocity, jnp.zeros_like(position)], axis=2),
        nodes=_with_distractor(windows.nodes, clear),
    )


def _with_distractor(nodes: Nodes, exists: Bool[Array, " B"]) -> Nodes:
    """One more node, of the type of the first that is neither actuated nor static."""
    first = jnp.argmax(nodes.passive, axis=1)[:, None]
    # `pair_indices` lists the pairs of a new last node after all others.
    last: dict[str, Array] = {"mask": exists[:, None], "candidate": jnp.ones_like(nodes.mask)}
    for name, field in PROPERTIES.items():
        values = getattr(nodes, name)
        if values is not None and field.axis[0] == "N":
            last[name] = jnp.full_like(values[:, :1], field.padding)
            if name in _OF_TYPE:
                of_first = first.reshape(-1, *(1,) * (values.ndim - 1))
                last[name] = jnp.take_along_axis(values, of_first, axis=1)
    joined = {name: jnp.concatenate([getattr(nodes, name), last[name]], 1) for name in last}
    return nodes._replace(**joined)


def _distractor_position(
    position: Float[Array, "L N D"],
    mask: Bool[Array, " N"],
    key: PRNGKeyArray,
    nearest: Float[Array, ""] | float,
    farthest: Float[Array, ""] | float,
) -> tuple[Float[Array, " D"], Bool[Array, ""]]:
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
