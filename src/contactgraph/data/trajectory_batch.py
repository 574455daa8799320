"""Trajectories of different length and size in arrays of one shape, as a JAX pytree.

Nothing here imports JAX: the fields are NumPy arrays until a caller maps them to JAX arrays.
"""

import zlib
from collections.abc import Iterable
from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import candidate_pairs, pair_indices
from contactgraph.data.outlines import hull_rows
from contactgraph.data.schema import Field, fields_of
from contactgraph.data.trajectory import Scene, Trajectory
from contactgraph.data.turns import coordinate_count, generalized_coordinates

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


PROPERTIES = {
    **{name: field for name, field in fields_of(Scene).items() if name in Nodes._fields},
    "type_id": Field("N", np.int32),
    "half_size": Field("N D", fill=0.0),
    "outlines": Field("N Q V D", fill=0.0),
}
"""The fields of `Nodes` that scenes tell, by name."""


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


def pad_trajectories(
    trajectories: Iterable[Trajectory],
    node_capacity: int | None = None,
    steps: int | None = None,
    contacts: bool = True,
    turn_length: float | None = None,
) -> TrajectoryBatch[np.ndarray]:
    """Pad to ``steps`` (default: the longest) and ``node_capacity`` (default: the most nodes, but
    at least two, as a graph without edges is not supported).

    Contact labels are left out unless ``contacts``. ``turn_length``: see `generalized_coordinates`.
    Raises `InvalidInputError` where a trajectory has more nodes than the capacity.
    """
    trajectories = tuple(trajectories)
    most = max(each.scene.node_count for each in trajectories)
    capacity = max(2, most) if node_capacity is None else node_capacity
    if capacity < most:
        raise InvalidInputError(
            f"node_capacity must be at least {most}, the most nodes of a trajectory, "
            f"found {node_capacity}"
        )
    count, first = len(trajectories), trajectories[0]
    longest = max(each.steps for each in trajectories) if steps is None else steps
    size = coordinate_count(first.scene.dimension, turn_length)
    position = np.zeros((count, longest + 1, capacity, size))
    velocity = np.zeros_like(position)
    control = np.zeros((count, longest, first.control_size))
    edges = capacity * (capacity - 1) // 2
    contact = np.full((count, longest + 1, edges), np.nan) if contacts else None
    for index, each in enumerate(trajectories):
        real = slice(0, each.steps + 1), slice(0, each.scene.node_count)
        moved = generalized_coordinates(
            turn_length, each.position, each.velocity, each.orientation, each.angular_velocity
        )
        _check_turns(each, *moved)
        position[index][real], velocity[index][real] = np.nan_to_num(moved)
        control[index, : each.steps] = each.control
        if contact is not None and each.contact is not None:
            # The edges of fewer nodes are a prefix of those of the capacity: see `pair_indices`.
            pairs = pair_indices(each.scene.node_count)
            labels = each.contact[:, pairs[:, 0], pairs[:, 1]]
            contact[index, : each.steps + 1, : len(pairs)] = labels
    shapes = property_shapes(each.scene for each in trajectories)
    nodes = zip(*(pad_nodes(each.scene, capacity, shapes) for each in trajectories), strict=True)
    return TrajectoryBatch(
        position=position,
        velocity=velocity,
        control=control,
        contact=contact,
        nodes=Nodes._make(None if leaves[0] is None else np.stack(leaves) for leaves in nodes),
        steps=np.array([each.steps for each in trajectories]),
    )


def _check_turns(trajectory: Trajectory, position: np.ndarray, velocity: np.ndarray) -> None:
    """Raises `InvalidInputError` where a body with an outline has no orientation at some step."""
    for name, values in (("orientation", position), ("angular_velocity", velocity)):
        for node in np.flatnonzero(np.isnan(values).any(axis=(0, 2))):
            if trajectory.scene.outlines_of(int(node)):
                step = int(np.flatnonzero(np.isnan(values[:, node]).any(axis=1))[0])
                raise InvalidInputError(
                    f"{name} must be known of bodies with an outline, but that of "
                    f"{trajectory.scene.node_name[node]!r} is not at step {step}"
                )


def type_id(name: str) -> int:
    """A number for the name of a node type, the same in every process; 32 bits, signed."""
    return int(np.uint32(zlib.crc32(name.encode())).view(np.int32))


def node_properties(scene: Scene) -> dict[str, np.ndarray]:
    """The `PROPERTIES` of a scene, without padding."""
    derived = {
        "type_id": np.array([type_id(name) for name in scene.node_type]),
        "outlines": _outlines(scene),
    }
    return {name: getattr(scene, name) for name in PROPERTIES if name not in derived} | derived


def _outlines(scene: Scene) -> np.ndarray:
    """[N, Q, V, …] m: see `Nodes.outlines`."""
    of_node = [scene.outlines_of(node) for node in range(scene.node_count)]
    if scene.dimension == 3:
        of_node = [list(map(hull_rows, each)) for each in of_node]
    every = [rows for each in of_node for rows in each]
    most = max(map(len, of_node), default=0), max(map(len, every), default=0)
    point = (5, 3) if scene.dimension == 3 else (scene.dimension,)
    outlines = np.zeros((len(of_node), *most, *point))
    for node, each in enumerate(of_node):
        for index, rows in enumerate(each):
            outlines[node, index:, : len(rows)] = rows
            outlines[node, index:, len(rows) :] = rows[-1]
    return outlines


def property_shapes(scenes: Iterable[Scene]) -> dict[str, tuple[int, ...]]:
    """The largest shape of each of the `PROPERTIES` that is given in some scene."""
    shapes: dict[str, tuple[int, ...]] = {}
    for scene in scenes:
        for name, value in node_properties(scene).items():
            # All components act on a node that alone is actuated.
            implied = name == "control_of" and scene.actuated.sum() <= 1
            if not PROPERTIES[name].is_absent(value) and not implied:
                shapes[name] = tuple(map(max, value.shape, shapes.get(name, value.shape)))
    return shapes


def pad_nodes(
    scene: Scene, capacity: int, shapes: dict[str, tuple[int, ...]] | None = None
) -> Nodes[np.ndarray]:
    """The nodes of a scene, padded to ``capacity``, with properties of these ``shapes``.

    The shapes are those of `property_shapes`, by default of this scene. Raises `InvalidInputError`
    where the scene has more nodes.
    """
    count = scene.node_count
    if capacity < count:
        raise InvalidInputError(f"node_capacity must be at least {count}, found {capacity}")
    shapes = property_shapes([scene]) if shapes is None else shapes
    own = node_properties(scene)
    if "control_of" in shapes and scene.control_of is None:
        own["control_of"] = np.repeat(scene.actuated[:, None], shapes["control_of"][1], axis=1)
    padded: dict[str, Any] = {}
    for name, shape in shapes.items():
        field = PROPERTIES[name]
        if field.axis[0] == "N":
            shape = (capacity, *shape[1:])
        value = own[name]
        more = [(0, size - least) for size, least in zip(shape, value.shape, strict=True)]
        if "V" in field.axis and value.size:  # Repeated corners and polygons change no outline.
            value = np.pad(value, [(0, 0), *more[1:]], mode="edge")
            more[1:] = [(0, 0)] * len(more[1:])
        padded[name] = np.pad(value.astype(field.kind), more, constant_values=field.padding)
    return Nodes(
        mask=np.arange(capacity) < count, candidate=candidate_pairs(scene, capacity), **padded
    )
