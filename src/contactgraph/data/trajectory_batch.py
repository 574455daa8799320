"""Trajectories of different length and size in arrays of one shape, as a JAX pytree.

Nothing here imports JAX: the fields are NumPy arrays until a caller maps them to JAX arrays.
"""

import zlib
from collections.abc import Iterable
from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np

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
    type_id: Array | None = None
    """[..., N] int32: `type_id` of the node's type. None: not known."""
    static: Array | None = None
    """[..., N] bool: whether a node never moves. None: no node is known to be static."""
    control_of: Array | None = None
    """[..., N, U] bool: the components of the control that act on each node. None: all of them act
    on the one node that is actuated."""
    planes: Array | None = None
    """[..., P, D+1] rows of a unit normal and an offset [m], see `Scene.planes`; the normal of
    padding is 0. None: there are no planes."""
    gravity: Array | None = None
    """[..., D] m/s^2 on bodies that are neither actuated nor static. None: without weight."""
    half_size: Array | None = None
    """[..., N, D] m: half the sides of the box that a node is; 0 for others. None: none is one."""
    reach: Array | None = None
    """[..., N, 2, D] m, see `Scene.reach`; NaN where there is no bound. None: nowhere."""
    outlines: Array | None = None
    """[..., N, P, V, 2] m: convex polygons in the body's frame, counter-clockwise, the last vertex
    and the last polygon repeated; 0 throughout for a body without. None: no body has one. In space
    [..., N, P, V, 5, 3]: the `hull_rows` of convex hulls."""
    log_mass: Array | None = None
    """[..., N] logarithm of the mass in units of that of the body's type. None: 0."""
    pins: Array | None = None
    """[..., P, 2] int: see `Scene.pins`; padding joins node 0 to itself. None: there are none."""
    pin_points: Array | None = None
    """[..., P, 2, D] m: see `Scene.pin_points`. Given with ``pins``."""

    @property
    def mobile(self) -> Any:
        """[..., N] bool: the nodes that exist and may move."""
        mask, static = cast(Any, self.mask), cast(Any, self.static)
        return mask if static is None else mask & ~static

    @property
    def passive(self) -> Any:
        """[..., N] bool: those of them on which no control acts."""
        return self.mobile & ~cast(Any, self.actuated)

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
    """[..., T+1, N, G] m: `generalized_coordinates`, of which the first D are the position."""
    velocity: Array
    """[..., T+1, N, G] m/s."""
    control: Array
    """[..., T, U] N."""
    contact: Array | None
    """[..., T+1, E]: 1 touching, 0 not, NaN not measured or padding. None: left out."""
    nodes: Nodes[Array]
    steps: Array
    """[...] int: number of real steps."""

    def __repr__(self) -> str:
        position, control = (np.shape(cast(Any, each)) for each in (self.position, self.control))
        return f"TrajectoryBatch(position{list(position)}, control{list(control)})"

    @property
    def step_mask(self) -> np.ndarray:
        """[..., T] bool: whether the step from ``t`` to ``t + 1`` is real."""
        count = np.shape(cast(Any, self.control))[-2]
        return np.arange(count) < cast(Any, self.steps)[..., None]

    def at(self, index: Any) -> "TrajectoryBatch[Array]":
        """The trajectory, or trajectories, of an index into the batch axis."""

        def chosen(arrays: Iterable[Any]) -> list[Any]:
            return [None if each is None else each[index] for each in arrays]

        *arrays, nodes, steps = cast(Any, self)
        return TrajectoryBatch._make([*chosen(arrays), Nodes._make(chosen(nodes)), steps[index]])


def type_id(name: str) -> int:
    """A number for the name of a node type, the same in every process; 32 bits, signed."""
    return int(np.uint32(zlib.crc32(name.encode())).view(np.int32))
