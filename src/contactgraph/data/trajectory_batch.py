"""Trajectories of different length and size in arrays of one shape, as a JAX pytree.

Nothing here imports JAX: the fields are NumPy arrays until a caller maps them to JAX arrays.
"""

from collections.abc import Iterable
from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import candidate_pairs, pair_indices
from contactgraph.data.scene import Scene
from contactgraph.data.trajectory import Trajectory

Array = TypeVar("Array")


class Nodes(NamedTuple, Generic[Array]):
    """Properties of ``N`` nodes that stay constant along a trajectory, with leading batch axes."""

    actuated: Array
    """[..., N] bool: whether the control acts on the node itself."""
    mask: Array
    """[..., N] bool: False for padding, which interacts with nothing."""
    candidate: Array
    """[..., E] bool: whether an edge may ever be active; edges in `pair_indices`' order."""
    anchor: Array | None = None
    """[..., N, D] m: hinge position, NaN for a node without one. None: no node has one."""

    @property
    def hinged(self) -> Any:
        """[..., N] bool: whether a node hangs on a hinge."""
        mask, anchor = cast(Any, self.mask), cast(Any, self.anchor)
        return mask & False if anchor is None else anchor[..., 0] == anchor[..., 0]  # NaN differs


class TrajectoryBatch(NamedTuple, Generic[Array]):
    """Trajectories padded to common ``T`` steps and ``N`` nodes, or one without the batch axis.

    Real nodes come first on the node axis and real steps first on the time axis. Padding is zero
    in numbers and False in masks.
    """

    position: Array
    """[..., T+1, N, D] m."""
    velocity: Array
    """[..., T+1, N, D] m/s."""
    control: Array
    """[..., T, U] N."""
    contact: Array | None
    """[..., T+1, E]: 1 touching, 0 not, NaN not measured or padding. None: left out."""
    nodes: Nodes[Array]
    steps: Array
    """[...] int: number of real steps."""

    @property
    def step_mask(self) -> np.ndarray:
        """[..., T] bool: whether the step from ``t`` to ``t + 1`` is real."""
        count = np.shape(cast(Any, self.control))[-2]
        return np.arange(count) < np.asarray(self.steps)[..., None]

    def at(self, index: Any) -> "TrajectoryBatch[Array]":
        """The trajectory, or trajectories, of an index into the batch axis."""

        def chosen(arrays: Iterable[Any]) -> list[Any]:
            return [None if each is None else each[index] for each in arrays]

        *arrays, nodes, steps = cast(Any, self)
        return TrajectoryBatch._make([*chosen(arrays), Nodes._make(chosen(nodes)), steps[index]])


def pad_trajectories(
    trajectories: Iterable[Trajectory],
    node_capacity: int | None = None,
    steps: int | None = None,
    contacts: bool = True,
) -> TrajectoryBatch[np.ndarray]:
    """Pad to ``steps`` (default: the longest) and ``node_capacity`` (default: the most nodes).

    Contact labels are left out unless ``contacts``. Raises `InvalidInputError` where a trajectory
    has more nodes than the capacity.
    """
    trajectories = tuple(trajectories)
    capacity = max(each.scene.node_count for each in trajectories)
    if node_capacity is not None:
        if node_capacity < capacity:
            raise InvalidInputError(
                f"node_capacity must be at least {capacity}, the most nodes of a trajectory, "
                f"found {node_capacity}"
            )
        capacity = node_capacity
    count, first = len(trajectories), trajectories[0]
    longest = max(each.steps for each in trajectories) if steps is None else steps
    position = np.zeros((count, longest + 1, capacity, first.scene.dimension))
    velocity = np.zeros_like(position)
    control = np.zeros((count, longest, first.control_size))
    edges = capacity * (capacity - 1) // 2
    contact = np.full((count, longest + 1, edges), np.nan) if contacts else None
    for index, each in enumerate(trajectories):
        real = slice(0, each.steps + 1), slice(0, each.scene.node_count)
        position[index][real], velocity[index][real] = each.position, each.velocity
        control[index, : each.steps] = each.control
        if contact is not None and each.contact is not None:
            # The edges of fewer nodes are a prefix of those of the capacity: see `pair_indices`.
            pairs = pair_indices(each.scene.node_count)
            labels = each.contact[:, pairs[:, 0], pairs[:, 1]]
            contact[index, : each.steps + 1, : len(pairs)] = labels
    hinged = any(each.scene.has_hinges for each in trajectories)
    nodes = zip(*(pad_nodes(each.scene, capacity, hinged) for each in trajectories), strict=True)
    return TrajectoryBatch(
        position=position,
        velocity=velocity,
        control=control,
        contact=contact,
        nodes=Nodes._make(None if leaves[0] is None else np.stack(leaves) for leaves in nodes),
        steps=np.array([each.steps for each in trajectories]),
    )


def pad_nodes(scene: Scene, capacity: int, hinged: bool | None = None) -> Nodes[np.ndarray]:
    """The nodes of a scene, padded to ``capacity``, with anchors if ``hinged`` (default: if any).

    Raises `InvalidInputError` where the scene has more nodes.
    """
    count = scene.node_count
    if capacity < count:
        raise InvalidInputError(f"node_capacity must be at least {count}, found {capacity}")
    actuated = np.zeros(capacity, dtype=bool)
    actuated[:count] = scene.actuated
    anchor = np.full((capacity, scene.dimension), np.nan)
    if scene.anchor is not None:
        anchor[:count] = scene.anchor
    return Nodes(
        actuated=actuated,
        mask=np.arange(capacity) < count,
        candidate=candidate_pairs(scene, capacity),
        anchor=anchor if (scene.has_hinges if hinged is None else hinged) else None,
    )
